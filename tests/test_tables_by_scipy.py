"""Numbers of the tables in docs/results.md and docs/what_helps.md from the committed files, by scipy and plain loops."""

import csv
import itertools
import math
import re

import numpy as np
import pytest
import scipy.stats
from conftest import ROOT
from test_presets import interval

THRESHOLD = {"push": 0.9, "pick_and_place": 0.9, "slide": 0.6}
LAST = {"push": 10, "pick_and_place": 10, "slide": 20}
NAMES = {"push": "Push", "pick_and_place": "PickAndPlace", "slide": "Slide"}


@pytest.fixture(scope="module")
def curves():
    """Success [epochs] by task, sweep, setting and seed."""
    found = {}
    for task in NAMES:
        with (ROOT / "docs" / "paper" / f"{task}_curves.csv").open() as file:
            for row in csv.DictReader(file):
                by_seed = found.setdefault((task, row["sweep"], row["setting"]), {})
                by_seed.setdefault(int(row["seed"]), []).append(float(row["success_rate"]))
    return found


def rows_of(page, name):
    """Cells of a table between its comments. Empty first cells are those of the line above."""
    text = (ROOT / "docs" / page).read_text().partition(f"<!-- {name}: ")[2].partition(f"<!-- end of {name} -->")[0]
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[1:] if line.startswith("|")]
    for before, row in itertools.pairwise(found):
        row[0] = row[0] or before[0]
    return found[2:]


def area(curve):
    return np.trapezoid(curve) / (len(curve) - 1)


def epoch_of(curve, threshold):
    return next((epoch for epoch, success in enumerate(curve, 1) if success >= threshold), math.inf)


def said(values):
    """Mean and Student's t interval, as the pages write them."""
    low, high = scipy.stats.t.interval(0.95, len(values) - 1, np.mean(values), scipy.stats.sem(values))
    return f"{np.mean(values):.3f} ({low:.3f} to {high:.3f})"


def p_of(differences):
    """Two-sided, by flips of signs: all of them with ten seeds, and 30,000 with twenty."""
    flips = np.inf if len(differences) <= 10 else 30_000
    test = scipy.stats.permutation_test((differences,), np.mean, permutation_type="samples", n_resamples=flips, rng=0)
    return float(test.pvalue)


def by_holm(p_values):
    """By Holm's procedure, step by step."""
    found, least = {}, 0.0
    for rank, at in enumerate(np.argsort(p_values)):
        found[at] = least = max(least, min(1.0, (len(p_values) - rank) * p_values[at]))
    return [found[at] for at in range(len(p_values))]


def test_the_table_of_samplers(curves):
    rows = rows_of("results.md", "samplers")
    assert len(rows) == 8
    for task, sampler, late, mean, epochs, there, better in rows:
        name = next(task_name for task_name, shown in NAMES.items() if shown == task)
        sweep = "own_methods" if "closest" in sampler else f"own_{name}"
        own, base = list(curves[name, sweep, sampler.strip("`")].values()), list(curves[name, f"own_{name}", "future"].values())
        assert late == said([np.mean(curve[-LAST[name] :]) for curve in own])
        assert mean == said([area(curve) for curve in own])
        reached = [epoch_of(curve, THRESHOLD[name]) for curve in own]
        assert epochs.startswith(f"{np.median(reached):g} (")
        assert there == f"{np.isfinite(reached).sum()} of {len(own)}"
        u = scipy.stats.mannwhitneyu([area(curve) for curve in own], [area(curve) for curve in base]).statistic
        assert better == ("" if sampler == "`future`" else f"{u / len(own) / len(base):.2f}")


def test_the_table_of_single_pairs(curves):
    for task, least, sooner, later, same in rows_of("results.md", "lottery"):
        name = next(task_name for task_name, shown in NAMES.items() if shown == task)
        weighted, future = (
            [epoch_of(curve, 0.9) for curve in curves[name, f"own_{name}", setting].values()]
            for setting in ("weighted", "future")
        )
        gains = [theirs - own for own in weighted for theirs in future]
        assert sooner == f"{sum(gain >= int(least) for gain in gains)} of {len(gains)}"
        assert later == f"{sum(gain <= -int(least) for gain in gains)} of {len(gains)}"
        others = [b - a for i, a in enumerate(future) for j, b in enumerate(future) if i != j]
        assert same == f"{sum(gain >= int(least) for gain in others)} of {len(others)}"


