"""Sampling and relabelling: transitions per second, for each goal sampler, from a ring of 10^6 transitions.

    python bench/relabel.py [--batch-size 1024] [--flashbax]

Batches are drawn as in training, many at once. `--flashbax` adds a row for the item buffer of flashbax (pip install
flashbax==0.1.3) with the same transitions and as many batches at once, drawn uniformly and not relabelled.
"""

import argparse

import jax
import jax.numpy as jnp
from learner import compute_reward, full_ring
from timing import median_seconds, print_table

from mjx_dher import HParams, replay, samplers
from mjx_dher.components import COMPONENTS
from mjx_dher.context import Context
from mjx_dher.relabel import draw_batches
from mjx_dher.trainer import MAX_TRANSITIONS_PER_DRAW
from mjx_dher.types import Batch

ROUNDS = 10


def total(tree):
    """Reads all that was drawn, so that the compiler cannot omit it."""
    return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(tree))


def transitions_a_second(draw, num_drawn):
    """Transitions per second of `draw(key)`, which draws `num_drawn`."""

    @jax.jit
    def run(keys):
        return jax.lax.scan(lambda found, key: (found + total(draw(key)), None), 0.0, keys)[0]

    keys = jax.random.split(jax.random.key(0), ROUNDS)
    return ROUNDS * num_drawn / median_seconds(lambda: run(keys))


def flashbax(ring, num_drawn):
    """A function key -> transitions [num_drawn] from an item buffer with the transitions of `ring`."""
    import flashbax as fbx

    episodes = ring.episodes
    flat = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
    desired = jnp.repeat(episodes.desired_goal, episodes.action.shape[1], axis=0)
    items = Batch(
        observation=flat(episodes.observation[:, :-1]),
        action=flat(episodes.action),
        reward=jnp.zeros(len(desired)),
        next_observation=flat(episodes.observation[:, 1:]),
        desired_goal=desired,
        discount=jnp.ones(len(desired)),
        row=jnp.repeat(jnp.arange(len(episodes.action)), episodes.action.shape[1]),
    )
    buffer = fbx.make_item_buffer(max_length=len(desired), min_length=1, sample_batch_size=num_drawn, add_batches=True)
    state = buffer.add(buffer.init(jax.tree.map(lambda x: x[0], items)), items)
    return lambda key: buffer.sample(state, key).experience


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch-size", type=int, default=1024)
    parser.add_argument("--flashbax", action="store_true")
    args = parser.parse_args()
    hparams, ring = HParams(), full_ring()
    cumulative = replay.cumulative(ring)
    shape = (max(1, MAX_TRANSITIONS_PER_DRAW // args.batch_size), args.batch_size)
    num_drawn = shape[0] * shape[1]
    rates = {}
    for name in COMPONENTS["sampler"]:

        def draw(key, sampler=samplers.make(name)):  # noqa: B008
            return draw_batches(ring, key, shape, sampler, Context(compute_reward, hparams), cumulative)

        rates[name] = transitions_a_second(draw, num_drawn)
    if args.flashbax:
        rates["flashbax, not relabelled"] = transitions_a_second(flashbax(ring, num_drawn), num_drawn)
    rows = [
        (name, f"{rate:,.0f}", f"{1e6 * args.batch_size / rate:.1f}", f"{rates['future'] / rate:.2f}")
        for name, rate in rates.items()
    ]
    print_table(("sampler", "transitions/s", f"µs per batch of {args.batch_size}", "time against future"), rows)


if __name__ == "__main__":
    main()
