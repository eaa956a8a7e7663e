"""Writes the tables of bench/ablation.py and bench/bakeoff.py into their pages: `python docs/make_comparison_tables.py`.

Tables and forest plots are made from docs/ablation_runs.csv and docs/bakeoff_runs.csv, which the two scripts write into their
sweeps' folders. docs/bakeoff_repeat_runs.csv and docs/bakeoff_third_runs.csv are the bakeoff_runs.csv of the second and the
third sweep. An arm is shown when all of its seeds have been run.
"""

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from paper_analysis import DOCS, NAMES, number, table, with_tables
from paper_set import verdict

sys.path.append(str(DOCS.parent / "bench"))

from ablation import ABLATION
from as_published import EXPERIMENTS as PUBLISHED
from bakeoff_arms import BAKEOFF, Experiment
from bakeoff_report import ALPHA, Row, compare, corrected, forest
from bakeoff_runs import by_arm, load
from crl import CONTRASTIVE
from crl_rewards import REWARDS
from hands import HANDS
from modern_critics import CRITICS
from td_controls import CONTROLS

EXPERIMENTS, IMAGES, SCRIPT = DOCS / "experiments", DOCS / "images", "docs/make_comparison_tables.py"
COLUMNS = (
    "mean success | difference | 95 % interval | p | p, corrected | p, joint flips | the last policy | could be seen | verdict"
)


class Page(NamedTuple):
    """An experiment's page."""

    experiment: Experiment
    page: Path
    data: Path
    name: str  # of its table, and of its pictures
    claims: bool = False  # whether the page has the table of claims, in place of the whole one
    pictures: bool = True
    over_tasks: bool = False  # whether p is corrected over the tasks, too
    seeds: int = 10  # of a complete arm


def repeat(*names: str) -> Experiment:
    """The bake-off of those arms (as in --arms) and the baseline, as a separate family."""
    arms = tuple(arm for arm in BAKEOFF.arms if arm.name in (BAKEOFF.baseline, *names))
    return dataclasses.replace(BAKEOFF, arms=arms, learners=("best",), tasks=("pick_and_place", "slide"))


REPEAT, THIRD = repeat("next_future", "energy", "td_error"), repeat("td_error")
_REPEATS = EXPERIMENTS / "bakeoff_repeats.md"
PAGES = (
    Page(ABLATION, EXPERIMENTS / "ablation.md", DOCS / "ablation_runs.csv", "ablation"),
    Page(CRITICS, EXPERIMENTS / "ablation.md", DOCS / "modern_critics_runs.csv", "modern_critics", pictures=False),
    Page(BAKEOFF, EXPERIMENTS / "bakeoff.md", DOCS / "bakeoff_runs.csv", "bakeoff", claims=True),
    Page(REPEAT, _REPEATS, DOCS / "bakeoff_repeat_runs.csv", "bakeoff_repeat", pictures=False),
    *(
        Page(PUBLISHED[part], EXPERIMENTS / "as_published.md", DOCS / f"as_published_{part}_runs.csv", part, pictures=False)
        for part in ("cher", "next_future", "ebp", "test")
    ),
    Page(CONTRASTIVE, EXPERIMENTS / "crl.md", DOCS / "crl_runs.csv", "crl", pictures=False),
    Page(REWARDS, EXPERIMENTS / "crl_rewards.md", DOCS / "crl_rewards_runs.csv", "crl_rewards", pictures=False),
    Page(CONTROLS, EXPERIMENTS / "td_controls.md", DOCS / "td_controls_runs.csv", "td_controls", pictures=False, seeds=20),
    Page(HANDS, EXPERIMENTS / "preset_hands.md", DOCS / "hands_runs.csv", "hands", pictures=False),
    Page(THIRD, _REPEATS, DOCS / "bakeoff_third_runs.csv", "bakeoff_third", pictures=False, over_tasks=True),
)


def read(page: Page) -> list[Row]:
    """Rows of a file's arms whose seeds are complete, learner by learner and task by task."""
    experiment, runs, found = page.experiment, load(page.data), []
    tests = experiment.tests or (len(experiment.arms) - 1) * (len(experiment.tasks) if page.over_tasks else 1)
    for learner in experiment.learners:
        for task in experiment.tasks:
            scores = by_arm(run for run in runs if (run.learner, run.task) == (learner, task))
            whole = {arm: own for arm, own in scores.items() if len(own.seeds) == page.seeds}
            if experiment.baseline in whole:
                found += compare(learner, task, whole, experiment.arms, tests)
    if experiment.tests:  # over a task's learners
        return [new for task in experiment.tasks for new in corrected([row for row in found if row.task == task], tests)]
    return corrected(found, tests) if page.over_tasks else found


def cells(row: Row) -> list[str]:
    """The cells of an arm, from its name on."""
    start = [f"`{row.arm}`", f"{row.mean_success:.3f}"]
    if math.isnan(row.difference):
        return [*start, "", "", "", "", "", f"{row.final:.3f}", "", ""]
    interval = f"{row.low:+.3f} to {row.high:+.3f}"
    said = verdict(row.low, row.high, row.p_corrected)
    found = [f"{row.difference:+.3f}", interval, number(row.p_value), number(row.p_corrected), number(row.p_joint)]
    return [*start, *found, f"{row.final:.3f}", f"{row.smallest_effect:.2f}", said]


def whole_table(page: Page, rows: Sequence[Row]) -> str:
    """Table of all arms. Learner and task are named in their first row."""
    several, lines, before = len(page.experiment.learners) > 1, [], None
    for row in rows:
        family = (row.learner, row.task)
        names = [NAMES.get(row.task, f"`{row.task}`"), *([f"`{row.learner}`"] if several else [])]
        lines.append([*(names if family != before else [""] * len(names)), *cells(row)])
        before = family
    return table(f"task | {'learner | ' if several else ''}arm | {COLUMNS}", lines)


def claims(rows: Sequence[Row], experiment: Experiment) -> str:
    """Table of each arm's claims and the measured differences, significant ones in bold."""
    lines = []
    for arm in experiment.arms[1:]:
        departs = f"{arm.departs} (runs of commit {arm.former})" if arm.former else arm.departs
        lines.append([f"`{arm.name}`", arm.claim, arm.source, departs, _found(arm.name, rows)])
    return table("arm | claimed | source | departures | found with our form", lines)


def _found(arm: str, rows: Sequence[Row]) -> str:
    by_learner: dict[str, list[str]] = {}
    for row in rows:
        if row.arm == arm:
            mark = "**" if row.p_corrected < ALPHA else ""
            by_learner.setdefault(row.learner, []).append(f"{NAMES[row.task]} {mark}{row.difference:+.3f}{mark}")
    return "; ".join(f"`{learner}`: {', '.join(found)}" for learner, found in by_learner.items())


def blocks(page: Page, rows: Sequence[Row]) -> Mapping[str, str]:
    """Tables of a page, each with its name."""
    return {"claims": claims(rows, page.experiment)} if page.claims else {page.name: whole_table(page, rows)}


def with_table(page: Page, rows: Sequence[Row]) -> str:
    """The page's text with the current tables."""
    return with_tables(page.page.read_text(), SCRIPT, blocks(page, rows))


def main() -> None:
    """Writes the tables and the pictures."""
    for page in PAGES:
        rows = read(page)
        page.page.write_text(with_table(page, rows))
        for task in dict.fromkeys(row.task for row in rows if page.pictures):
            picture = IMAGES / f"{page.name}_{task}.png"
            forest([row for row in rows if row.task == task], picture, page.experiment.baseline)


if __name__ == "__main__":
    main()
