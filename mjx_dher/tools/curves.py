"""Learning curves of single runs: read from their folders, and drawn one by one or together."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mjx_dher.components import reads
from mjx_dher.rates import wilson_interval
from mjx_dher.runs.folder import fingerprint, results, run_folder
from mjx_dher.runs.folder.results import Record
from mjx_dher.runs.folder.run_folder import FAILED
from mjx_dher.system.files import FolderError
from mjx_dher.tools import figures

CURVE = "curve"  # stem of the picture of one run
# Panels of a run's picture: heading, curves by column, and whether the axis is logarithmic. Empty panels are left out.
_PANELS = (
    ("mean return", {"return_mean": "evaluation", "train_return_mean": "exploring"}, False),
    ("mean value of a transition", {"q_mean": "critic"}, False),
    ("loss of the critic", {"critic_loss": "critic"}, True),
)


def read_curve(folder: Path, allow_empty: bool = False) -> Record:
    """Reads the curve of the run in `folder`, finished or not. Raises FolderError if it is not a run folder, it is damaged, or
    no epoch has ended and `allow_empty` is False.
    """
    curve = results.read(folder, with_policy=False)
    if not curve.rows and not allow_empty:
        failed = curve.status == FAILED
        told = f"it failed in its first epoch: {curve.result['reason']}" if failed else "no epoch of the run has ended"
        raise FolderError(f"{folder} has no curve: {told}")
    return curve


def title(curve: Record) -> str:
    """One line about a run: its settings and progress."""
    spec = curve.spec
    parts = [spec.env, *spec.env_kwargs, f"sampler {spec.sampler}", f"learner {spec.learner}", f"seed {spec.seed}"]
    steps = f"{curve.rows[-1]['env_steps']:,} steps in {curve.rows[-1]['wall_seconds']:,.0f} s" if curve.rows else "no epoch"
    state = f"failed: {curve.result['reason']}" if curve.status == FAILED else curve.status
    return f"{', '.join(parts)}; {curve.content['physics']}; {steps}; {state}"


def draw_curve(curve: Record) -> Any:
    """Draws a run over environment steps: success with its 95 % interval (Wilson 1927), returns, values and losses."""
    panels = [
        (label, {name: text for name, text in columns.items() if np.isfinite(curve.column(name)).any()}, log)
        for label, columns, log in _PANELS
    ]
    panels = [panel for panel in panels if panel[1]]
    count = 1 + len(panels)
    columns = min(2, count)
    height = 3.2 * math.ceil(count / columns)
    figure, axes = figures.subplots(math.ceil(count / columns), columns, 4.6 * columns, height)
    unit, name = _unit([curve])
    steps = curve.column("env_steps") / unit
    _draw_success(axes[0], curve, steps)
    marker = "." if len(steps) == 1 else ""
    for axis, (label, names, log) in zip(axes[1:], panels):
        for (column, text), (color, line, _) in zip(names.items(), figures.styles(len(names))):
            axis.plot(steps, curve.column(column), color=color, linestyle=line, label=text, marker=marker)
        axis.set_title(label, fontsize=10)
        if log and (curve.column(next(iter(names))) > 0).all():
            axis.set_yscale("log")
        if len(names) > 1:
            axis.legend(frameon=False, fontsize=8)
    for axis in axes[count:]:
        axis.set_visible(False)
    for axis in axes[:count]:
        axis.set_xlabel(name, fontsize=9)
        axis.grid(alpha=0.2)
    figure.suptitle(figures.folded(title(curve), 4.6 * columns), fontsize=10)
    return figure


def _draw_success(axis: Any, curve: Record, steps: NDArray) -> None:
    """Draws the success of evaluation, exploration, final evaluation and resets."""
    rates, episodes = curve.column("success_rate"), curve.eval_episodes
    bounds = [wilson_interval(round(rate * episodes), episodes) if np.isfinite(rate) else (0.0, 1.0) for rate in rates]
    low, high = np.reshape(bounds, (-1, 2)).T
    axis.fill_between(steps, low, high, color="#000000", alpha=0.13, linewidth=0)
    marker = "." if len(steps) == 1 else ""
    axis.plot(steps, rates, color="#000000", label=f"evaluation, {episodes} episodes", marker=marker)
    axis.plot(steps, curve.column("train_success_rate"), color="#0072B2", linestyle="--", label="exploring", marker=marker)
    if np.isfinite(at_reset := curve.column("reset_success_rate")).any():
        axis.axhline(float(np.nanmean(at_reset)), color="0.6", linewidth=0.8, linestyle=":", label="at the reset")
    if "success_rate" in curve.result and len(steps):
        rate = curve.result["success_rate"]
        around = np.maximum([[rate - curve.result["success_low"]], [curve.result["success_high"] - rate]], 0.0)  # of rounding
        label = f"end, {curve.result['episodes']} episodes: {rate:.3f}"
        axis.errorbar(steps[-1], rate, around, color="#D55E00", marker="D", markersize=4, capsize=3, label=label)
    axis.set_title("success rate", fontsize=10)
    axis.set_ylim(-0.02, 1.02)
    axis.legend(frameon=False, fontsize=8)


def _unit(curves: Sequence[Record]) -> tuple[float, str]:
    """Unit of environment steps, and the label of their axis."""
    last = max((curve.rows[-1]["env_steps"] for curve in curves if curve.rows), default=0)
    return (1e6, "million environment steps") if last >= 1e6 else (1e3, "thousand environment steps")


def labels(curves: Sequence[Record]) -> list[str]:
    """Name of each run: the settings that it reads and in which the runs differ, or else its folder."""
    settings = [{**fingerprint.settings(c.spec), "seed": c.spec.seed, "physics": c.content["physics"]} for c in curves]
    varying = [name for name in fingerprint.varying(settings) if name != "engine"]
    told = [", ".join(fingerprint.named(name, each[name]) for name in varying if reads(each, name)) for each in settings]
    apart = [text if text and told.count(text) == 1 else f"{text}: {c.folder}".lstrip(": ") for text, c in zip(told, curves)]
    return [f"{text} ({c.status})" if c.status != run_folder.FINISHED else text for text, c in zip(apart, curves)]


def draw_together(curves: Sequence[Record]) -> Any:
    """Draws the success of several runs over environment steps and over seconds."""
    names = labels(curves)
    columns = max(1, min(4, 120 // (6 + max(map(len, names)))))
    rows = math.ceil(len(names) / columns)
    figure, axes = figures.subplots(1, 2, 10, 3.8 + 0.22 * rows)
    unit, label_steps = _unit(curves)
    for curve, name, (color, line, marker) in zip(curves, names, figures.styles(len(curves))):
        rates, every = curve.column("success_rate"), max(1, len(curve.rows) // 8)
        style = {"color": color, "linestyle": line, "marker": marker, "markevery": every, "markersize": 4}
        for axis, x in zip(axes, (curve.column("env_steps") / unit, curve.column("wall_seconds"))):
            axis.plot(x, rates, label=name, **style)
    title = f"{', '.join(dict.fromkeys(curve.spec.env for curve in curves))}: success of each evaluation"
    figures.label_success(figure, axes, (label_steps, "seconds of training"), names, columns, title)
    return figure


def curves_table(curves: Sequence[Record]) -> tuple[list[str], list[list[str]]]:
    """Table of several runs: its head, and cells with settings, progress and success."""
    head = ["run", "differences", "status", "env steps", "seconds", "last evaluation", "final success (95 % interval)"]
    cells = []
    for curve, name in zip(curves, labels(curves)):
        last, final = curve.rows[-1] if curve.rows else {}, ""
        if "success_rate" in curve.result:
            final = "{success_rate:.3f} ({success_low:.3f} to {success_high:.3f})".format(**curve.result)
        cells.append(
            [
                str(curve.folder),
                name,
                curve.status,
                f"{last.get('env_steps', 0):,}",
                f"{last.get('wall_seconds', 0):,.0f}",
                f"{last['success_rate']:.2f}" if last else "",
                final,
            ]
        )
    return head, cells
