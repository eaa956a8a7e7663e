"""Writes tables and forest plots of the paper's experiment from the committed curves: `python docs/make_results_figures.py`.

A table's place in the page is between `<!-- NAME: docs/make_results_figures.py -->` and `<!-- end of NAME -->`. The curves are
from bench/paper.py (docs/paper/TASK_curves.csv), and from 2026-11-22 (docs/paper_TASK_curves.csv).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import paper_forest
import paper_set
from paper_analysis import (
    DOCS,
    FIRST,
    LAST,
    MARGIN,
    NAMES,
    START,
    STEPS,
    THRESHOLDS,
    Difference,
    Sweeps,
    area,
    difference,
    gain,
    load,
    number,
    of,
    reach,
    signed,
    sooner,
    table,
    window,
    with_tables,
)
from scipy.stats import t

from mjx_dher import stats

SCRIPT = "docs/make_results_figures.py"
# The tables of each page.
PAGES = {
    DOCS / "results.md": ("verdicts", "lottery", "own_samplers", "samplers", "field"),
    DOCS / "experiments" / "paper_set.md": ("power", "set", "k", "kernels"),
    DOCS / "experiments" / "paper_repeats.md": ("repeats", "robustness"),
}


OWN_CYCLES, LONG_CYCLES = "50 an epoch", "1 an epoch"


def verdicts(the_set: Mapping[str, Sweeps]) -> str:
    """Table of the paper's claims, with the paper's cycles or, if these have not been run, with longer ones."""
    push, pick = the_set["push"], the_set["pick_and_place"]
    found = paper_set.compared(the_set)
    claim = {result.comparison.task: result for result in found["the paper's own cycles"]}
    behind = {result.comparison.setting: result for result in found["methods 1 and 2, own cycles"]}
    methods = gain(push, "own_methods", "epsilon_closest", "closest")
    own = [
        ["Push: `weighted` converges sooner than `future`", *_sooner(claim["push"])],
        ["... starts two to three epochs sooner (0.20)", *_epochs(sooner(push, paper_set.OWN["push"], START), 2)],
        ["... is there about five epochs sooner (0.90)", *_epochs(sooner(push, paper_set.OWN["push"], 0.9), 5)],
        ["Push: `epsilon_closest` is behind `future`", *_success(behind["epsilon_closest"].difference, -1)],
        ["Push: `closest` is behind `epsilon_closest`", *_success(methods)],
        ["PickAndPlace: `weighted` converges sooner than `future`", *_sooner(claim["pick_and_place"])],
        ["... starts two to three epochs sooner (0.20)", *_epochs(sooner(pick, paper_set.OWN["pick_and_place"], START), 2)],
        ["... is there about ten epochs sooner (0.90)", *_epochs(sooner(pick, paper_set.OWN["pick_and_place"], 0.9), 10)],
    ]
    for task in ("push", "pick_and_place"):
        early, late = (window(the_set[task], paper_set.OWN[task], part) for part in (slice(FIRST), slice(-LAST[task], None)))
        own.append([f"{NAMES[task]}: epochs 1 to {FIRST} are alike", *_alike(early)])
        own.append([f"{NAMES[task]}: in the last {LAST[task]} epochs `weighted` is at least as good", *_no_worse(late)])
    slide = next(result for result in found["the paper's claim"] if result.comparison.task == "slide")
    late = window(the_set["slide"], "slide", slice(-LAST["slide"], None))
    long = [
        ["Slide: no noticeable difference", *_alike(slide.difference)],
        [f"Slide: in the last {LAST['slide']} epochs `weighted` is at least as good", *_no_worse(late)],
    ]
    for result in found["k 16 against 8"]:
        long.append([f"{NAMES[result.comparison.task]}: k 16 is worse than k 8", *_success(result.difference, -1, result.p)])
    rows = [[*row[:1], cycles, *row[1:]] for cycles, part in ((OWN_CYCLES, own), (LONG_CYCLES, long)) for row in part]
    return table("the paper says | cycles | our estimate | 95 % interval | p | verdict", rows)


def _sooner(result: paper_set.Compared) -> list[str]:
    """Cells of a claim that a setting learns sooner: alike, if its interval lies within the margin."""
    d = result.difference
    cells = _success(d, p=result.p)
    return [*cells[:-1], "**no**: alike"] if d.low > -MARGIN and d.high < MARGIN else cells


def lottery(the_set: Mapping[str, Sweeps]) -> str:
    """Table of single pairs of seeds: the number of pairs that show the gain in the paper."""
    rows = []
    for task, claimed in (("push", 5), ("pick_and_place", 10)):
        weighted, future = (reach(the_set[task][paper_set.OWN[task], name], 0.9) for name in ("weighted", "future"))
        same = (future[:, None] - future)[~np.eye(len(future), dtype=bool)]
        counts = [f"{np.sum(gains >= claimed)} of {gains.size}" for gains in (future[:, None] - weighted, same)]
        rows.append([NAMES[task], str(claimed), *counts])
    return table("task | epochs sooner | `weighted` against `future` | `future` against `future`, another seed", rows)


def _success(d: Difference, sign: int = 1, p: float | None = None) -> list[str]:
    """Cells of a claim that success is larger, or smaller if `sign` is -1.

    `p` is corrected over the claim's family; None for a claim without a family.
    """
    low, high = sorted((sign * d.low, sign * d.high))
    verdict = "**yes**" if low > 0 else "**no**, the opposite" if high < 0 else "not shown"
    if p is not None and not p < 0.05:
        verdict = "not shown"
    mean, interval, p = signed(d)
    return [f"mean success {mean}", interval, p, verdict]


def _epochs(d: Difference, claimed: float) -> list[str]:
    """Cells of a claim that at least `claimed` epochs are saved."""
    left = f"**no**: {claimed:g} are outside the interval" if d.high < claimed else "not shown" if d.low <= 0 else "**yes**"
    mean, interval, p = signed(d, 1)
    return [f"{mean} epochs sooner", interval, p, left]


def _alike(d: Difference) -> list[str]:
    within = abs(d.low) < MARGIN and abs(d.high) < MARGIN
    verdict = (
        "**yes**"
        if within
        else "not shown: up to 0.02 would be"
        if d.low <= 0 <= d.high
        else "**no**: a small one, for `weighted`"
        if d.low > 0
        else "**no**: a small one, against `weighted`"
    )
    mean, interval, p = signed(d)
    return [f"mean success {mean}", interval, p, verdict]


def _no_worse(d: Difference) -> list[str]:
    mean, interval, p = signed(d)
    verdict = "**yes**, to within 0.02" if d.low > -MARGIN else "**no**" if d.high < 0 and d.p < 0.05 else "not shown"
    return [f"mean success {mean}", interval, p, verdict]


def samplers(data: Mapping[str, Sweeps]) -> str:
    """Table of the samplers, on all tasks."""
    order = ("future", "weighted", "episode", "epsilon_closest", "closest", "random")
    rows = []
    for task, sweeps in data.items():
        names = [name for name in order if ("samplers", name) in sweeps]
        compared = {name: gain(sweeps, "samplers", name, "future") for name in names[1:]}
        corrected = dict(zip(compared, stats.holm([d.p for d in compared.values()])))
        for name in names:
            curves, last = sweeps["samplers", name], LAST[task]
            epochs, base = reach(curves, THRESHOLDS[task]), area(sweeps["samplers", "future"])
            better = "" if name == "future" else f"{stats.probability_of_improvement(area(curves), base):.2f}"
            cells = [of(curves.success[:, -last:].mean(axis=1)), of(area(curves)), of(epochs, 0, np.median)]
            there = f"{np.isfinite(epochs).sum()} of {len(epochs)}"
            p = number(corrected[name]) if name in corrected else ""
            rows.append([NAMES[task] if name == "future" else "", f"`{name}`", *cells, there, better, p])
    head = "task | sampler | late success, IQM | mean success, IQM | epochs to 0.90 (Slide: 0.60), median | seeds there"
    return table(f"{head} | P(better than `future`) | p, corrected", rows)


def ks(the_set: Mapping[str, Sweeps]) -> str:
    """Table of hindsight goals."""
    rows = []
    for task, curves in paper_set.ks(the_set).items():
        for k, own in curves.items():
            against = signed(difference(area(own), area(curves[4]))) if k != 4 else ["", "", ""]
            epochs = of(reach(own, THRESHOLDS[task]), 0, np.median)
            rows.append([NAMES[task] if k == 1 else "", str(k), of(area(own)), *against, epochs])
    head = "task | k | mean success, IQM | against k 4 | 95 % interval | p"
    return table(f"{head} | epochs to 0.90 (Slide: 0.60), median", rows)


def kernels(data: Mapping[str, Sweeps]) -> str:
    """Table of kernels and temperatures."""
    push, rows, default = data["push"], [], "weighted, linear, temperature 1"
    for kernel in ("linear", "inverse", "softmax"):
        for temperature in ("0.25", "1", "4"):
            name = f"weighted, {kernel}, temperature {temperature}"
            against = ["", "", ""] if name == default else signed(gain(push, "kernels", name, default))
            rows.append([f"`{kernel}`", temperature, of(area(push["kernels", name])), *against])
    return table("kernel | temperature | mean success, IQM | against `linear` at 1 | 95 % interval | p", rows)


def repeats(data: Mapping[str, Sweeps]) -> str:
    """Table of `weighted` against `future` in every sweep that has both, and their random-effects mean by task."""
    rows = []
    for task, sweeps in data.items():
        names = list(dict.fromkeys(sweep for sweep, setting in sweeps if setting == "weighted" and (sweep, "future") in sweeps))
        gains = [gain(sweeps, sweep, "weighted", "future") for sweep in names]
        for sweep, success in zip(names, gains):
            epochs = sooner(sweeps, sweep, THRESHOLDS[task])
            length = str(sweeps[sweep, "future"].success.shape[1])
            rows.append([NAMES[task] if sweep == names[0] else "", sweep, length, *signed(success), *signed(epochs, 1)[:2]])
        mean, low, high = pooled(gains)
        rows.append(["", "**all of them**", "", f"{mean:+.3f}", f"{low:+.3f} to {high:+.3f}", "", "", ""])
    return table(
        "task | sweep | epochs | mean success, `weighted` less `future` | 95 % interval | p | epochs sooner | 95 % interval",
        rows,
    )


def pooled(differences: Sequence[Difference]) -> tuple[float, float, float]:
    """Random-effects mean of the differences, and its 95 % interval.

    Source: DerSimonian & Laird (1986) for the spread between sweeps, Hartung & Knapp (2001) for the interval.
    """
    means = np.array([d.mean for d in differences])
    within = np.array([d.each.var(ddof=1) / len(d.each) for d in differences])
    weights = 1 / within
    fixed = np.average(means, weights=weights)
    excess = float(weights @ (means - fixed) ** 2) - (len(means) - 1)
    between = max(0.0, excess / (weights.sum() - (weights**2).sum() / weights.sum()))
    weights = 1 / (within + between)
    mean = float(np.average(means, weights=weights))
    variance = float(weights @ (means - mean) ** 2) / ((len(means) - 1) * weights.sum())
    half = float(t.ppf(0.975, len(means) - 1)) * math.sqrt(variance)
    return mean, mean - half, mean + half


CHANGES = (  # what, task, the sweep, and the one that it is compared with
    ("the paper's cycles: 16 episodes, 40 updates", "push", "the paper's own cycles", "samplers"),
    ("cycles 2.5 times as long", "push", "long cycles", "samplers"),
    ("bfloat16", "push", "bfloat16", "samplers"),
    ("bfloat16, long cycles", "push", "bfloat16 and long cycles", "long cycles"),
    ("`fast`: bfloat16, a cycle an epoch", "push", "fast", "samplers"),
    ("... PickAndPlace", "pick_and_place", "fast", "samplers"),
    ("... Slide, from cycles half as long", "slide", "fast", "samplers"),
    ("`hopper`: from `fast`, the learner's kernels", "push", "hopper", "fast"),
    ("... again", "push", "hopper again", "fast"),
    ("... PickAndPlace", "pick_and_place", "hopper", "fast"),
    ("... Slide", "slide", "hopper", "fast"),
)


def robustness(data: Mapping[str, Sweeps]) -> str:
    """Table of the changes that made sweeps faster."""
    rows = []
    for what, task, sweep, before in CHANGES:
        settings = [name for own, name in data[task] if own == sweep and (before, name) in data[task]]
        for setting in sorted(settings, key=("future", "weighted", "epsilon_closest", "closest").index):
            new, old = data[task][sweep, setting], data[task][before, setting]
            epochs = min(new.success.shape[1], old.success.shape[1])
            d = difference(area(new, epochs), area(old, epochs))
            told = f"{area(old, epochs).mean():.3f}, then {area(new, epochs).mean():.3f}"
            rows.append([what if setting == "future" else "", str(epochs), f"`{setting}`", told, *signed(d)])
    return table("change | epochs | sampler | mean success | difference | 95 % interval | p", rows)


PUBLISHED = (  # million steps to a success rate, as read off a published curve (to 3 points of success), and its end
    ("DDPG and HER, PyTorch and MPI (a), 5 seeds, median", "0.64", "0.99", "2.6", "0.93", "2.4", "0.72"),
    ("TQC and HER (b), one run", "", "1.00 after 1.0", "", "1.00 after 1.0", "", "0.80 after 2.5"),
)


def field(data: Mapping[str, Sweeps]) -> str:
    """Table of published curves and ours, in environment steps."""
    rows = [list(row) for row in PUBLISHED]
    for name in ("future", "weighted"):
        cells = []
        for task, sweeps in data.items():
            curves = sweeps["samplers", name]
            steps = float(np.median(reach(curves, THRESHOLDS[task]))) * STEPS[task] / 1e6
            cells += [f"{steps:.2f}", f"{np.median(curves.success[:, -LAST[task] :].mean(axis=1)):.2f}"]
        rows.append([f"ours, `{name}`, 10 seeds, median", *cells])
    return table("who | Push: to 0.90 | at the end | PickAndPlace: to 0.90 | at the end | Slide: to 0.60 | at the end", rows)


OWN, TODAY = "the paper's cycles, 20 seeds", "today's preset"  # names of the set's sweeps among those of 2026-11-22


def own_samplers(the_set: Mapping[str, Sweeps]) -> str:
    """Table of the samplers with the paper's own cycles."""
    names = {"own_methods", *paper_set.OWN.values()}
    own = {t: {("samplers", n): c for (w, n), c in s.items() if w in names} for t, s in the_set.items()}
    return samplers({task: sweeps for task, sweeps in own.items() if sweeps})


