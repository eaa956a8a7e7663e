"""`Config` (static: shapes of the compiled program) and `HParams` (traced: the algorithm's numbers).

A number's range and help text stand beside its field; `validation` checks them. Loads neither JAX nor MuJoCo.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_type_hints


@dataclasses.dataclass(frozen=True)
class Number:
    """Metadata of a field: the interval of its values, such as "[0, 1)"."""

    interval: str

    def contains(self, value: float) -> bool:
        """Returns whether `value` lies in the interval; NaN does not."""
        low, high = map(float, self.interval[1:-1].split(","))
        above = value >= low if self.interval[0] == "[" else value > low
        return above and (value <= high if self.interval[-1] == "]" else value < high)


Count = Annotated[int, Number("[1, 1000000]")]
Share = Annotated[float, Number("[0, 1]")]
Positive = Annotated[float, Number("(0, inf)")]
NotNegative = Annotated[float, Number("[0, inf)")]


@dataclasses.dataclass(frozen=True)
class Config:
    """Sizes that shape the compiled program. Two runs with equal Configs can share one compilation.

    A cycle rolls out `num_envs` whole episodes, adds them to the replay ring and makes `updates_per_cycle` updates; an
    epoch is `cycles_per_epoch` cycles and an evaluation.
    """

    num_envs: Count = 16
    """Environments in parallel, and episodes a cycle."""
    cycles_per_epoch: Count = 50
    """Cycles an epoch."""
    updates_per_cycle: Count = 40
    """Gradient steps a cycle, of critic and actor both."""
    target_period: Count = 40
    """Gradient steps from one soft update of the targets to the next; divides updates_per_cycle."""
    batch_size: Annotated[int, Number("[1, 10000000]")] = 256
    """Transitions a gradient step."""
    total_steps: Annotated[int, Number("[1, 2000000000]")] = 1_000_000
    """Environment steps of the whole run, rounded up to whole epochs."""
    replay_size: Annotated[int, Number("[1, 10000000000]")] = 1_000_000
    """Transitions that the replay ring (the buffer) holds."""
    hidden_sizes: Annotated[tuple[int, ...], Number("[1, 65536]")] = (256, 256, 256)
    """Units of the hidden layers, of actor and critic both."""
    num_critics: Annotated[int, Number("[1, 1000]")] = 2
    """Critics that learn side by side: 2 in TD3 and SAC, 5 in TQC, 10 in REDQ."""
    subset_critics: Annotated[int, Number("[1, 1000]")] = 2
    """Critics, drawn at random, whose smallest value is the target."""
    num_quantiles: Annotated[int, Number("[1, 10000]")] = 25
    """Quantiles of the return that a critic gives."""
    dropped_quantiles: Annotated[int, Number("[0, 10000]")] = 2
    """Quantiles a critic that are left out of the target, the largest of all critics' first."""
    policy_delay: Annotated[int, Number("[1, 1000]")] = 1
    """Gradient steps of the critics for one of the actor: 2 in TD3. It divides target_period, or is a multiple of it that
    divides updates_per_cycle."""
    learner_dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the hidden layers while learning. bfloat16 is faster on a GPU with large batches or many runs side by side.
    Parameters, and the policy that plays, are float32 with either."""
    n_step: Annotated[int, Number("[1, 1000]")] = 1
    """Steps of a return that are taken from the episode, before the value of the state that they lead to."""
    renewals: Annotated[int, Number("[0, 1000000]")] = 0
    """Episodes whose priority is renewed at a cycle, for each that it plays: these, and others drawn at random; 0: the whole
    ring. Read by priorities that are renewed and weigh each episode alone: of the built-in ones, td_error."""
    eval_episodes: Count = 100
    """Episodes of the deterministic evaluation that ends each epoch."""


class HParams(NamedTuple):
    """Numbers of the algorithm: a pytree, traced, so that a sweep over numbers compiles once.

    The defaults are those of the HER code line (Plappert et al. 2018, arXiv 1802.09464; openai/baselines). docs/results.md
    says which of them the paper names: actor_lr, critic_lr, random_eps and noise_std.
    """

    actor_lr: Share = 1e-3
    """Adam's step size (learning rate) for the actor."""
    critic_lr: Share = 1e-3
    """Adam's step size (learning rate) for the critic."""
    lr_end: Share = 1.0
    """Fraction of both step sizes that is left at the end of the run, reached linearly; 1: constant."""
    adam_eps: Annotated[float, Number("[1e-30, 1]")] = 1e-8
    """Number that Adam adds to the root of the second moments. The gradients of W workers summed, not averaged, are the same
    as this divided by W."""
    gamma: Annotated[float, Number("[0, 1)")] = 0.98
    """Discount; target values are clipped to [-1/(1-gamma), 0]."""
    polyak: Share = 0.95
    """Fraction of the old target that a soft update keeps: 1 - tau, where others write tau."""
    action_l2: NotNegative = 1.0
    """Weight of the mean squared action in the actor's loss."""
    random_eps: Share = 0.3
    """Probability of a uniformly random action while exploring."""
    noise_std: NotNegative = 0.2
    """Standard deviation of the Gaussian noise on the other actions; a learner that draws its actions needs none."""
    random_noise: Share = 0.0
    """Noise on the random actions, too, as a fraction of noise_std; actions are clipped to [-1, 1] after it."""
    her_k: Annotated[float, Number("[0, inf]")] = 4.0
    """Hindsight goals per original one: k/(k+1) of each batch is relabelled; inf: all of it."""
    priority_fraction: Share = 0.0
    """Fraction of each batch drawn from episodes in proportion to their priority; the rest is uniform."""
    epsilon: Share = 0.2
    """Probability of a uniform future goal instead of the closest, for epsilon_closest."""
    temperature: Positive = 1.0
    """Evenness of the weights, for weighted: the larger, the more even (infinite: the same as future)."""
    weight_scale: Annotated[float, Number("[1e-6, 1e6]")] = 0.05
    """Distance that counts as 1, in metres, for weighted with weight_normalization none."""
    target_noise: NotNegative = 0.2
    """Standard deviation of the Gaussian noise on the actions of targets, which smooths these."""
    target_noise_clip: NotNegative = 0.5
    """Bound of that noise: it is clipped to +- this."""
    entropy_weight: NotNegative = 1.0
    """Weight of the policy's entropy in its values, before the learner has changed it."""
    entropy_target: Annotated[float, Number("(-inf, inf)")] = -1.0
    """Entropy that this weight is changed for, for each number of an action."""
    hindsight_reward: Share = 1.0
    """Factor of the reward of a transition whose goal was replaced: below 1, hindsight counts as a better outcome (ARCHER)."""
    obs_clip: Positive = 200.0
    """Bound of observations and goals: they are clipped to +- this before they are normalized."""
    norm_clip: Positive = 5.0
    """Bound of normalized observations and goals: they are clipped to +- this."""
    norm_eps: Positive = 0.01
    """Least standard deviation that the normalizers divide by."""


