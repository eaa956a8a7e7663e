import math

import numpy as np
import pytest
from conftest import refuses

from mjx_dher import RunSpec, stats
from mjx_dher.runs.folder import fingerprint
from mjx_dher.sweeps import comparison
from mjx_dher.system.files import FolderError


def cell(sampler, seed, success, env="push", final=None, **numbers):
    curve = {
        "epoch": list(range(1, len(success) + 1)),
        "env_steps": [1000 * i for i in range(1, len(success) + 1)],
        "wall_seconds": [2.0 * i for i in range(1, len(success) + 1)],
        "success_rate": list(success),
    }
    final = {"success_rate": success[-1] if final is None else final, "reset_success_rate": 0.07}
    settings = {**fingerprint.settings(RunSpec(env=env, sampler=sampler)), **numbers}
    return {
        "settings": settings,
        "seed": seed,
        "status": "finished",
        "asked_engine": "auto",
        "curve": curve,
        "final": final,
        "lanes": 1,
        "folder": f"cells/{sampler}-{seed}",
    }


SLOW = [[0.0, 0.2, 0.5, 0.9], [0.1, 0.3, 0.5, 0.8], [0.0, 0.2, 0.6, 0.9]]
FAST = [[0.2, 0.9, 0.9, 1.0], [0.3, 0.8, 0.9, 0.9], [0.2, 0.9, 1.0, 1.0]]
CELLS = [cell(s, i, c) for s, curves in (("weighted", FAST), ("future", SLOW)) for i, c in enumerate(curves)]


def test_a_setting_against_the_baseline_by_hand():
    (groups,) = comparison.groups(CELLS).values()
    assert [g.label for g in groups] == ["future", "weighted"]
    slow, fast = comparison.compare(groups, "future", 0.9)
    # Areas by trapezoids over three epochs: (first + last) / 2 + the two between, divided by 3.
    areas = {"slow": [1.15 / 3, 1.25 / 3, 1.25 / 3], "fast": [2.4 / 3, 2.3 / 3, 2.5 / 3]}
    assert fast.area == pytest.approx(2.4 / 3)
    assert slow.area == pytest.approx(np.mean(areas["slow"]))
    assert fast.area_gain == pytest.approx(np.mean(np.subtract(areas["fast"], areas["slow"])))
    # To 0.9: epochs 2, 3, 2 against 4, never, 4.
    assert (fast.epochs, fast.reached, fast.env_steps) == (2, 3, 2000)
    assert (slow.epochs, slow.reached, slow.epochs_high) == (4, 2, math.inf)
    assert fast.better == 1.0
    # All three differences are positive: of 8 changes of sign, two are as extreme.
    assert fast.p_value == fast.p_corrected == 0.25
    assert math.isnan(slow.better)
    assert math.isnan(slow.p_corrected)
    assert fast.final == pytest.approx(2.9 / 3)
    assert fast.at_reset == pytest.approx(0.07)
    assert fast.final_low <= fast.final_iqm <= fast.final_high


def test_a_custom_sampler_is_compared_with_a_built_in_one():
    cells = [cell("future", i, curve, source="task.py 01") for i, curve in enumerate(SLOW)]
    cells += [cell("mine:soon", i, curve, source="task.py 01, mine.py 23") for i, curve in enumerate(FAST)]
    cells += [cell("mine:late", i, curve, source="task.py 45, mine.py 23") for i, curve in enumerate(FAST)]  # another task
    rows = comparison.compare(comparison.groups(cells)["push"], "future", 0.9)
    better = {row.setting.split(",")[0]: row.better for row in rows}
    assert better["mine:soon"] == 1.0
    assert math.isnan(better["mine:late"])


