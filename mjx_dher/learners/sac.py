"""SAC (Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications"): paid for entropy, with a learned weight.

y = r + gamma (min_i Q'_i(s', a') - alpha log pi(a'|s')),  a' ~ pi(s')        (equations 2, 3 and 5)
critics: mean (Q_i(s, a) - y)^2;  actor: mean(alpha log pi(a|s) - min_i Q_i(s, a))
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
    """Makes the learner. `num_critics` is 2 in the paper.

    Raises:
      ValueError: what `actor_critic.make` raises.
    """
    parts = Critics(config.num_critics, 1, critics.smallest, critics.squared_error, critics.lowest)
    return actor_critic.make("sac", config, sizes, networks, Gaussian(), parts)
