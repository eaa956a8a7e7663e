"""docs/start.md: its Python runs."""

import contextlib
import io
import re

import numpy as np
import pytest
from conftest import ROOT

PAGE = (ROOT / "docs" / "start.md").read_text()


@pytest.mark.slow
def test_the_page_trains_reach(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick, loop = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    names, printed = {}, io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(quick, "start.md", "exec"), names)
        exec(compile(loop, "start.md", "exec"), {})
    epochs, last = printed.getvalue().splitlines()[:-2], printed.getvalue().split()[-4:]
    assert last == ["finished", "1.0", "()", "400"]
    assert [line.split()[:2] for line in epochs] == [["1", "8000"], ["2", "16000"]]
    obs = {"observation": np.zeros(10), "desired_goal": np.zeros(3)}
    assert names["policy"](obs).shape == (4,)
