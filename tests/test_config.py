import contextlib
import dataclasses
import itertools

import pytest
from configs import SMALL
from conftest import refuses

from mjx_dher import components, config, presets, spec, validation
from mjx_dher.cli import train as cli_train
from mjx_dher.components import COMPONENTS
from mjx_dher.config import Config, HParams, Number
from mjx_dher.runs import loop, program
from mjx_dher.runs.folder import fingerprint
from mjx_dher.spec import RunSpec
from probes import PointMass


@pytest.mark.parametrize(
    ("env", "workers", "epochs"), [("push", 8, 50), ("pick_and_place", 16, 50), ("slide", 8, 200), ("reach", 8, 50)]
)
def test_the_paper_preset_is_the_paper_s(env, workers, epochs):
    run = presets.preset("paper", env)
    c, h = run.config, run.hparams
    assert (run.env, c.num_envs, c.batch_size) == (env, 2 * workers, 256 * workers)
    assert (c.cycles_per_epoch, c.updates_per_cycle, c.target_period) == (50, 40, 40)
    assert config.num_epochs(c, 50) == epochs
    assert c.replay_size == c.total_steps <= workers * 1_000_000  # a ring of a million for each worker
    assert (c.hidden_sizes, run.networks, run.learner) == ((256, 256, 256), "fan_in", "ddpg")
    assert (h.actor_lr, h.critic_lr, h.gamma, h.polyak, h.action_l2) == (1e-3, 1e-3, 0.98, 0.95, 1.0)
    assert (h.random_eps, h.noise_std, h.random_noise, h.her_k) == (0.3, 0.2, 1.0, 4.0)
    assert h.adam_eps == 1e-8 / workers  # gradients summed over the workers
    assert (h.priority_fraction, h.lr_end) == (0.0, 1.0)  # what the paper does not have is off
    assert (h.obs_clip, h.norm_clip, h.norm_eps) == (200.0, 5.0, 0.01)


def test_each_reading_of_the_paper_can_be_changed():
    """By the options that docs/experiments/paper_settings.md names for each."""
    options = [
        "--preset",
        "paper",
        "--replay-size",
        "1000000",
        "--networks",
        "mlp",
        "--random-noise",
        "0",
        "--adam-eps",
        "1e-8",
    ]
    run = cli_train.parse_train_args([*options, "--env", "slide"]).spec
    assert (run.config.replay_size, run.networks) == (1_000_000, "mlp")
    assert run.hparams == HParams()


def test_presets_are_valid():
    for name, env in itertools.product(presets.PRESETS, ["push", "pick_and_place", "slide", "reach"]):
        spec.validate(presets.preset(name, env))


def test_a_preset_has_a_priority_of_its_own_where_its_learner_is_taken():
    own = presets.preset("cpu", "pick_and_place")
    assert (own.learner, own.priority) == ("tqc", "energy")
    assert presets.preset("cpu", "pick_and_place", priority="td_error") == dataclasses.replace(own, priority="td_error")
    assert presets.preset("cpu", "pick_and_place", learner="ddpg").priority == "eventful"
    assert presets.preset("cpu", "push").priority == "eventful"
    of_slide = [presets.preset(name, "slide").priority for name in ("cpu", "gpu", "frugal")]
    assert of_slide == ["td_error_shared", "td_error", "td_error"]
    assert presets.preset("gpu", "slide", learner="td3").priority == "eventful"


@pytest.mark.parametrize("env", ["push", "pick_and_place", "slide", "reach"])
def test_the_frugal_preset_plays_less_and_learns_more_from_it(env):
    frugal, *others = (presets.preset(name, env).config for name in ("frugal", "cpu", "gpu"))
    learned = [c.updates_per_cycle * c.batch_size / (50 * c.num_envs) for c in (frugal, *others)]  # transitions for each played
    assert frugal.total_steps < min(c.total_steps for c in others)
    assert learned[0] > max(learned[1:])


