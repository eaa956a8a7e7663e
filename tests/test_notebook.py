"""docs/notebook.ipynb: its outputs are of a run, and it runs."""

import json
import re

import pytest
from conftest import ROOT

NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
CELLS = json.loads(NOTEBOOK.read_text())["cells"]
CODE = [cell for cell in CELLS if cell["cell_type"] == "code"]


def texts(cells):
    return "".join("".join(output["text"]) for cell in cells for output in cell["outputs"] if output["output_type"] == "stream")


def pictures(cells):
    return sum("image/png" in output.get("data", {}) for cell in cells for output in cell["outputs"])


def test_it_is_kept_as_it_ran_from_the_first_cell_to_the_last():
    assert [cell["execution_count"] for cell in CODE] == list(range(1, len(CODE) + 1))
    assert not [output for cell in CODE for output in cell["outputs"] if output["output_type"] == "error"]
    assert pictures(CODE) == 3
    assert not re.search(r"/(home|tmp|root|work)/", NOTEBOOK.read_text())


def test_its_files_are_there():
    for cell in CELLS:
        for link in re.findall(r"\]\(([\w./]+)\)", "".join(cell["source"])):
            assert (NOTEBOOK.parent / link).exists(), link


@pytest.mark.slow  # two minutes on two cores
def test_it_runs_and_its_policy_reaches():
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(NOTEBOOK, 4)
    client = NotebookClient(notebook, timeout=1800, kernel_name="python3", resources={"metadata": {"path": str(ROOT)}})
    client.execute()
    code = [cell for cell in notebook.cells if cell["cell_type"] == "code"]
    printed = texts(code)
    assert float(re.search(r"success ([\d.]+) in 500 fresh episodes", printed)[1]) >= 0.95
    assert float(re.search(r"'success_rate': ([\d.]+)", printed)[1]) >= 0.95
    assert float(re.search(r"actions within (\S+) of the policy's", printed)[1]) <= 1e-5
    assert len(re.findall(r"mean success over the run ([\d.]+)", printed)) == 2
    assert pictures(code) == 3
