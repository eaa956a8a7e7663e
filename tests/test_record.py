"""The history of speed: lines, what keeps one from being honest, and the page that they make."""

import datetime
import json
import sys

import pytest
from conftest import ROOT, refuses

sys.path.insert(0, str(ROOT / "bench"))
import record

ENTRY = {
    "date": "2026-11-20T10:00:00Z",
    "commit": "0123456789ab",
    "remarks": [],
    "machine": "cpu; some CPU, 2 cores",
    "versions": {"mjx_dher": "0.2.0", "jax": "0.12.0"},
    "setup": {"preset": "cpu"},
    "figures": {
        "env_steps_per_second": 12345.0,
        "updates_per_second": 234.0,
        "cold_start_seconds": 31.25,
        "warm_start_seconds": 6.5,
    },
}
LATER = {**ENTRY, "date": "2026-11-21T10:00:00Z", "remarks": ["machine busy: load 1.00 on 2 cores"], "machine": "other"}


def test_the_page_in_the_repository_is_that_of_its_history():
    assert (ROOT / "bench" / "history.md").read_text() == record.page(record.read(record.HISTORY))


def test_the_page_has_a_row_an_entry_the_newest_first(tmp_path):
    path = tmp_path / "history.jsonl"
    path.write_text(json.dumps(LATER) + "\n" + json.dumps(ENTRY) + "\n")
    entries = record.read(path)
    assert entries == [ENTRY, LATER]
    rows = [line for line in record.page(entries).splitlines() if line.startswith("| 2026")]
    assert rows[0].startswith("| 2026-11-21 | `0123456789ab` | 12,345 | 234 | 31.2 | 6.5 |  |  | other |")
    assert rows[0].endswith("| machine busy: load 1.00 on 2 cores |")
    assert len(rows) == 2
    figure = record.draw(entries)
    assert [axis.get_title() for axis in figure.axes] == [label for label, _ in record.FIGURES.values()]
    line = figure.axes[0].lines[0]
    assert list(line.get_ydata()) == [12345.0]
    assert line.get_xdata()[0] == datetime.datetime.fromisoformat(ENTRY["date"])


BAD_FIGURES = [{**ENTRY["figures"], "updates_per_second": x} for x in (float("nan"), 0, -1, "x", None)]
BAD_ENTRIES = [{**ENTRY, "figures": figures} for figures in ({}, *BAD_FIGURES)]
BAD_ENTRIES += [{name: x for name, x in ENTRY.items() if name != "commit"}, []]


def test_a_line_that_is_no_entry_is_reported_by_number(tmp_path):
    path = tmp_path / "history.jsonl"
    for line in ("", "{", *map(json.dumps, BAD_ENTRIES)):
        path.write_text(json.dumps(ENTRY) + "\n" + line + "\n")
        with refuses(2, error=SystemExit):
            record.read(path)


def test_a_busy_machine_and_changes_are_refused(tmp_path, monkeypatch):
    assert record.remarks_of(0.1, 2, "") == []
    assert record.remarks_of(0.5, 2, "") == ["machine busy: load 0.50 on 2 cores"]
    assert record.remarks_of(0.1, 2, " M file") == ["working tree with changes"]
    monkeypatch.setattr(record, "remarks_of", lambda *args: ["machine busy"])
    monkeypatch.setattr(record, "measure", lambda repeats: (dict.fromkeys(record.FIGURES, 2.0 / 3), {"device": "cpu"}))
    path = tmp_path / "history.jsonl"
    with refuses("machine busy", error=SystemExit):
        record.record(path, 1, anyway=False)
    assert not path.exists()
    for _ in range(2):
        record.record(path, 1, anyway=True)
    first, second = record.read(path)
    assert first["remarks"] == ["machine busy"]
    assert first["figures"] == dict.fromkeys(record.FIGURES, 0.6667)
    assert len(second["commit"]) >= 12


@pytest.mark.parametrize("argv", [["--seeds", "0"], ["--out", "nowhere/curve.csv"]])
def test_a_time_to_success_that_would_be_lost_is_refused_before_it_trains(argv, monkeypatch, capsys):
    import time_to_success

    monkeypatch.setattr(time_to_success, "train", None)
    monkeypatch.setattr(sys, "argv", ["time_to_success.py", *argv])
    with pytest.raises(SystemExit) as ended:
        time_to_success.main()
    assert ended.value.code == 2
    assert argv[0] in capsys.readouterr().err.splitlines()[-1]
