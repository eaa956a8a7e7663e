"""REDQ (Chen et al. 2021): SAC with many critics, of which a few drawn at random make the target, and many updates a step.

y = r + gamma (min_{i in M} Q'_i(s', a') - alpha log pi(a'|s')),  M: `subset_critics` of the C        (algorithm 1)
critics: mean (Q_i(s, a) - y)^2;  actor: mean(alpha log pi(a|s) - mean_i Q_i(s, a))
"""

from __future__ import annotations

from mjx_dher.config import Config
from mjx_dher.learners import actor_critic, critics
from mjx_dher.learners.actor_critic import ActorCritic
from mjx_dher.learners.actors import Gaussian
from mjx_dher.learners.critics import Critics
from mjx_dher.networks import NetworksFn
from mjx_dher.types import Sizes


def make(config: Config, sizes: Sizes, networks: NetworksFn) -> ActorCritic:
    """Makes the learner. `num_critics` is 10 in the paper, `subset_critics` 2, with 20 updates a step.

    Raises:
      ValueError: a subset that is larger than the ensemble, or what `actor_critic.make` raises.
    """
    if config.subset_critics > config.num_critics:
        raise ValueError(f"subset_critics must be at most num_critics ({config.num_critics}); got {config.subset_critics}")
    combine = critics.smallest_of(config.subset_critics)
    parts = Critics(config.num_critics, 1, combine, critics.squared_error, critics.mean)
    return actor_critic.make("redq", config, sizes, networks, Gaussian(), parts)