def test_a_run_with_other_settings_by_name():
    run = presets.preset("cpu", "slide")
    changed = run.replace(num_envs=4, gamma=0.9, sampler="weighted", seed=3)
    assert (changed.config.num_envs, changed.hparams.gamma, changed.sampler, changed.seed) == (4, 0.9, "weighted", 3)
    assert changed.replace(num_envs=256, gamma=0.97, sampler="future", seed=0) == run != changed
    assert run.replace(config=Config(), num_envs=4) == dataclasses.replace(run, config=Config(num_envs=4))
    with pytest.raises(ValueError, match="'num_env' \\(did you mean 'num_envs'"):
        run.replace(num_env=4)


def test_sizes_that_follow():
    c = Config(num_envs=16, cycles_per_epoch=50, total_steps=100_001, replay_size=1_000_049)
    assert config.steps_per_epoch(c, 50) == 40_000
    assert config.num_epochs(c, 50) == 3
    assert config.episodes_capacity(c, 50) == 20_000


BAD_SETTINGS = [
    *[("env", "pusj", "push"), ("sampler", "wieghted", "weighted"), ("weight_kernel", "cubic", "linear")],
    *[("weight_normalization", "meam", "mean"), ("metric", "speed", "position"), ("priority", "energetic", "eventful")],
    *[("generator", "hg", "hgg"), ("learner", "dpg", "ddpg"), ("networks", "mpl", "mlp"), ("engine", "warpp", "warp")],
    *[("seed", -1, 4294967295), ("seed", 10**20, 4294967295)],
]


def test_a_bad_setting_of_a_run_is_reported_with_its_value_and_what_is_allowed():
    for name, value, allowed in BAD_SETTINGS:
        with refuses(name, value, allowed):
            spec.validate(dataclasses.replace(RunSpec(), **{name: value}))


BAD_CONFIG = [  # settings, and what the message must have
    ({"learner_dtype": "float16"}, ["learner_dtype", "float16", "bfloat16"]),
    ({"num_envs": 0}, ["num_envs", 0, "[1, 1000000]"]),
    ({"num_envs": 2.5}, ["num_envs", 2.5, "integer"]),
    ({"num_envs": True}, ["num_envs", True, "integer"]),
    ({"batch_size": -1}, ["batch_size", -1]),
    ({"total_steps": 0}, ["total_steps", 0]),
    ({"eval_episodes": 0}, ["eval_episodes", 0]),
    ({"hidden_sizes": ()}, ["hidden_sizes", "()"]),
    ({"hidden_sizes": (256, 0)}, ["hidden_sizes", 0, "[1, 65536]"]),
    ({"cycles_per_epoch": 10**6, "num_envs": 10**5, "replay_size": 10**8}, ["total_steps", 2147483647]),
    ({"updates_per_cycle": 10**6, "target_period": 1, "total_steps": 10**9}, ["updates_per_cycle", 2147483647]),
    ({"updates_per_cycle": 12, "target_period": 5}, ["target_period", 5, 12]),
    ({"replay_size": 799, "num_envs": 16}, ["replay_size", 799, 800]),
    ({"batch_size": 2000, "replay_size": 1000}, ["batch_size", 2000, 1000]),
]
NOT_FOR_TEN_STEPS = [  # of an episode
    ({"n_step": 11}, ["n_step", 11, "[1, 10]"]),
    ({"cycles_per_epoch": 61}, ["total_steps", 240, 244, "num_envs 4", "cycles_per_epoch 61"]),
]
BAD_HPARAMS = [
    *[("gamma", 1.0), ("polyak", -0.1), ("actor_lr", float("nan")), ("noise_std", float("inf")), ("temperature", 0.0)],
    *[("her_k", -1), ("priority_fraction", 1.5)],
    *[("gamma", 1 - 1e-9), ("action_l2", 1e39), ("obs_clip", 1e-300)],  # float32 would make 1, infinity and 0 of them
]


def test_a_bad_size_is_reported_with_its_value_and_what_is_allowed():
    for change, parts in BAD_CONFIG:
        with refuses(*parts):
            validation.validate(dataclasses.replace(Config(), **change), HParams(), 50)


@pytest.mark.parametrize(("change", "parts"), NOT_FOR_TEN_STEPS)
def test_a_size_that_the_episodes_do_not_allow_is_reported_before_anything_is_compiled(change, parts, monkeypatch):
    monkeypatch.setattr(loop, "compile_program", lambda *args: pytest.fail("compiled"))
    sizes = dataclasses.replace(SMALL, **change)
    with refuses(*parts):
        next(iter(loop.train(PointMass(), sizes)))
    with refuses(*parts):
        program.check_runs(PointMass(), [RunSpec(env="point_mass:PointMass", config=sizes)])