def test_a_setting_of_which_all_seeds_fail_counts_to_the_end():
    short = [{**cell("weighted", i, curve[:2]), "status": "failed", "final": {}} for i, curve in enumerate(FAST)]
    at_once = [{**one, "curve": {}} for one in short]
    for failed, areas in ((short, [1.0 / 3, 0.95 / 3, 1.0 / 3]), (at_once, [0.0] * 3)):
        cells = [{**one, "settings": {**one["settings"], "total_steps": 4000}} for one in (*CELLS[3:], *failed)]
        row = comparison.compare(comparison.groups(cells)["push"], "future", 0.9)[1]
        assert row.failed == 3
        # (first + last) / 2 + the two between, divided by 3: the last two are 0.
        assert row.area_gain == pytest.approx(np.mean(areas) - 3.65 / 9)
        assert (row.epochs, row.env_steps) in ((2.0, 2000.0), (math.inf, math.inf))


def test_p_values_are_corrected_over_the_settings_of_an_environment():
    cells = [*CELLS, *(cell("closest", i, [x / 2 for x in curve]) for i, curve in enumerate(SLOW))]
    rows = {row.setting: row for row in comparison.compare(comparison.groups(cells)["push"], "future", 0.9)}
    assert rows["weighted"].p_corrected == rows["closest"].p_corrected == stats.holm([0.25, 0.25])[0] == 0.5


@pytest.mark.parametrize("kept", [(1, 2), (2,)])
def test_the_seeds_that_both_have_are_paired(kept):
    cells = [c for c in CELLS if c["settings"]["sampler"] != "weighted" or c["seed"] in kept]
    fast = comparison.compare(comparison.groups(cells)["push"], "future", 0.9)[1]
    assert fast.better == 1.0
    if len(kept) < 2:
        assert math.isnan(fast.p_value)
        return
    # Areas of the seeds 1 and 2, as above. Of 4 changes of sign, two are as extreme.
    assert fast.area_gain == pytest.approx(np.mean(np.subtract([2.3 / 3, 2.5 / 3], [1.25 / 3, 1.25 / 3])))
    assert fast.p_value == 0.5


def test_labels_say_what_differs_and_the_baseline_shares_it():
    """A sampler as the baseline stands for its setting with the same other numbers, as far as it reads them."""
    cells = [
        cell(sampler, seed, curve, her_k=k, temperature=t)
        for sampler, curves in (("future", SLOW), ("weighted", FAST))
        for k in (2.0, 4.0)
        for t in ((0.5, 1.0) if sampler == "weighted" else (1.0,))
        for seed, curve in enumerate(curves)
    ]
    groups = comparison.groups(cells)["push"]
    labels = ["future, her_k 2", "future, her_k 4"]
    weighted = [f"weighted, her_k {k}, temperature {t}" for k in (2, 4) for t in (0.5, 1)]
    assert [g.label for g in groups] == [*labels, *weighted]
    bases = {g.label: comparison._baseline_of(g, groups, "future") for g in groups}
    assert [bases[label] for label in labels] == [None, None]
    assert [bases[label].label for label in weighted] == [labels[0]] * 2 + [labels[1]] * 2
    assert comparison._baseline_of(groups[3], groups, "future, her_k 2").label == "future, her_k 2"
    assert comparison._baseline_of(groups[3], groups, "episode") is None


def test_numbers_are_in_rising_order():
    cells = [cell("future", 0, SLOW[0], her_k=k) for k in (16.0, 2.0, 4.0)]
    (groups,) = comparison.groups(cells).values()
    assert [g.label for g in groups] == ["future, her_k 2", "future, her_k 4", "future, her_k 16"]


def test_a_setting_that_some_runs_lack_comes_first():
    cells = [cell("future", i, c, demonstrations=name) for name in ("b.npz", None, "a.npz") for i, c in enumerate(SLOW)]
    (groups,) = comparison.groups(cells).values()
    assert [group.others["demonstrations"] for group in groups] == [None, "a.npz", "b.npz"]


def test_environments_are_compared_apart():
    found = comparison.groups([*CELLS, *(cell("future", i, c, env="slide") for i, c in enumerate(SLOW))])
    assert {env: [g.label for g in groups] for env, groups in found.items()} == {
        "push": ["future", "weighted"],
        "slide": ["future"],
    }


