"""Writes the table of bench/ablation.py in docs/learners.md, and its pictures: `python docs/make_ablation_table.py`.

They are made from docs/ablation.csv, which `bench/ablation.py` writes as ablation.csv into the folder of its runs.
"""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path

from paper_analysis import DOCS, NAMES, number, table
from paper_set import verdict

sys.path.append(str(DOCS.parent / "bench"))

from bakeoff_report import Row, forest

PAGE, DATA, IMAGES = DOCS / "learners.md", DOCS / "ablation.csv", DOCS / "images"
BEGIN, END = "<!-- ablation: docs/make_ablation_table.py -->\n", "<!-- end of ablation -->"
BASELINE = "preset"
HEAD = "task | arm | mean success | difference | 95 % interval | p | p, corrected | the last policy | could be seen | verdict"
WORDS = ("learner", "task", "arm", "claim", "source")


def read(path: Path) -> list[Row]:
    """Returns the rows of the report."""
    with path.open(newline="") as file:
        return [
            Row(**{name: text if name in WORDS else float(text) for name, text in row.items()}) for row in csv.DictReader(file)
        ]


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
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    lines = [cells(row, first=number == 0 or rows[number - 1].task != row.task) for number, row in enumerate(rows)]
    return f"{before}{BEGIN}{table(HEAD, lines)}\n{END}{after}"


def main() -> None:
    """Writes the table and the pictures."""
    rows = read(DATA)
    PAGE.write_text(with_table(PAGE.read_text(), rows))
    for task in dict.fromkeys(row.task for row in rows):
        forest([row for row in rows if row.task == task], IMAGES / f"ablation_{task}.png", BASELINE)


if __name__ == "__main__":
    main()
