"""`Config` (static sizes of the compiled program) and `HParams` (traced numbers of the algorithm).

Each field declares its range and help text; `validation` checks the range. Loads neither JAX nor MuJoCo.
"""

import dataclasses
import math
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_type_hints


@dataclasses.dataclass(frozen=True)
class Number:
    """Interval of a field's values, such as "[0, 1)"."""

    interval: str

    def contains(self, value: float) -> bool:
        """Whether `value` lies in the interval. NaN does not."""
        low, high = map(float, self.interval[1:-1].split(","))
        above = value >= low if self.interval[0] == "[" else value > low
        return above and (value <= high if self.interval[-1] == "]" else value < high)


Count = Annotated[int, Number("[1, 1000000]")]
Share = Annotated[float, Number("[0, 1]")]
Positive = Annotated[float, Number("[1e-37, 3e38]")]
NotNegative = Annotated[float, Number("[0, 3e38]")]  # programs compute in float32


def plain(value: Any) -> Any:
    """A scalar of NumPy or JAX as Python's, and any other value as it is."""
    return value.item() if getattr(value, "shape", None) == () else value


@dataclasses.dataclass(frozen=True)
class Config:
    """Sizes that shape the compiled program. Runs with equal Configs can share one compilation.

    A cycle rolls out `num_envs` whole episodes, adds them to the replay ring and makes `updates_per_cycle` updates. An epoch
    is `cycles_per_epoch` cycles and an evaluation.
    """

    num_envs: Count = 16
    """Parallel environments; each plays one episode per cycle."""
    cycles_per_epoch: Count = 50
    """Cycles per epoch."""
    updates_per_cycle: Count = 40
    """Gradient steps per cycle, for both critic and actor."""
    target_period: Count = 40
    """Gradient steps between soft updates of the targets. Must divide updates_per_cycle."""
    batch_size: Annotated[int, Number("[1, 10000000]")] = 256
    """Transitions per gradient step."""
    total_steps: Annotated[int, Number("[1, 2000000000]")] = 1_000_000
    """Environment steps of the run, rounded up to whole epochs; at least a tenth of one."""
    replay_size: Annotated[int, Number("[1, 10000000000]")] = 1_000_000
    """Transitions in the replay ring (the buffer)."""
    hidden_sizes: Annotated[tuple[int, ...], Number("[1, 65536]")] = (256, 256, 256)
    """Hidden layer sizes of both actor and critic."""
    num_critics: Annotated[int, Number("[1, 1000]")] = 2
    """Number of critics: 2 in TD3 and SAC, 5 in TQC, 10 in REDQ."""
    subset_critics: Annotated[int, Number("[1, 1000]")] = 2
    """Random critics per target, of which the smallest value is used."""
    num_quantiles: Annotated[int, Number("[1, 10000]")] = 25
    """Return quantiles per critic."""
    dropped_quantiles: Annotated[int, Number("[0, 10000]")] = 2
    """Quantiles per critic dropped from the target, starting with the largest of all critics."""
    num_bins: Annotated[int, Number("[2, 10000]")] = 101
    """Values into which a categorical critic classifies the return."""
    reset_every: Annotated[int, Number("[0, 2000000000]")] = 0
    """Updates after which networks and the entropy weight start again, a multiple of updates_per_cycle. 0: never."""
    energy: Literal["norm", "l2", "dot", "cosine"] = "norm"
    """Similarity of phi(s, a) and psi(g): minus their distance, minus its square, their product, or its cosine."""
    contrastive_loss: Literal["forward", "backward", "symmetric"] = "forward"
    """InfoNCE over the goals for each action, over the actions for each goal, or the sum of both."""
    representation_size: Annotated[int, Number("[1, 65536]")] = 64
    """Numbers in phi(s, a) and psi(g)."""
    same_episode: Literal["negatives", "masked"] = "negatives"
    """Goals of the same episode in a batch: negative examples, or excluded, because the action may lead to them, too."""
    policy_delay: Annotated[int, Number("[1, 1000]")] = 1
    """Critic steps per actor step: 2 in TD3. Must divide target_period, or be a multiple of it that divides
    updates_per_cycle."""
    learner_dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of the hidden layers while learning. bfloat16 is faster on a GPU with large batches or many parallel runs.
    Parameters, and the policy that plays, are float32 with either."""
    n_step: Annotated[int, Number("[1, 1000]")] = 1
    """Rewards in a return before it bootstraps from the critic, at most an episode's."""
    renewals: Annotated[int, Number("[0, 1000000]")] = 0
    """Priorities renewed per cycle and new episode: the new episodes first, then random ones. 0 renews the whole ring. Read by
    renewable priorities that weigh each episode alone: of the built-in ones, td_error and td_error_shared."""
    augmentation: Literal["none", "mirror"] = "none"
    """mirror replaces a random half of each batch by mirror images. The task needs the method mirror."""
    eval_episodes: Count = 100
    """Episodes of the deterministic evaluation after each epoch."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():  # run folders take no scalars of NumPy
            object.__setattr__(self, name, tuple(map(plain, value)) if isinstance(value, tuple) else plain(value))


class HParams(NamedTuple):
    """Numbers of the algorithm, a traced pytree: a sweep over them compiles once.

    The defaults follow the original HER code (Plappert et al. 2018, arXiv 1802.09464; openai/baselines). The paper names four
    of them: actor_lr, critic_lr, random_eps and noise_std.
    """

    actor_lr: Share = 1e-3
    """Learning rate of the actor (Adam)."""
    critic_lr: Share = 1e-3
    """Learning rate of the critic (Adam)."""
    lr_end: Share = 1.0
    """Final learning rates as a fraction of the initial ones, reached linearly. 1 keeps them constant."""
    adam_eps: Annotated[float, Number("[1e-30, 1]")] = 1e-8
    """Adam's epsilon. Summing the gradients of W workers, instead of averaging them, is the same as dividing this by W."""
    gamma: Annotated[float, Number("[0, 0.9999999]")] = 0.98
    """Discount factor. Target values are clipped to the range of possible returns, [-1/(1-gamma), 0] for Fetch."""
    polyak: Share = 0.95
    """Fraction of the old target that a soft update keeps: 1 - tau in other libraries."""
    action_l2: NotNegative = 1.0
    """Weight of the mean squared action in the actor's loss."""
    random_eps: Share = 0.3
    """Probability of a uniformly random action while exploring."""
    noise_std: NotNegative = 0.2
    """Standard deviation of the Gaussian noise on the other actions. Not used by stochastic actors."""
    random_noise: Share = 0.0
    """Noise on the random actions as a fraction of noise_std, before they are clipped to [-1, 1]."""
    her_k: Annotated[float, Number("[0, inf]")] = 4.0
    """Hindsight goals per original goal: k/(k+1) of each batch is relabelled; inf relabels all of it."""
    priority_fraction: Share = 0.0
    """Fraction of each batch drawn in proportion to episode priority. The rest is uniform."""
    epsilon: Share = 0.2
    """Probability that epsilon_closest draws a uniform future goal instead of the closest."""
    temperature: Annotated[float, Number("[1e-6, inf]")] = 1.0
    """Temperature of weighted. Larger values give more even weights; inf equals future."""
    weight_scale: Annotated[float, Number("[1e-6, 1e6]")] = 0.05
    """Distance in metres that counts as 1, for weighted with weight_normalization none."""
    target_noise: NotNegative = 0.2
    """Standard deviation of the Gaussian noise on target actions (target policy smoothing)."""
    target_noise_clip: NotNegative = 0.5
    """Target noise is clipped to +- this."""
    entropy_weight: NotNegative = 1.0
    """Initial weight of the policy's entropy."""
    entropy_target: Annotated[float, Number("[-1e30, 1e30]")] = -1.0
    """Target entropy per action dimension, for which the learner adapts the entropy weight."""
    logsumexp_penalty: NotNegative = 0.1
    """Weight of the mean squared logsumexp of the energies in the contrastive loss."""
    hindsight_reward: Share = 1.0
    """Reward factor of relabelled transitions. Below 1, hindsight counts as a better outcome (ARCHER)."""
    obs_clip: Positive = 200.0
    """Observations and goals are clipped to +- this before normalization."""
    norm_clip: Annotated[float, Number("[1e-37, 1e9]")] = 5.0
    """Normalized observations and goals are clipped to +- this."""
    norm_eps: Positive = 0.01
    """Smallest standard deviation that the normalizers divide by."""


