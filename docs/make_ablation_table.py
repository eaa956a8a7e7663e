"""Writes the table of bench/ablation.py in docs/learners.md, and its pictures: `python docs/make_ablation_table.py`.

They are made from docs/ablation_runs.csv, which `bench/ablation.py` writes into the folder of its sweeps.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

from paper_analysis import DOCS, NAMES, number, table, with_tables
from paper_set import verdict

sys.path.append(str(DOCS.parent / "bench"))

from ablation import ABLATION
from bakeoff_report import Row, compare, forest
from bakeoff_runs import by_arm, load

PAGE, DATA, IMAGES = DOCS / "learners.md", DOCS / "ablation_runs.csv", DOCS / "images"
SCRIPT = "docs/make_ablation_table.py"
HEAD = "task | arm | mean success | difference | 95 % interval | p | p, corrected | the last policy | could be seen | verdict"


def read(path: Path) -> list[Row]:
    """Returns what a file of runs says of each arm, task by task."""
    runs, (learner,) = load(path), ABLATION.learners
    tasks = [task for task in ABLATION.tasks if any(run.task == task for run in runs)]
    scores = {task: by_arm(run for run in runs if run.task == task) for task in tasks}
    return [row for task in tasks for row in compare(learner, task, scores[task], ABLATION.arms)]


def cells(row: Row, first: bool) -> list[str]:
    """Returns the cells of an arm; the task is named in its `first` row only."""
    start = [NAMES[row.task] if first else "", f"`{row.arm}`", f"{row.mean_success:.3f}"]
    if math.isnan(row.difference):
        return [*start, "", "", "", "", f"{row.final:.3f}", "", ""]
    interval = f"{row.low:+.3f} to {row.high:+.3f}"
    said = verdict(row.low, row.high, row.p_corrected)
    found = [f"{row.difference:+.3f}", interval, number(row.p_value), number(row.p_corrected)]
    return [*start, *found, f"{row.final:.3f}", f"{row.smallest_effect:.2f}", said]


def with_table(page: str, rows: list[Row]) -> str:
    """Returns the text of the page with the table as it is now."""
    lines = [cells(row, first=number == 0 or rows[number - 1].task != row.task) for number, row in enumerate(rows)]
    return with_tables(page, SCRIPT, {"ablation": table(HEAD, lines)})


def main() -> None:
    """Writes the table and the pictures."""
    rows = read(DATA)
    PAGE.write_text(with_table(PAGE.read_text(), rows))
    for task in dict.fromkeys(row.task for row in rows):
        forest([row for row in rows if row.task == task], IMAGES / f"ablation_{task}.png", ABLATION.baseline)


if __name__ == "__main__":
    main()
