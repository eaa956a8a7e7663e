import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile

import pytest
import yaml
from conftest import ROOT

import mjx_dher


def test_importing_prints_nothing_and_loads_neither_jax_nor_mujoco():
    code = "import sys, mjx_dher; from mjx_dher import envs, Config; print({'jax', 'mujoco'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert (run.stdout, run.stderr) == ("set()\n", "")


def test_a_run_loads_what_it_uses_and_little_else():
    """`train --env push --learner ddpg` up to its compilation. Until its end, without the curve, it loads no more."""
    code = """
import sys
from mjx_dher import __main__, envs
from mjx_dher.cli.train import parse_train_args
from mjx_dher.runs import driver
spec = parse_train_args(["--env", "push", "--learner", "ddpg"]).spec
driver.program_lib.make_loop(envs.make(spec.env), spec, driver.program_lib.choices_of([spec]))
own = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "mjx_dher"}
lines = sum(len(open(module.__file__).readlines()) for module in own.values())
print(*sorted(own), len(own), lines)
"""
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    *names, modules, lines = printed.splitlines()[-1].split()
    assert int(modules) <= 59, names
    assert int(lines) <= 10_350, names


@pytest.mark.slow
def test_loading_everything_prints_nothing():
    code = (
        "import mjx_dher; [getattr(mjx_dher, n) for n in mjx_dher.__all__];"
        "import mjx_dher.envs.engines.mjx, mjx_dher.envs.engines.native, mjx_dher.cli, mjx_dher.runs.folder.loggers"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert (run.stdout, run.stderr) == ("", "")


def test_public_names_are_there():
    assert all(hasattr(mjx_dher, name) for name in mjx_dher.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        mjx_dher.nonsense  # noqa: B018


def tracked():
    """Every file of this checkout that is to be committed."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("this is no checkout of git's")
    return {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """The sdist of this checkout, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    for name in tracked():  # elsewhere, because building leaves files behind
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / "source" / name)
    (folder / "source" / "mjx_dher" / "envs").symlink_to("../envs")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, folder / "source"]
    built = subprocess.run(command, check=False, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return next(folder.glob("*.tar.gz")), next(folder.glob("*.whl"))


def test_the_sdist_holds_what_the_checkout_holds(distributions):
    with tarfile.open(distributions[0]) as archive:
        files = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    made = {name for name in files if name.startswith("mjx_dher.egg-info/")} | {"PKG-INFO", "setup.cfg"}
    copies = {f"mjx_dher/{name}" for name in tracked() if name.startswith("envs/") and name.endswith((".py", ".xml"))}
    assert files == tracked() | made | copies  # mjx_dher/envs is a link to envs/, and an archive holds what it leads to


def test_the_wheel_holds_the_package_and_nothing_else(distributions):
    _, wheel = distributions
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"mjx_dher", f"mjx_dher-{mjx_dher.__version__}.dist-info"}
    expected = {f"mjx_dher/{path.relative_to(ROOT / 'mjx_dher')}" for path in (ROOT / "mjx_dher").rglob("*.py")}
    expected |= {f"mjx_dher/envs/{path.relative_to(ROOT / 'envs')}" for path in (ROOT / "envs").rglob("*.py")}
    expected |= {
        f"mjx_dher/{path.relative_to(ROOT / 'mjx_dher')}"
        for path in (ROOT / "mjx_dher" / "policy" / "bundled").glob("*/*.*")
        if path.suffix != ".pyc"  # in the checkout once Python has run there, and not in a wheel
    }
    expected |= {f"mjx_dher/{path.relative_to(ROOT)}" for path in (ROOT / "envs" / "assets").rglob("*.xml")}
    expected |= {"mjx_dher/py.typed"}
    assert {name for name in names if name.startswith("mjx_dher/")} == expected


def test_the_wheel_works_away_from_any_checkout(distributions, tmp_path):
    """Its dependencies are those of this environment; .ci/dist has a fresh one."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", tmp_path / "site", distributions[1]]
    subprocess.run(command, check=True, capture_output=True)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}

    def run(*arguments):
        return subprocess.run(arguments, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout

    script = str(tmp_path / "site" / "bin" / "mjx-dher")
    assert run(sys.executable, script, "--version") == f"mjx-dher {mjx_dher.__version__}\n"
    assert run(sys.executable, script, "eval", "--help").startswith("usage: mjx-dher eval ")
    code = """
import mjx_dher.envs.fetch as fetch
from mjx_dher import cli, lookup
print(fetch.__file__)
fetch.Push(engine="native")
cli.main(["list"])
print(lookup.missing_extra("", "", "view"))
"""
    said = run(sys.executable, "-P", "-c", code)
    assert said.startswith(str(tmp_path / "site"))
    assert "  weighted " in said
    assert said.endswith('pip install "mjx-dher[view]"\n')


def test_the_version_is_the_same_everywhere():
    citation, changes = yaml.safe_load((ROOT / "CITATION.cff").read_text()), (ROOT / "CHANGELOG.md").read_text()
    version, date = citation["version"], citation["date-released"]
    assert version == mjx_dher.__version__
    assert re.search(r"\n## (.*)\n", changes)[1] in ("Unreleased", f"{version} ({date})")
    assert f"\n## {version} ({date})\n" in changes
    metadata = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert metadata["authors"] == citation["authors"]
    assert metadata["license"] == citation["license"]
    repository = metadata.get("urls", {}).get("Repository")
    assert repository == citation.get("repository-code")
    assert f'REPOSITORY = \\"{repository or ""}\\"' in (ROOT / "docs" / "notebook.ipynb").read_text()


def test_a_release_uploads_nothing_until_someone_enables_it():
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())["jobs"]
    assert [step["run"] for step in jobs["build"]["steps"] if "run" in step][-1] == "DIST=dist bash .ci/dist"
    uploads = [name for name, job in jobs.items() if "pypi" in str(job)]
    assert uploads == ["publish"]
    assert "vars.PUBLISH == 'true' && startsWith(github.ref, 'refs/tags/v')" in jobs["publish"]["if"]
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
