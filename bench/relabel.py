"""Sampling and relabelling: transitions a second, for each goal sampler, from a ring of 10^6 transitions.

python bench/relabel.py [--batch-size 1024]
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
from learner import compute_reward, full_ring
from timing import median_seconds, print_table

from mjx_dher import HParams, replay, samplers
from mjx_dher.relabel import relabel

BATCHES = 40


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch-size", type=int, default=1024)
    args = parser.parse_args()
    hparams, ring = HParams(), full_ring()
    keys = jax.random.split(jax.random.key(0), BATCHES)
    times = {}
    for name in samplers.list_samplers():
        sampler = samplers.make(name)

        @jax.jit
        def run(keys, sampler=sampler):
            def step(total, key):
                sample_key, relabel_key = jax.random.split(key)
                sample = replay.sample(ring, sample_key, args.batch_size)
                batch = relabel(ring, sample, sampler, compute_reward, hparams, relabel_key)
                return total + sum(jnp.sum(leaf) for leaf in jax.tree.leaves(batch)), None

            return jax.lax.scan(step, 0.0, keys)[0]

        times[name] = median_seconds(lambda run=run: run(keys)) / BATCHES
    rows = [
        (name, f"{args.batch_size / seconds:,.0f}", f"{seconds * 1e6:.0f}", f"{seconds / times['future']:.2f}")
        for name, seconds in times.items()
    ]
    print_table(("sampler", "transitions/s", f"µs per batch of {args.batch_size}", "against future"), rows)


if __name__ == "__main__":
    main()
