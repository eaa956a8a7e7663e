"""What the pages say of trials of presets, recomputed from their runs by scipy."""

import csv
import itertools
import re

import numpy as np
from conftest import ROOT
from test_presets import interval
from test_tables_by_scipy import with_interval

from mjx_dher import presets


def runs(preset, task, setting, env_steps, first, count=None):
    """Late success, last success and steps to 0.90 of `count` seeds from `first` on. Default: as many as were run."""
    count = count or {"push": 20, "pick_and_place": 8, "slide": 10 if setting.endswith("again") else 40}[task]
    with (ROOT / "docs" / "preset_mirror_runs.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if first <= int(row["seed"]) < first + count]
    of = [row for row in rows if [*row.values()][:4] == [preset, task, setting, str(env_steps)]]
    assert [int(row["seed"]) for row in of] == list(range(first, first + count))
    return np.array([[float(row[name]) for name in ("late_success", "final", "steps_to_0.9")] for row in of]).T


def page(name):
    return " ".join((ROOT / "docs" / "experiments" / f"{name}.md").read_text().split())


def test_push_learns_in_fewer_steps():
    long, images = (runs("frugal", "push", setting, 160_000, 710)[1] for setting in ("plain", "mirror"))
    below = {}
    for steps in (112_000, 96_000):
        last = runs("frugal", "push", "mirror", steps, 710)[1]
        below[steps] = np.median(last) - last.min()
        numbers = f"{last.mean():.3f} | {with_interval(last - long)} | {last.min():.3f} | {below[steps]:.3f}"
        assert f"| {steps:,} | {numbers} |" in page("preset_mirror")
        assert np.mean(last - long) > -0.01
    assert below[112_000] < 0.05 < below[96_000]
    assert presets.preset("frugal", "push").config.total_steps == 112_000
    median = np.median(runs("frugal", "push", "mirror", 112_000, 710)[2])
    assert f"takes Push to 0.90 in {median:,.0f} steps" in page("../real_robot")
    less = with_interval(images - runs("frugal", "push", "mirror", 112_000, 710)[1], "{:.3f} ({:.3f} to {:.3f})")
    assert f"That is {less} less than after 160,000 with images" in page("preset_mirror")


def test_pick_and_place_learns_in_fewer_steps():
    plain, images = (runs("frugal", "pick_and_place", setting, 320_000, 710) for setting in ("plain", "mirror"))
    assert presets.preset("frugal", "pick_and_place").config.total_steps == 320_000
    first, mirror = f"{np.median(images[2]):,.0f}", page("preset_mirror")
    assert f"0.90 comes after {first} steps in the median ({images[2].min():,.0f} to {images[2].max():,.0f})" in mirror
    reached = plain[2][plain[2] < np.inf]
    assert len(reached) == 6
    lost = "{:.3f} and {:.3f}".format(*np.sort(plain[1])[:2])
    assert f"images take {reached.min():,.0f} to {reached.max():,.0f}, and two end at {lost}." in mirror
    lowest = f"the lowest ends at {images[1].min():.3f}, which is {np.median(images[1]) - images[1].min():.3f} below the median"
    assert lowest in mirror
    form, tens = "{:.3f} ({:.3f} to {:.3f})", {}
    for steps, seed in (*itertools.product((192_000, 224_000), (720, 620)), (320_000, 720)):
        for setting in ("mirror", "lr_end") if steps < 320_000 else ("preset",):
            _, last, reached = tens[setting, steps, seed] = runs("frugal", "pick_and_place", setting, steps, seed, 10)
            rates = {"mirror": "", "lr_end": f", {1 - 0.95 * steps / 320_000:.3g}", "preset": ", 0.05 (the preset)"}[setting]
            numbers = f"{with_interval(last, form)} | {last.min():.3f} | {(reached < np.inf).sum()} of 10"
            assert f"| {steps:,}{rates} | {seed} to {seed + 9} | {numbers} |" in mirror
    _, whole, reached = tens["preset", 320_000, 720]
    again = f"{np.median(reached):,.0f} steps in the median of these ten ({reached.min():,.0f} to {reached.max():,.0f})"
    assert again in mirror
    loses, gains = [], []
    for steps in (192_000, 224_000):
        loses.append(with_interval(whole - tens["lr_end", steps, 720][1], form))
        smaller, larger = (np.concatenate([tens[s, steps, seed][1] for seed in (720, 620)]) for s in ("mirror", "lr_end"))
        gains.append(with_interval(larger - smaller, form))
        assert np.mean(whole - tens["lr_end", steps, 720][1]) > 0.01  # so, by the plan, neither becomes the preset
    assert "192,000 steps lose {}, and 224,000 lose {},".format(*loses) in mirror
    assert "it is {} with 192,000 steps, and {} with 224,000".format(*gains) in mirror
    assert "lr_end` 0.43 and 0.335" in mirror
    with (ROOT / "docs" / "unseen_runs.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if (row["learner"], row["task"]) == ("frugal", "pick_and_place")]
    last, reached = np.array([(float(row["final"]), float(row["steps"])) for row in rows]).T
    unseen = (
        f"end at {with_interval(last, form)}, with {last.min():.3f} at least. 0.90 comes after {np.median(reached):,.0f} steps"
    )
    assert unseen in mirror
    assert f"and PickAndPlace in {np.median(reached):,.0f}, the medians of [twenty and ten" in page("../real_robot")


def test_slide_with_few_steps():
    late, last = zip(*(runs("frugal", "slide", setting, 1_000_000, 710, 20)[:2] for setting in ("plain", "mirror")))
    assert interval(late[1] - late[0])[1] > 0  # the plan's bound
    lows = [f"{side.min():.3f}, {np.median(side) - side.min():.3f} below" for side in last[::-1]]
    assert "ends at {} the median. Without images it is {}.".format(*lows) in page("preset_mirror")
    assert presets.preset("frugal", "slide").config.augmentation == "mirror"


def test_a_shorter_slide_ends_lower():
    plain, short = runs("cpu", "slide", "plain", 1_280_000, 710)[1], runs("cpu", "slide", "shared", 1_024_000, 710)[1]
    lower = with_interval(plain - short, "{:.3f} ({:.3f} to {:.3f})")
    assert f"the last success is {short.mean():.3f}, {lower} lower than without images" in page("preset_mirror")


def test_shared_candidates_cost_success():
    shared = runs("cpu", "slide", "shared", 1_280_000, 710)
    for setting, words in (("mirror", "`td_error`"), ("plain", "`td_error`, without mirror images")):
        other = runs("cpu", "slide", setting, 1_280_000, 710)
        form = "{:+.3f} ({:+.3f} to {:+.3f})"
        measure, last = (with_interval(gain, form) for gain in shared[:2] - other[:2])
        row = f"| {words} | {measure} | {(shared[0] > other[0]).sum()} of 40 | {last} |"
        assert row in page("bakeoff_repeats")
    assert f"It ends at {shared[1].mean():.3f}." in page("bakeoff_repeats")
    four, again = (runs("cpu", "slide", setting, 1_280_000, 710) for setting in ("mirror_again", "shared_again"))
    measure, last = (with_interval(gain, form) for gain in again[:2] - four[:2])
    assert (again[0] < four[0]).sum() == 8
    ends = f"{four[1].mean():.3f} and {again[1].mean():.3f}"
    assert f"{measure}, behind in eight, and {last} at the end, where they have {ends}." in page("bakeoff_repeats")
    with (ROOT / "docs" / "unseen_runs.csv").open() as file:
        here = [float(row["final"]) for row in csv.DictReader(file) if (row["learner"], row["task"]) == ("cpu", "slide")]
    ends = f"ten seeds end at {np.mean(here):.3f} on `native` and [forty others](bakeoff_repeats.md#cost-of-td_error) at"
    assert f"{ends} {shared[1].mean():.3f} on `warp`" in page("preset_screen")
    below = [np.median(last) - np.min(last) for last in (shared[1], here)]
    assert "it is {:.3f}, and {:.3f} on ten seeds of two cores".format(*below) in page("presets")


def test_the_candidate_of_slide_passed():
    """Means, spreads and Student's intervals of the third stage, as preset_screen.md has them."""
    with (ROOT / "docs" / "preset_screen_slide_runs.csv").open() as file:
        rows = [
            (row["setting"], int(row["seed"]), float(row["late_success"]), float(row["final"])) for row in csv.DictReader(file)
        ]
    assert [row[:2] for row in rows] == [(name, seed) for name in ("preset", "candidate") for seed in range(670, 690)]
    late, final = (np.array([row[column] for row in rows]).reshape(2, 20) for column in (2, 3))
    screen = page("preset_screen")
    for a, b in zip(late, final):
        assert f"| {a.mean():.3f} | {b.mean():.3f} ({b.min():.3f} to {b.max():.3f}) | {b.std(ddof=1):.3f} |" in screen
    gains = [with_interval(candidate - preset) for preset, candidate in (late, final)]
    assert f"| {gains[0]} | {gains[1]} |" in screen
    assert f"in {(late[1] > late[0]).sum()} of 20 pairs" in screen
    falls = [f"{np.median(each) - each.min():.3f}" for each in final[::-1]]
    assert "{} below the median, the former preset's {}.".format(*falls) in screen


def test_transfers_and_their_averages_are_of_the_rows():
    """Of fidelity.md: there minus here of each policy, and the averages over the policies of a preset."""
    text = page("../fidelity")
    row = r"\| (\w+) +\| `(\w+)`, (\d+) +\| (\d\.\d{3}) \(.*?\) \| (\d\.\d{3}) \(.*?\) \| ([-+]\d\.\d{3}) \("
    points = {}
    for task, preset, seed, there, here, shown in re.findall(row, text):
        assert f"{float(there) - float(here):+.3f}" == shown, (task, preset, seed)
        points.setdefault((preset, task), []).append(100 * (float(there) - float(here)))
    assert [len(of) for of in points.values()] == [5, 5, 5, 5, 5, 10]
    mean = {of: f"{np.mean(values):+.1f}".replace("+0.0", "0.0").replace("-0.0", "0.0") for of, values in points.items()}
    of_cpu = "; ".join(mean["cpu", task] for task in ("push", "pick_and_place", "slide"))
    assert f"| `cpu`, Push; PickAndPlace; Slide | {of_cpu} |" in text
    assert f"| `gpu`, Push; PickAndPlace | {mean['gpu', 'push']}; {mean['gpu', 'pick_and_place']} |" in text
    assert f"| `gpu`, Slide | {mean['gpu', 'slide']} (" in text
    lost = f"lose {mean['gpu', 'slide'][1:]} (preset `gpu`) and {mean['cpu', 'slide'][1:]} (`cpu`)"
    assert lost in text
    most = max(abs(float(mean[preset, task])) for preset in ("gpu", "cpu") for task in ("push", "pick_and_place"))
    assert f"policies change by at most {most} points there on Push and PickAndPlace" in text
