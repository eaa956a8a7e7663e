"""A run's policy as a file for other programs: an ONNX graph, or its tensors in safetensors (extra `export`).

docs/policies.md describes both files. They need neither JAX nor MuJoCo, here or where they are read.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_dher import __version__, names
from mjx_dher.host import files
from mjx_dher.policy import Policy, from_arrays
from mjx_dher.runs.run_folder import RunConfig

FORMAT_VERSION = 1  # of both files: names, shapes and meanings
OPSET = 17  # of ONNX: later ones have nothing that this graph needs, and fewer programs read them
TOLERANCE = 1e-5  # by which actions may differ from the policy's: float32 sums in another order
CHECKED = 1000  # observations that a file is checked with before it is left on disk


class Found(NamedTuple):
    """What a file that was read again holds."""

    act: Callable[[np.ndarray, np.ndarray], np.ndarray]  # (observation [N, D], goal [N, G]) -> actions [N, A]
    about: dict[str, str]  # `metadata`
    arrays: dict[str, np.ndarray]  # `Policy.arrays`, and possibly others


def check(file_format: str, out: Path, overwrite: bool) -> None:
    """Refuses what cannot be written, before anything slow has happened.

    Raises:
      ValueError: no such format, its package is not installed, or `out` cannot or must not be written.
    """
    names.check_name("format", file_format, FORMATS)
    files.check_file(out, [f".{file_format}"], overwrite)
    try:
        importlib.import_module(file_format)
    except ImportError as error:
        raise ValueError(f'format {file_format} needs the extra "export": pip install -e ".[export]" ({error})') from error


def metadata(policy: Policy, run: RunConfig) -> dict[str, str]:
    """What a file says of itself."""
    observation_size, goal_size, action_size = sizes(policy)
    content = {
        "format": "mjx-dher policy",
        "format_version": FORMAT_VERSION,
        "mjx_dher": __version__,
        "env": run.config.env,
        "sampler": run.config.sampler,
        "seed": run.seed,
        "observation_size": observation_size,
        "goal_size": goal_size,
        "action_size": action_size,
        "layers": len(policy.layers),
        "norm_clip": policy.norm_clip,
        "obs_clip": policy.obs_clip,
    }
    return {name: str(value) for name, value in content.items()}


def sizes(policy: Policy) -> tuple[int, int, int]:
    """D, G and A."""
    return len(policy.observation_mean), len(policy.goal_mean), len(policy.layers[-1][1])


def write(policy: Policy, run: RunConfig, file_format: str, out: Path) -> float:
    """Writes the policy to `out`, reads it again, and compares; only a file that passed takes the place of what was there.

    Args:
      policy: of a run.
      run: what the run was started with.
      file_format: one of FORMATS.
      out: see `check`.

    Returns:
      The largest difference between an action of the file and one of the policy, over CHECKED observations.

    Raises:
      ValueError: `out` cannot be written, or what is read again is not the policy.
    """
    to_bytes, read = FORMATS[file_format]
    about = metadata(policy, run)
    try:
        with files.atomic_write(out) as partial:
            partial.write_bytes(to_bytes(policy, about))
            return _compare(policy, about, read(partial))
    except OSError as error:
        raise ValueError(f"out: cannot write {out} ({error})") from error


def _compare(policy: Policy, about: dict[str, str], found: Found) -> float:
    """The largest difference between actions; raises ValueError where the file is not the policy."""
    if found.about != about:
        raise ValueError(f"nothing was written: the file's metadata came back as {found.about}")
    for name, array in policy.arrays().items():
        read = found.arrays.get(name)
        if read is None or (read.dtype, read.shape, read.tobytes()) != (array.dtype, array.shape, array.tobytes()):
            raise ValueError(f"nothing was written: {name} did not come back as it is in the policy")
    observation, goal = observations(policy, CHECKED)
    expected = policy({"observation": observation, "desired_goal": goal})
    difference = float(np.max(np.abs(found.act(observation, goal) - expected)))
    if not difference <= TOLERANCE:  # nor where it is NaN
        raise ValueError(f"nothing was written: the file's actions differ from the policy's by up to {difference:.1e}")
    return difference


def observations(policy: Policy, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Observations [number, D] and goals [number, G] to compare actions with, always the same for a policy.

    They lie from a tenth of a standard deviation to thousands of it around the mean; every fourth goes on to ten times
    `obs_clip`.
    """
    rng = np.random.default_rng(0)
    spread = 10 ** rng.uniform(-1, 3.5, (number, 1))
    far = (np.arange(number) % 4 == 0)[:, None]
    greatest = 1e30  # finite in float32, also when divided by a standard deviation

    def draw(mean, std):
        noise = rng.normal(size=(number, len(mean)))
        values = np.where(far, 10 * policy.obs_clip * noise, mean + std * spread * noise)
        return np.clip(values, -greatest, greatest).astype(np.float32)

    return draw(policy.observation_mean, policy.observation_std), draw(policy.goal_mean, policy.goal_std)


