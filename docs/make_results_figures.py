"""Writes tables and forest plots of the paper's experiment from the committed curves: `python docs/make_results_figures.py`.

A table's place in the page is between `<!-- NAME: docs/make_results_figures.py -->` and `<!-- end of NAME -->`. The curves are
from bench/paper.py (docs/paper/TASK_curves.csv), and from 2026-11-22 (docs/paper_TASK_curves.csv).
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import paper_forest
import paper_set
from paper_analysis import (
    DOCS,
    LAST,
    MARGIN,
    NAMES,
    START,
    THRESHOLDS,
    Difference,
    Sweeps,
    area,
    difference,
    gain,
    load,
    mean_of,
    median_of,
    number,
    reach,
    read,
    signed,
    sooner,
    table,
    with_tables,
)
from scipy.stats import t

from mjx_dher import stats

SCRIPT = "docs/make_results_figures.py"
# The tables of each page.
PAGES = {
    DOCS / "results.md": ("verdicts", "pooled", "lottery", "samplers"),
    DOCS / "experiments" / "paper_own_cycles.md": ("own",),
    DOCS / "experiments" / "paper_set.md": ("power", "set", "k"),
    DOCS / "experiments" / "paper_repeats.md": ("repeats", "robustness"),
}


OWN_CYCLES, LONG_CYCLES = "50 an epoch", "1 an epoch"


def verdicts(the_set: Mapping[str, Sweeps]) -> str:
    """Table of the paper's claims, with the paper's cycles where they have been run."""
    push, pick = the_set["push"], the_set["pick_and_place"]
    found = paper_set.compared(the_set)
    claim = {result.comparison.task: result for result in found["the paper's own cycles"]}
    behind = next(r for r in found["methods 1 and 2, own cycles"] if r.comparison.setting == "epsilon_closest")
    methods = gain(push, "own_methods", "closest", "epsilon_closest")
    own = [
        ["Push: `weighted` converges sooner than `future`", *_success(claim["push"].difference, 1, claim["push"].p)],
        ["... starts two to three epochs sooner (0.20)", *_epochs(sooner(push, paper_set.OWN["push"], START), 2)],
        ["... is there about five epochs sooner (0.90)", *_epochs(sooner(push, paper_set.OWN["push"], 0.9), 5)],
        ["Push: `epsilon_closest` is behind `future`", *_success(behind.difference, -1, behind.p)],
        ["Push: `closest` is behind `epsilon_closest`", *_success(methods, -1)],
        [
            "PickAndPlace: `weighted` converges sooner than `future`",
            *_success(claim["pick_and_place"].difference, 1, claim["pick_and_place"].p),
        ],
        ["... starts two to three epochs sooner (0.20)", *_epochs(sooner(pick, paper_set.OWN["pick_and_place"], START), 2)],
        ["... is there about ten epochs sooner (0.90)", *_epochs(sooner(pick, paper_set.OWN["pick_and_place"], 0.9), 10)],
        ["Slide: no noticeable difference", *_success(claim["slide"].difference, 1, claim["slide"].p)],
    ]
    long = [
        [f"{NAMES[result.comparison.task]}: k 16 is worse than k 8", *_success(result.difference, -1, result.p)]
        for result in found["k 16 against 8"]
    ]
    rows = [[row[0], row[1], cycles, *row[2:]] for cycles, part in ((OWN_CYCLES, own), (LONG_CYCLES, long)) for row in part]
    return table("the paper says | seeds | cycles | our estimate | 95 % interval | p, corrected | verdict", rows)


def _success(d: Difference, sign: int, p: float | None = None) -> list[str]:
    """Cells of a claim that success is larger, or smaller if `sign` is -1.

    `p` is corrected over the claim's family. A claim without a family has None, and the interval decides.
    """
    low, high = sorted((sign * d.low, sign * d.high))
    if p is not None and p >= 0.05:
        verdict = "**alike**" if low > -MARGIN and high < MARGIN else "not shown"
    else:
        verdict = "**confirmed**" if low > 0 else "**the opposite**" if high < 0 else "not shown"
    mean, interval, _ = signed(d)
    return [str(len(d.each)), f"mean success {mean}", interval, "" if p is None else number(p), verdict]


def _epochs(d: Difference, claimed: float) -> list[str]:
    """Cells of a claim that at least `claimed` epochs are saved. The plan does not test epochs, so there is no p.

    A difference is NaN if a run never reaches the threshold.
    """
    verdict = "**refuted**" if d.high < claimed else "**confirmed**" if d.low > 0 else "not shown"
    mean, interval, _ = signed(d, 1)
    return [str(len(d.each)), f"{mean} epochs sooner", interval, "", verdict]


def lottery(the_set: Mapping[str, Sweeps]) -> str:
    """Table of single pairs of seeds: the number of pairs with the paper's gain, and with as large a loss."""
    rows = []
    for task, claimed in (("push", 5), ("pick_and_place", 5), ("pick_and_place", 10)):
        weighted, future = (reach(the_set[task][paper_set.OWN[task], name], 0.9) for name in ("weighted", "future"))
        gains, same = future[:, None] - weighted, (future[:, None] - future)[~np.eye(len(future), dtype=bool)]
        counts = [f"{np.sum(hits)} of {hits.size}" for hits in (gains >= claimed, gains <= -claimed, same >= claimed)]
        rows.append([NAMES[task], str(claimed), *counts])
    return table(
        "task | epochs | pairs in which `weighted` is sooner by at least these | ... later by these"
        " | pairs of two seeds of `future` in which the first is sooner by these",
        rows,
    )


