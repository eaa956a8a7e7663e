"""Comparisons of bench/paper.py's set, stated before it was run, and the effects that ten seeds can show in it.

A family is a question. p is corrected within it by Holm's method, and alternatively by Westfall and Young's sign flips. The
least p of ten pairs is 2/1024, so a family of more than 25 comparisons could show nothing by Holm.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from paper_analysis import (
    DOCS,
    MARGIN,
    NAMES,
    THRESHOLDS,
    Curves,
    Difference,
    Sweeps,
    area,
    difference,
    gain,
    number,
    read,
    signed,
    sooner,
    table,
    with_seeds,
)

from mjx_dher import stats
from mjx_dher.config import HParams

FOLDER = DOCS / "paper"
MAIN = {"push": "samplers", "pick_and_place": "pick_and_place", "slide": "slide"}  # the sweep with `future` and `weighted`


class Comparison(NamedTuple):
    """A setting of a task against another one, each by sweep and setting. The default is the main sweep's `future`."""

    task: str
    sweep: str
    setting: str
    against: tuple[str, str] | None = None


def _readings(task: str, prefix: str = "", against: tuple[str, str] | None = None) -> list[Comparison]:
    """Readings other than the default one."""
    linear = ("sum", "max", "minmax", "none", "far") if task == "push" else ("sum", "minmax", "far")
    softmax, sweep = ("mean", "none") if task == "push" else ("none",), f"readings_{prefix}{task}"
    return [Comparison(task, sweep, f"weighted, {name}, linear", against) for name in linear] + [
        Comparison(task, f"{sweep}_softmax", f"weighted, {name}, softmax", against) for name in softmax
    ]


def _own(sweep: str, *settings: str) -> list[Comparison]:
    """Settings of Push with the paper's own cycles."""
    return [Comparison("push", sweep, setting, (OWN["push"], "future")) for setting in settings]


OWN = {task: f"own_{task}" for task in NAMES}  # the sweeps with the paper's own cycles, in float32
FAMILIES: dict[str, list[Comparison]] = {
    "the paper's own cycles": [Comparison(task, sweep, "weighted", (sweep, "future")) for task, sweep in OWN.items()],
    "methods 1 and 2, own cycles": _own("own_methods", "closest", "epsilon_closest"),
    "readings, own cycles": _readings("push", "own_", (OWN["push"], "future")),
    "k against 4, own cycles": _own("k_own_push", *(f"future, her_k {k}" for k in (1, 2, 8, 16))),
    "final and random, own cycles": _own("samplers_own_push", "final", "random"),
    "ring and noise, own cycles": _own("ring_own_push", "future, ring of 200,000")
    + _own("noise_own_push", "future, random_noise 0"),
    "the paper's claim": [Comparison(task, sweep, "weighted") for task, sweep in MAIN.items()],
    "readings": [comparison for task in NAMES for comparison in _readings(task)],
    "method 2": [Comparison("push", "samplers", f"epsilon_closest, epsilon {e}") for e in (0.1, 0.2, 0.3, 0.5)]
    + [Comparison("push", "samplers", "closest")],
    "k against 4": [Comparison(task, f"k_{task}", f"future, her_k {k}") for task in NAMES for k in (1, 2, 8, 16)],
    "k 16 against 8": [Comparison(t, f"k_{t}", "future, her_k 16", (f"k_{t}", "future, her_k 8")) for t in NAMES],
    "settings of Slide": [
        Comparison("slide", "ring_slide", "future, ring of a million"),
        Comparison("slide", "noise_slide", "future, random_noise 0"),
    ],
    "eventful": [Comparison(task, f"eventful_{task}", "future, priority_fraction 0.5") for task in NAMES],
}
HEAD = (
    "question | task | setting | against | epochs | mean success | 95 % interval | p | p, corrected | p, joint flips"
    " | spread | could be seen | verdict"
)


def load_set(folder: Path) -> dict[str, Sweeps]:
    """Curves of the set by task, for tasks that have any."""
    return {task: read(path) for task in NAMES if (path := folder / f"{task}_curves.csv").is_file()}


def current(data: Mapping[str, Sweeps]) -> dict[str, Sweeps]:
    """Sweeps of the set with `future` and `weighted`, by task, each as a sweep `samplers`.

    `epsilon_closest` has the preset's epsilon.
    """
    names = {f"epsilon_closest, epsilon {HParams().epsilon:g}": "epsilon_closest"}
    return {
        task: {("samplers", names.get(name, name)): curves for (sweep, name), curves in sweeps.items() if sweep == MAIN[task]}
        for task, sweeps in data.items()
    }


def ks(data: Mapping[str, Sweeps]) -> dict[str, dict[int, Curves]]:
    """Curves of `future` by task and k over the common epochs, for tasks with all k."""
    found = {}
    for task, sweeps in data.items():
        curves = {k: sweeps.get((f"k_{task}", f"future, her_k {k}")) for k in (1, 2, 8, 16)}
        curves[4] = sweeps.get((MAIN[task], "future"))
        whole = {k: own for k, own in sorted(curves.items()) if own is not None}
        if len(whole) == len(curves):
            epochs = min(own.success.shape[1] for own in whole.values())
            found[task] = {k: own._replace(success=own.success[:, :epochs]) for k, own in whole.items()}
    return found