OF_TODAY: dict[str, Callable[[Mapping[str, Sweeps]], str]] = {"samplers": samplers, "field": field}
OF_BEFORE: dict[str, Callable[[Mapping[str, Sweeps]], str]] = {"kernels": kernels, "robustness": robustness}


def blocks(the_set: Mapping[str, Sweeps], before: Mapping[str, Sweeps]) -> dict[str, str]:
    """All tables by name, from the curves of the set and of 2026-11-22."""
    today = paper_set.current(the_set)
    found = {name: make(today) for name, make in OF_TODAY.items()} | {name: make(before) for name, make in OF_BEFORE.items()}
    found |= {"verdicts": verdicts(the_set), "lottery": lottery(the_set), "own_samplers": own_samplers(the_set)}
    found |= {"k": ks(the_set), "repeats": repeats(with_repeats(the_set, before))}
    return found | paper_set.blocks(the_set, before)


def with_repeats(the_set: Mapping[str, Sweeps], before: Mapping[str, Sweeps]) -> dict[str, Sweeps]:
    """Sweeps with `weighted` and `future` by task: with the paper's cycles, the set's longer ones, and earlier ones."""
    today = paper_set.current(the_set)
    found = {}
    for task, sweeps in before.items():
        own = {(OWN, name): curves for (sweep, name), curves in the_set[task].items() if sweep == paper_set.OWN[task]}
        found[task] = own | {(TODAY, name): curves for (_, name), curves in today[task].items()} | dict(sweeps)
    return found


def main() -> None:
    """Writes tables and pictures."""
    the_set, before = paper_set.load_set(paper_set.FOLDER), load()
    tables = blocks(the_set, before)
    for page, names in PAGES.items():
        page.write_text(with_tables(page.read_text(), SCRIPT, {name: tables[name] for name in names}))
    paper_forest.draw(with_repeats(the_set, before), DOCS / "images" / "paper_forest.png", (OWN, TODAY))
    paper_forest.draw_set(paper_set.compared(the_set), DOCS / "images" / "set_forest.png")


if __name__ == "__main__":
    main()
