"""Pictures of a sweep: nothing is cut off, nothing overlaps, and failed runs are seen."""

import io
import itertools

import numpy as np
import pytest
from rich.console import Console
from test_comparison import cell, failed

from mjx_dher.cli.common import print_table
from mjx_dher.sweeps import comparison, plotting
from mjx_dher.tools import figures

LONG = "a_package_of_mine.samplers_of_mine:prefer_goals_that_are_near"
ENV = "a_package_of_mine.environments:TaskOfMine"


def groups_of(count, env="push", seeds=4, lanes=1):
    """So many settings, the last of which failed for one seed; two of them with long names."""
    rng = np.random.default_rng(0)
    cells = []
    for number in range(count):
        sampler = ("future", "weighted", LONG, f"{LONG}_and_far")[number % 4]
        for seed in range(seeds):
            curve = list(np.minimum(1.0, np.sort(0.95 + 0.01 * rng.random(12))))
            trial = {**cell(sampler, seed, curve, env=env, her_k=float(number // 4)), "lanes": lanes}
            cells.append(failed(trial, 3) if number == count - 1 and seed == 0 else trial)
    return comparison.groups(cells)[env]


def seen(tick, side):
    low, high = sorted(side.get_view_interval())
    return low <= tick.get_loc() <= high


def texts(figure):
    """Everything written in a figure that is seen, with its place."""
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    axes = figure.axes
    ticks = [
        tick.label1 for axis in axes for side in (axis.xaxis, axis.yaxis) for tick in side.get_major_ticks() if seen(tick, side)
    ]
    legends = [text for legend in figure.legends for text in legend.get_texts()]
    names = [label for axis in axes for label in (axis.xaxis.label, axis.yaxis.label, axis.title)]
    every = [*ticks, *legends, *names, *([figure._suptitle] if figure._suptitle else [])]
    return [(text, text.get_window_extent(renderer)) for text in every if text.get_text() and text.get_visible()]


@pytest.mark.parametrize(("count", "env"), [(1, "push"), (8, ENV)])
@pytest.mark.parametrize("name", ["curves", "thresholds", "comparison"])
def test_everything_written_is_inside_and_apart(name, env, count):
    groups = groups_of(count, env)
    rows = comparison.compare(groups, "future", 0.9)
    figure = (
        plotting.comparison(rows)
        if name == "comparison"
        else (plotting.curves(groups, 0.9) if name == "curves" else plotting.thresholds(groups, rows, 0.9))
    )
    width, height = figure.canvas.get_width_height()
    placed = texts(figure)
    for text, box in placed:
        assert box.x0 >= -1, (text.get_text(), box)
        assert box.x1 <= width + 1, (text.get_text(), box)
        assert box.y0 >= -1, (text.get_text(), box)
        assert box.y1 <= height + 1, (text.get_text(), box)
    for axis in figure.axes:
        boxes = sorted((box.x0, box.x1) for text, box in placed if text in axis.get_xticklabels())
        assert all(left[1] <= right[0] + 1 for left, right in itertools.pairwise(boxes)), boxes
    assert any("1 of 4 failed" in text.get_text().replace("\n", " ") for text, _ in placed)


def test_each_setting_has_its_own_line_in_the_legend():
    cells = [cell(sampler, seed, [0.2, 0.5]) for sampler in ("future", "_mine:a$_$", "mine:b") for seed in range(2)]
    groups = comparison.groups(cells)["push"]
    (legend,) = plotting.curves(groups, 0.9).legends
    own = {text.get_text().replace(r"\$", "$"): line.get_color() for text, line in zip(legend.get_texts(), legend.get_lines())}
    assert own == {group.label: color for group, (color, *_) in zip(groups, figures.styles(3))}
    for figure in plotting.draw(groups, comparison.compare(groups, "future", 0.9), 0.9).values():
        texts(figure)  # `$_$` is no formula


@pytest.mark.parametrize(("lanes", "label"), [(1, "seconds (one run)"), (5, "seconds (parallel runs)")])
def test_seconds_are_of_what_they_say(lanes, label):
    assert plotting.curves(groups_of(2, lanes=lanes), 0.9).axes[2].get_xlabel() == label


HEAD = ["env", "setting", "final success (IQM)"]
ROWS = [["push", f"future, action_l2 {x}, temperature 0.123456", "0.950 (0.900-1.000)"] for x in (1, 2)]


@pytest.mark.parametrize(("width", "terminal"), [(80, False), (20, False), (20, True), (50, True), (200, True)])
def test_a_table_is_never_cut(width, terminal):
    console = Console(file=io.StringIO(), width=width, force_terminal=terminal, color_system=None)
    print_table(HEAD, ROWS, console)
    text = console.file.getvalue()
    for row in ROWS:
        for part in row:
            assert part in text
    assert "\u2026" not in text


def test_curves_differ_in_colour_or_line():
    looks = [(colour, line) for colour, line, _ in figures.styles(49)]
    assert len(set(looks)) == 49
