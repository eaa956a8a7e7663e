"""bench/bakeoff.py and ablation.py: arms and their costs, what is made of scores; whole ones on the point mass."""

import argparse
import csv
import math

import numpy as np
import pytest
from conftest import ROOT, names

from mjx_dher.components import COMPONENTS
from mjx_dher.runs.folder import fingerprint
from mjx_dher.spec import RunSpec, validate


@pytest.fixture
def bakeoff(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import bakeoff

    return bakeoff


@pytest.fixture
def arms(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import bakeoff_arms

    return bakeoff_arms


@pytest.fixture
def report(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import bakeoff_report

    return bakeoff_report


@pytest.fixture
def ablation(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import ablation

    return ablation


def test_every_arm_is_a_run_of_every_task_and_learner(arms):
    for learner in arms.LEARNERS:
        for task in arms.TASKS:
            specs = {arm.name: arms.spec_of(learner, task, arm) for arm in arms.ARMS}
            for arm in (arm for arm in arms.ARMS if arm.group):  # the others are no longer in the library
                validate(specs[arm.name])
            assert len(set(specs.values())) == len(arms.ARMS) >= 13
            assert all(spec.config.replay_size == spec.config.total_steps for spec in specs.values())
            for group in arms.BAKEOFF.groups:  # one program each
                assert len({specs[arm.name].program for arm in arms.ARMS if arm.group == group}) == 1
    built_in = {arm.parts.get("priority") for arm in arms.ARMS} | {arm.parts.get("generator") for arm in arms.ARMS}
    not_methods = {"eventful", "energy_clipped", "td_error_shared", "reset"}  # variants, and what every arm has
    assert {*COMPONENTS["priority"], *COMPONENTS["generator"]} - not_methods <= built_in
    assert "next_future" in COMPONENTS["sampler"]


def changes(spec, base):
    """What differs between two runs, by field."""
    mine, theirs = fingerprint.settings(spec), fingerprint.settings(base)
    return {name: value for name, value in mine.items() if value != theirs[name]}


@pytest.mark.parametrize("task", ["pick_and_place", "slide"])
def test_every_arm_of_the_ablation_leaves_out_what_its_name_says(ablation, task):
    specs = {arm.name: ablation.spec_of("gpu", task, arm) for arm in ablation.ARMS}
    for spec in specs.values():
        validate(spec)
    told = {name: changes(spec, specs["preset"]) for name, spec in specs.items()}
    slide = task == "slide"
    with_entropy = {"learner": "tqc", "action_l2": 0.0, "entropy_weight": 0.1}
    without = {"learner": "dtqc", "action_l2": 1.0, "target_noise": 0.0}
    ddpg = {"learner": "ddpg", "networks": "mlp", "n_step": 1}
    assert told == {
        "preset": {},
        "no_quantiles": {"learner": "td3" if slide else "sac"},
        "other_entropy": with_entropy if slide else without,
        "one_critic": {"num_critics": 1},
        "no_layer_norm": {"networks": "mlp"},
        "one_step": {"n_step": 1},
        "half_width": {"hidden_sizes": (256, 256, 256) if slide else (128, 128, 128)},
        "half_batch": {"batch_size": 512},
        "half_updates": {"updates_per_cycle": 500},
        "no_eventful": {"priority_fraction": 0.0},
        "ddpg": ddpg if slide else {**ddpg, "action_l2": 1.0},
    }


def test_the_arms_of_contrastive_rl_and_her_share_all_but_what_their_names_say(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import crl

    for task in crl.SIZES:
        specs = {arm.name: crl.spec_of("equal", task, arm) for arm in crl.ARMS}
        for spec in specs.values():
            validate(spec)
        differ = {name: set(changes(spec, specs["crl"])) for name, spec in specs.items()}
        assert differ.pop("crl") == set()
        assert differ.pop("crl_uniform") == {"sampler"}
        assert differ.pop("crl_hindsight") == {"her_k"}
        assert differ.pop("crl_jaxgcrl") == {"her_k", "actor_lr", "critic_lr", "random_eps", "gamma"}
        assert {frozenset(fields - {"her_k"}) for fields in differ.values()} == {frozenset(("learner", "sampler"))}
        assert {specs[name].hparams.her_k for name in ("sac_k8", "tqc_k8")} == {8.0}
        for group in crl.CONTRASTIVE.groups:  # one program each
            assert len({specs[arm.name].program for arm in crl.ARMS if arm.group == group}) == 1
        validate(crl.spec_of("equal", task, crl.ARMS[0], True))


def test_every_arm_of_the_ablation_is_a_toy_too(ablation):
    for arm in ablation.ARMS:
        validate(ablation.spec_of("gpu", "reach", arm, True))


def scores(report, areas, first=0):
    areas = np.asarray(areas, float)
    seeds = tuple(range(first, first + len(areas)))
    return report.Scores(seeds, areas, areas, np.where(areas > 0.5, 1000.0, np.inf), 0)


def test_arms_are_compared_seed_by_seed(report, arms):
    base = np.linspace(0.3, 0.6, 10)
    ahead = base + np.linspace(0.01, 0.05, 10)
    alike = base + np.tile([0.01, -0.01], 5)
    rows = report.compare(
        "paper",
        "push",
        {"future": scores(report, base), "energy": scores(report, ahead), "hgg": scores(report, alike)},
        [arm for arm in arms.ARMS if arm.name in ("future", "energy", "hgg")],
    )
    future, energy, hgg = rows
    assert math.isnan(future.difference)
    assert math.isnan(future.p_corrected)
    np.testing.assert_allclose([energy.difference, hgg.difference], [0.03, 0.0], atol=1e-12)
    assert energy.p_value == 2 / 1024
    assert energy.p_corrected == 2 * 2 / 1024
    assert hgg.p_corrected == hgg.p_value > 0.5
    assert energy.smallest_effect == report.smallest_effect(float((ahead - base).std(ddof=1)), 10, 2)  # of two arms
    assert energy.low > 0.02 > hgg.low
    assert energy.steps_to_threshold == np.median(np.where(ahead > 0.5, 1000.0, np.inf))


def test_arms_that_have_not_been_run_count_in_the_correction(report, arms):
    """So nothing that is shown today is taken back when the other arms have ended."""
    base = np.linspace(0.3, 0.6, 10)
    given = {"future": scores(report, base), "energy": scores(report, base + 0.02), "hgg": scores(report, base - 0.03)}
    rows = report.compare("paper", "push", given, arms.ARMS)
    others = len(arms.ARMS) - 1
    assert [row.p_corrected for row in rows[1:]] == [others * 2 / 1024] * 2
    given |= {arm.name: scores(report, base + 0.01) for arm in arms.ARMS if arm.name not in given}
    later = {row.arm: row for row in report.compare("paper", "push", given, arms.ARMS)}
    assert all(later[row.arm].p_corrected <= row.p_corrected for row in rows[1:])


def test_arms_of_several_tasks_can_be_corrected_together(report, arms):
    """Two of them: the smaller p is doubled, the larger one is not, and differences are seen as of two tests."""
    rng = np.random.default_rng(0)
    base, noise = rng.uniform(0.4, 0.6, size=10), rng.uniform(0.0, 0.02, size=10)
    both = [arm for arm in arms.ARMS if arm.name in ("future", "energy")]
    signs = {"slide": 1.0, "push": np.where(np.arange(10) < 1, -1.0, 1.0)}
    own = {
        task: {"future": scores(report, base), "energy": scores(report, base + sign * (0.01 + noise))}
        for task, sign in signs.items()
    }
    rows = [row for task in own for row in report.compare("best", task, own[task], both, tests=2)]
    alone = report.compare("best", "slide", own["slide"], both)
    assert alone[1].p_value == alone[1].p_corrected == rows[1].p_value == 2 / 1024
    assert rows[1].smallest_effect > alone[1].smallest_effect
    first, small, second, large = report.corrected(rows, 2)
    assert large.p_value > small.p_value
    assert (small.p_corrected, large.p_corrected) == (2 * small.p_value, large.p_value)
    assert np.isnan([first.p_corrected, second.p_corrected]).all()


def test_only_seeds_that_both_have_are_paired(report, arms):
    base, other = scores(report, [0.1, 0.2, 0.3]), scores(report, [0.5, 0.6, 0.7], first=1)
    _, row = report.compare("best", "slide", {"future": base, "dpp": other}, arms.ARMS)
    np.testing.assert_allclose(row.difference, np.mean([0.5 - 0.2, 0.6 - 0.3]))


def test_the_smallest_effect_of_ten_seeds_is_that_of_ten_equal_signs(report):
    """With 13 tests p must be 2/1024: all ten differences have one sign, with probability Phi(x)^10 = 0.8."""
    from scipy.stats import norm

    by_hand = norm.ppf(0.8**0.1)
    assert abs(report.smallest_effect(1.0, 10, 13) - by_hand) < 0.06
    assert abs(report.smallest_effect(0.1, 10, 13) - 0.1 * by_hand) < 0.006
    assert report.smallest_effect(1.0, 10, 1) < 1.1
    assert math.isnan(report.smallest_effect(1.0, 5, 13))  # no five seeds have so small a p


def test_forests_are_drawn(report, arms, tmp_path):
    rng = np.random.default_rng(0)
    given = {name: scores(report, rng.uniform(size=4)) for name in ("future", "energy", "archer")}
    rows = [row for learner in ("paper", "best") for row in report.compare(learner, "push", given, arms.ARMS)]
    report.forest(rows, tmp_path / "forest.png", "future")
    assert (tmp_path / "forest.png").stat().st_size > 10_000


def test_wrong_arguments_are_refused(bakeoff, capsys):
    for argv in (
        *(["--seeds", "0"], ["--seeds", str(10**20)], ["--first-seed", "-1"], ["--minutes", "nan"], ["--arms", "energi"]),
        ["--out", "/proc/x"],
    ):
        with pytest.raises(SystemExit) as ended:
            bakeoff.parse(["--out", "x", *argv])
        assert ended.value.code == 2
        names(capsys.readouterr().err, argv[0] if argv[0] != "--out" else "/proc")


def test_a_plan_trains_nothing(bakeoff, tmp_path, capsys):
    assert bakeoff.main(["--out", str(tmp_path / "b"), "--plan", "--arms", "energy", "--seeds", "3"]) == 0
    text = capsys.readouterr().out
    assert "best-slide: 6 runs" in text
    assert not (tmp_path / "b").exists()


def test_nothing_to_report_is_said(bakeoff, tmp_path, capsys):
    assert bakeoff.main(["--out", str(tmp_path / "b"), "--report", "--toy"]) == 0
    assert "nothing can be compared yet" in capsys.readouterr().out


@pytest.fixture
def ended(ablation):
    """Runs of two arms of the ablation that have ended elsewhere."""
    import bakeoff_runs

    specs = {arm.name: ablation.spec_of("gpu", "slide", arm) for arm in ablation.ARMS[:2]}
    made = [(arm, seed, bakeoff_runs.name_of(spec, seed)) for arm, spec in specs.items() for seed in range(10)]
    return [
        bakeoff_runs.Run("gpu", "slide", arm, seed, name, 0, round(0.25 + seed / 100, 2), 0.5, math.inf)
        for arm, seed, name in made
    ]


def test_an_arm_whose_runs_all_fail_at_once_scores_nothing(bakeoff):
    run = {"settings": fingerprint.settings(RunSpec()), "seed": 3, "folder": "a", "status": "failed", "lanes": 1}
    runs = bakeoff._runs(("paper", "push", "future"), [{**run, "curve": {}, "final": {}}], 0.9)
    assert [run[3:] for run in runs] == [(3, "a", 1, 0.0, 0.0, math.inf)]


def test_runs_are_read_as_they_were_written(ablation, ended, tmp_path):
    import bakeoff_runs

    bakeoff_runs.save(tmp_path / "runs.csv", ended)
    assert bakeoff_runs.load(tmp_path / "runs.csv", ablation.ABLATION) == ended
    assert bakeoff_runs.merged([*ended, ended[0]._replace(final=0.9)]) == ended
    scores = bakeoff_runs.by_arm(reversed(ended))["no_quantiles"]
    assert scores.seeds == tuple(range(10))
    np.testing.assert_allclose(scores.area, 0.25 + np.arange(10) / 100)


def test_runs_that_have_ended_elsewhere_are_not_trained_again(bakeoff, ablation, ended, tmp_path, capsys):
    import bakeoff_runs

    bakeoff_runs.save(tmp_path / "runs.csv", ended)
    argv = ["--out", str(tmp_path / "a"), "--tasks", "slide", "--runs", str(tmp_path / "runs.csv")]
    assert bakeoff.main([*argv, "--plan"], ablation.ABLATION) == 0
    assert "110 runs of 1,740,800 steps, 20 done" in capsys.readouterr().out
    assert bakeoff.main([*argv, "--report"], ablation.ABLATION) == 0
    assert (tmp_path / "a" / "ablation_runs.csv").read_text() == (tmp_path / "runs.csv").read_text()
    with (tmp_path / "a" / "ablation.csv").open() as file:
        assert [(row["arm"], row["seeds"], row["p_corrected"]) for row in csv.DictReader(file)] == [
            ("preset", "10", "nan"),
            ("no_quantiles", "10", "1"),
        ]


BAD_RUNS = [  # column, value, and what the message must name
    ("name", "slide-future-s0-0123456789", ["settings", "slide-future-s0-0123456789"]),
    ("seed", 3, ["settings"]),
    ("arm", "no_such", ["arm", "no_such"]),
    ("task", "push", ["task", "push"]),
    ("final", 1.5, ["success"]),
    ("mean_success", math.nan, ["success"]),
    ("steps", "many", ["many"]),
    ("failed", 2, ["failed"]),
]


def test_runs_that_are_none_of_the_experiment_are_refused(bakeoff, ablation, ended, tmp_path, capsys):
    import bakeoff_runs

    for column, value, parts in BAD_RUNS:
        bakeoff_runs.save(tmp_path / "runs.csv", [ended[0]._replace(**{column: value})])
        with pytest.raises(SystemExit) as stopped:
            bakeoff.main(["--out", str(tmp_path / "a"), "--plan", "--runs", str(tmp_path / "runs.csv")], ablation.ABLATION)
        assert stopped.value.code == 2
        names(capsys.readouterr().err, *parts)


def test_a_file_without_runs_is_refused(bakeoff, ablation, tmp_path, capsys):
    path = tmp_path / "runs.csv"
    for content in (None, b"a,b\n1,2\n", b"\xff\x00"):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(SystemExit):
            bakeoff.main(["--out", str(tmp_path / "a"), "--report", "--runs", str(path)], ablation.ABLATION)
        names(capsys.readouterr().err, "runs.csv")


@pytest.mark.slow
@pytest.mark.parametrize("which", ["bakeoff", "ablation"])
def test_one_stops_and_goes_on_and_reports(bakeoff, ablation, tmp_path, which):
    experiment = bakeoff.BAKEOFF if which == "bakeoff" else ablation.ABLATION
    argv = ["--out", str(tmp_path), "--toy", "--seeds", "2", "--lanes", "10"]
    assert bakeoff.main([*argv, "--minutes", "0.02"], experiment) == 3
    assert bakeoff.main(argv, experiment) == 0
    with (tmp_path / f"{which}.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["arm"] for row in rows] == [arm.name for arm in experiment.arms if arm.group]
    assert {(row["seeds"], row["failed"]) for row in rows} == {("2", "0")}
    assert isinstance(bakeoff.parse(argv, experiment), argparse.Namespace)
    assert bakeoff.main(argv, experiment) == 0  # nothing is left, and it says the same


def test_memory_that_does_not_suffice_is_a_sentence(bakeoff, ablation, tmp_path, monkeypatch, capsys):
    def train(args, console):
        raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 2.48GiB. [executable_name='jit__init']")

    monkeypatch.setattr(bakeoff, "train", train)
    assert bakeoff.main(["--out", str(tmp_path / "a"), "--toy"], ablation.ABLATION) == 2
    said = capsys.readouterr().out
    assert "error: out of memory (RESOURCE_EXHAUSTED" in said
    assert "[executable_name='jit__init']" in said  # no markup
