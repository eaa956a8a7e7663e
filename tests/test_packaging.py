import ast
import shutil
import subprocess
import sys
import zipfile

import pytest
from conftest import ROOT

import mjx_dher

# The layers of the algorithm, lowest first: a module imports from the layers below its own only.
LAYERS = [
    {"config", "types", "warp_setup"},
    {"normalizer", "networks", "replay", "samplers", "stats", "memory"},
    {"relabel", "ddpg", "rollout"},
    {"evaluate", "fused"},
    {"trainer", "fused_kernels"},
]


def imports_of(path):
    """The modules of this library that a file imports when it is loaded."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("mjx_dher"):
            inner = node.module.split(".")[1:]
            found |= {inner[0]} if inner else {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize(("layer", "name"), [(i, name) for i, layer in enumerate(LAYERS) for name in sorted(layer)])
def test_modules_depend_downward_only(layer, name):
    allowed = set().union(*LAYERS[:layer])
    assert imports_of(ROOT / "mjx_dher" / f"{name}.py") <= allowed


def test_an_environment_is_a_value_handed_in():
    """Only the command line and the gymnasium views import the environments (the package itself names them, for users)."""
    importers = {path.stem for path in (ROOT / "mjx_dher").glob("*.py") if "envs" in imports_of(path)}
    assert importers == {"cli", "cli_sweep", "gym"}


def test_importing_prints_nothing_and_loads_neither_jax_nor_mujoco():
    code = "import sys, mjx_dher; from mjx_dher import envs, Config; print({'jax', 'mujoco'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert (run.stdout, run.stderr) == ("set()\n", "")


def test_loading_everything_prints_nothing():
    code = (
        "import mjx_dher; [getattr(mjx_dher, n) for n in mjx_dher.__all__];"
        "import mjx_dher.envs.engines.mjx, mjx_dher.envs.engines.native, mjx_dher.cli, mjx_dher.metrics"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert (run.stdout, run.stderr) == ("", "")


def test_public_names_are_there():
    assert all(hasattr(mjx_dher, name) for name in mjx_dher.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        mjx_dher.nonsense  # noqa: B018


def test_the_wheel_holds_the_package_and_nothing_else(tmp_path):
    source = tmp_path / "source"  # building leaves files behind
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(".*", "runs", "build", "dist", "*.egg-info", "__pycache__"))
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, source]
    built = subprocess.run(command, check=False, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"mjx_dher", f"mjx_dher-{mjx_dher.__version__}.dist-info"}
    expected = {f"mjx_dher/{path.relative_to(ROOT / 'mjx_dher')}" for path in (ROOT / "mjx_dher").rglob("*.py")}
    expected |= {f"mjx_dher/envs/{path.relative_to(ROOT / 'envs')}" for path in (ROOT / "envs").rglob("*.py")}
    expected |= {f"mjx_dher/envs/assets/{path.name}" for path in (ROOT / "envs" / "assets").glob("*.xml")}
    expected |= {"mjx_dher/py.typed", "mjx_dher/fused_kernels.cu"}
    assert {name for name in names if name.startswith("mjx_dher/")} == expected
