"""Presets of the hand and the arm tasks, and what the pages say of them and of JaxGCRL's own code."""

import csv
import itertools

import numpy as np
import pytest
import scipy.stats
from conftest import ROOT
from test_pages import cells

from mjx_dher import envs, presets, spec
from mjx_dher.components import robot


def test_presets_know_the_robot_by_its_built_in_name():
    known = {"push": "fetch", "pen": "hand", "arm_grasp": "arms", "arm_of_mine": "", "mine:ArmGrasp": "", 3: ""}
    assert {env: robot(env) for env in known} == known
    for env in (name for name in envs.list_envs() if robot(name) == "arms"):
        for name in ("cpu", "gpu"):
            run = presets.preset(name, env)
            spec.validate(run)
            assert (run.learner, run.sampler, run.config.replay_size) == ("sac", "final", run.config.total_steps)
        assert presets.preset("gpu", env, learner="tqc").hparams == presets.preset("gpu", "push", learner="tqc").hparams
        assert presets.preset("gpu", env, sampler="future").sampler == "future"


def test_which_presets_have_mirror_images():
    """All learners of a preset, so that they can be compared, but `crl`."""
    of = lambda name, env, learner: presets.preset(name, env, learner).config.augmentation  # noqa: E731
    with_images = {
        "push": ("cpu", "gpu", "frugal"),
        "pick_and_place": ("cpu", "gpu", "frugal"),
        "slide": ("cpu", "frugal"),
        "reach": (),
    }
    assert sum(map(len, with_images.values())) == 8
    assert "eight of their nine tuned presets have it" in (ROOT / "docs" / "samplers.md").read_text()
    for env, names in with_images.items():
        for name in presets.PRESETS:
            expected = "mirror" if name in names else "none"
            assert {of(name, env, learner) for learner in (None, "ddpg", "td3", "tqc")} == {expected}
            assert of(name, env, "crl") == "none"


def test_tables_of_hands_and_arms_are_those_of_the_file():
    """Success on `native` and its median, on the presets' pages and beside others' on docs/field.md."""
    found: dict[str, list[dict[str, str]]] = {}
    with (ROOT / "docs" / "preset_success.csv").open() as file:
        for row in (row for row in csv.DictReader(file) if robot(row["task"]) != "fetch"):
            found.setdefault(row["task"], []).append(row)
    assert len(found) == 10
    pages = ROOT / "docs" / "experiments"
    text = (pages / "preset_hands.md").read_text().split("## Results")[1]
    text += (pages / "preset_gpu.md").read_text().split("## The arm tasks")[1]
    tables = [[cell.strip() for cell in cells(line)] for line in text.splitlines()]
    field = [
        line for line in (ROOT / "docs" / "field.md").read_text().splitlines() if line.startswith("| mjx-dher, preset `gpu` |")
    ]
    assert len(field) == 2
    for task, rows in found.items():
        (row,) = (row for row in tables if row[0] == f"`{task}`" and f"{int(rows[0]['env_steps']):,}" in row)
        median = f"{np.median([float(row['success']) for row in rows]):.3f}"
        assert ", ".join(row["success"] for row in rows) in row, task
        assert median in row, task
        assert median in " ".join(field), task


def test_what_the_page_says_of_the_hands_and_slides_candidates_follows_from_its_table():
    text = (ROOT / "docs" / "experiments" / "preset_hands.md").read_text().split("## Fewer errors")[1].split("## Results")[0]
    rows = [[cell.strip() for cell in cells(line)] for line in text.splitlines() if line.startswith("| ")]
    pairs = {}
    for before, after in itertools.pairwise(rows):
        if (before[1], after[1]) == ("preset", "candidate"):
            measure = 3 if before[0] == "Slide" else 2
            old, new = (np.array([float(number) for number in row[measure].split(", ")]) for row in (before, after))
            pairs[before[0].strip("`")] = new - old
    blocks = (pairs["block_rotate_parallel"], pairs["block_rotate_xyz"])
    for change in (np.concatenate(blocks), pairs["Slide"]):
        found = scipy.stats.ttest_1samp(change, 0)
        low, high = found.confidence_interval()
        row = f"| {change.mean():+.3f} ({low:.3f} to {high:.3f}), p {found.pvalue:.1g} | "
        assert float(text.split(row)[1][:5]) == pytest.approx(change.std(ddof=1), abs=6e-4)
    for change in blocks:
        low, high = scipy.stats.ttest_1samp(change, 0).confidence_interval()
        assert f"{change.mean():.3f} ({low:.3f} to {high:.3f})" in text
    assert np.concatenate(blocks).size == 10


