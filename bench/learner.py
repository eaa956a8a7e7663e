"""Gradient updates: what one costs, and how much of it is drawing and relabelling its batch.

    python bench/learner.py [--batch-sizes 256 512 1024] [--seeds 1] [--sampler weighted]
        [--dtype bfloat16 [--kernels hopper]]

As in training: as many batches as trainer.MAX_TRANSITIONS_PER_DRAW allows are drawn at once, then learned from one by one,
until 500 updates or more are made, all in one program. Several seeds are one program, vmapped; times are per update of one of
them.
"""

from __future__ import annotations

import argparse
import itertools

import jax
import jax.numpy as jnp
from timing import median_seconds, print_table

from mjx_dher import Config, HParams, replay, samplers
from mjx_dher.hopper import gradients as hopper
from mjx_dher.learners import ddpg
from mjx_dher.networks import mlp
from mjx_dher.relabel import draw_batches
from mjx_dher.trainer import MAX_TRANSITIONS_PER_DRAW
from mjx_dher.types import Episode, Sizes


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
    priority = (jnp.arange(num_episodes) % 3 == 0).astype(jnp.float32)
    return jax.jit(replay.add)(replay.init(shapes, num_episodes), episodes, priority)


def flops(batch_size: int) -> int:
    """Of the matrix products of an update.

    In passes through a network of one kind: the actor forward as target, forward, and backward (two products a layer); the
    critic forward as target, forward and backward, and for the actor forward and backward (to its input only: one).
    """
    sizes = (28, *Config().hidden_sizes)
    hidden = sum(a * b for a, b in itertools.pairwise(sizes))
    actor, critic = hidden + sizes[-1] * 4, hidden + 4 * sizes[1] + sizes[-1]
    return 2 * batch_size * (4 * actor + 6 * critic)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=[256, 512, 1024])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--sampler", default="weighted")
    parser.add_argument("--dtype", default="float32", help="of the hidden layers: float32 or bfloat16")
    parser.add_argument("--kernels", default="xla", choices=["xla", "hopper"], help="what computes the gradients")
    args = parser.parse_args()
    compute_gradients = (hopper if args.kernels == "hopper" else ddpg).compute_gradients
    for batch_size in args.batch_sizes if args.kernels == "hopper" else ():
        if problem := hopper.unsupported_reason(
            Config(learner_dtype=args.dtype, batch_size=batch_size), num_inputs=28, action_size=4
        ):
            parser.error(f"--kernels hopper needs {problem}")
    playing, learning = (mlp(4, Config().hidden_sizes, dtype) for dtype in ("float32", args.dtype))
    learner = ddpg.DDPG(Sizes(25, 3, 4), playing, learning, compute_gradients)
    hparams = jax.tree.map(jnp.float32, HParams(priority_fraction=0.5))
    sampler, ring = samplers.make(args.sampler), full_ring()
    cumulative = replay.cumulative_priority(ring)
    rows = []
    for batch_size, seeds in itertools.product(args.batch_sizes, args.seeds):
        at_once = max(1, MAX_TRANSITIONS_PER_DRAW // batch_size)
        draws = -(-500 // at_once)

        def draw(key, shape=(at_once, batch_size)):
            return draw_batches(ring, key, shape, sampler, compute_reward, hparams, cumulative)

        def draw_all(key, draw=draw, draws=draws):
            """[draws] one number of each batch, so that none is left out."""
            add_up = lambda _, key: (None, sum(jnp.sum(x) for x in jax.tree.leaves(draw(key))))  # noqa: E731
            return jax.lax.scan(add_up, None, jax.random.split(key, draws))[1]

        def update(state, batch):
            state, losses = learner.update(state, batch, hparams)
            return learner.update_target(state, hparams), losses

        def updates_only(state, batches, update=update, draws=draws):
            return jax.lax.scan(lambda state, _: jax.lax.scan(update, state, batches), state, length=draws)

        def both(state, key, draw=draw, update=update, draws=draws):
            draw_and_update = lambda state, key: jax.lax.scan(update, state, draw(key))  # noqa: E731
            return jax.lax.scan(draw_and_update, state, jax.random.split(key, draws))

        keys = jax.random.split(jax.random.key(2), seeds)
        states = jax.vmap(learner.init)(keys)
        drawing, updating, whole = (jax.jit(jax.vmap(function)) for function in (draw_all, updates_only, both))
        batches = jax.jit(jax.vmap(draw))(keys)
        each = at_once * draws * seeds
        draw_time = median_seconds(lambda: drawing(keys)) / each
        update_time = median_seconds(lambda: updating(states, batches)) / each
        both_time = median_seconds(lambda: whole(states, keys)) / each
        rows.append(
            (
                batch_size,
                seeds,
                f"{both_time * 1e6:,.1f}",
                f"{1 / both_time:,.0f}",
                f"{update_time * 1e6:,.1f}",
                f"{draw_time * 1e6:,.1f}",
                f"{draw_time / update_time:.1%}",
                f"{flops(batch_size) / update_time / 1e9:,.0f}",
            )
        )
    head = ("batch", "seeds", "µs/update", "updates/s", "of it: gradients, µs", "drawing, µs", "share", "GFLOP/s")
    print_table(head, rows)


if __name__ == "__main__":
    main()
