"""Presets: tuned settings, and the paper's. Loads neither JAX nor MuJoCo, except in `machine_preset`."""

import importlib.util
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, get_args

from mjx_dher.components import robot
from mjx_dher.config import Config, HParams
from mjx_dher.lookup import check_name
from mjx_dher.spec import RunSpec

Preset = Literal["cpu", "gpu", "frugal", "paper"]
PRESETS = get_args(Preset)

_TUNED = RunSpec().replace(target_period=1, gamma=0.95, polyak=0.98, noise_std=0.4, her_k=16.0, priority_fraction=0.5)


def machine_preset() -> str:
    """Preset for this machine: gpu if JAX runs on a GPU, else cpu. Loads JAX only if it has a plugin."""
    if importlib.util.find_spec("jax_plugins") is None:
        return "cpu"
    import jax

    return "cpu" if jax.default_backend() == "cpu" else "gpu"


def preset(name: str, env: str, learner: str | None = None, networks: str | None = None, **changes: Any) -> RunSpec:
    """Run of a preset in an environment.

    `cpu` and `gpu` are tuned for wall-clock time to success, on two cores with native physics and on one NVIDIA GPU with warp.
    `frugal` is tuned for few environment steps at any number of updates (docs/experiments). `paper` is the set-up of "Distance
    Based Replay Sampling in Hindsight Experience Replay", completed from the code behind its numbers (docs/results.md). It
    rolls out the workers' episodes in parallel and takes the gradient of their joint batch.

    Args:
      learner: learner. Default: the preset's, which may bring its own numbers and priority. Others use the numbers of `ddpg`,
        and the preset's augmentation (`crl`: none).
      networks: networks. Default: the preset's for this learner.
      **changes: other settings (`RunSpec.replace`), such as `sampler`, `seed` or `num_envs`. A whole `config` or `hparams`
        replaces all of the preset's.

    Raises:
      ValueError: there is no such preset or setting.
    """
    check_name("preset", name, PRESETS)
    best = _LEARNERS.get((name, env)) or _LEARNERS.get((name, robot(env)), _DDPG)
    if learner == "crl":
        best = _CRL
    elif learner not in (None, best.learner):
        best = _DDPG._replace(learner=str(learner), changes={"augmentation": best.changes.get("augmentation", "none")})
    run = (best.setup or {"cpu": _cpu, "gpu": _gpu, "frugal": _frugal, "paper": _paper}[name])(env)
    networks = networks or ("fan_in" if name == "paper" else best.networks)
    return run.replace(env=env, learner=best.learner, networks=networks, **best.changes).replace(**changes)


def _kept(base: RunSpec, steps: int, **changes: Any) -> RunSpec:
    """The base with `steps` environment steps, a ring that keeps them all, and other `changes`."""
    return base.replace(total_steps=steps, replay_size=steps, **changes)


def _small(base: RunSpec, **changes: Any) -> RunSpec:
    """The base with one critic, two layers, no target noise, and other `changes`."""
    return base.replace(num_critics=1, hidden_sizes=(256, 256), target_noise=0.0, **changes)


def _cpu(env: str) -> RunSpec:
    base = _TUNED.replace(num_envs=32, cycles_per_epoch=15, batch_size=1024, total_steps=600_000)
    if env == "reach":
        return base.replace(num_envs=16, cycles_per_epoch=10, batch_size=256, total_steps=16_000)
    if env == "pick_and_place":
        return base.replace(total_steps=1_000_000, noise_std=0.2, lr_end=0.05)
    if env == "slide":
        return _kept(base, 1_500_000, gamma=0.97, noise_std=0.2, lr_end=0.05)
    if robot(env) == "hand":
        return _kept(base, 2_000_000, cycles_per_epoch=8, gamma=0.98)
    return base


def _cpu_push(env: str) -> RunSpec:
    return _small(_cpu(env), updates_per_cycle=128, batch_size=512, policy_delay=2, total_steps=288_000, critic_lr=2e-3)


