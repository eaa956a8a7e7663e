"""TQC (Kuznetsov et al. 2020): SAC whose critics give quantiles of the return; the largest of all are left out of the target.

    y_k = r + gamma (z_k(s', a') - alpha log pi(a'|s')),  z_1 <= z_2 <= ... the pooled quantiles without the largest
    critics: the quantile Huber loss (equation 12);  actor: mean(alpha log pi(a|s) - the mean of all quantiles)

`dtqc` has the same critics under a deterministic actor (TD3's), which explores under noise.
"""

from __future__ import annotations

from mjx_dher.config import Config
from mjx_dher.learners import actor_critic, critics
from mjx_dher.learners.actor_critic import ActorCritic
from mjx_dher.learners.actors import ActorKind, Deterministic, Gaussian
from mjx_dher.learners.critics import Critics
from mjx_dher.networks import NetworksFn
from mjx_dher.types import Sizes


def make(config: Config, sizes: Sizes, networks: NetworksFn) -> ActorCritic:
    """Makes the learner. `num_critics` is 5 in the paper, `num_quantiles` 25 and `dropped_quantiles` 2.

    Raises:
      ValueError: no quantile is left, or what `actor_critic.make` raises.
    """
    return _make("tqc", config, sizes, networks, Gaussian())


def make_deterministic(config: Config, sizes: Sizes, networks: NetworksFn) -> ActorCritic:
    """Makes `dtqc`.

    Raises:
      ValueError: no quantile is left, or what `actor_critic.make` raises.
    """
    return _make("dtqc", config, sizes, networks, Deterministic())


def _make(name: str, config: Config, sizes: Sizes, networks: NetworksFn, actor: ActorKind) -> ActorCritic:
    if config.dropped_quantiles >= config.num_quantiles:
        raise ValueError(
            f"dropped_quantiles must be less than num_quantiles ({config.num_quantiles}); got {config.dropped_quantiles}"
        )
    combine = critics.truncated(config.dropped_quantiles)
    parts = Critics(config.num_critics, config.num_quantiles, combine, critics.quantile_huber, critics.mean)
    return actor_critic.make(name, config, sizes, networks, actor, parts)
