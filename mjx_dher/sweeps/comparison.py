"""What a sweep shows: its settings beside one another, with intervals, and against a baseline."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mjx_dher import config as config_lib
from mjx_dher import stats
from mjx_dher.host import files
from mjx_dher.sweeps.sweep import reads

COMPARISON = "comparison.csv"


class Group(NamedTuple):
    """All seeds of one setting."""

    env: str
    label: str  # the sampler, and whatever else differs between the settings of this environment
    sampler: str
    others: dict[str, Any]  # what else differs, of the settings that this sampler reads
    seeds: tuple[int, ...]  # S of them
    epoch: NDArray  # [P]
    env_steps: NDArray  # [P]
    seconds: NDArray  # [P] the mean over the seeds
    success: NDArray  # [S, P] success rate after each epoch
    final: NDArray  # [S] success rate of the last policy
    at_reset: float  # share of the final episodes whose goal was reached at the reset


def groups(cells: list[dict[str, Any]]) -> dict[str, list[Group]]:
    """The cells of a sweep, as `sweep.read` gives them, by environment and setting."""
    by_env: dict[str, list[dict[str, Any]]] = {}
    for cell in cells:
        by_env.setdefault(cell["config"]["env"], []).append(cell)
    return {env: _groups_of(env, found) for env, found in by_env.items()}


def _groups_of(env: str, cells: list[dict[str, Any]]) -> list[Group]:
    settings = [{**cell["config"], **cell["hparams"]} for cell in cells]
    varying = [name for name in settings[0] if name not in ("sampler", "env") and len({str(s[name]) for s in settings}) > 1]
    by_label: dict[str, tuple[dict[str, Any], list[dict[str, Any]]]] = {}
    for cell, setting in zip(cells, settings):
        own = {name: setting[name] for name in varying if reads(setting["sampler"], name)}
        label = ", ".join([setting["sampler"], *(_say(name, value) for name, value in own.items())])
        by_label.setdefault(label, (own, []))[1].append(cell)
    order = {name: number for number, name in enumerate(config_lib.SAMPLERS)}
    found = [_group(env, label, *rest) for label, rest in by_label.items()]
    # Numbers in rising order; names of one setting are all strings.
    return sorted(found, key=lambda group: (order.get(group.sampler, len(order)), list(group.others.values())))


def _say(name: str, value: Any) -> str:
    return (
        str(value) if isinstance(value, str) else f"{name} {value:g}" if isinstance(value, (int, float)) else f"{name} {value}"
    )


def _group(env: str, label: str, others: dict[str, Any], cells: list[dict[str, Any]]) -> Group:
    cells = sorted(cells, key=lambda cell: cell["seed"])
    curves = [cell["curve"] for cell in cells]
    return Group(
        env=env,
        label=label,
        sampler=cells[0]["config"]["sampler"],
        others=others,
        seeds=tuple(cell["seed"] for cell in cells),
        epoch=np.array(curves[0]["epoch"]),
        env_steps=np.array(curves[0]["env_steps"]),
        seconds=np.mean([curve["wall_seconds"] for curve in curves], axis=0),
        success=np.array([curve["success_rate"] for curve in curves]),
        final=np.array([cell["final"]["success_rate"] for cell in cells]),
        at_reset=float(np.mean([cell["final"]["reset_success_rate"] for cell in cells])),
    )


class Row(NamedTuple):
    """A setting against the baseline. Intervals are of 95 %, over seeds; see `compare`."""

    env: str
    setting: str
    seeds: int
    final: float  # mean success rate of the last policies
    final_iqm: float  # interquartile mean of it
    final_low: float
    final_high: float
    at_reset: float
    area: float  # interquartile mean of the mean success rate over all epochs
    area_low: float
    area_high: float
    reached: int  # seeds with an epoch at the threshold or above
    epochs: float  # median of the first such epoch; infinite where half of the seeds have none
    epochs_low: float
    epochs_high: float
    env_steps: float  # as many environment steps
    better: float  # probability that a seed has a larger area than one of the baseline; nan for the baseline itself
    better_low: float
    better_high: float
    area_gain: float  # mean difference of the areas to the baseline's, seed by seed
    p_value: float  # of that difference, two-sided, before correction
    p_corrected: float  # by Holm's method, over the settings of this environment


def compare(found: list[Group], baseline: str, threshold: float) -> list[Row]:
    """Each of an environment's settings, and its difference to the baseline.

    Success, area and epochs have bootstrap intervals over seeds; `better` is the probability of improvement; the p value is of
    a paired permutation test by seed, where both have the same seeds.

    Args:
      found: settings of one environment.
      baseline: label of one of them, or a sampler: then each is compared with that sampler's setting that shares its other
        numbers. Where there is none, nothing is compared.
      threshold: success rate.
    """
    rows = [_row(group, _baseline_of(group, found, baseline), threshold) for group in found]
    tested = [i for i, row in enumerate(rows) if not math.isnan(row.p_value)]
    corrected = stats.holm([rows[i].p_value for i in tested]) if tested else []
    for i, p in zip(tested, corrected):
        rows[i] = rows[i]._replace(p_corrected=float(p))
    return rows


def _baseline_of(group: Group, found: list[Group], baseline: str) -> Group | None:
    """The setting to compare `group` with; None where there is none, or it is the baseline itself."""

    def fits(other: Group) -> bool:
        return all(group.others.get(name, value) == value for name, value in other.others.items())

    labelled = [other for other in found if other.label == baseline]
    likely = labelled or [other for other in found if other.sampler == baseline and fits(other)]
    return likely[0] if len(likely) == 1 and likely[0] is not group else None


def _row(group: Group, base: Group | None, threshold: float) -> Row:
    areas = _areas(group)
    reach = stats.first_reach(group.epoch, group.success, threshold)
    median = lambda x: float(np.quantile(x, 0.5, method="inverted_cdf"))  # noqa: E731
    epochs = median(reach)
    steps_per_epoch = group.env_steps[0] / group.epoch[0]
    nan = math.nan
    better, gain, p_value = (nan, nan, nan), nan, nan
    if base is not None:
        others = _areas(base)
        better = (stats.probability_of_improvement(areas, others), *stats.improvement_interval(areas, others))
        if base.seeds == group.seeds and len(areas) > 1:
            gain, p_value = float(np.mean(areas - others)), stats.paired_p_value(areas, others)
    return Row(
        group.env,
        group.label,
        len(group.seeds),
        float(group.final.mean()),
        stats.interquartile_mean(group.final),
        *stats.bootstrap_interval(group.final),
        group.at_reset,
        stats.interquartile_mean(areas),
        *stats.bootstrap_interval(areas),
        int(np.isfinite(reach).sum()),
        epochs,
        *stats.bootstrap_interval(reach, median),
        epochs * steps_per_epoch,
        *better,
        gain,
        p_value,
        p_value,
    )


def _areas(group: Group) -> NDArray:
    if len(group.epoch) < 2:
        return group.success.mean(axis=1)
    return stats.area_under_curve(group.epoch, group.success)


def table(rows: list[Row]) -> tuple[list[str], list[list[str]]]:
    """Head and cells of `rows`, for a reader."""
    head = ["env", "setting", "seeds", "final success (IQM)", "mean over epochs", "epochs to threshold", "P(better)", "p"]
    cells = []
    for r in rows:
        epochs = f"{r.epochs:g} ({r.epochs_low:g}-{r.epochs_high:g}); {r.reached} of {r.seeds}" if r.reached else "never"
        cells.append(
            [
                r.env,
                r.setting,
                str(r.seeds),
                f"{r.final_iqm:.3f} ({r.final_low:.3f}-{r.final_high:.3f})",
                f"{r.area:.3f} ({r.area_low:.3f}-{r.area_high:.3f})",
                epochs,
                "" if math.isnan(r.better) else f"{r.better:.2f} ({r.better_low:.2f}-{r.better_high:.2f})",
                "" if math.isnan(r.p_corrected) else f"{r.p_corrected:.3g}",
            ]
        )
    return head, cells


def write(folder: Path, rows: list[Row]) -> None:
    """Writes comparison.csv."""
    with files.atomic_write(folder / COMPARISON) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in rows)