def test_curves_of_jaxgcrls_own_code_are_those_of_the_file(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import crl_curves

    assert (
        crl_curves.report([ROOT / "docs" / "crl_curves.csv"]) in (ROOT / "docs" / "experiments" / "crl_jaxgcrl.md").read_text()
    )


PLAYED = ("last", "any_step", "time_at_goal", "steps", "seconds")


def test_success_at_any_step_is_that_of_the_file():
    """Means over ten seeds of the plays in docs/crl_rewards_played.csv, row by row, and the last time that `crl` is ahead."""
    page = (ROOT / "docs" / "experiments" / "crl_rewards.md").read_text()
    table = [cells(line)[-5:] for line in page.partition("| any state |")[2].splitlines()[2:45]]
    arms: dict[tuple[str, ...], list[dict[str, str]]] = {}
    with (ROOT / "docs" / "crl_rewards_played.csv").open() as file:
        for row in csv.DictReader(file):
            arms.setdefault((row["task"], row["learner"], row["rewards"]), []).append(row)
    order = [key for learner in ("sac_k4", "sac_final", "tqc_k4", "tqc_final", "crl") for key in arms if key[1] == learner]
    for key, found in zip(sorted(order, key=lambda key: key[0]), table, strict=True):
        last, any_step, held, steps, seconds = (np.array([float(row[name]) for row in arms[key]]) for name in PLAYED)
        reached, median = np.isfinite(steps).sum(), np.median(steps)
        fast = (f"{median / 1e3:.0f}", f"{np.median(seconds):.0f}") if np.isfinite(median) else ("\u2013", "\u2013")
        times = (f"{fast[0]} ({reached})", fast[1])
        assert [cell.strip() for cell in found] == [*(f"{value.mean():.3f}" for value in (last, any_step, held)), *times], key

    curves: dict[tuple[str, str], dict[str, dict[float, list[float]]]] = {}
    with (ROOT / "docs" / "crl_rewards_curves.csv").open() as file:
        for row in csv.DictReader(file):
            arm = curves.setdefault((row["task"], row["learner"]), {}).setdefault(row["rewards"], {})
            arm.setdefault(float(row["env_steps"]), []).append(float(row["success_rate"]))
    early = dict.fromkeys(("arm_grasp", "arm_push_easy", "arm_push_hard"), 76_800)
    for task, last in {**early, "block_rotate_z": 512_000, "pick_and_place": 128_000, "push": 153_600}.items():
        (crl,) = curves[task, "crl"].values()
        ahead = [
            steps
            for (its, learner), rewards in curves.items()
            for arm in rewards.values()
            for steps in crl
            if its == task and learner != "crl" and np.mean(crl[steps]) > np.mean(arm[steps])
        ]
        assert max(ahead) == last
        assert f"the first {last:,} of" in " ".join(page.split())


def paired(file, task, arm, base, paper=False):
    """Mean gain in mean success and its interval, from a file of runs, with learners other than `paper`, or with it."""
    runs = {}
    with (ROOT / "docs" / file).open() as rows:
        for row in csv.DictReader(rows):
            if row["task"] == task and (row["learner"] == "paper") == paper:
                runs.setdefault(row["arm"], {})[row["seed"]] = float(row["mean_success"])
    return interval(np.array([x - runs[base][seed] for seed, x in runs[arm].items()]))


def interval(gains):
    """Mean of paired gains [S], and its 95 % interval by Student's t."""
    return gains.mean(), *scipy.stats.t.interval(0.95, len(gains) - 1, gains.mean(), scipy.stats.sem(gains))


def test_what_the_pages_say_of_td_error_and_of_the_break_off_point():
    names = ("td_controls.md", "as_published.md", "../what_helps.md", "../../README.md")
    page, parted, helps, readme = (" ".join((ROOT / "docs" / "experiments" / name).read_text().split()) for name in names)
    tasks = ("pick_and_place", "slide", "block_rotate_z")
    for arm, base in (
        ("td_error", "more_updates"),
        ("td_error", "transitions_alone"),
        ("transitions_alone", "more_updates"),
        ("td_error_whole", "td_error"),
        ("td_error_whole", "more_updates"),
        ("transitions_alone", "random_of_four"),
        ("random_of_four", "uniform"),
    ):
        numbers = [paired("td_controls_runs.csv", task, arm, base) for task in tasks]
        shown = ["{:+.3f} ({:+.3f} to {:+.3f})".format(*found) for found in numbers]
        row = page.partition(f"| `{arm}` less `{base}` |")[2].split("|")[:6]
        assert [cell.strip().partition(", p")[0] for cell in row[::2]] == shown
        if (arm, base) == ("td_error", "more_updates"):
            (gain, low, high), *losses = numbers
            losses = [f"{-loss:.3f} ({-bounds[1]:.3f} to {-bounds[0]:.3f})" for loss, *bounds in losses]
            shown = f"gains {gain:.3f} ({low:.3f} to {high:.3f})", f"loses {losses[0]}"
            assert all(part in text for part in shown for text in (helps, readme))
            assert f"loses {losses[0]} on Slide and {losses[1]} on `block_rotate_z`" in helps

    more, half, whole = (
        [paired("td_controls_runs.csv", task, *of, paper=True) for task in ("pick_and_place", "slide")]
        for of in (("td_error_whole", "td_error"), ("td_error", "future"), ("td_error_whole", "future"))
    )
    row = page.partition("| `td_error_whole` less `td_error`, DDPG |")[2].split("|")[:3:2]
    assert [cell.strip() for cell in row] == ["{:+.3f} ({:+.3f} to {:+.3f})".format(*found) for found in more]
    assert "gains {:.3f} ({:.3f} to {:.3f}) and all of it {:.3f} ({:.3f} to {:.3f})".format(*half[0], *whole[0]) in page
    loss, high, low = (-x for x in whole[1])
    assert all(f"loses {loss:.3f} ({low:.3f} to {high:.3f})" in text for text in (page, helps))
    assert f"half of the batch gains {half[0][0]:.3f} on PickAndPlace" in helps
    assert "the whole {:.3f} ({:.3f} to {:.3f})".format(*whole[0]) in helps
    assert half[1][1] < 0.0 < half[1][2]
    over_uniform, *_ = paired("td_controls_runs.csv", "slide", "td_error_whole", "uniform")
    assert f"all of it gains {over_uniform:.3f} there over `uniform`" in page

    curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
    with (ROOT / "docs" / "break_off.csv").open() as file:
        for row in csv.DictReader(file):
            shown = float(row["success_rate"]), float(row["priority_mean"])
            curves.setdefault(row["setting"], {}).setdefault(row["seed"], []).append(shown)
    found = {s: [np.array(curve)[:, 0] for curve in runs.values()] for s, runs in curves.items()}  # success [50] of each seed
    start = {s: [next(i for i, (_, p) in enumerate(c) if p >= 0.2) for c in runs.values()] for s, runs in curves.items()}
    assert all(len(curve) == 50 for of in found.values() for curve in of)
    after = {s: np.array([c[b : b + 10].mean() for c, b in zip(found[s], start[s])]) for s in found}
    for sampler, mean in after.items():
        epochs = np.array(start[sampler]) + 1
        row = f"| `{sampler}` | {np.median(epochs):g} ({min(epochs)} to {max(epochs)}) | "
        if sampler != "future":
            areas = [np.trapezoid(found[name], dx=1 / 49) for name in (sampler, "future")]
            gains = (mean - after["future"], areas[0] - areas[1])
            shown = ["{:+.1f} ({:+.1f} to {:+.1f})".format(*interval(epochs - 1 - start["future"]))]
            shown += ["{:+.3f} ({:+.3f} to {:+.3f})".format(*interval(gain)) for gain in gains]
            if sampler == "weighted":
                chances = [scipy.stats.ttest_1samp(gain, 0.0).pvalue for gain in gains]
                shown[1:] = [f"{cell}, p {chance:.2f}" for cell, chance in zip(shown[1:], chances)]
            row += " | ".join(shown)
        assert row in parted, row


def test_how_random_weighted_is_stands_in_a_file():
    """Means over three seeds, and the first and last share that docs/results.md has."""
    names = ("mean", "mean, softmax", "none", "none, softmax", "closest")
    with (ROOT / "docs" / "randomness.csv").open() as file:
        rows = list(csv.DictReader(file))
    page, shares = (ROOT / "docs" / "samplers.md").read_text(), []
    for epoch in ("1", "3", "5", "8", "15"):
        of = [row for row in rows if row["epoch"] == epoch]
        shown = [np.mean([float(row[name]) for row in of]) for name in ("success_rate", "priority_mean", *names)]
        assert f"| {int(of[0]['env_steps']):,} | {' | '.join(f'{value:.2f}' for value in shown)} |" in page
        shares.append(shown[2])
    assert f"rises from {shares[0]:.2f} to {max(shares):.2f} and" in (ROOT / "docs" / "results.md").read_text()


def test_what_the_pages_say_of_hands_and_of_contrastive_rl():
    crl, readme = (" ".join((ROOT / name).read_text().split()) for name in ("docs/experiments/crl.md", "README.md"))
    hands = " ".join((ROOT / "docs" / "experiments" / "preset_hands.md").read_text().split())
    assert "k 1 gains {:.3f} ({:.3f} to {:.3f})".format(*paired("hands_runs.csv", "block_rotate_z", "k1", "future")) in readme
    k8, k16 = (paired("hands_runs.csv", "hand_reach", arm, "future")[0] for arm in ("k8", "k16"))
    assert f"k 8 and 16 gain {k8:.3f} and {k16:.3f}" in hands
    assert f"ends at {paired('hands_runs.csv', 'block_rotate_z', 'td_error', 'future')[2]:.3f}" in hands
    names = {"block_rotate_z": "Block Z", "pick_and_place": "PickAndPlace", "push": "Push", "slide": "Slide"}
    for task in ("push", "pick_and_place", "arm_push_easy", "slide", "arm_push_hard", "arm_grasp", "block_rotate_z"):
        found = [paired("crl_runs.csv", task, f"{learner}_final", f"{learner}_k4") for learner in ("sac", "tqc")]
        row = " | ".join("{:+.3f} ({:+.3f} to {:+.3f})".format(*numbers) for numbers in found)
        assert f"| {names.get(task, task)} | {row}" in crl


def test_what_the_pages_say_of_modern_critics():
    names = ("docs/experiments/ablation.md", "docs/what_helps.md")
    page, helps = (" ".join((ROOT / name).read_text().split()) for name in names)
    block, slide = (paired("modern_critics_runs.csv", task, "mlp", "preset") for task in ("block_rotate_z", "slide"))
    assert "Block Z gains {:.3f} ({:.3f} to {:.3f})".format(*block) in page
    assert "Slide's difference is {:+.3f} ({:+.3f} to {:+.3f})".format(*slide) in page
    assert "loses {:.3f}](experiments/ablation.md#modern-critics) ({:.3f} to {:.3f}, ten pairs)".format(*block) in helps
    for arm in ("residual", "unit_norm", "categorical", "categorical_unit_norm", "resets"):
        assert max(paired("modern_critics_runs.csv", task, arm, "preset")[2] for task in ("slide", "block_rotate_z")) < 0


def test_no_smaller_network_replaced_that_of_push():
    """Of the table of successes by seed: means, Student's intervals of the paired differences, and the plan's bound."""
    section = (ROOT / "docs" / "experiments" / "preset_gpu.md").read_text().split("### Push")[1].split("\n## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if line.count(", ") > 9]
    base, *smaller = (np.array(row[1].split(", "), float) for row in rows)
    assert [len(smaller), *map(len, smaller)] == [5] + [10] * 5
    assert [row[2] for row in rows] == [f"{each.mean():.3f}" for each in (base, *smaller)]
    assert [row[3] for row in rows] == ["", *("{:+.3f} ({:.3f} to {:.3f})".format(*interval(each - base)) for each in smaller)]
    assert max((each - base).mean() for each in smaller) < -0.005