def _to_onnx(policy: Policy, about: dict[str, str]) -> bytes:
    from onnx import TensorProto, helper, numpy_helper

    arrays = policy.arrays()
    arrays |= {f"minus_{name}": -arrays[name] for name in ("norm_clip", "obs_clip")}
    nodes = []
    for given, name in (("observation", "observation"), ("desired_goal", "goal")):
        nodes += [
            helper.make_node("Clip", [given, "minus_obs_clip", "obs_clip"], [f"{name}_clipped"]),
            helper.make_node("Sub", [f"{name}_clipped", f"{name}_mean"], [f"{name}_centred"]),
            helper.make_node("Div", [f"{name}_centred", f"{name}_std"], [f"{name}_scaled"]),
            helper.make_node("Clip", [f"{name}_scaled", "minus_norm_clip", "norm_clip"], [f"{name}_normalized"]),
        ]
    nodes.append(helper.make_node("Concat", ["observation_normalized", "goal_normalized"], ["layer0_input"], axis=1))
    last = len(policy.layers) - 1
    for i in range(last + 1):
        after, result = ("Relu", f"layer{i + 1}_input") if i < last else ("Tanh", "action")
        nodes += [
            helper.make_node("Gemm", [f"layer{i}_{part}" for part in ("input", "kernel", "bias")], [f"layer{i}_output"]),
            helper.make_node(after, [f"layer{i}_output"], [result]),
        ]
    ends = {
        name: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
        for name, size in zip(("observation", "desired_goal", "action"), sizes(policy))
    }
    graph = helper.make_graph(
        nodes,
        "policy",
        inputs=[ends["observation"], ends["desired_goal"]],
        outputs=[ends["action"]],
        initializer=[numpy_helper.from_array(np.asarray(array), name) for name, array in arrays.items()],
    )
    opsets = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(
        graph,
        opset_imports=opsets,
        ir_version=helper.find_min_ir_version_for(opsets),
        producer_name="mjx-dher",
        producer_version=__version__,
    )
    helper.set_model_props(model, about)
    return model.SerializeToString()


def _read_onnx(path: Path) -> Found:
    import onnx
    from onnx import numpy_helper
    from onnx.reference import ReferenceEvaluator

    model = onnx.load_model_from_string(path.read_bytes())
    onnx.checker.check_model(model, full_check=True)
    evaluator = ReferenceEvaluator(model)

    def act(observation, goal):
        (action,) = evaluator.run(["action"], {"observation": observation, "desired_goal": goal})
        return action

    arrays = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    return Found(act, {entry.key: entry.value for entry in model.metadata_props}, arrays)


def _to_safetensors(policy: Policy, about: dict[str, str]) -> bytes:
    from safetensors.numpy import save

    return save(policy.arrays(), about)


def _read_safetensors(path: Path) -> Found:
    from safetensors import safe_open

    with safe_open(path, "np") as file:
        arrays, about = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    return Found(from_arrays(arrays).forward, about, arrays)


# How each format, which is called as the package that it needs, is written and read again.
FORMATS: dict[str, tuple[Callable[[Policy, dict[str, str]], bytes], Callable[[Path], Found]]] = {
    "onnx": (_to_onnx, _read_onnx),
    "safetensors": (_to_safetensors, _read_safetensors),
}