def _gpu(env: str) -> RunSpec:
    base = _TUNED.replace(num_envs=2048, cycles_per_epoch=3, updates_per_cycle=1000, batch_size=1024)
    base = base.replace(total_steps=1_500_000, replay_size=2_000_000)
    if env == "reach":
        return base.replace(num_envs=256, cycles_per_epoch=1, updates_per_cycle=200, total_steps=64_000)
    if env not in ("pick_and_place", "slide"):
        return base
    base = base.replace(cycles_per_epoch=5, updates_per_cycle=500, replay_size=4_000_000, lr_end=0.05)
    base = base.replace(noise_std=0.1, random_eps=0.2, total_steps=6_000_000)
    return base if env == "pick_and_place" else base.replace(total_steps=10_000_000, gamma=0.97, her_k=8.0)


def _paper(env: str) -> RunSpec:
    workers = 16 if env == "pick_and_place" else 8
    epochs = 200 if env == "slide" else 50
    total_steps = epochs * 50 * 2 * workers * 50
    config = Config(
        num_envs=2 * workers,
        cycles_per_epoch=50,
        updates_per_cycle=40,
        target_period=40,
        batch_size=256 * workers,
        total_steps=total_steps,
        # Each worker has a ring of a million transitions, but cannot fill it with fewer steps.
        replay_size=min(1_000_000 * workers, total_steps),
    )
    # The workers sum their gradients. For Adam, averaging them and dividing its epsilon by their number is the same.
    return RunSpec(config=config, hparams=HParams(random_noise=1.0, adam_eps=1e-8 / workers))


def _frugal(env: str) -> RunSpec:
    base = _cpu(env)
    if env == "reach":
        return base.replace(updates_per_cycle=80, total_steps=8_000)
    steps = {"push": 112_000, "pick_and_place": 500_000, "slide": 1_000_000}.get(env, base.config.total_steps)
    return base.replace(cycles_per_epoch=5, updates_per_cycle=200, total_steps=steps)


def _frugal_slide(env: str) -> RunSpec:
    return _small(_frugal(env), updates_per_cycle=150, n_step=3)


def _entropy(env: str) -> RunSpec:
    """Base settings of the PickAndPlace presets with `tqc`."""
    return _gpu(env).replace(num_envs=512, updates_per_cycle=1000, total_steps=1_000_000, action_l2=0.0, entropy_weight=0.1)


def _gpu_hand(env: str) -> RunSpec:
    steps = {"block_rotate_z": 2_000_000, "block": 8_000_000, "egg": 8_000_000, "pen": 8_000_000}.get(env, 4_000_000)
    k = 1.0 if env == "block_rotate_z" else 4.0
    base = _gpu(env).replace(num_envs=1024, cycles_per_epoch=2, updates_per_cycle=3500, total_steps=steps, her_k=k)
    return base.replace(replay_size=4_000_000, hidden_sizes=(512, 512, 512), learner_dtype="bfloat16", gamma=0.98, lr_end=0.05)


def _cpu_hand(env: str) -> RunSpec:
    base = _small(_gpu_hand(env), num_envs=64, cycles_per_epoch=16, updates_per_cycle=250, policy_delay=2, critic_lr=2e-3)
    return _kept(base, 1_024_000, her_k=4.0, renewals=5)


def _gpu_arm(env: str) -> RunSpec:
    base = RunSpec().replace(num_envs=256, cycles_per_epoch=4, updates_per_cycle=1000, target_period=1, batch_size=512)
    base = base.replace(polyak=0.98, action_l2=0.0, entropy_weight=0.1, random_eps=0.1, lr_end=0.05)
    steps = {"arm_reach": 512_000, "arm_push_hard": 6_144_000}
    return _kept(base, steps.get(env, 3_072_000), hidden_sizes=(256, 256))


