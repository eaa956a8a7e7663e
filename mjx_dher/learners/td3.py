"""TD3 (Fujimoto et al. 2018): two critics whose smaller value is the target, smoothed targets, a delayed actor.

y = r + gamma min_i Q'_i(s', clip(pi'(s') + clip(eps, -c, c)))        (equations 10 and 14)
critics: mean (Q_i(s, a) - y)^2;  actor: -mean Q_1(s, pi(s))
"""

from __future__ import annotations

from mjx_dher.config import Config
from mjx_dher.learners import actor_critic, critics
from mjx_dher.learners.actor_critic import ActorCritic
from mjx_dher.learners.actors import Deterministic
from mjx_dher.learners.critics import Critics
from mjx_dher.networks import NetworksFn
from mjx_dher.types import Sizes


def make(config: Config, sizes: Sizes, networks: NetworksFn) -> ActorCritic:
    """Makes the learner. `num_critics` is 2 in the paper, `policy_delay` 2.

    Raises:
      ValueError: what `actor_critic.make` raises.
    """
    parts = Critics(config.num_critics, 1, critics.smallest, critics.squared_error, critics.lowest, num_judges=1)
    return actor_critic.make("td3", config, sizes, networks, Deterministic(), parts)