def test_the_table_says_never_where_no_seed_got_there(tmp_path):
    rows = comparison.compare(comparison.groups(CELLS)["push"], "future", 0.95)
    _, cells = comparison.table(rows)
    assert cells[0][5] == "never"
    assert cells[1][5].endswith("2 of 3")
    comparison.write(tmp_path, rows)
    lines = (tmp_path / comparison.COMPARISON).read_text().splitlines()
    assert lines[0].split(",") == list(comparison.Row._fields)
    assert len(lines) == 3


@pytest.mark.parametrize(
    ("reach", "median"),
    [([2, 9], math.inf), ([6, 8, 0, 0], math.inf), ([6, 8], 7), ([6, 8, 9, 0], 8.5), ([6, 8, 0], 8), ([6, 0, 0], math.inf)],
)
def test_the_median_is_the_median(reach, median):
    """Epochs to the threshold; 0: never. With an even number of seeds it lies between the two in the middle."""
    curves = [[1.0 if first and epoch >= first else 0.0 for epoch in range(1, 10)] for first in reach]
    if reach == [2, 9]:
        curves[1] = [0.0] * 9
    (group,) = comparison.groups([cell("future", i, curve) for i, curve in enumerate(curves)])["push"]
    (row,) = comparison.compare([group], "future", 0.9)
    assert (row.epochs, row.env_steps) == (median, 1000 * median)
    assert row.epochs_low <= row.epochs <= row.epochs_high
    _, ((*_, epochs, _, _),) = comparison.table([row])
    assert epochs.startswith("inf (" if median == math.inf else f"{median:g} (")


def test_settings_that_print_alike_stay_apart():
    cells = [cell("future", seed, SLOW[0], gamma=g) for seed in (0, 1) for g in (0.98, 0.98000001)]
    groups = comparison.groups(cells)["push"]
    assert [g.label for g in groups] == ["future, gamma 0.98", "future, gamma 0.98000001"]
    assert [g.seeds for g in groups] == [(0, 1), (0, 1)]


def test_own_code_that_changed_is_another_setting():
    cells = [cell("future", 0, SLOW[0], source=source) for source in ("", "task.py 0123456789", "task.py abcdef0123")]
    labels = [g.label for g in comparison.groups(cells)["push"]]
    assert labels == ["future", "future, task.py 0123456789", "future, task.py abcdef0123"]


def test_no_seed_is_counted_twice():
    """A copied folder is named; runs that differ in what their sampler does not read are the same run."""
    copied = [cell("future", 0, SLOW[0]), {**cell("future", 0, SLOW[0]), "folder": "cells/copy"}]
    with refuses("cells/future-0", "cells/copy", error=FolderError):
        comparison.groups(copied)
    alike = [cell("future", 0, SLOW[0], temperature=t) for t in (0.5, 1.0)]
    others = [cell("weighted", 0, SLOW[0], temperature=t) for t in (0.5, 1.0)]
    groups = comparison.groups([*alike, *others])["push"]
    assert [(g.label, g.seeds) for g in groups] == [
        ("future", (0,)),
        ("weighted, temperature 0.5", (0,)),
        ("weighted, temperature 1", (0,)),
    ]


def failed(trial, epochs):
    """The trial as one that failed in the epoch after `epochs` of them."""
    curve = {name: values[:epochs] for name, values in trial["curve"].items()}
    return {**trial, "status": "failed", "reason": "not finite", "curve": curve, "final": {}}


def test_a_setting_that_failed_throughout_has_no_numbers():
    cells = [*CELLS[:3], *(failed(cell("future", i, SLOW[0]), 2) for i in range(3))]
    rows = comparison.compare(comparison.groups(cells)["push"], "weighted", 0.9)
    _, lines = comparison.table(rows)
    assert lines[0][:6] == ["push", "future", "3 (3 failed)", "failed", "failed", "never"]
    assert [(row.failed, row.setting) for row in rows] == [(3, "future"), (0, "weighted")]
    assert math.isnan(rows[0].at_reset)
