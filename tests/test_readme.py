import re
import runpy

from conftest import ROOT

README = (ROOT / "README.md").read_text()


def test_the_components_example_runs(capsys):
    (example,) = [block for block in re.findall(r"```python\n(.*?)```", README, re.S) if "relabel" in block]
    assert len(example.strip().splitlines()) <= 16
    exec(compile(example, "README.md", "exec"), {})
    assert capsys.readouterr().out.startswith("(256, 25) (256, 3) -")


def test_files_that_the_documents_name_are_there():
    for document in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "bench" / "README.md"]:
        for link in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
            assert (document.parent / link).exists(), f"{document.name} links to {link}"


def test_the_two_commands_are_what_ci_installs_and_runs():
    assert "python train.py --env push --sampler weighted\n" in README
    ci = (ROOT / ".ci" / "run").read_text()
    assert 'pip install -e ".[test]" && pytest\n' in README
    assert '-e ".[test]"' in ci
    assert ci.rstrip().endswith("\npytest")


def test_the_picture_of_the_design_is_what_its_script_draws():
    figure = runpy.run_path(str(ROOT / "docs" / "make_design_figure.py"))["make"]()
    assert figure == (ROOT / "docs" / "images" / "design.svg").read_text()