class Compared(NamedTuple):
    """Result of a comparison."""

    comparison: Comparison
    difference: Difference
    epochs: int
    p: float  # corrected over the family, in which comparisons that have not been run have a p of 1
    joint: float  # p by joint sign flips over the family's comparisons that have been run


def compared(data: Mapping[str, Sweeps]) -> dict[str, list[Compared]]:
    """Results by family, of the comparisons whose curves are complete."""
    found = {}
    for family, comparisons in FAMILIES.items():
        ready = [c for c in comparisons if {(c.sweep, c.setting), _baseline(c)} <= set(data.get(c.task, {}))]
        differences = [_compare(data[c.task], c) for c in ready]
        corrected = stats.holm([d.p for d, _ in differences], len(comparisons))
        most = max((len(d.each) for d, _ in differences), default=0)
        each = [np.pad(d.each, (0, most - len(d.each)), constant_values=np.nan) for d, _ in differences]
        joint = stats.westfall_young(each) if each else []
        found[family] = [Compared(c, *d, p, j) for c, d, p, j in zip(ready, differences, corrected, joint)]
    return found


def rows(data: Mapping[str, Sweeps], own_cycles: bool = False) -> list[list[str]]:
    """A row for each complete comparison, with the paper's own cycles or with longer ones. k against 4 has another table."""
    found = []
    wanted = {name for name in FAMILIES if ("own cycles" in name) == own_cycles and name != "k against 4"}
    for family, results in ((name, results) for name, results in compared(data).items() if name in wanted):
        for c, d, epochs, p, joint in results:
            cells = [NAMES[c.task], f"`{c.setting}`", f"`{_baseline(c)[1]}`", str(epochs), *signed(d)]
            spread = float(d.each.std(ddof=1))
            seen = detectable(spread, len(d.each), 0.05 / len(FAMILIES[family]))
            cells += [number(p), number(joint), f"{spread:.3f}", f"{seen:.3f}"]
            found.append([family, *cells, verdict(d.low, d.high, p)])
    return found


def verdict(low: float, high: float, p: float) -> str:
    """Verdict from an interval and a corrected p: better or worse with p below 0.05, alike within 0.02 of 0."""
    if p < 0.05:
        return "better" if low > 0 else "worse" if high < 0 else "not shown"
    return "alike" if low > -MARGIN and high < MARGIN else "not shown"


def _baseline(c: Comparison) -> tuple[str, str]:
    return c.against or (MAIN[c.task], "future")


def _compare(sweeps: Sweeps, c: Comparison) -> tuple[Difference, int]:
    """Difference of mean success over the common epochs, paired by the setting's seeds, and the number of epochs."""
    a = sweeps[c.sweep, c.setting]
    b = with_seeds(sweeps[_baseline(c)], a.seeds)
    epochs = min(a.success.shape[1], b.success.shape[1])
    return difference(area(a, epochs), area(b, epochs)), epochs


def detectable(spread: float, seeds: int, level: float, power: float = 0.8) -> float:
    """Least mean difference that a paired t test detects, with its sign, for differences with this spread."""
    from scipy.optimize import brentq
    from scipy.stats import nct, t

    bound = t.ppf(1 - level / 2, seeds - 1)

    def missing(effect: float) -> float:
        return float(nct.sf(bound, seeds - 1, effect * math.sqrt(seeds))) - power

    return spread * float(brentq(missing, 1e-3, 3.0))


SIZES = {1: "one comparison", 3: "the three tasks", 15: "the fifteen readings"}


def power(data: Mapping[str, Sweeps]) -> str:
    """Table of the smallest effects that ten seeds can show, from the spread of the existing sweeps."""
    rows = []
    for task, sweeps in data.items():
        pairs = [sweep for sweep in ("samplers", "fast", "hopper", "hopper again") if (sweep, "weighted") in sweeps]
        for measure, digits, score in (
            ("mean success", 3, lambda s, n: gain(s, n, "weighted", "future")),
            (f"epochs to {THRESHOLDS[task]:.2f}", 1, lambda s, n, task=task: sooner(s, n, THRESHOLDS[task])),
        ):
            variance = np.mean([np.var(score(sweeps, name).each, ddof=1) for name in pairs])
            spread = math.sqrt(float(variance))
            least = [f"{detectable(spread, 10, 0.05 / m):.{digits}f}" for m in SIZES]
            rows.append([NAMES[task], measure, f"{spread:.{digits}f}", *least])
    return table(f"task | measure | spread of paired differences | {' | '.join(SIZES.values())}", rows)


def blocks(data: Mapping[str, Sweeps], before: Mapping[str, Sweeps]) -> dict[str, str]:
    """Tables of the comparisons in `data`, and of the set's power, which is computed from the earlier curves."""
    return {"set": table(HEAD, rows(data)), "own": table(HEAD, rows(data, own_cycles=True)), "power": power(before)}
