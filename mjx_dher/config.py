"""What a training run is made of: `Config` (static) and `HParams` (traced), the presets, and all validation.

This module loads neither JAX nor MuJoCo (but for one question, `machine_preset`), so that a wrong argument is refused before
either has been loaded.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterable
from typing import Any, NamedTuple

from mjx_dher.names import check_name, is_own

ENGINES = ("auto", "native", "jax", "warp")
SAMPLERS = ("random", "episode", "future", "final", "closest", "epsilon_closest", "weighted")
WEIGHT_KERNELS = ("linear", "inverse", "softmax")
METRICS = ("position",)
DTYPES = ("float32", "bfloat16")
LEARNER_KERNELS = ("auto", "xla", "hopper")


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that shapes the compiled program. Two runs with equal Configs share one compilation.

    A cycle rolls out `num_envs` whole episodes, adds them to the replay ring and makes `updates_per_cycle` updates; an
    epoch is `cycles_per_epoch` cycles and an evaluation.
    """

    env: str = "push"
    """Environment: a name from `envs.list_envs()`, or one of your own as module:attribute."""
    sampler: str = "future"
    """How hindsight goals are chosen: random, episode, future, final, closest, epsilon_closest or weighted, or
    module:attribute."""
    weight_kernel: str = "linear"
    """For the weighted sampler, how weights fall with distance: linear, inverse or softmax."""
    metric: str = "position"
    """The distance between an achieved and a desired goal that closest, epsilon_closest and weighted go by."""
    engine: str = "auto"
    """Physics: native (MuJoCo C on all cores), warp (MuJoCo Warp on an NVIDIA GPU), jax (MJX) or auto, which picks."""
    num_envs: int = 16
    """Environments in parallel, and episodes a cycle."""
    cycles_per_epoch: int = 50
    """Cycles an epoch."""
    updates_per_cycle: int = 40
    """Gradient steps, of critic and actor both, a cycle."""
    target_period: int = 40
    """Gradient steps from one soft update of the targets to the next; divides updates_per_cycle."""
    batch_size: int = 256
    """Transitions a gradient step."""
    total_steps: int = 1_000_000
    """Environment steps of the whole run, rounded up to whole epochs."""
    replay_size: int = 1_000_000
    """Transitions that the replay ring holds."""
    hidden_sizes: tuple[int, ...] = (256, 256, 256)
    """Units of the hidden layers, of actor and critic both."""
    learner_dtype: str = "float32"
    """Of the hidden layers while learning: float32, or bfloat16, which is faster on a GPU with large batches or many runs side
    by side. Parameters, and the policy that plays, are float32 with either."""
    learner_kernels: str = "auto"
    """What computes the gradients: xla, hopper (this library's kernels for an NVIDIA H100 or H200, for bfloat16) or auto, which
    takes hopper wherever it can."""
    eval_episodes: int = 100
    """Episodes of the deterministic evaluation that ends each epoch."""


class HParams(NamedTuple):
    """Every number of the algorithm: a pytree, traced, so that a sweep over numbers compiles once.

    The defaults are those of the original HER code line (Plappert et al. 2018, arXiv 1802.09464) and of the paper.
    """

    actor_lr: float = 1e-3
    """Adam's step size for the actor."""
    critic_lr: float = 1e-3
    """Adam's step size for the critic."""
    lr_end: float = 1.0
    """Share of both step sizes that is left at the end of the run, reached linearly; 1 (constant) in the paper."""
    gamma: float = 0.98
    """Discount; target values are clipped to [-1/(1-gamma), 0]."""
    polyak: float = 0.95
    """Share of the old target that a soft update keeps."""
    action_l2: float = 1.0
    """Weight of the mean squared action in the actor's loss."""
    random_eps: float = 0.3
    """Probability of a uniformly random action while exploring."""
    noise_std: float = 0.2
    """Standard deviation of the Gaussian noise on the other actions."""
    her_k: float = 4.0
    """Hindsight goals per original one: k/(k+1) of each batch is relabelled."""
    eventful_share: float = 0.0
    """Share of each batch drawn from episodes that moved the achieved goal out of reach of where it was; 0 in the paper."""
    epsilon: float = 0.2
    """For epsilon_closest: probability of a uniform future goal instead of the closest."""
    temperature: float = 1.0
    """For weighted: the larger, the more even the weights (infinite: the same as future)."""
    obs_clip: float = 200.0
    """Observations and goals are clipped to +- this before they are normalized."""
    norm_clip: float = 5.0
    """Normalized observations and goals are clipped to +- this."""
    norm_eps: float = 0.01
    """Least standard deviation that the normalizers divide by."""


def episodes_capacity(config: Config, episode_length: int) -> int:
    """Whole episodes that the replay ring holds."""
    return config.replay_size // episode_length


def steps_per_epoch(config: Config, episode_length: int) -> int:
    """Environment steps an epoch, evaluation not counted."""
    return config.num_envs * config.cycles_per_epoch * episode_length


def num_epochs(config: Config, episode_length: int) -> int:
    """Whole epochs that `total_steps` takes."""
    return math.ceil(config.total_steps / steps_per_epoch(config, episode_length))


