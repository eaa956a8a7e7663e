import dataclasses
import json
import os
import re
import subprocess
import sys

import numpy as np
import onnx
import pytest
from conftest import ROOT, names, refuses, save_policy
from onnx.reference import ReferenceEvaluator
from safetensors import safe_open
from safetensors.numpy import load_file

import mjx_dher
from mjx_dher import RunSpec, cli, contract, envs
from mjx_dher.policy import Policy
from mjx_dher.runs.folder import reading, run_folder
from mjx_dher.tools import export

D, G, A = 7, 3, 4
FORMATS = ("onnx", "safetensors")


def save_run(path, policy):
    """A run folder that holds `policy`."""
    run_folder.write_config(path, RunSpec(env="slide", sampler="weighted", seed=3), "native", {})
    save_policy(path, policy)
    return path


def random_policy():
    """A policy whose every clip matters: of values from -1.5 to 1.5, and normalized from -2 to 2."""
    rng = np.random.default_rng(1)
    normal = lambda std, size: rng.normal(0, std, size).astype(np.float32)  # noqa: E731
    return Policy(
        layers=tuple((normal(0.4, shape), normal(0.3, shape[1])) for shape in [(D + G, 16), (16, 8), (8, A)]),
        observation_mean=normal(0.5, D),
        observation_std=rng.uniform(0.1, 2, D).astype(np.float32),
        goal_mean=normal(0.5, G),
        goal_std=rng.uniform(0.1, 2, G).astype(np.float32),
        norm_clip=2.0,
        obs_clip=1.5,
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with both files, as the command writes them."""
    path = save_run(tmp_path_factory.mktemp("export") / "run", random_policy())
    for name in FORMATS:
        assert cli.main(["export", str(path), "--format", name]) == 0
    return path


def onnx_actions(path, observation, goal):
    model = onnx.load(str(path))
    (action,) = ReferenceEvaluator(model).run(["action"], {"observation": observation, "desired_goal": goal})
    return action


def safetensors_actions(path, observation, goal):
    """By the lines in docs/policies.md."""
    (example,) = [block for block in python_of_the_document() if "safetensors" in block]
    scope = {"observation": observation, "desired_goal": goal}
    exec(example.replace("policy.safetensors", str(path)), scope)
    return scope["action"]


ACTIONS = {"onnx": onnx_actions, "safetensors": safetensors_actions}


def python_of_the_document():
    return re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "policies.md").read_text(), re.S)


@pytest.mark.parametrize("name", FORMATS)
def test_the_file_acts_as_the_policy_does(run, name):
    policy = mjx_dher.load_policy(run)
    rng = np.random.default_rng(0)
    spread = 10 ** rng.uniform(-1, 2, (1000, 1))
    observation, goal = ((spread * rng.normal(size=(1000, size))).astype(np.float32) for size in (D, G))
    expected = policy({"observation": observation, "desired_goal": goal})
    assert (np.abs(observation) > 1.5).mean() > 0.3
    assert expected.std(axis=0).min() > 0.1
    actions = ACTIONS[name](run / f"policy.{name}", observation, goal)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)
    one = ACTIONS[name](run / f"policy.{name}", observation[:1], goal[:1])
    np.testing.assert_allclose(one, expected[:1], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", FORMATS)
def test_an_action_by_hand(tmp_path, name):
    """Observation 10 -> 2 -> (2 - 0.5) / 0.5 = 3 -> 2.5, goal -0.25 -> -0.5; 2 * 2.5 + 4 * -0.5 = 3, and -3 -> 0."""
    numbers = lambda *values: np.array(values, np.float32)  # noqa: E731
    policy = Policy(
        layers=((numbers([2, -2], [4, -4]), numbers(0, 0)), (numbers([0.1], [1000]), numbers(-0.2))),
        observation_mean=numbers(0.5),
        observation_std=numbers(0.5),
        goal_mean=numbers(0),
        goal_std=numbers(0.5),
        norm_clip=2.5,
        obs_clip=2.0,
    )
    path = save_run(tmp_path / "run", policy)
    assert cli.main(["export", str(path), "--format", name, "--out", str(tmp_path / f"mine.{name}")]) == 0
    action = ACTIONS[name](tmp_path / f"mine.{name}", numbers([10]), numbers([-0.25]))
    np.testing.assert_allclose(action, [[np.tanh(0.1 * 3 - 0.2)]], rtol=1e-6)


ABOUT = {
    "format": "mjx-dher policy",
    "format_version": "1",
    "mjx_dher": mjx_dher.__version__,
    "env": "slide",
    "env_kwargs": "",
    "sampler": "weighted",
    "seed": "3",
    "observation_size": "7",
    "goal_size": "3",
    "action_size": "4",
    "layers": "3",
    "norm_clip": "2.0",
    "obs_clip": "1.5",
}


def test_a_file_says_which_methods_of_its_task_are_own():
    policy = dataclasses.replace(random_policy(), interface={"own": ["observe"]})
    assert export.metadata(policy, RunSpec(env="slide", sampler="weighted", seed=3)) == ABOUT | {"own": '["observe"]'}


def test_an_unknown_format_is_named_before_its_file(tmp_path):
    with refuses("format must be one of onnx, safetensors; got 'pickle'"):
        export.check("pickle", tmp_path / "policy.onnx", overwrite=False)


def test_an_onnx_file_says_what_it_is(run):
    model = onnx.load(str(run / "policy.onnx"))
    onnx.checker.check_model(model, full_check=True)
    assert [(opset.domain, opset.version) for opset in model.opset_import] == [("", 17)]
    assert model.ir_version == 8  # the first one with opset 17: programs that read it are from 2022 on
    assert (model.producer_name, model.producer_version) == ("mjx-dher", mjx_dher.__version__)
    assert {entry.key: entry.value for entry in model.metadata_props} == ABOUT

    def ends(values):
        types = {value.name: value.type.tensor_type for value in values}
        assert {kind.elem_type for kind in types.values()} == {onnx.TensorProto.FLOAT}
        return {name: [d.dim_param or d.dim_value for d in kind.shape.dim] for name, kind in types.items()}

    assert ends(model.graph.input) == {"observation": ["N", D], "desired_goal": ["N", G]}
    assert ends(model.graph.output) == {"action": ["N", A]}


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_carries_what_a_robot_needs(name, tmp_path):
    """Rate, controls and layout of the task that a run was trained on, and its arguments."""
    env = envs.make("my_arm:Reach", engine="native", obs_noise=0.01)
    started = RunSpec(env="my_arm:Reach", env_kwargs=("obs_noise=0.01",))
    path, out = tmp_path / "run", tmp_path / f"policy.{name}"
    run_folder.write_config(path, started, "native", {})
    save_policy(path, dataclasses.replace(random_policy(), interface=contract.robot_interface(env)))
    assert mjx_dher.load_policy(path / "policy.npz").interface == contract.robot_interface(env)  # without the folder, too
    assert cli.main(["export", str(path), "--format", name, "--out", str(out)]) == 0
    about = export.FORMATS[name][1](out).about
    (control,) = json.loads(about["controls"])
    assert (about["dt"], about["env_kwargs"]) == ("0.04", "obs_noise=0.01")
    assert (control["kind"], control["scale"], control["moves"]) == ("JointDelta", 0.15, [f"j{i}" for i in range(1, 7)])
    assert len(control["low"]) == len(control["high"]) == 6
    assert json.loads(about["layout"])["vel:tip"] == [3, 6]
    assert json.loads(about["joints"])["qpos:j*"] == control["moves"]  # not the free joint of the box, which has no name


def test_a_safetensors_file_holds_the_policy_to_the_bit(run):
    policy, tensors = mjx_dher.load_policy(run), load_file(run / "policy.safetensors")
    expected = {
        "observation_mean": policy.observation_mean,
        "observation_std": policy.observation_std,
        "goal_mean": policy.goal_mean,
        "goal_std": policy.goal_std,
        "obs_clip": np.float32(1.5),
        "norm_clip": np.float32(2.0),
    }
    for i, (kernel, bias) in enumerate(policy.layers):
        expected |= {f"layer{i}_kernel": kernel, f"layer{i}_bias": bias}
    assert tensors.keys() == expected.keys()
    for name, array in expected.items():
        assert (tensors[name].dtype, tensors[name].shape) == (np.float32, array.shape), name
        assert tensors[name].tobytes() == array.tobytes(), name
    assert tensors["layer0_kernel"].shape == (D + G, 16)
    with safe_open(run / "policy.safetensors", "np") as file:
        assert file.metadata() == ABOUT


def test_the_document_loads_a_run_in_python(run):
    (example,) = [block for block in python_of_the_document() if "load_policy(run)" in block]
    scope = {"run": run, "observation": np.ones((5, D)), "desired_goal": np.ones((5, G))}
    exec(example, scope)
    assert scope["action"].shape == (5, A)


def test_the_document_runs_the_graph(run, monkeypatch):
    pytest.importorskip("onnxruntime")
    monkeypatch.chdir(run)
    (example,) = [block for block in python_of_the_document() if "onnxruntime" in block]
    policy = mjx_dher.load_policy(run)
    observation, goal = export.observations(policy, 1000)
    scope = {"observation": observation, "desired_goal": goal}
    exec(example, scope)
    expected = policy({"observation": observation, "desired_goal": goal})
    np.testing.assert_allclose(scope["action"], expected, rtol=0, atol=1e-5)
    assert scope["env"] == "slide"


def test_observations_to_check_with_reach_beyond_the_clips():
    policy = dataclasses.replace(random_policy(), obs_clip=200.0)
    observation, goal = export.observations(policy, 1000)
    assert (observation.shape, goal.shape) == ((1000, D), (1000, G))
    for values, mean, std in (
        (observation, policy.observation_mean, policy.observation_std),
        (goal, policy.goal_mean, policy.goal_std),
    ):
        assert (np.abs(values) > 200).mean() > 0.2
        within = np.abs((values - mean) / std) < 2
        assert 0.2 < within.mean() < 0.6
    huge = dataclasses.replace(policy, obs_clip=1e38)
    assert all(np.isfinite(values).all() for values in export.observations(huge, 100))


def test_a_file_is_replaced_only_if_asked_for(run, tmp_path, capsys):
    out = tmp_path / "policy.onnx"
    out.write_text("mine")
    assert cli.main(["export", str(run), "--format", "onnx", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: out: {out} ")
    assert "--overwrite" in error
    assert out.read_text() == "mine"
    assert cli.main(["export", str(run), "--format", "onnx", "--out", str(out), "--overwrite"]) == 0
    assert out.read_bytes() == (run / "policy.onnx").read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"]
    shown = capsys.readouterr().out
    assert "slide: observation [N, 7], desired_goal [N, 3] -> action [N, 4]; the same actions for 1,000" in shown
    assert shown.endswith(f"wrote {out}\n")


def other_weight(policy):
    (kernel, bias), *others = policy.layers
    return dataclasses.replace(policy, layers=((np.nextafter(kernel, np.float32(9)), bias), *others))


def without_relu(policy, about):
    """The graph with the first ReLU left out: all of its tensors are right."""
    model = onnx.load_model_from_string(export.FORMATS["onnx"][0](policy, about))
    next(node for node in model.graph.node if node.op_type == "Relu").op_type = "Identity"
    return model.SerializeToString()


WRONG = [
    ("onnx", lambda write, policy, about: write(other_weight(policy), about), "layer0_kernel"),
    ("safetensors", lambda write, policy, about: write(other_weight(policy), about), "layer0_kernel"),
    ("onnx", lambda write, policy, about: write(policy, about | {"seed": "4"}), "metadata"),
    ("safetensors", lambda write, policy, about: write(policy, {}), "metadata"),
    ("onnx", lambda write, policy, about: without_relu(policy, about), "actions"),
]


@pytest.mark.parametrize(("name", "spoil", "message"), WRONG)
def test_a_file_that_is_not_the_policy_is_not_kept(run, tmp_path, monkeypatch, name, spoil, message):
    to_bytes, read = export.FORMATS[name]
    out = tmp_path / f"policy.{name}"
    out.write_text("before")
    policy, started = mjx_dher.load_policy(run), reading.read_spec(run)
    spoiled = spoil(to_bytes, policy, export.metadata(policy, started))
    monkeypatch.setitem(export.FORMATS, name, (lambda policy, about: spoiled, read))
    with refuses(message):
        export.write(policy, started, name, out)
    assert out.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == [out.name]


@pytest.mark.parametrize("name", FORMATS)
def test_a_policy_that_is_not_finite_is_not_exported(tmp_path, name, capsys):
    policy = random_policy()
    policy.layers[1][1][0] = np.nan
    path = save_run(tmp_path / "run", policy)
    assert cli.main(["export", str(path), "--format", name]) == 2
    assert "layer1_bias must be finite" in capsys.readouterr().err
    assert {file.name for file in path.iterdir()} == {"config.json", "policy.npz"}


BAD = [
    (["{run}", "--format", "onyx"], ["format", "onyx", "onnx"]),
    (["{run}", "--format", "onnx", "--out", "x.safetensors"], ["out", ".onnx", "x.safetensors"]),
    (["{run}", "--format", "onnx", "--out", "{run}/policy.npz", "--overwrite"], ["out", ".onnx", "policy.npz"]),
    (["{run}", "--format", "onnx", "--out", "nowhere/x.onnx"], ["out", "nowhere"]),
    (["{run}", "--format", "safetensors"], ["out", "policy.safetensors", "--overwrite"]),
    (["docs", "--format", "onnx"], ["docs", "run folder", "config.json"]),
    (["nowhere", "--format", "onnx"], ["nowhere", "run folder"]),
]


def test_bad_arguments_are_refused(run, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    before = {path: path.read_bytes() for path in run.iterdir()}
    for argv, parts in BAD:
        assert cli.main(["export", *(arg.format(run=run) for arg in argv)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        names(error, *parts)
    assert {path: path.read_bytes() for path in run.iterdir()} == before


def test_a_run_without_a_policy_is_refused(tmp_path, capsys):
    path = save_run(tmp_path / "run", random_policy())
    (path / run_folder.POLICY_FILE).unlink()
    assert cli.main(["export", str(path), "--format", "onnx"]) == 2
    assert "policy.npz is missing" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_to_is_told(run, tmp_path):
    """A folder is where the unfinished file would be."""
    (tmp_path / f"policy.onnx.{os.getpid()}.partial").mkdir()
    policy, started = mjx_dher.load_policy(run), reading.read_spec(run)
    with refuses("out", tmp_path / "policy.onnx"):
        export.write(policy, started, "onnx", tmp_path / "policy.onnx")


@pytest.mark.parametrize("name", FORMATS)
def test_the_missing_extra_is_named(run, tmp_path, name, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    assert cli.main(["export", str(run), "--format", name, "--out", str(tmp_path / f"x.{name}")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert all(part in error for part in (f"format {name}", '"export"', ".[export]"))


def test_exporting_loads_neither_jax_nor_mujoco(run, tmp_path):
    code = f"""
import sys
from mjx_dher.cli import main
for name in {FORMATS}:
    assert main(["export", {str(run)!r}, "--format", name, "--out", {str(tmp_path)!r} + "/policy." + name]) == 0
assert not {{"jax", "mujoco"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True)
