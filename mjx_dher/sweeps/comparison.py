"""Compares a sweep's settings with each other and with a baseline."""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjx_dher import lookup, stats
from mjx_dher.components import COMPONENTS, reads
from mjx_dher.runs.folder import fingerprint
from mjx_dher.runs.folder.run_folder import FAILED
from mjx_dher.system import files
from mjx_dher.system.files import FolderError

COMPARISON = "comparison.csv"


class Group(NamedTuple):
    """Results of one setting over all seeds."""

    env: str
    label: str  # the sampler and the other values that differ between settings
    sampler: str
    others: dict[str, Any]  # other values that differ and that the run reads
    seeds: tuple[int, ...]  # S of them
    failed: int  # number of failed runs
    lanes: int  # most parallel runs
    epoch: NDArray  # [P]
    env_steps: NDArray  # [P]
    seconds: NDArray  # [P] mean over seeds
    success: NDArray  # [S, P] success rate after each epoch
    final: NDArray  # [S] success rate of the last policy
    at_reset: float  # fraction of the final episodes whose goal was reached at the reset


def groups(trials: list[dict[str, Any]]) -> dict[str, list[Group]]:
    """Groups the trials from `tables.read` by environment and setting."""
    by_env: dict[str, list[dict[str, Any]]] = {}
    for trial in trials:
        by_env.setdefault(trial["settings"]["env"], []).append(trial)
    return {env: _groups_of(env, own) for env, own in by_env.items()}


def _groups_of(env: str, trials: list[dict[str, Any]]) -> list[Group]:
    settings = [trial["settings"] for trial in trials]
    varying = [name for name in fingerprint.varying(settings) if name != "sampler"]
    by_setting: dict[str, tuple[dict[str, Any], list[dict[str, Any]]]] = {}
    for trial, setting in zip(trials, settings):
        own = {name: setting[name] for name in varying if reads(setting, name)}
        by_setting.setdefault(str((setting["sampler"], own)), (own, []))[1].append(trial)
    order = {name: number for number, name in enumerate(COMPONENTS["sampler"])}
    labels = [_label(alike[0], own, fingerprint.named) for own, alike in by_setting.values()]
    exact = [_label(alike[0], own, lambda name, value: f"{name} {value!r}") for own, alike in by_setting.values()]
    labels = [label if labels.count(label) == 1 else digits for label, digits in zip(labels, exact)]
    result = [_group(env, label, own, _once_a_seed(alike)) for label, (own, alike) in zip(labels, by_setting.values())]

    def place(group: Group) -> Any:  # numbers ascend, after None
        return order.get(group.sampler, len(order)), [(value is not None, value) for value in group.others.values()]

    return sorted(result, key=place)


def _label(trial: dict[str, Any], own: dict[str, Any], form: Callable[[str, Any], str]) -> str:
    told = (form(name, value) for name, value in own.items() if (name, value) != ("source", ""))
    return ", ".join([trial["settings"]["sampler"], *told])