def check_count(field: str, value: int) -> None:
    """Refuses what is no number of things.

    Raises:
      ValueError: less than 1.
    """
    if not _is_count(value):
        raise ValueError(f"{field} must be an integer of at least 1; got {value}")


def check_every(field: str, value: int) -> None:
    """Refuses what is no interval of epochs.

    Raises:
      ValueError: less than 0.
    """
    if value < 0:
        raise ValueError(f"{field} must be a number of epochs, or 0; got {value}")


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def validate(config: Config, hparams: HParams, episode_length: int | None = None) -> None:
    """Refuses what cannot run.

    Args:
      config: shapes and choices.
      hparams: numbers; arrays among them are not looked at.
      episode_length: of the environment, where it is known. None: that of the tasks here, and of an environment of the user's
        own nothing is assumed.

    Raises:
      ValueError: names every field at fault, its value and what is allowed.
    """
    if episode_length is None:
        episode_length = 1 if is_own(config.env) else 50
    problems = [*_config_problems(config, episode_length), *_hparam_problems(hparams)]
    if problems:
        raise ValueError("\n".join(problems))


def _config_problems(c: Config, episode_length: int) -> Iterable[str]:
    for field, value, allowed in (
        ("sampler", c.sampler, sampler_names()),
        ("weight_kernel", c.weight_kernel, WEIGHT_KERNELS),
        ("metric", c.metric, metric_names()),
        ("engine", c.engine, ENGINES),
        ("learner_dtype", c.learner_dtype, DTYPES),
        ("learner_kernels", c.learner_kernels, LEARNER_KERNELS),
    ):
        try:
            check_name(field, value, allowed, own=field == "sampler")
        except ValueError as error:
            yield str(error)
    positive = ("num_envs", "cycles_per_epoch", "updates_per_cycle", "target_period", "batch_size", "total_steps")
    wrong = False
    for field in (*positive, "replay_size", "eval_episodes"):
        value = getattr(c, field)
        if not _is_count(value):
            wrong = True
            yield f"{field} must be an integer of at least 1; got {value!r}"
    sizes = c.hidden_sizes
    if not (isinstance(sizes, tuple) and sizes and all(map(_is_count, sizes))):
        yield f"hidden_sizes must be one or more integers of at least 1; got {sizes!r}"
    if wrong:
        return
    if c.updates_per_cycle % c.target_period:
        yield (
            f"target_period must divide updates_per_cycle ({c.updates_per_cycle}); got {c.target_period},"
            f" allowed: {', '.join(str(n) for n in range(1, c.updates_per_cycle + 1) if c.updates_per_cycle % n == 0)}"
        )
    cycle = c.num_envs * episode_length
    if c.replay_size < cycle:
        yield (
            f"replay_size must hold at least one cycle of {c.num_envs} episodes x {episode_length} steps = {cycle}"
            f" transitions; got {c.replay_size}"
        )
    if c.batch_size > c.replay_size:
        yield f"batch_size must not exceed replay_size ({c.replay_size}); got {c.batch_size}"


def sampler_names() -> tuple[str, ...]:
    """The samplers known so far: users can have registered more only once the module has been imported."""
    module = sys.modules.get("mjx_dher.samplers")
    return module.list_samplers() if module else SAMPLERS


def metric_names() -> tuple[str, ...]:
    """The metrics known so far; see `sampler_names`."""
    module = sys.modules.get("mjx_dher.samplers")
    return tuple(module.METRICS) if module else METRICS


# field -> (least value, may it be least, greatest value, may it be greatest)
_HPARAM_RANGES: dict[str, tuple[float, bool, float, bool]] = {
    "actor_lr": (0, True, 1, True),
    "critic_lr": (0, True, 1, True),
    "lr_end": (0, True, 1, True),
    "gamma": (0, True, 1, False),
    "polyak": (0, True, 1, True),
    "action_l2": (0, True, math.inf, False),
    "random_eps": (0, True, 1, True),
    "noise_std": (0, True, math.inf, False),
    "her_k": (0, True, math.inf, False),
    "eventful_share": (0, True, 1, True),
    "epsilon": (0, True, 1, True),
    "temperature": (0, False, math.inf, False),
    "obs_clip": (0, False, math.inf, False),
    "norm_clip": (0, False, math.inf, False),
    "norm_eps": (0, False, math.inf, False),
}


def _hparam_problems(hparams: HParams) -> Iterable[str]:
    for field, (least, least_too, greatest, greatest_too) in _HPARAM_RANGES.items():
        value = getattr(hparams, field)
        if hasattr(value, "dtype"):
            continue  # an array: one value a seed, made by a program
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            yield f"{field} must be a number; got {value!r}"
            continue
        above = value >= least if least_too else value > least
        below = value <= greatest if greatest_too else value < greatest
        if not (above and below):
            brackets = "[("[not least_too], "])"[not greatest_too]
            yield f"{field} must lie in {brackets[0]}{least:g}, {greatest:g}{brackets[1]}; got {value!r}"