def test_a_run_of_a_tenth_of_an_epoch_has_one_epoch():
    sizes = dataclasses.replace(SMALL, cycles_per_epoch=60)
    validation.check_plan(sizes, 10, 1)
    assert config.num_epochs(sizes, 10) == 1


def test_a_number_out_of_its_range_is_reported_with_its_value():
    for name, value in BAD_HPARAMS:
        with refuses(name, value):
            validation.validate(Config(), HParams(**{name: value}), 50)


def test_every_number_has_a_range_and_a_default_in_it():
    numbers = config.metadata(HParams, Number)
    assert set(numbers) == set(HParams._fields)
    assert all(number.contains(getattr(HParams(), name)) for name, number in numbers.items())
    sizes = set(config.metadata(Config, Number)) | {
        "learner_dtype",
        "energy",
        "contrastive_loss",
        "same_episode",
        "augmentation",
    }
    assert sizes == {field.name for field in dataclasses.fields(Config)}


FIELDS = [(owner, name) for owner in (Config, HParams) for name in config.metadata(owner, Number)]


@pytest.mark.parametrize("value", [10**20, -1, 0, float("nan"), float("inf"), 1e-300, "", None, True])
def test_extremes_of_every_field_are_accepted_or_reported_by_name(value):
    for owner, name in FIELDS:
        settings = {Config: Config(), HParams: HParams()}
        settings[owner] = settings[owner]._replace(**{name: value}) if owner is HParams else Config(**{name: value})
        if name == "hidden_sizes":
            settings[owner] = Config(hidden_sizes=(value,))
        numeric = isinstance(value, int if owner is Config else (int, float)) and not isinstance(value, bool)
        if numeric and config.metadata(owner, Number)[name].contains(value):
            with contextlib.suppress(ValueError):  # sizes that depend on one another may still not agree
                validation.validate(settings[Config], settings[HParams], 50)
        else:
            with refuses(name):
                validation.validate(settings[Config], settings[HParams], 50)


@pytest.mark.parametrize(
    ("changes", "read", "unread"),
    [
        ({"sampler": "weighted"}, "temperature weight_kernel gamma", "weight_scale epsilon"),
        ({"sampler": "weighted", "weight_normalization": "none"}, "weight_scale", "epsilon"),
        ({"sampler": "weighted", "weight_normalization": "mine:own"}, "weight_scale", "epsilon"),
        ({"sampler": "epsilon_closest"}, "metric epsilon", "weight_kernel"),
        ({"sampler": "mine:sampler", "learner": "sac"}, "temperature weight_scale epsilon", "noise_std"),  # it may read any
        ({"weight_normalization": "none"}, "gamma noise_std", "temperature weight_normalization weight_scale num_critics"),
        ({"weight_normalization": "mine:own"}, "gamma", "weight_scale"),
        ({"learner": "tqc"}, "num_quantiles", "noise_std"),
        ({"learner": "crl"}, "representation_size", "hindsight_reward polyak num_critics"),
        ({"learner": "mine:learner"}, "noise_std num_quantiles", "temperature"),
    ],
)
def test_a_run_reads_the_settings_of_its_components(changes, read, unread):
    settings = fingerprint.settings(RunSpec(**changes))
    assert [name for name in read.split() if not components.reads(settings, name)] == []
    assert [name for name in unread.split() if components.reads(settings, name)] == []


def test_each_component_is_there_and_reads_settings_that_there_are():
    settings = fingerprint.settings(RunSpec())
    for field, table in COMPONENTS.items():
        for name, row in table.items():
            assert components.load(field, name) is components.load(field, row.path)
            assert set(row.reads) <= set(settings)


def test_all_problems_are_reported_at_once():
    with refuses("num_envs", "batch_size", "gamma") as raised:
        validation.validate(Config(num_envs=0, batch_size=0), HParams(gamma=2), 50)
    assert len(str(raised.value).splitlines()) == 3


def test_unknown_preset():
    with refuses("preset", "papper", "paper"):
        presets.preset("papper", "push")
