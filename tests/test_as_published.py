"""bench/as_published.py, td_controls.py, unseen.py, modern_critics.py and hands.py: the runs that docs/experiments plans."""

import csv
import dataclasses
import sys

import make_comparison_tables
import numpy as np
import pytest
from conftest import ROOT, refuses

from mjx_dher.spec import validate


def test_the_planned_comparisons_are_of_valid_runs(monkeypatch):
    """Each group is one program, arms differ, and numbers are those of the plan."""
    monkeypatch.syspath_prepend(ROOT / "bench")
    import as_published
    import bakeoff_arms
    import crl
    import hands
    import modern_critics
    import td_controls
    import unseen

    k_of = dict.fromkeys([arm.name for arm in as_published.METHODS], 8)
    monkeypatch.setattr(as_published, "best_k", lambda task, method: k_of[method])
    for experiment in (*as_published.EXPERIMENTS.values(), td_controls.CONTROLS, modern_critics.CRITICS, hands.HANDS):
        learner = experiment.learners[0]
        for task in experiment.tasks:
            specs = [experiment.spec_of(learner, task, arm, False) for arm in experiment.arms]
            assert len(set(specs)) == len(specs)
            for arm, spec in zip(experiment.arms, specs):
                validate(spec)
                validate(experiment.spec_of(learner, "reach", arm, True))
                own = {own.program for other, own in zip(experiment.arms, specs) if other.group == arm.group}
                assert own == {spec.program}
    controls = {arm.name: td_controls.spec_of("best", "slide", arm) for arm in td_controls.ARMS}
    assert controls["more_updates"].config.updates_per_cycle == 1.75 * controls["future"].config.updates_per_cycle
    with refuses("paper", "block_rotate_z"):
        td_controls.spec_of("paper", "block_rotate_z", td_controls.ARMS[0])
    strict = as_published.next_future("2cm", "push", as_published.METHODS[0])
    assert strict.env_arguments == {"distance_threshold": 0.02}
    cher, ebp = (as_published.EXPERIMENTS[name] for name in ("cher", "ebp"))
    one, many = (e.spec_of("", e.tasks[0], e.arms[1], False) for e in (cher, ebp))
    assert (one.config.num_envs, one.config.batch_size, one.hparams.priority_fraction) == (2, 64, 1.0)
    assert (many.config.num_envs, many.config.batch_size, many.config.total_steps) == (38, 4864, 4_750_000)
    assert unseen.spec_of("cpu", "push", unseen.UNSEEN.arms[0]).sampler == "weighted"
    for run in (bakeoff_arms.tuned("push"), *(crl.spec_of("", task, arm) for task in crl.SIZES for arm in crl.ARMS)):
        assert run.config.augmentation == "none"  # planned before the presets had mirror images