def _once_a_seed(trials: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One trial per seed of a setting. Runs that differ only in settings that they do not read, or in whether their engine was
    named or chosen, are equal. Raises FolderError if two folders hold the same run, for example after a copy.
    """
    by_seed: dict[int, dict[str, Any]] = {}
    for trial in trials:
        first = by_seed.setdefault(trial["seed"], trial)
        if first is not trial and all(first[name] == trial[name] for name in ("settings", "asked_engine")):
            raise FolderError(f"{first['folder']} and {trial['folder']} hold the same run: remove one of them")
    return list(by_seed.values())


def _group(env: str, label: str, others: dict[str, Any], trials: list[dict[str, Any]]) -> Group:
    """Group of one setting's trials. A failed run counts as success 0 from then on."""
    trials = sorted(trials, key=lambda trial: trial["seed"])
    longest = max((trial["curve"] for trial in trials), key=lambda curve: len(curve.get("epoch", ())))
    longest = longest or {"epoch": [1], "env_steps": [0], "wall_seconds": [0.0]}
    if all(trial["status"] == FAILED for trial in trials):
        longest = _to_the_end(longest, trials[0]["settings"]["total_steps"])
    length = len(longest["epoch"])
    whole = [trial["curve"]["wall_seconds"] for trial in trials if len(trial["curve"].get("epoch", ())) == length]
    success = [trial["curve"].get("success_rate", []) for trial in trials]
    at_reset = [trial["final"]["reset_success_rate"] for trial in trials if trial["final"]]
    return Group(
        env=env,
        label=label,
        sampler=trials[0]["settings"]["sampler"],
        others=others,
        seeds=tuple(trial["seed"] for trial in trials),
        failed=sum(trial["status"] == FAILED for trial in trials),
        lanes=max(trial["lanes"] for trial in trials),
        epoch=np.array(longest["epoch"]),
        env_steps=np.array(longest["env_steps"]),
        seconds=np.mean(whole or [longest["wall_seconds"]], axis=0),
        success=np.array([rates + [0.0] * (length - len(rates)) for rates in success]),
        final=np.array([trial["final"].get("success_rate", 0.0) for trial in trials]),
        at_reset=float(np.mean(at_reset)) if at_reset else math.nan,
    )


def _to_the_end(curve: dict[str, list[Any]], total_steps: int) -> dict[str, list[Any]]:
    """A failed run's curve of epochs, steps and seconds, continued to the steps that it would have made."""
    each = curve["env_steps"][0]
    missing = max(0, math.ceil(total_steps / each) - len(curve["epoch"])) if each else 0
    ahead = range(1, missing + 1)
    return {
        "epoch": [*curve["epoch"], *(curve["epoch"][-1] + i for i in ahead)],
        "env_steps": [*curve["env_steps"], *(curve["env_steps"][-1] + i * each for i in ahead)],
        "wall_seconds": [*curve["wall_seconds"], *curve["wall_seconds"][-1:] * missing],
    }


class Row(NamedTuple):
    """Comparison of a setting with the baseline, with 95 % intervals over seeds; see `compare`."""

    env: str
    setting: str
    seeds: int
    failed: int  # failed seeds; their success is 0 from then on
    final: float  # mean success rate of the last policies
    final_iqm: float  # interquartile mean of these rates
    final_low: float
    final_high: float
    at_reset: float
    area: float  # interquartile mean of the mean success rate over all epochs
    area_low: float
    area_high: float
    reached: int  # seeds that reach the threshold
    epochs: float  # median epochs to the threshold; infinite if at least half of the seeds never reach it
    epochs_low: float
    epochs_high: float
    env_steps: float  # environment steps until that epoch
    better: float  # probability that a seed has a larger area than one of the baseline; NaN for the baseline
    better_low: float
    better_high: float
    area_gain: float  # mean difference of areas to the baseline, paired by seed
    p_value: float  # two-sided p-value of the gain, before correction
    p_corrected: float  # p-value after Holm's correction over the settings of this environment


def compare(settings: list[Group], baseline: str, threshold: float) -> list[Row]:
    """Compares each setting of an environment with the baseline.

    Success, area and epochs have bootstrap intervals over seeds. `better` is the probability of improvement. Gain and
    p-value, which comes from a permutation test, are paired by seed. They need two seeds or more that both settings have.
    All three are NaN if the two settings differ in steps by more than an epoch, because areas are means over all epochs.

    Args:
      settings: settings of one environment.
      baseline: label of a setting, or a sampler. With a sampler, each setting is compared with that sampler's setting of the
        same other values, if it exists.
      threshold: success rate for `reached` and `epochs`.
    """
    rows = [_row(group, _baseline_of(group, settings, baseline), threshold) for group in settings]
    tested = [i for i, row in enumerate(rows) if not math.isnan(row.p_value)]
    corrected = stats.holm([rows[i].p_value for i in tested]) if tested else []
    for i, p in zip(tested, corrected):
        rows[i] = rows[i]._replace(p_corrected=float(p))
    return rows


def check_baseline(by_env: Mapping[str, Sequence[Group]], baseline: str) -> None:
    """Raises ValueError unless a setting has this sampler or label. The default, `future`, may be missing."""
    settings = [group for groups in by_env.values() for group in groups]
    names = dict.fromkeys(["future", *(group.sampler for group in settings), *(group.label for group in settings)])
    lookup.check_name("baseline", baseline, names)


def _baseline_of(group: Group, settings: list[Group], baseline: str) -> Group | None:
    """Setting to compare `group` with, or None if there is none or `group` is the baseline."""

    def fits(other: Group) -> bool:
        # The baseline may lack the files of this setting's own components, but no JAX flags or devices.
        base, own = (set(filter(None, str(each.others.get("source", "")).split(", "))) for each in (other, group))
        rest = ((name, value) for name, value in other.others.items() if name != "source")
        same = base <= own and not any(text.startswith("JAX_") or text.endswith(" devices") for text in own - base)
        return same and all(group.others.get(name, value) == value for name, value in rest)

    of_sampler = [other for other in settings if other.sampler == baseline]
    likely = list(filter(fits, of_sampler)) if of_sampler else [other for other in settings if other.label == baseline]
    return likely[0] if len(likely) == 1 and likely[0] is not group else None


def _row(group: Group, base: Group | None, threshold: float) -> Row:
    areas = areas_of(group)
    reach = stats.first_reach(group.epoch, group.success, threshold)
    epochs = float(np.median(reach))
    steps_per_epoch = group.env_steps[0] / group.epoch[0]
    nan = math.nan
    better, gain, p_value = (nan, nan, nan), nan, nan
    if base is not None and _as_long(group, base):
        others = areas_of(base)
        better = (stats.probability_of_improvement(areas, others), *stats.improvement_interval(areas, others))
        own, theirs = np.nonzero(np.equal.outer(group.seeds, base.seeds))  # places of the seeds that both have
        if len(own) > 1:
            gain, p_value = float(np.mean(areas[own] - others[theirs])), stats.paired_p_value(areas[own], others[theirs])
    return Row(
        group.env,
        group.label,
        len(group.seeds),
        group.failed,
        float(group.final.mean()),
        stats.interquartile_mean(group.final),
        *stats.bootstrap_interval(group.final),
        group.at_reset,
        stats.interquartile_mean(areas),
        *stats.bootstrap_interval(areas),
        int(np.isfinite(reach).sum()),
        epochs,
        *stats.bootstrap_interval(reach, np.median),
        epochs * steps_per_epoch if math.isfinite(epochs) else math.inf,
        *better,
        gain,
        p_value,
        p_value,
    )


def _as_long(group: Group, base: Group) -> bool:
    """Whether two settings have the same steps, up to an epoch. One that failed at once has none, and is always compared."""
    ends = [each.env_steps[-1] for each in (group, base)]
    return 0 in ends or abs(ends[0] - ends[1]) <= max(group.env_steps[0], base.env_steps[0])


def areas_of(group: Group) -> NDArray:
    """Mean success [S] over the epochs, by trapezoids."""
    if len(group.epoch) < 2:
        return group.success.mean(axis=1)
    return stats.area_under_curve(group.epoch, group.success)


def table(rows: list[Row]) -> tuple[list[str], list[list[str]]]:
    """Formats rows as a table for the terminal: its head and its cells."""
    head = ["env", "setting", "seeds", "final success (IQM)", "mean over epochs", "epochs to threshold", "P(better)", "p"]
    cells = []
    for r in rows:
        epochs = f"{r.epochs:g} ({r.epochs_low:g}-{r.epochs_high:g}); {r.reached} of {r.seeds}" if r.reached else "never"
        all_failed = r.failed == r.seeds
        cells.append(
            [
                r.env,
                r.setting,
                f"{r.seeds} ({r.failed} failed)" if r.failed else str(r.seeds),
                "failed" if all_failed else f"{r.final_iqm:.3f} ({r.final_low:.3f}-{r.final_high:.3f})",
                "failed" if all_failed else f"{r.area:.3f} ({r.area_low:.3f}-{r.area_high:.3f})",
                epochs,
                "" if math.isnan(r.better) else f"{r.better:.2f} ({r.better_low:.2f}-{r.better_high:.2f})",
                "" if math.isnan(r.p_corrected) else f"{r.p_corrected:.3g}",
            ]
        )
    return head, cells


def write(folder: Path, rows: list[Row]) -> None:
    """Writes the rows to comparison.csv in `folder`."""
    with files.atomic_write(folder / COMPARISON) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in rows)