def pooled_gains(data: Mapping[str, Sweeps]) -> str:
    """Table of the random-effects mean over all sweeps, by task."""
    rows = []
    for task, sweeps in data.items():
        gains = [gain(sweeps, sweep, "weighted", "future") for sweep in _with_both(sweeps)]
        mean, low, high = pooled(gains)
        pairs = sum(len(d.each) for d in gains)
        rows.append([NAMES[task], str(len(gains)), str(pairs), f"{mean:+.3f}", f"{low:+.3f} to {high:+.3f}"])
    return table("task | sweeps | pairs | mean success, `weighted` less `future` | 95 % interval", rows)


def _with_both(sweeps: Sweeps) -> list[str]:
    """Names of the sweeps with `weighted` and `future`."""
    return list(dict.fromkeys(sweep for sweep, setting in sweeps if setting == "weighted" and (sweep, "future") in sweeps))


def samplers(the_set: Mapping[str, Sweeps]) -> str:
    """Table of the samplers, with the paper's cycles."""
    rows = []
    for task, sweeps in the_set.items():
        own = {name: curves for (sweep, name), curves in sweeps.items() if sweep in (paper_set.OWN[task], "own_methods")}
        base = area(own["future"])
        for name in (name for name in ("future", "weighted", "epsilon_closest", "closest") if name in own):
            curves, epochs = own[name], reach(own[name], THRESHOLDS[task])
            better = "" if name == "future" else f"{stats.probability_of_improvement(area(curves), base):.2f}"
            late = curves.success[:, -LAST[task] :].mean(axis=1)
            cells = [mean_of(late), mean_of(area(curves)), median_of(epochs), f"{np.isfinite(epochs).sum()} of {len(epochs)}"]
            rows.append([NAMES[task] if name == "future" else "", f"`{name}`", *cells, better])
    head = "task | sampler | late success | mean success | epochs to 0.90 (Slide: 0.60), median"
    return table(f"{head} | seeds there | P(better than `future`)", rows)


def ks(the_set: Mapping[str, Sweeps]) -> str:
    """Table of hindsight goals."""
    rows, found = [], {(r.comparison.task, r.comparison.setting): r for r in paper_set.compared(the_set)["k against 4"]}
    for task, curves in paper_set.ks(the_set).items():
        for k, own in curves.items():
            result = found.get((task, f"future, her_k {k}"))
            against = [*signed(result.difference)[:2], number(result.p)] if result else ["", "", ""]
            epochs = median_of(reach(own, THRESHOLDS[task]))
            rows.append([NAMES[task] if k == 1 else "", str(k), mean_of(area(own)), *against, epochs])
    head = "task | k | mean success | against k 4 | 95 % interval | p, corrected"
    return table(f"{head} | epochs to 0.90 (Slide: 0.60), median", rows)