Metadata = TypeVar("Metadata")


def metadata(owner: Any, kind: type[Metadata]) -> dict[str, Metadata]:
    """Returns what is declared of `kind` beside the fields of `owner`, by field name."""
    hints = get_type_hints(owner, include_extras=True)
    return {name: m for name, hint in hints.items() for m in getattr(hint, "__metadata__", ()) if isinstance(m, kind)}


def episodes_capacity(config: Config, episode_length: int) -> int:
    """Returns the whole episodes that the replay ring holds."""
    return config.replay_size // episode_length


def steps_per_epoch(config: Config, episode_length: int) -> int:
    """Returns the environment steps of an epoch, evaluation not counted."""
    return config.num_envs * config.cycles_per_epoch * episode_length


def num_epochs(config: Config, episode_length: int) -> int:
    """Returns the whole epochs that `total_steps` takes."""
    return math.ceil(config.total_steps / steps_per_epoch(config, episode_length))


def num_updates(config: Config, episode_length: int) -> int:
    """Returns the updates of the learner in a whole run."""
    return num_epochs(config, episode_length) * config.cycles_per_epoch * config.updates_per_cycle


def of_one_device(config: Config, devices: int) -> Config:
    """Sizes of one of the devices that share a run; `check_parts` says whether they can be divided."""
    divided = ("num_envs", "batch_size", "replay_size", "total_steps", "eval_episodes")
    return dataclasses.replace(config, **{name: math.ceil(getattr(config, name) / devices) for name in divided})
