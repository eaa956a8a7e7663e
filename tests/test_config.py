import dataclasses

import pytest

from mjx_dher import config, presets
from mjx_dher.config import Config, HParams


@pytest.mark.parametrize(
    ("env", "workers", "epochs"), [("push", 8, 50), ("pick_and_place", 16, 50), ("slide", 8, 200), ("reach", 8, 50)]
)
def test_the_paper_preset_is_the_paper_s(env, workers, epochs):
    c, h = presets.preset("paper", env)
    assert (c.env, c.num_envs, c.batch_size) == (env, 2 * workers, 256 * workers)
    assert (c.cycles_per_epoch, c.updates_per_cycle, c.target_period) == (50, 40, 40)
    assert config.num_epochs(c, 50) == epochs
    assert c.replay_size == 1_000_000
    assert c.hidden_sizes == (256, 256, 256)
    assert (h.actor_lr, h.critic_lr, h.gamma, h.polyak, h.action_l2) == (1e-3, 1e-3, 0.98, 0.95, 1.0)
    assert (h.random_eps, h.noise_std, h.her_k) == (0.3, 0.2, 4.0)
    assert (h.eventful_share, h.lr_end) == (0.0, 1.0)  # what the paper does not have is off
    assert (h.obs_clip, h.norm_clip, h.norm_eps) == (200.0, 5.0, 0.01)


@pytest.mark.parametrize("name", presets.PRESETS)
@pytest.mark.parametrize("env", ["push", "pick_and_place", "slide", "reach"])
def test_presets_are_valid(name, env):
    config.validate(*presets.preset(name, env))


def test_sizes_that_follow():
    c = Config(num_envs=16, cycles_per_epoch=50, total_steps=100_001, replay_size=1_000_049)
    assert config.steps_per_epoch(c, 50) == 40_000
    assert config.num_epochs(c, 50) == 3
    assert config.episodes_capacity(c, 50) == 20_000


BAD_CONFIG = [
    ({"sampler": "wieghted"}, "sampler must be one of random, .*; got 'wieghted' .did you mean 'weighted'"),
    ({"weight_kernel": "cubic"}, "weight_kernel must be one of linear, inverse, softmax; got 'cubic'"),
    ({"learner_dtype": "float16"}, "learner_dtype must be one of float32, bfloat16; got 'float16'"),
    ({"engine": "warpp"}, "engine must be one of auto, native, jax, warp; got 'warpp'"),
    ({"num_envs": 0}, "num_envs must be an integer of at least 1; got 0"),
    ({"num_envs": 2.5}, "num_envs must be an integer of at least 1; got 2.5"),
    ({"num_envs": True}, "num_envs must be an integer of at least 1; got True"),
    ({"batch_size": -1}, "batch_size must be an integer of at least 1; got -1"),
    ({"total_steps": 0}, "total_steps must be an integer of at least 1; got 0"),
    ({"eval_episodes": 0}, "eval_episodes must be an integer of at least 1; got 0"),
    ({"hidden_sizes": ()}, r"hidden_sizes must be one or more integers of at least 1; got \(\)"),
    ({"hidden_sizes": (256, 0)}, r"hidden_sizes must be .*; got \(256, 0\)"),
    (
        {"updates_per_cycle": 12, "target_period": 5},
        r"target_period must divide updates_per_cycle \(12\); got 5, allowed: 1, 2",
    ),
    (
        {"replay_size": 799, "num_envs": 16},
        "replay_size must hold at least one cycle of 16 episodes x 50 steps = 800 .*; got 799",
    ),
    ({"batch_size": 2000, "replay_size": 1000}, r"batch_size must not exceed replay_size \(1000\); got 2000"),
]


@pytest.mark.parametrize(("change", "message"), BAD_CONFIG)
def test_what_cannot_run_is_refused_by_name_value_and_range(change, message):
    with pytest.raises(ValueError, match=message):
        config.validate(dataclasses.replace(Config(), **change), HParams())


BAD_HPARAMS = [
    ({"gamma": 1.0}, r"gamma must lie in \[0, 1\); got 1.0"),
    ({"polyak": -0.1}, r"polyak must lie in \[0, 1\]; got -0.1"),
    ({"actor_lr": float("nan")}, r"actor_lr must lie in \[0, 1\]; got nan"),
    ({"noise_std": float("inf")}, r"noise_std must lie in \[0, inf\); got inf"),
    ({"temperature": 0.0}, r"temperature must lie in \(0, inf\); got 0.0"),
    ({"her_k": -1}, r"her_k must lie in \[0, inf\); got -1"),
    ({"eventful_share": 1.5}, r"eventful_share must lie in \[0, 1\]; got 1.5"),
]


@pytest.mark.parametrize(("change", "message"), BAD_HPARAMS)
def test_numbers_out_of_range_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        config.validate(Config(), HParams(**change))


def test_every_number_has_a_range():
    assert set(config._HPARAM_RANGES) == set(HParams._fields)


def test_all_problems_are_named_at_once():
    with pytest.raises(ValueError, match=r"num_envs.*\n.*batch_size.*\n.*gamma"):
        config.validate(Config(num_envs=0, batch_size=0), HParams(gamma=2))


def test_unknown_preset():
    with pytest.raises(ValueError, match=r"preset must be one of cpu, gpu, paper; got .papper. .did you mean .paper."):
        presets.preset("papper", "push")
