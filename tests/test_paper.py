"""The set of runs that docs/experiments/paper_set.md states beforehand: commands, comparisons, and tables from its curves."""

import csv
import importlib.util
import math
import os
import signal
import subprocess
import sys
import threading

import make_results_figures
import numpy as np
import paper_analysis
import paper_set
import pytest
from conftest import ROOT, refuses

from mjx_dher import config
from mjx_dher.cli import sweep as cli_sweep
from mjx_dher.runs.folder import fingerprint
from mjx_dher.sweeps import comparison
from probes import held

_spec = importlib.util.spec_from_file_location("bench_paper", ROOT / "bench" / "paper.py")
paper = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(paper)
SWEEPS = [sweep for figure in paper.FIGURES.values() for sweep in figure]


def trials_of(sweep, out, toy=False):
    (_, *argv) = paper.command(sweep, out, toy)
    return cli_sweep.parse_sweep_args(argv)[1]


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """What each command of the set trains."""
    folder = tmp_path_factory.mktemp("set")
    return {sweep: trials_of(sweep, folder) for sweep in SWEEPS}


def test_every_command_trains_what_the_page_says(trials):
    assert len({sweep.name for sweep in SWEEPS}) == len(SWEEPS)
    for sweep, runs in trials.items():
        assert len(runs) == sweep.settings * sweep.seeds, sweep.name
        assert {run.seed for run in runs} == set(range(sweep.first_seed, sweep.first_seed + sweep.seeds))
        assert len({run.program for run in runs}) == 1, sweep.name  # lanes of one program
        for run in runs:
            assert config.num_epochs(run.config, 50) == sweep.epochs
            dtype = "float32" if sweep.own_cycles else "bfloat16"
            assert (run.env, run.networks, run.config.learner_dtype) == (sweep.task, "fan_in", dtype)
            assert run.config.cycles_per_epoch == (50 if sweep.own_cycles else 1)
            workers = 16 if sweep.task == "pick_and_place" else 8
            assert run.config.batch_size == 256 * workers
            # An epoch of the paper: 50 cycles of two episodes a worker, and of 40 updates.
            assert run.config.num_envs * run.config.cycles_per_epoch == 100 * workers
            assert run.config.updates_per_cycle * run.config.cycles_per_epoch == 2000
    readings = {(r.weight_normalization, r.weight_kernel) for s, runs in trials.items() if s.task == "push" for r in runs}
    assert {normalization for normalization, _ in readings} == {"mean", "sum", "max", "minmax", "none", "far"}
    assert {run.config.replay_size for s, runs in trials.items() if s.name == "ring_slide" for run in runs} == {1_000_000}
    assert {run.hparams.random_noise for s, runs in trials.items() if s.name == "noise_slide" for run in runs} == {0.0}


def finished(run):
    """A trial as `tables.read` gives it, of two epochs."""
    settings = {**fingerprint.settings(run), "engine": "none", "source": ""}
    curve = {"epoch": [1, 2], "env_steps": [1, 2], "wall_seconds": [1.0, 2.0], "success_rate": [0.0, 0.1 * run.seed]}
    final = {"success_rate": 0.0, "reset_success_rate": 0.0, "return_mean": 0.0, "episodes": 1}
    return {
        "settings": settings,
        "seed": run.seed,
        "status": "finished",
        "lanes": 1,
        "final": final,
        "curve": curve,
        "folder": run,
    }


def test_every_comparison_is_of_settings_that_the_set_has(trials):
    """By the names under which their curves are written."""
    named = {}
    for sweep, runs in trials.items():
        (groups,) = comparison.groups([finished(run) for run in runs]).values()
        assert len(groups) == sweep.settings, sweep.name
        for group in groups:
            named[sweep.task, sweep.name, paper.named(sweep, group.label)] = len(group.seeds)
    needed = {(c.task, c.sweep, c.setting) for family in paper_set.FAMILIES.values() for c in family}
    needed |= {(c.task, *paper_set._baseline(c)) for family in paper_set.FAMILIES.values() for c in family}
    assert needed <= set(named)
    assert set(named) - needed == {("push", "samplers", "episode")}
    assert {count for (_, sweep, _), count in named.items() if sweep in ("own_push", "own_pick_and_place")} == {20}
    assert {count for (_, sweep, _), count in named.items() if sweep not in ("own_push", "own_pick_and_place")} == {10}


