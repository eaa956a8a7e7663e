"""Gradient updates: what one costs, and how much of it is sampling and relabelling.

python bench/learner.py [--batch-sizes 256 512 1024] [--sampler weighted]
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
from timing import median_seconds, print_table

from mjx_dher import Config, HParams, ddpg, replay, samplers
from mjx_dher.ddpg import Networks
from mjx_dher.networks import Actor, Critic
from mjx_dher.relabel import relabel
from mjx_dher.types import Batch, Episode

UPDATES = 40


def compute_reward(achieved_goal, desired_goal):
    return -(jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) > 0.05).astype(jnp.float32)


def full_ring(num_episodes: int = 20_000, num_steps: int = 50) -> replay.ReplayState:
    """A ring of 10^6 transitions, shaped like Push, of random numbers."""
    shapes = Episode(
        observation=jax.ShapeDtypeStruct((num_steps + 1, 25), jnp.float32),
        achieved_goal=jax.ShapeDtypeStruct((num_steps + 1, 3), jnp.float32),
        desired_goal=jax.ShapeDtypeStruct((3,), jnp.float32),
        action=jax.ShapeDtypeStruct((num_steps, 4), jnp.float32),
    )
    episodes = jax.tree.map(lambda x: 0.1 * jax.random.normal(jax.random.key(0), (num_episodes, *x.shape)), shapes)
    eventful = jnp.arange(num_episodes) % 3 == 0
    return jax.jit(replay.add)(replay.init(shapes, num_episodes), episodes, eventful)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=[256, 512, 1024])
    parser.add_argument("--sampler", default="weighted")
    args = parser.parse_args()
    networks = Networks(actor=Actor(4), critic=Critic(Config().hidden_sizes))
    hparams = jax.tree.map(jnp.float32, HParams(eventful_share=0.5))
    sampler, ring = samplers.make(args.sampler), full_ring()
    learner = ddpg.init(jax.random.key(1), networks, 25, 3, 4)
    rows = []
    for batch_size in args.batch_sizes:

        def draw(key, batch_size=batch_size):
            keys = jax.random.split(key, 3)
            picked = replay.draw_rows(ring, keys[0], batch_size, hparams.eventful_share, replay.count_eventful(ring))
            sample = replay.sample(ring, keys[1], batch_size, picked)
            return relabel(ring, sample, sampler, compute_reward, hparams, keys[2])

        def update(learner, batch):
            learner, losses = ddpg.update(networks, learner, batch, hparams)
            return ddpg.update_target(learner, hparams), losses

        @jax.jit
        def draws_only(keys, draw=draw):
            def step(total, key):
                return total + sum(jnp.sum(leaf) for leaf in jax.tree.leaves(draw(key))), None

            return jax.lax.scan(step, 0.0, keys)[0]

        @jax.jit
        def updates_only(learner, batch, update=update):
            return jax.lax.scan(lambda s, _: update(s, batch), learner, length=UPDATES)

        @jax.jit
        def both(learner, keys, draw=draw, update=update):
            return jax.lax.scan(lambda s, key: update(s, draw(key)), learner, keys)

        keys = jax.random.split(jax.random.key(2), UPDATES)
        batch: Batch = jax.jit(draw)(keys[0])
        draw_time = median_seconds(lambda: draws_only(keys)) / UPDATES
        update_time = median_seconds(lambda: updates_only(learner, batch)) / UPDATES
        both_time = median_seconds(lambda: both(learner, keys)) / UPDATES
        rows.append(
            (
                batch_size,
                f"{both_time * 1e3:.2f}",
                f"{1 / both_time:,.0f}",
                f"{update_time * 1e3:.2f}",
                f"{draw_time * 1e3:.3f}",
                f"{draw_time / update_time:.1%}",
            )
        )
    print_table(("batch", "ms/update", "updates/s", "of it: gradients, ms", "sampling + relabelling, ms", "share"), rows)


if __name__ == "__main__":
    main()
