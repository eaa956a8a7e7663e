"""Exports a run's policy for other programs, as an ONNX graph or as safetensors (extra `export`).

docs/policies.md describes both files. Neither writing nor reading them needs JAX or MuJoCo.
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_dher import __version__, lookup
from mjx_dher.policy import Policy, from_arrays
from mjx_dher.spec import RunSpec
from mjx_dher.system import files, outputs

FORMAT_VERSION = 1  # version of names, shapes and meanings in both files
OPSET = 17  # ONNX opset; later ones add nothing to this graph, and fewer programs support them
TOLERANCE = 1e-5  # largest allowed difference between actions, because the order of float32 sums may differ
CHECKED = 1000  # number of observations to check a file with


class Contents(NamedTuple):
    """Contents of an exported file after reading it back."""

    act: Callable[[np.ndarray, np.ndarray], np.ndarray]  # (observation [N, D], goal [N, G]) -> actions [N, A]
    about: dict[str, str]  # `metadata`
    arrays: dict[str, np.ndarray]  # `Policy.arrays`, and possibly others


def check(file_format: str, out: Path, overwrite: bool) -> None:
    """Raises ValueError early if `file_format` is unknown, its package is missing, or `out` cannot or must not be written."""
    lookup.check_name("format", file_format, FORMATS)
    outputs.check_file(out, [f".{file_format}"], overwrite)
    lookup.require_extra(f"format {file_format}", file_format, "export")


def metadata(policy: Policy, run: RunSpec) -> dict[str, str]:
    """Metadata of an exported file."""
    observation_size, goal_size, action_size = policy.sizes
    content = {
        "format": "mjx-dher policy",
        "format_version": FORMAT_VERSION,
        "mjx_dher": __version__,
        "env": run.env,
        "env_kwargs": " ".join(run.env_kwargs),
        "sampler": run.sampler,
        "seed": run.seed,
        "observation_size": observation_size,
        "goal_size": goal_size,
        "action_size": action_size,
        "layers": len(policy.layers),
        "norm_clip": policy.norm_clip,
        "obs_clip": policy.obs_clip,
    }
    names = ("dt", "controls", "goal", "layout", "joints", "sensors", "own")
    about = {name: json.dumps(policy.interface[name]) for name in names if name in policy.interface}
    return {**about, **{name: str(value) for name, value in content.items()}}


def write(policy: Policy, run: RunSpec, file_format: str, out: Path) -> float:
    """Writes the policy to `out`, reads it back and compares. If this fails, an existing file stays unchanged.

    Returns the largest difference between actions of the file and of the policy, over CHECKED observations. Raises ValueError
    if `out` cannot be written, or the file differs from the policy.
    """
    to_bytes, read = FORMATS[file_format]
    about = metadata(policy, run)
    try:
        with files.atomic_write(out) as partial:
            partial.write_bytes(to_bytes(policy, about))
            return _compare(policy, about, read(partial))
    except OSError as error:
        raise ValueError(f"out: cannot write {out} ({error})") from error


def _compare(policy: Policy, about: dict[str, str], contents: Contents) -> float:
    """Largest difference between actions. Raises ValueError if the file differs from the policy."""
    if contents.about != about:
        raise ValueError(f"nothing was written: the file's metadata came back as {contents.about}")
    for name, array in policy.arrays().items():
        read = contents.arrays.get(name)
        if read is None or (read.dtype, read.shape, read.tobytes()) != (array.dtype, array.shape, array.tobytes()):
            raise ValueError(f"nothing was written: {name} in the file differs from the policy's")
    observation, goal = observations(policy, CHECKED)
    expected = policy({"observation": observation, "desired_goal": goal})
    difference = float(np.max(np.abs(contents.act(observation, goal) - expected)))
    if not difference <= TOLERANCE:  # true for NaN, too
        raise ValueError(f"nothing was written: the file's actions differ from the policy's by up to {difference:.1e}")
    return difference


def observations(policy: Policy, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Draws observations [number, D] and goals [number, G] to compare actions with. Always the same for a policy.

    Their distances from the mean range from a tenth to thousands of standard deviations. Every fourth has a standard deviation
    of ten times `obs_clip` instead.
    """
    rng = np.random.default_rng(0)
    spread = 10 ** rng.uniform(-1, 3.5, (number, 1))
    far = (np.arange(number) % 4 == 0)[:, None]
    greatest = 1e30  # finite in float32, even divided by a standard deviation

    def draw(mean, std):
        noise = rng.normal(size=(number, len(mean)))
        values = np.where(far, 10 * policy.obs_clip * noise, mean + std * spread * noise)
        return np.clip(values, -greatest, greatest).astype(np.float32)

    return draw(policy.observation_mean, policy.observation_std), draw(policy.goal_mean, policy.goal_std)


def _to_onnx(policy: Policy, about: dict[str, str]) -> bytes:
    from onnx import TensorProto, helper, numpy_helper

    arrays = policy.arrays()
    arrays |= {f"minus_{name}": -arrays[name] for name in ("norm_clip", "obs_clip")}
    ends = {
        name: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
        for name, size in zip(("observation", "desired_goal", "action"), policy.sizes)
    }
    graph = helper.make_graph(
        [helper.make_node(kind, inputs, [output], **options) for kind, inputs, output, options in _operations(policy)],
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


def _operations(policy: Policy) -> Iterator[tuple[str, list[str], str, dict[str, Any]]]:
    """Operations of the graph in order: ONNX operator, inputs, output and attributes."""
    for source, name in (("observation", "observation"), ("desired_goal", "goal")):
        yield "Clip", [source, "minus_obs_clip", "obs_clip"], f"{name}_clipped", {}
        yield "Sub", [f"{name}_clipped", f"{name}_mean"], f"{name}_centred", {}
        yield "Div", [f"{name}_centred", f"{name}_std"], f"{name}_scaled", {}
        yield "Clip", [f"{name}_scaled", "minus_norm_clip", "norm_clip"], f"{name}_normalized", {}
    yield "Concat", ["observation_normalized", "goal_normalized"], "layer0_input", {"axis": 1}
    last = len(policy.layers) - 1
    for i in range(last + 1):
        yield "Gemm", [f"layer{i}_{part}" for part in ("input", "kernel", "bias")], f"layer{i}_output", {}
        activation, output = ("Relu", f"layer{i + 1}_input") if i < last else ("Tanh", "action")
        yield activation, [f"layer{i}_output"], output, {}


def _read_onnx(path: Path) -> Contents:
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
    return Contents(act, {entry.key: entry.value for entry in model.metadata_props}, arrays)


def _to_safetensors(policy: Policy, about: dict[str, str]) -> bytes:
    from safetensors.numpy import save

    return save(policy.arrays(), about)


def _read_safetensors(path: Path) -> Contents:
    from safetensors import safe_open

    with safe_open(path, "np") as file:
        arrays, about = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    return Contents(from_arrays(arrays).forward, about, arrays)


# Writer and reader of each format, which is named after the package that it needs.
FORMATS: dict[str, tuple[Callable[[Policy, dict[str, str]], bytes], Callable[[Path], Contents]]] = {
    "onnx": (_to_onnx, _read_onnx),
    "safetensors": (_to_safetensors, _read_safetensors),
}