# claim of the verdicts' table, its family of (task, sweep and setting, baseline's), and its place there
FAMILIES = [
    [(task, (f"own_{task}", "weighted"), (f"own_{task}", "future")) for task in NAMES],
    [("push", ("own_methods", name), ("own_push", "future")) for name in ("closest", "epsilon_closest")],
    [(task, (f"k_{task}", "future, her_k 16"), (f"k_{task}", "future, her_k 8")) for task in NAMES],
]
CLAIMS = {
    "Push: `weighted` converges sooner": (0, 0),
    "PickAndPlace: `weighted` converges sooner": (0, 1),
    "Slide: no noticeable difference": (0, 2),
    "Push: `epsilon_closest` is behind `future`": (1, 1),
    "Push: k 16 is worse": (2, 0),
    "PickAndPlace: k 16 is worse": (2, 1),
    "Slide: k 16 is worse": (2, 2),
}


def gains_of(curves, task, own, base):
    a, b = curves[task, *own], curves[task, *base]
    epochs = min(len(curve) for curve in (*a.values(), *b.values()))
    return np.array([area(a[seed][:epochs]) - area(b[seed][:epochs]) for seed in a])


def test_the_table_of_verdicts(curves):
    rows = {row[0]: row for row in rows_of("results.md", "verdicts")}
    for claim, (family, place) in CLAIMS.items():
        (row,) = (row for name, row in rows.items() if name.startswith(claim))
        gains = [gains_of(curves, *comparison) for comparison in FAMILIES[family]]
        own = gains[place]
        low, high = scipy.stats.t.interval(0.95, len(own) - 1, own.mean(), scipy.stats.sem(own))
        assert row[3:5] == [f"mean success {own.mean():+.3f}", f"{low:+.3f} to {high:+.3f}"]
        assert row[1] == str(len(own))
        corrected = by_holm([p_of(each) for each in gains])[place]
        assert float(row[5]) == pytest.approx(corrected, rel=0.05)
        worst = claim.startswith("Slide: no") or max(abs(low), abs(high)) > 0.02
        shown = ("not shown" if worst else "**alike**") if corrected >= 0.05 else "**"
        assert row[6].startswith(shown)


def test_the_epochs_that_weighted_is_sooner(curves):
    shown = [row for row in rows_of("results.md", "verdicts") if row[0].startswith("...")]
    levels = [("push", 0.2), ("push", 0.9), ("pick_and_place", 0.2), ("pick_and_place", 0.9)]
    for row, (task, level) in zip(shown, levels, strict=True):
        own, base = curves[task, f"own_{task}", "weighted"], curves[task, f"own_{task}", "future"]
        sooner = [epoch_of(base[seed], level) - epoch_of(own[seed], level) for seed in own]
        low, high = scipy.stats.t.interval(0.95, len(sooner) - 1, np.mean(sooner), scipy.stats.sem(sooner))
        assert row[3:5] == [f"{np.mean(sooner):+.1f} epochs sooner", f"{low:+.1f} to {high:+.1f}"]