def test_runs_with_both_reward_conventions_differ_in_the_rewards_alone(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import crl_rewards

    from mjx_dher.envs import make

    for task in ("arm_push_easy", "pick_and_place"):
        runs = {name: [crl_rewards.spec_of(name, task, arm) for arm in crl_rewards.ARMS] for name in crl_rewards.SETTINGS}
        none, same = runs.pop("crl")
        assert none == same
        for negative, positive in runs.values():
            validate(positive)
            assert negative == dataclasses.replace(positive, env=negative.env) != positive
        here, there = (make(run.env) for run in runs["sac_k4"])
        goal = np.zeros((2, here.spec.goal_size), np.float32)
        reached = goal + np.float32([[0.0], [1.0]])
        assert [*here.compute_reward(reached, goal)] == [0.0, -1.0]
        assert here.spec.reward_range == (-1.0, 0.0)
        assert [*there.compute_reward(reached, goal)] == [1.0, 0.0]
        assert there.spec.reward_range == (0.0, 1.0)


def test_rewards_are_compared_over_the_arms_of_a_task(monkeypatch, tmp_path):
    """Ten equal differences have p 2/1024, and four arms are compared."""
    monkeypatch.syspath_prepend(ROOT / "bench")
    import bakeoff
    import bakeoff_runs
    import crl_rewards

    task, runs = "pick_and_place", tmp_path / "runs.csv"
    rows = [
        bakeoff_runs.Run(name, task, arm.name, seed, bakeoff_runs.name_of(spec, seed), 0, 0.5 + 0.1 * number, 0.5, 1.0)
        for name in ("sac_k4", "tqc_k4")
        for number, arm in enumerate(crl_rewards.ARMS)
        for spec in [crl_rewards.spec_of(name, task, arm)]
        for seed in range(20, 30)
    ]
    bakeoff_runs.save(runs, rows)
    options = ["--out", str(tmp_path), "--tasks", task, "--runs", str(runs), "--report"]
    assert bakeoff.main(options, crl_rewards.REWARDS) == 0
    with (tmp_path / "rewards.csv").open(newline="") as file:
        found = [row for row in csv.DictReader(file) if row["arm"] == "positive"]
    assert [(row["learner"], float(row["p_corrected"])) for row in found] == [("sac_k4", 0.0078125), ("tqc_k4", 0.0078125)]


def test_the_tuned_k_has_the_largest_mean_success(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import as_published
    import bakeoff_runs

    path = tmp_path / "runs.csv"
    monkeypatch.setattr(as_published, "TUNED", path)
    runs = [
        bakeoff_runs.Run("paper", "push", f"hgg_k{k}", seed, f"{k}-{seed}", 0, success, 0.5, 1.0)
        for k, scores in {4: (0.5, 0.5), 8: (0.1, 0.95), 16: (0.6, 0.4)}.items()
        for seed, success in enumerate(scores)
    ]
    bakeoff_runs.save(path, runs)
    assert as_published.best_k.__wrapped__("push", "hgg") == 8
    with refuses("hgg", "slide"):
        as_published.best_k.__wrapped__("slide", "hgg")


def test_runs_that_are_kept_are_those_of_the_arms_as_they_are():
    """Else `--runs` would train them again: a preset that changes must not change what was compared."""
    import as_published
    import bakeoff_runs

    kept = {page.data: page.experiment for page in make_comparison_tables.PAGES}
    kept[as_published.TUNED] = as_published.EXPERIMENTS["tune"]
    for other_precision in ("crl_rewards", "td_controls"):  # in part, which is a setting
        del kept[ROOT / "docs" / f"{other_precision}_runs.csv"]
    for path, experiment in kept.items():
        assert bakeoff_runs.load(path, experiment)


def test_the_page_has_the_means_of_the_tuning_runs_and_the_k_that_test_would_use():
    text = (ROOT / "docs" / "experiments" / "as_published.md").read_text().split("### The tuning of k")[1].split("###")[0]
    with (ROOT / "docs" / "as_published_tune_runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    shown = 0
    for method, *tasks in (
        [cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| `")
    ):
        for task, cell in zip(("push", "pick_and_place", "slide"), tasks, strict=True):
            own = [[row for row in rows if (row["task"], row["arm"]) == (task, f"{method[1:-1]}_k{k}")] for k in (4, 8, 16)]
            assert [len(runs) for runs in own] == ([5, 5, 5] if cell else [0, 0, 0])
            means = [sum(float(row["mean_success"]) for row in runs) / 5 for runs in own]
            marked = [f"**{mean:.3f}**" if cell and mean == max(means) else f"{mean:.3f}" for mean in means]
            assert cell in (", ".join(marked), "")
            shown += sum(map(len, own))
    assert shown == len(rows)
    assert f"{shown} of 450 runs" in text


def test_curves_of_both_are_compared_over_the_steps_that_both_have(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import crl_curves

    size = crl_curves.SIZES["arm_reach"]
    assert (size.updates, size.first, size.total) == (50, 13, 256 * 8 * (13 + 6 * 20))
    rows = [("ours", "arm_reach", seed, steps, steps / 400 + 0.1 * seed, "") for seed in (0, 1) for steps in (0, 200)]
    rows += [("theirs", "arm_reach", seed, steps, 0.1 * seed, 1.0) for seed in (0, 1) for steps in (100, 300)]
    with (tmp_path / "curves.csv").open("w", newline="") as file:
        csv.writer(file).writerows([crl_curves.COLUMNS, *rows])
    ours, theirs = crl_curves.report([tmp_path / "curves.csv"]).splitlines()[2:]
    # From 100 to 200 steps: means 0.375 and 0.475 against 0 and 0.1. Both variances are 0.005, so t has two degrees of freedom.
    half = 4.302653 * (2 * 0.005 / 2) ** 0.5
    assert ours == f"| `arm_reach` | ours | 2 | 0.425 | 0.550 | +0.375 | {0.375 - half:+.3f} to {0.375 + half:+.3f} |"
    assert theirs == "| `arm_reach` | theirs | 2 | 0.050 | 0.050 |  |  |"


@pytest.mark.parametrize(("argv", "status"), [(["--help"], 0), ([], 2), (["chr"], 2)])
def test_the_first_argument_is_an_experiment(argv, status, monkeypatch, capsys):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import as_published

    monkeypatch.setattr(sys, "argv", ["as_published.py", *argv])
    with pytest.raises(SystemExit) as ended:
        as_published.main()
    assert ended.value.code == status
    assert "next_future" in "".join(capsys.readouterr())