def _cpu_arm(env: str) -> RunSpec:
    base = _gpu_arm(env)
    return _kept(base, base.config.total_steps // 2, num_envs=64, cycles_per_epoch=8, updates_per_cycle=250)


def _gpu_hand_reach(env: str) -> RunSpec:
    # Little noise, because it moves all fingertips at once, and a goal allows 1 cm.
    base = _gpu(env).replace(num_envs=128, cycles_per_epoch=8, updates_per_cycle=400, batch_size=512)
    base = base.replace(total_steps=1_000_000, replay_size=1_024_000, polyak=0.99, lr_end=0.05)
    return base.replace(noise_std=0.1, random_eps=0.1, her_k=4.0, priority_fraction=0.0)


def _gpu_slide(env: str) -> RunSpec:
    base = _gpu(env).replace(updates_per_cycle=1000, total_steps=8_000_000, n_step=3, renewals=5)
    return base.replace(hidden_sizes=(512, 512, 512), target_noise=0.0, policy_delay=2, learner_dtype="bfloat16")


def _cpu_slide(env: str) -> RunSpec:
    base = _small(_cpu(env), num_envs=256, updates_per_cycle=500, policy_delay=2, n_step=3, renewals=5, cycles_per_epoch=2)
    base = base.replace(critic_lr=3e-3, polyak=0.99, noise_std=0.1, random_eps=0.2)
    return _kept(base, 1_280_000, her_k=8.0, hindsight_reward=0.5, priority_fraction=0.8)


def _pick_and_place(env: str) -> RunSpec:
    base = _small(_entropy(env), num_envs=256, updates_per_cycle=500, policy_delay=2, critic_lr=3e-3)
    return _kept(base, 512_000, her_k=8.0, hindsight_reward=0.5)


class _Best(NamedTuple):
    """A preset's learner for a task. Without `setup`, it has the settings for `ddpg`."""

    learner: str
    networks: str
    setup: Callable[[str], RunSpec] | None
    changes: Mapping[str, Any] = {}  # other settings that differ from those of `setup`


_MIRROR = {"augmentation": "mirror"}
_DDPG = _Best("ddpg", "mlp", None)
_PICK_AND_PLACE = _Best("tqc", "layer_norm", _pick_and_place, {"priority": "energy", **_MIRROR})
_CRL = _Best("crl", "mlp", None, {"sampler": "geometric", "action_l2": 0.0, "random_eps": 0.1})  # for each task and preset
_LEARNERS = {  # by preset, and environment or robot
    ("cpu", "hand"): _Best("dtqc", "layer_norm", _cpu_hand, {"priority": "td_error"}),
    ("gpu", "hand"): _Best("dtqc", "layer_norm", _gpu_hand),
    ("cpu", "arms"): _Best("sac", "layer_norm", _cpu_arm, {"sampler": "final"}),
    ("gpu", "arms"): _Best("sac", "layer_norm", _gpu_arm, {"sampler": "final"}),
    ("cpu", "hand_reach"): _Best(
        "ddpg", "mlp", lambda env: _kept(_gpu_hand_reach(env), 480_000, num_envs=64, cycles_per_epoch=5, updates_per_cycle=80)
    ),
    ("cpu", "push"): _Best("td3", "mlp", _cpu_push, _MIRROR),
    ("cpu", "pick_and_place"): _PICK_AND_PLACE,
    ("cpu", "slide"): _Best("dtqc", "layer_norm", _cpu_slide, {"priority": "td_error_shared", **_MIRROR}),
    ("gpu", "push"): _Best("ddpg", "mlp", None, _MIRROR),
    ("gpu", "hand_reach"): _Best("ddpg", "mlp", _gpu_hand_reach),
    ("gpu", "pick_and_place"): _PICK_AND_PLACE,
    ("gpu", "slide"): _Best("dtqc", "layer_norm", _gpu_slide, {"priority": "td_error"}),
    ("frugal", "push"): _Best("td3", "mlp", lambda env: _frugal(env).replace(noise_std=0.6), _MIRROR),
    ("frugal", "pick_and_place"): _Best("tqc", "layer_norm", lambda env: _kept(_entropy(env), 320_000, num_envs=64), _MIRROR),
    ("frugal", "slide"): _Best("dtqc", "layer_norm", _frugal_slide, {"priority": "td_error", **_MIRROR}),
}