Metadata = TypeVar("Metadata")


def metadata(owner: Any, kind: type[Metadata]) -> dict[str, Metadata]:
    """Metadata of type `kind` that is declared for the fields of `owner`, by field name."""
    hints = get_type_hints(owner, include_extras=True)
    return {name: m for name, hint in hints.items() for m in getattr(hint, "__metadata__", ()) if isinstance(m, kind)}


def episodes_capacity(config: Config, episode_length: int) -> int:
    """Number of whole episodes that the replay ring holds."""
    return config.replay_size // episode_length


def steps_per_epoch(config: Config, episode_length: int) -> int:
    """Training steps of an epoch."""
    return config.num_envs * config.cycles_per_epoch * int(episode_length)  # which may be NumPy's


def num_epochs(config: Config, episode_length: int) -> int:
    """Number of epochs, rounded up to reach `total_steps`."""
    return math.ceil(config.total_steps / steps_per_epoch(config, episode_length))


def num_updates(config: Config, episode_length: int) -> int:
    """Gradient steps of a whole run."""
    return num_epochs(config, episode_length) * config.cycles_per_epoch * config.updates_per_cycle


def of_one_device(config: Config, devices: int) -> Config:
    """Sizes per device if `devices` share a run. `validation.check_plan` tests that they can be divided."""
    divided = ("num_envs", "batch_size", "replay_size", "total_steps", "eval_episodes")
    return dataclasses.replace(config, **{name: math.ceil(getattr(config, name) / devices) for name in divided})