def test_effects_of_what_helps(curves):
    """Differences of mean success of ten pairs, as its table of effects has them."""
    text = (ROOT / "docs" / "what_helps.md").read_text()
    cells = {line.split("|")[1].strip(): line.split("|")[2:5] for line in text.splitlines() if line.startswith("| ")}
    of_paper = {
        "k 8 in place of 4, one cycle per epoch": ("k_{}", "future, her_k 8", None),
        "k 16 in place of 4 (over 30 epochs +0.094 and +0.059)": ("k_{}", "future, her_k 16", None),
        "k 16 in place of 4, paper's cycles, 30 epochs": ("k_own_{}", "future, her_k 16", "own_{}"),
        "`closest` in place of `future`, paper's cycles, ten pairs": ("own_methods", "closest", "own_{}"),
    }
    for change, (sweep, setting, base) in of_paper.items():
        for task, cell in zip(NAMES, cells[change]):
            if cell.strip().startswith(("+", "-")):
                former = base.format(task) if base else {"push": "samplers"}.get(task, task)
                gains = gains_of(curves, task, (sweep.format(task), setting), (former, "future"))
                assert cell.strip() == f"{gains.mean():+.3f}", (change, task)
    runs = {}
    with (ROOT / "docs" / "ablation_runs.csv").open() as file:
        for row in csv.DictReader(file):
            runs.setdefault((row["task"], row["arm"]), {})[row["seed"]] = float(row["mean_success"])
    arms = {"half of the updates, preset `gpu`": "half_updates", "half of the batch": "half_batch"}
    arms |= {"half of the width": "half_width", "returns of one step in place of three": "one_step"}
    for change, arm in arms.items():
        for task, cell in zip(NAMES, cells[change]):
            if cell.strip().startswith(("+", "-")):
                gains = [runs[task, arm][seed] - runs[task, "preset"][seed] for seed in runs[task, arm]]
                assert cell.strip() == f"{np.mean(gains):+.3f}", (change, task)
    with (ROOT / "docs" / "td_controls_runs.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["learner"] == "best"]
    best = {(row["task"], row["arm"], row["seed"]): float(row["mean_success"]) for row in rows}
    [change] = [change for change in cells if change.startswith("the same, learners of `best`")]
    for task, cell in list(zip(NAMES, cells[change]))[1:]:
        seeds = sorted(seed for of, arm, seed in best if (of, arm) == (task, "uniform"))
        gains = [best[task, "future", seed] - best[task, "uniform", seed] for seed in seeds]
        assert len(seeds) == 20
        assert cell.strip() == f"{np.mean(gains):+.3f}"


def test_effects_of_the_tuned_methods():
    """As what_helps.md names them: means of ten pairs, and Student's interval of the gain."""
    with (ROOT / "docs" / "as_published_test_runs.csv").open() as file:
        runs = {(row["task"], row["arm"], row["seed"]): float(row["mean_success"]) for row in csv.DictReader(file)}
    rows = [line for line in (ROOT / "docs" / "what_helps.md").read_text().splitlines() if line.startswith("| `")]
    [effects] = [line for line in rows if "(`archer`)" in line]
    tuned = {line.split("`")[1]: line.partition("k tuned for both")[2].lower() for line in rows}
    tuned |= {"energy_clipped": tuned["energy"], "dpp": tuned["diversity"]}  # in one row each
    for task, arm, said in (
        ("push", "next_future", "{loss:.3f}, not shown"),
        ("push", "energy_clipped", "loses {loss:.3f} on push"),
        ("slide", "energy_clipped", "and {loss:.3f} on slide"),
        ("push", "hgg", "by {loss:.3f} on push"),
        ("pick_and_place", "hgg", "and {loss:.3f} on pickandplace"),
        ("pick_and_place", "archer", "gains {gain:.3f} on pickandplace ({low:.3f} to {high:.3f})"),
        ("slide", "archer", "{gain:.3f} on slide ({low:.3f} to {high:.3f})"),
        ("push", "td_error", "gains {gain:.3f} on push ({low:.3f} to {high:.3f})"),
        ("slide", "td_error", "and {gain:.3f} on slide"),
        ("push", "dpp", "loses {loss:.3f} on push"),
        ("pick_and_place", "dpp", "{loss:.3f} on pickandplace"),
        ("slide", "dpp", "and {loss:.3f} on slide"),
        ("push", "curriculum", "loses {loss:.3f} on push"),
        ("pick_and_place", "curriculum", "{loss:.3f} on pickandplace"),
        ("slide", "curriculum", "and {loss:.3f} on slide"),
        ("pick_and_place", "not_misleading", "{gain:.3f} on pickandplace is not shown"),
        ("pick_and_place", "td_error", "not shown are {gain:.3f} on pickandplace"),
    ):
        gains = np.array([runs[task, arm, str(seed)] - runs[task, "future", str(seed)] for seed in range(10, 20)])
        low, high = scipy.stats.t.interval(0.95, 9, gains.mean(), scipy.stats.sem(gains))
        assert arm != "archer" or f" {gains.mean():+.3f} " in effects
        assert said.format(gain=gains.mean(), loss=-gains.mean(), low=low, high=high) in tuned[arm], (task, arm)


def with_interval(gains, form="{:+.3f} ({:.3f} to {:.3f})"):
    return form.format(*interval(gains))


def test_what_mirror_images_gain():
    """Of both trials: means, and Student's intervals of the paired differences."""
    page = (ROOT / "docs" / "experiments" / "preset_mirror.md").read_text()
    lines = re.findall(r"\| (?:the preset|with mirror images) (\|.*\|)\n", page)
    assert len(lines) == 2
    for line in lines:
        *successes, mean = map(float, line.strip("| ").split(" | "))
        np.testing.assert_allclose(np.mean(successes), mean, atol=0.005)  # of rounded numbers
    shown, pairs = re.search(r"They gain (.*), Student's t\).*\n?.*The pairs gain (.*)\. All", page).groups()
    gains = np.array(re.findall(r"0\.\d{3}", pairs), float)
    np.testing.assert_allclose([*interval(gains)], [*map(float, re.findall(r"0\.\d{3}", shown))], atol=0.0015)
    rows = re.findall(r"\| 61\d \| (.*) \| (.*) \|", page)
    assert len(rows) == 5
    before, after = (np.array([[float(n.replace(",", "")) for n in row[i].split(", ")] for row in rows]) for i in (0, 1))
    shown = re.search(r"\| difference \| \| (.*) \|", page).group(1)
    numbers = [float(n.replace(",", "")) for n in re.findall(r"[-+][\d.]+(?:,\d{3})?", shown)]
    for column, (mean, low, high), allowed in zip((after - before).T, np.reshape(numbers, (3, 3)), (500, 0.001, 0.0005)):
        np.testing.assert_allclose([*interval(column)], [mean, low, high], atol=allowed)


MIRROR_RUNS = {  # (preset, task, environment steps, first seed): first cells of the row
    ("cpu", "push", 360_000, 690): "`cpu`, `push`",
    ("cpu", "push", 288_000, 690): "`cpu`, `push`",
    ("gpu", "push", 1_536_000, 690): "`gpu`, `push`",
    ("gpu", "push", 921_600, 690): "`gpu`, `push`, `lr_end` 0.05",
    ("gpu", "pick_and_place", 704_000, 690): "`gpu`, `pick_and_place`",
    ("gpu", "pick_and_place", 512_000, 690): "`gpu`, `pick_and_place`",
    ("cpu", "slide", 1_280_000, 690): "`cpu`, `slide`",
    ("cpu", "slide", 1_280_000, 710): "`cpu`, `slide`, 710 to 749",
    ("frugal", "push", 160_000, 710): "`frugal`, `push`, 710 to 729",
    ("frugal", "pick_and_place", 320_000, 710): "`frugal`, `pick_and_place`, 710 to 717",
    ("frugal", "slide", 1_000_000, 710): "`frugal`, `slide`, 710 to 729",
}


def test_what_mirror_images_gain_on_a_gpu():
    runs, native = {}, []
    with (ROOT / "docs" / "preset_mirror_runs.csv").open() as file:
        for row in csv.DictReader(file):
            if (row["task"], row["setting"]) == ("slide", "plain") and row["native"]:
                native.append((float(row["final"]), float(row["native"])))
            first = 690 if int(row["seed"]) < 710 else 710
            shorter = row["env_steps"] in ("96000", "112000", "192000", "224000")  # test_preset_trials.py
            if row["setting"] not in ("plain", "mirror") or shorter:
                continue
            of = runs.setdefault((row["preset"], row["task"], int(row["env_steps"]), first), {"plain": {}, "mirror": {}})
            measure = row["late_success" if row["task"] == "slide" else "mean_success"]
            of[row["setting"]][int(row["seed"])] = float(measure), float(row["final"]), float(row["steps_to_0.9"])
    assert runs.keys() == MIRROR_RUNS.keys()
    there, here = np.array(native).T
    screen = " ".join((ROOT / "docs" / "experiments" / "preset_screen.md").read_text().split())
    assert f"{there.mean():.3f} on `warp` and {here.mean():.3f} on `native`, {with_interval(here - there)}" in screen
    page = " ".join((ROOT / "docs" / "experiments" / "preset_mirror.md").read_text().split())
    arrays = {}
    for of, name in MIRROR_RUNS.items():
        seeds = range(
            of[3], of[3] + {("cpu", "slide", 710): 40, ("frugal", "pick_and_place", 710): 8}.get((*of[:2], of[3]), 20)
        )
        assert all(list(by_seed) == list(seeds) for by_seed in runs[of].values())
        plain, mirror = (np.array(list(runs[of][setting].values())).T for setting in ("plain", "mirror"))
        arrays[of] = plain, mirror
        measured, last = (f"{a.mean():.3f}, {b.mean():.3f} | {with_interval(b - a)}" for a, b in zip(plain[:2], mirror))
        assert f"| {name} | {of[2]:,} | {measured} | {(mirror[0] > plain[0]).sum()} | {last} |" in page
    helps = (ROOT / "docs" / "what_helps.md").read_text()
    shown = [f"{(mirror[0] - plain[0]).mean():+.3f}" for plain, mirror in arrays.values()]
    others = f"PickAndPlace with `frugal`, eight pairs: {shown[9]}; Slide with `frugal`, twenty: {shown[10]})"
    others = f"(Push with `gpu`: {shown[2]}, `frugal`: {shown[8]}; {others}"
    assert f"{others} | {shown[0]} | {shown[4]} | {shown[7]} | [mirror" in helps
    tips = (ROOT / "docs" / "tips.md").read_text()
    push, pick, slide = (f"{float(shown[i]):.2f}" for i in (0, 4, 7))
    assert f"[{push} and {pick} of mean success on Push and PickAndPlace, {slide} on Slide]" in tips
    without, with_images = arrays["cpu", "slide", 1_280_000, 710]
    reached = [(side[2] < np.inf).sum() for side in (with_images, without)]
    assert "comes in {} of 40 runs with them, and in {} without".format(*reached) in page
    lows = [f"{side[1].min():.3f}, {np.median(side[1]) - side[1].min():.3f}" for side in (with_images, without)]
    assert "ends at {} below the median. Without images it is {} below".format(*lows) in page
    steps = "{:,.0f} ({:,.0f} to {:,.0f})"
    for of, form in (
        (("cpu", "push", 360_000, 690), "{:,.0f} steps ({:,.0f} to {:,.0f})"),
        (("gpu", "pick_and_place", 704_000, 690), steps),
        (("gpu", "push", 1_536_000, 690), steps),
        (("gpu", "push", 921_600, 690), steps),
        (("frugal", "push", 160_000, 710), "{:,.0f} steps ({:,.0f} to {:,.0f})"),
    ):
        assert with_interval(arrays[of][0][2] - arrays[of][1][2], form) in page
    for long, short in (
        (("cpu", "push", 360_000, 690), ("cpu", "push", 288_000, 690)),
        (("gpu", "pick_and_place", 704_000, 690), ("gpu", "pick_and_place", 512_000, 690)),
    ):
        mirror = arrays[short][1][1]
        assert f"differs by {with_interval(mirror - arrays[long][0][1])} from the success after {long[2]:,} steps" in page
        assert f"seed has {mirror.min():.3f}" in page
        assert np.median(mirror) - mirror.min() < 0.05
        loses = with_interval(arrays[long][0][1] - arrays[short][0][1], "{:.3f} ({:.3f} to {:.3f})")
        assert short[1] == "push" or f"the shorter runs would lose {loses}" in page
    with (ROOT / "docs" / "unseen_runs.csv").open() as file:
        own = [
            (row["task"], float(row["final"]), float(row["steps"])) for row in csv.DictReader(file) if row["learner"] == "cpu"
        ]
    for task, text in (("push", "Push ends at"), ("pick_and_place", "of PickAndPlace end at")):
        final, first = np.array([row[1:] for row in own if row[0] == task]).T
        assert f"{text} {with_interval(final, '{:.3f} ({:.3f} to {:.3f})')}, with {final.min():.3f} at least" in page
        assert task == "push" or f"reach 0.90 after {np.median(first):,.0f} steps in the median" in page
    lost = arrays["gpu", "push", 1_536_000, 690][0][1] - arrays["gpu", "push", 921_600, 690][1][1]
    assert f"921,600 steps lose {with_interval(lost, '{:.3f} ({:.3f} to {:.3f})')}" in page


def test_what_hindsight_gains():
    """Of the table of runs with and without hindsight: means, and Student's interval of the paired difference."""
    section = (ROOT / "docs" / "experiments" / "preset_gpu.md").read_text().split("## Without hindsight")[1].split("\n## ")[0]
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if re.match(r"\| \w*\s*\| \d", line)
    ]
    assert [row[1] for row in rows] == ["0", "16"] * 2 + ["0", "8"]
    for without, with_hindsight in zip(rows[::2], rows[1::2]):
        a, b = (np.array(row[2].split(", "), float) for row in (without, with_hindsight))
        low, high = scipy.stats.t.interval(0.95, 4, (b - a).mean(), scipy.stats.sem(b - a))
        assert [without[3], with_hindsight[3]] == [f"{a.mean():.3f}", f"{b.mean():.3f}"]
        assert with_hindsight[4] == f"{(b - a).mean():.3f} ({low:.3f} to {high:.3f})"
