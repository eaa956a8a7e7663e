"""Adds episodes of a custom loop to the replay ring and relabels them.

python docs/examples/own_episodes.py
"""

import jax
import jax.numpy as jnp

from mjx_dher import HParams, relabel, replay
from mjx_dher.context import Context
from mjx_dher.types import Episode
from point_mass import PointMass, soon

env = PointMass()


def play(key: jax.Array) -> Episode:
    """Plays 16 episodes of random actions in a custom scan."""
    reset_key, action_key = jax.random.split(key)
    first = jax.vmap(env.reset)(jax.random.split(reset_key, 16))
    actions = jax.random.uniform(action_key, (env.episode_length, 16, env.action_size), jnp.float32, minval=-1, maxval=1)
    last, obs = jax.lax.scan(lambda state, action: (jax.vmap(env.step)(state, action), state.obs), first, actions)
    whole = jax.tree.map(lambda steps, end: jnp.moveaxis(jnp.concatenate([steps, end[None]]), 0, 1), obs, last.obs)
    observation, achieved_goal = whole["observation"], whole["achieved_goal"]
    return Episode(observation, achieved_goal, first.obs["desired_goal"], jnp.moveaxis(actions, 0, 1)).filled()


def main() -> None:
    """Adds 16 episodes to a ring of 100, and draws a batch of 64 from it."""
    episodes = play(jax.random.key(0))
    ring = replay.add(replay.init(jax.tree.map(lambda x: x[0], episodes), num_episodes=100), episodes)
    sample = replay.sample(ring, jax.random.key(1), batch_size=64)
    batch = relabel.relabel(sample, soon, Context(env.compute_reward, HParams()), jax.random.key(2)).batch
    print(f"{int(ring.size)} episodes; a batch of {len(batch.reward)}, mean reward {float(batch.reward.mean()):.2f}")


if __name__ == "__main__":
    main()