def repeats(data: Mapping[str, Sweeps]) -> str:
    """Table of `weighted` against `future` in every sweep that has both."""
    rows = []
    for task, sweeps in data.items():
        names = _with_both(sweeps)
        gains = [gain(sweeps, sweep, "weighted", "future") for sweep in names]
        for sweep, success in zip(names, gains):
            epochs = sooner(sweeps, sweep, THRESHOLDS[task])
            length = str(sweeps[sweep, "future"].success.shape[1])
            rows.append([NAMES[task] if sweep == names[0] else "", sweep, length, *signed(success), *signed(epochs, 1)[:2]])
    return table(
        "task | sweep | epochs | mean success, `weighted` less `future` | 95 % interval | p | epochs sooner | 95 % interval",
        rows,
    )


def pooled(differences: Sequence[Difference]) -> tuple[float, float, float]:
    """Random-effects mean of the differences, and its 95 % interval.

    Source: DerSimonian & Laird (1986) for the spread between sweeps, Knapp & Hartung (2003) for the interval. It is no narrower
    than the spread of the seeds alone allows: sweeps that agree by luck would make it too short.
    """
    means = np.array([d.mean for d in differences])
    within = np.array([d.each.var(ddof=1) / len(d.each) for d in differences])
    weights = 1 / within
    fixed = np.average(means, weights=weights)
    excess = float(weights @ (means - fixed) ** 2) - (len(means) - 1)
    between = max(0.0, excess / (weights.sum() - (weights**2).sum() / weights.sum()))
    weights = 1 / (within + between)
    mean = float(np.average(means, weights=weights))
    scale = max(1.0, float(weights @ (means - mean) ** 2) / (len(means) - 1))
    half = float(t.ppf(0.975, len(means) - 1)) * math.sqrt(scale / weights.sum())
    return mean, mean - half, mean + half


CHANGES = (  # what, task, the sweep, and the one that it is compared with
    ("the paper's cycles: 16 episodes, 40 updates", "push", "the paper's cycles of 2026-11-22", "samplers"),
    ("cycles 2.5 times as long", "push", "long cycles", "samplers"),
    ("bfloat16", "push", "bfloat16", "samplers"),
    ("bfloat16, long cycles", "push", "bfloat16 and long cycles", "long cycles"),
    ("`fast`: bfloat16, a cycle an epoch", "push", "fast", "samplers"),
    ("... PickAndPlace", "pick_and_place", "fast", "samplers"),
    ("... Slide, from cycles half as long", "slide", "fast", "samplers"),
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


OWN, TODAY = "the paper's cycles", "today's preset"  # names of the set's sweeps among those of 2026-11-22


def blocks(the_set: Mapping[str, Sweeps], before: Mapping[str, Sweeps]) -> dict[str, str]:
    """All tables with their names, from the curves of the set and of 2026-11-22."""
    both = with_repeats(the_set, before)
    found = {"verdicts": verdicts(the_set), "lottery": lottery(the_set), "samplers": samplers(the_set), "k": ks(the_set)}
    found |= {"pooled": pooled_gains(both), "repeats": repeats(both), "robustness": robustness(before)}
    return found | paper_set.blocks(the_set, before)


def with_repeats(the_set: Mapping[str, Sweeps], before: Mapping[str, Sweeps]) -> dict[str, Sweeps]:
    """Sweeps with `weighted` and `future` by task: with the paper's cycles, the set's longer ones, and earlier ones."""
    again = read(DOCS / "break_off.csv")
    today = paper_set.current(the_set)
    found: dict[str, Sweeps] = {}
    for task, sweeps in before.items():
        own = {(OWN, name): curves for (sweep, name), curves in the_set[task].items() if sweep == paper_set.OWN[task]}
        longer = {(TODAY, name): curves for (_, name), curves in today[task].items()}
        found[task] = {**own, **longer, **(again if task == "push" else {}), **sweeps}
    return found


def main() -> None:
    """Writes tables and pictures."""
    the_set, before = paper_set.load_set(paper_set.FOLDER), load()
    tables = blocks(the_set, before)
    for page, names in PAGES.items():
        page.write_text(with_tables(page.read_text(), SCRIPT, {name: tables[name] for name in names}))
    paper_forest.draw(with_repeats(the_set, before), DOCS / "images" / "paper_forest.png", (OWN, "break-off", TODAY))
    paper_forest.draw_set(paper_set.compared(the_set), DOCS / "images" / "set_forest.png")


if __name__ == "__main__":
    main()