def test_no_family_is_larger_than_ten_pairs_can_decide():
    """The least p of ten pairs is 2 / 2^10, and Holm's first step multiplies it by the family's size."""
    assert all(2 / 2**10 * len(family) < 0.05 for family in paper_set.FAMILIES.values())


def test_what_ten_seeds_can_show():
    """A paired t test of ten pairs finds an effect of 1.0 spreads four times in five (Cohen 1988: n = 10, d = 0.996)."""
    assert paper_set.detectable(1.0, 10, 0.05) == pytest.approx(0.996, abs=0.002)
    assert paper_set.detectable(0.02, 10, 0.05) == pytest.approx(0.0199, abs=1e-4)
    draws = np.random.default_rng(0).normal(0.996, 1.0, (20_000, 10))
    t = draws.mean(axis=1) / (draws.std(axis=1, ddof=1) / math.sqrt(10))
    assert abs((t > 2.262).mean() - 0.8) < 0.01  # 2.262: the 97.5 % point of t with nine degrees of freedom


def write_curves(folder, task, settings):
    """A file of curves of ten seeds and three epochs; `settings` maps sweep and setting to success in all epochs."""
    with (folder / f"{task}_curves.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, paper.COLUMNS)
        writer.writeheader()
        for (sweep, setting), level in settings.items():
            for seed in range(10):
                for epoch in (1, 2, 3):
                    rate = level + 0.01 * (seed % 2)  # the same for a seed, so differences do not vary
                    values = (sweep, setting, seed, epoch, epoch, f"{rate:g}")
                    writer.writerow(dict(zip(paper.COLUMNS, values)))


def test_verdicts_by_hand(tmp_path):
    main = {("slide", "future"): 0.5, ("slide", "weighted"): 0.51}
    write_curves(tmp_path, "slide", {**main, ("noise_slide", "future, random_noise 0"): 0.4})
    write_curves(tmp_path, "push", {("samplers", "future"): 0.5, ("samplers", "weighted"): 0.53})
    rows = paper_set.rows(paper_set.load_set(tmp_path))
    assert [row[:2] for row in rows] == [
        ["the paper's claim", "Push"],
        ["the paper's claim", "Slide"],
        ["settings of Slide", "Slide"],
    ]
    assert rows[0][5:8] == ["+0.030", "+0.030 to +0.030", "0.002"]
    assert rows[1][5] == "+0.010"
    assert rows[2][5] == "-0.100"
    # No family is whole. What has not been run counts as 1: of 2/1024, 2/1024 and 1, and of 2/1024 and 1.
    assert [[row[8], row[-1]] for row in rows] == [["0.0059", "better"], ["0.0059", "better"], ["0.0039", "worse"]]
    assert [row[9] for row in rows] == ["0.002"] * 3  # all flips but two are less extreme, for both comparisons together
    write_curves(tmp_path, "pick_and_place", {("pick_and_place", name): 0.5 for name in ("future", "weighted")})
    rows = paper_set.rows(paper_set.load_set(tmp_path))
    # Of 2/1024, 2/1024 and 1: Holm gives 6/1024, 6/1024 and 1.
    assert [(row[1], row[8], row[-1]) for row in rows[:3]] == [
        ("Push", "0.0059", "better"),
        ("PickAndPlace", "1.00", "alike"),
        ("Slide", "0.0059", "better"),
    ]


def test_the_interval_is_students_t_and_pairs_by_seed():
    """By hand: differences 0.1, 0.2 and 0.3 have mean 0.2, spread 0.1 and t 4.303 with two degrees of freedom."""
    d = paper_analysis.difference(np.array([0.4, 0.4, 0.4]), np.array([0.3, 0.2, 0.1]))
    assert (d.mean, d.low, d.high) == pytest.approx((0.2, 0.2 - 4.303 * 0.1 / 3**0.5, 0.2 + 4.303 * 0.1 / 3**0.5), abs=1e-4)
    flat = {seed: np.full((1, 3), 0.1 * seed) for seed in range(4)}
    baseline = paper_analysis.Curves((0, 1, 2, 3), np.concatenate([flat[seed] for seed in range(4)]))
    setting = paper_analysis.Curves((1, 3), np.concatenate([flat[1], flat[3]]) + 0.05)
    sweeps = {("own_push", "future"): baseline, ("own_methods", "closest"): setting}
    compared, epochs = paper_set._compare(sweeps, paper_set.FAMILIES["methods 1 and 2, own cycles"][0])
    assert (compared.each.tolist(), epochs) == (pytest.approx([0.05, 0.05]), 3)
    with refuses("seeds", [3]):
        paper_set._compare(
            {**sweeps, ("own_push", "future"): paper_analysis.Curves((1, 2), baseline.success[:2])},
            paper_set.FAMILIES["methods 1 and 2, own cycles"][0],
        )


def test_the_pooled_estimate_by_hand():
    """Means 0.1 and 0.3 with variances of 0.01: Q is 2, the variance between them 0.01; t with one degree is 12.706."""
    spread = np.array([-0.1, 0.1])  # variance 0.02, of the mean of two 0.01
    sweeps = [paper_analysis.Difference(mean + spread, mean, 0.0, 0.0, 1.0) for mean in (0.1, 0.3)]
    assert make_results_figures.pooled(sweeps) == pytest.approx((0.2, 0.2 - 1.2706, 0.2 + 1.2706), abs=1e-3)


def test_sweeps_that_agree_by_luck_have_no_shorter_interval():
    """Two equal means with variances of 0.01: 12.706 times the root of 0.01 / 2. The spread of the means alone would give 0."""
    sweeps = [paper_analysis.Difference(0.1 + np.array([-0.1, 0.1]), 0.1, 0.0, 0.0, 1.0)] * 2
    assert make_results_figures.pooled(sweeps) == pytest.approx((0.1, 0.1 - 0.8985, 0.1 + 0.8985), abs=1e-3)


def test_sweeps_of_other_precision_are_weighed_by_both_variances():
    """Means 0 and 0.3, variances 0.01 and 0.03: Q is 2.25, the variance between 0.025, the weights 1/0.035 and 1/0.055."""
    sweeps = [
        paper_analysis.Difference(mean + variance**0.5 * np.array([-1, 1]), mean, 0.0, 0.0, 1.0)
        for mean, variance in ((0.0, 0.01), (0.3, 0.03))
    ]
    mean, low, high = make_results_figures.pooled(sweeps)
    assert mean == pytest.approx(0.35 / 3, abs=1e-6)  # 0.075 without the variance between them
    assert (mean - low, high - mean) == pytest.approx((1.8583, 1.8583), abs=1e-3)


def test_verdicts_of_intervals():
    assert paper_set.verdict(0.001, 0.03, 0.04) == "better"
    assert paper_set.verdict(-0.03, -0.001, 0.04) == "worse"
    assert paper_set.verdict(-0.01, 0.015, 0.5) == "alike"
    assert paper_set.verdict(-0.01, 0.025, 0.5) == "not shown"
    assert paper_set.verdict(0.001, 0.03, 0.06) == "not shown"


def test_epochs_to_a_threshold_that_a_run_never_reaches_confirm_nothing():
    for low, high, verdict in ((0.5, 3.0, "**confirmed**"), (0.5, 1.9, "**refuted**"), (-1, 3, "not shown")):
        assert make_results_figures._epochs(paper_analysis.Difference(np.zeros(2), 1.0, low, high, 1.0), 2)[-1] == verdict
    never = paper_analysis.difference(np.array([3.0, np.inf]), np.array([1.0, 2.0]))
    assert make_results_figures._epochs(never, 2)[-1] == "not shown"


def test_curves_out_of_order_are_refused(tmp_path):
    path = tmp_path / "curves.csv"
    path.write_text("sweep,setting,seed,epoch,success_rate\na,b,0,1,0.5\na,b,0,3,0.5\n")
    with refuses("epoch", 3):
        paper_analysis.read(path)


def test_a_figure_that_is_none_is_refused(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["paper.py", "samplrs"])
    with pytest.raises(SystemExit) as ended:
        paper.main()
    assert ended.value.code == 2
    assert "got samplrs" in capsys.readouterr().err


def test_k_is_compared_over_the_epochs_that_all_have():
    """On Slide k 4 has 200 epochs, from another sweep, and the others have 50."""
    data = paper_set.load_set(paper.CURVES)
    for task, curves in paper_set.ks(data).items():
        assert {own.success.shape[1] for own in curves.values()} == {50}
        rows = [row for row in paper_set.compared(data)["k against 4"] if row.comparison.task == task]
        means = {k: float(paper_analysis.area(own).mean()) for k, own in curves.items()}
        differences = {int(row.comparison.setting.split()[-1]): row.difference.mean for row in rows}
        assert differences == {k: pytest.approx(mean - means[4]) for k, mean in means.items() if k != 4}


def test_figures_and_sweeps_go_by_name():
    assert [sweep.name for sweep in paper.chosen(["k", "k_push", "slide"])] == [
        "k_push",
        "k_pick_and_place",
        "k_slide",
        "slide",
    ]
    assert paper.chosen(["k_push", "all"])[1:] == [sweep for sweep in paper.SWEEPS if sweep.name != "k_push"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_figure_goes_on_where_it_was_stopped(tmp_path, number):
    """On a toy: stopped after its first run, it keeps that one, and its curves are those of a figure that was not."""
    argv = [sys.executable, str(ROOT / "bench" / "paper.py"), "--toy", "settings", "--out"]
    subprocess.run([*argv, str(tmp_path / "whole")], check=True, timeout=600)
    command = [*argv, str(tmp_path / "cut")]
    cut = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True)
    ended = []
    for line in cut.stdout:
        ended.append(line)
        if "50%" in line:  # a signal to one is passed on; a kill is of all of them
            cut.send_signal(number) if number == signal.SIGTERM else os.killpg(cut.pid, number)
    assert cut.wait() != 0, ended
    assert not (tmp_path / "cut" / "noise_slide").exists()
    subprocess.run(command, check=True, timeout=600)
    curves = [(tmp_path / name / "curves" / "slide_curves.csv").read_text() for name in ("whole", "cut")]
    assert curves[0] == curves[1]
    assert len(curves[0].splitlines()) == 1 + 2 * 2 * 3  # two sweeps, two seeds, three epochs


def test_curves_of_other_sweeps_stay(tmp_path, monkeypatch):
    """A set that is made in parts: what another machine collected stays, and a sweep that is made again takes its place."""
    ran = {"samplers": "0.5", "k_push": "0.25"}
    monkeypatch.setattr(paper, "read_curves", lambda folder, sweep: [row(sweep.name, ran[sweep.name])])
    for name in ran:
        paper.collect(paper.BY_NAME[name], tmp_path / "machine", tmp_path / "curves")
    ran["samplers"] = "1"
    path = paper.collect(paper.BY_NAME["samplers"], tmp_path / "machine", tmp_path / "curves")
    header, *rows = path.read_text().splitlines()
    assert header == ",".join(paper.COLUMNS)
    assert rows == ["samplers,future,0,1,40000,1", "k_push,future,0,1,40000,0.25"]


def test_curves_wait_for_another_program_that_writes_there(tmp_path, monkeypatch):
    """Two programs share a set: what one collects between the other's reading and writing would be lost."""
    monkeypatch.setattr(paper, "read_curves", lambda folder, sweep: [row(sweep.name, "0.5")])
    with held(tmp_path):
        collecting = threading.Thread(target=paper.collect, args=(paper.BY_NAME["k_push"], tmp_path, tmp_path))
        collecting.start()
        collecting.join(0.3)
        assert collecting.is_alive()
        assert not list(tmp_path.glob("*.csv"))
    collecting.join(20)
    assert (tmp_path / "push_curves.csv").read_text().splitlines()[1:] == ["k_push,future,0,1,40000,0.5"]


def row(sweep, success):
    return dict(zip(paper.COLUMNS, (sweep, "future", "0", "1", "40000", success)))
