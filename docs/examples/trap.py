"""A task with a terminal state and custom rewards: a point that can fall into a trap on its way.

    python docs/examples/trap.py
    PYTHONPATH=docs/examples python train.py --env trap:Trap --sampler future

With a reward of -1 for each step before the goal, falling would be rewarded, because no cost follows it. So rewards are 0
and 1, or lie between 0 and 5 with `dense=True`. The `EnvSpec` declares this range, and that episodes can end.
"""

import argparse

import jax
import jax.numpy as jnp
from flax import struct

from mjx_dher import Config, HParams, make_train
from mjx_dher.rollout import rollout
from mjx_dher.types import EnvSpec, GoalObs

STEP = 0.1  # distance that an action of 1 moves the point, along each axis
REACH = 0.1  # distance at which the goal is reached
TRAP = 0.15  # radius of the trap, around 0


@struct.dataclass
class TrapState:
    """State of an episode."""

    obs: GoalObs  # observation [2], achieved_goal [2], desired_goal [2]
    reward: jax.Array  # []
    success: jax.Array  # [] 1.0 if the goal is reached, else 0.0
    terminal: jax.Array  # [] whether the point has fallen: no goal can be reached, so no future follows


class Trap:
    """A point in the plane; start and goal lie on a ring around the trap."""

    name = "trap"
    observation_size, goal_size, action_size = 2, 2, 2

    def __init__(self, episode_length: int = 15, dense: bool = False):
        self.episode_length, self.dense = episode_length, dense
        self.spec = EnvSpec(
            observation=jax.ShapeDtypeStruct((2,), jnp.float32),
            goal_size=2,
            action_size=2,
            episode_length=episode_length,
            reward_range=(0.0, 5.0 if dense else 1.0),
            ends=True,
        )

    def reset(self, key):
        """Draws start and goal at random angles and distances around the trap."""
        angle_key, radius_key = jax.random.split(key)
        angle = jax.random.uniform(angle_key, (2,), jnp.float32, maxval=2 * jnp.pi)
        radius = jax.random.uniform(radius_key, (2,), jnp.float32, minval=0.3, maxval=0.4)
        start, goal = radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        return self._state(start, goal)

    def step(self, state, action):
        """State after `action` [2], which is clipped to [-1, 1]."""
        return self._state(state.obs["achieved_goal"] + STEP * jnp.clip(action, -1, 1), state.obs["desired_goal"])

    def reached(self, achieved_goal, desired_goal):
        """Whether goals [..., 2] are reached, bool [...]. The default, a reward at its maximum, does not suit dense rewards."""
        return jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) <= REACH

    def compute_reward(self, achieved_goal, desired_goal):
        """Rewards [...] of goals [..., 2]: 1 within reach and else 0. If dense, 5 at the goal, falling with distance."""
        if self.dense:
            return 5 * jnp.exp(-5 * jnp.linalg.norm(achieved_goal - desired_goal, axis=-1))
        return self.reached(achieved_goal, desired_goal).astype(jnp.float32)

    def _state(self, position, goal):
        fallen = jnp.linalg.norm(position) < TRAP
        success = (self.reached(position, goal) & ~fallen).astype(jnp.float32)
        obs = GoalObs(observation=position, achieved_goal=position, desired_goal=goal)
        return TrapState(obs=obs, reward=self.compute_reward(position, goal), success=success, terminal=fallen)


def main(argv=None):
    """Trains, and prints the success rate and the share of fallen points after each epoch."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--dense", action="store_true")
    args = parser.parse_args(argv)
    env = Trap(dense=args.dense)
    config = Config(
        num_envs=8,
        cycles_per_epoch=5,
        updates_per_cycle=40,
        target_period=1,
        batch_size=128,
        replay_size=30_000,
        hidden_sizes=(64, 64),
        eval_episodes=100,
        total_steps=600 * args.epochs,
    )
    hparams = HParams(gamma=0.85, polyak=0.95, action_l2=0.03, actor_lr=3e-3, critic_lr=3e-3)
    program = make_train(env, config)
    epoch = jax.jit(program.epoch, donate_argnums=0)

    @jax.jit
    def fallen(state, key):
        def act(_, obs):
            return program.learner.act(state.learner, obs, hparams)

        return rollout(env, act, key, 200)[0].terminal.mean()

    state = program.init(jax.random.key(args.seed), hparams)
    for number in range(1, args.epochs + 1):
        state, metrics = epoch(state)
        share = float(fallen(state, jax.random.key(1)))
        print(f"epoch {number}: success {float(metrics['success_rate']):.2f}, fallen {share:.2f}")


if __name__ == "__main__":
    main()
