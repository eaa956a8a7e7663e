"""How random `weighted` is while a run learns: the share of its draws that differ from `future`, epoch by epoch.

    python bench/randomness.py --out randomness.csv [--env push] [--preset cpu] [--seeds 3] [--first-seed 0]

Trains with `weighted` and measures readings of it on the steps of each epoch's newest episodes. The share is the total
variation between the probabilities of the reading and of `future`: 0 means the same draws, 1 none in common. The paper
says that the sampler gives "a direction early on in training, while becoming more and more random as the network learns".
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from bakeoff_runs import save
from timing import print_table

from mjx_dher import envs, learners, presets, priorities, samplers
from mjx_dher.cli.settings import check_writable
from mjx_dher.config import HParams, num_epochs, steps_per_epoch
from mjx_dher.contract import env_spec
from mjx_dher.replay import ReplayState
from mjx_dher.spec import validate
from mjx_dher.system.files import FolderError
from mjx_dher.trainer import make_train
from mjx_dher.types import Array

READINGS = {
    "mean": samplers.make("weighted"),
    "mean, softmax": samplers.make("weighted", "softmax"),
    "none": samplers.make("weighted", normalization="none"),
    "none, softmax": samplers.make("weighted", "softmax", normalization="none"),
    "closest": samplers.make("closest"),
}
FIELDS = ("seed", "epoch", "env_steps", "success_rate", "priority_mean", *READINGS)


def shares(ring: ReplayState, newest: int, hparams: HParams) -> dict[str, Array]:
    """Mean share [] of draws that differ from `future`, over all steps of the `newest` episodes but the last two steps."""
    rows = (ring.cursor - 1 - jnp.arange(newest)) % ring.priority.shape[0]
    achieved, desired = ring.episodes.achieved_goal[rows], ring.episodes.desired_goal[rows]
    steps = jnp.arange(achieved.shape[1] - 3)

    def share(reading: samplers.Sampler, achieved: Array, desired: Array, step: Array) -> Array:
        own, base = (sample(achieved, desired, step, hparams) for sample in (reading.log_weights, samplers.future))
        return 0.5 * jnp.sum(jnp.abs(samplers.probabilities(own) - samplers.probabilities(base)))

    def mean(reading: samplers.Sampler) -> Array:
        of_steps = jax.vmap(lambda a, d: jax.vmap(lambda step: share(reading, a, d, step))(steps))
        return jnp.mean(of_steps(achieved, desired))

    return {name: mean(reading) for name, reading in READINGS.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--env", default="push")
    parser.add_argument("--preset", default="cpu")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    args = parser.parse_args()
    if args.seeds < 1:
        parser.error(f"--seeds is 1 or more; got {args.seeds}")
    if args.out.is_dir():
        parser.error(f"--out must be a file; {args.out} is a folder")
    try:
        check_writable(args.out.resolve().parent)
        spec = presets.preset(args.preset, args.env)
        for seed in (args.first_seed, args.first_seed + args.seeds - 1):
            validate(dataclasses.replace(spec, seed=seed))
    except (FolderError, ValueError) as error:
        parser.error(str(error))
    args.out.resolve().parent.mkdir(parents=True, exist_ok=True)
    env = envs.make(args.env)
    learner = learners.make(spec.learner, spec.config, env_spec(env), spec.networks)
    priority = priorities.make(spec.priority)
    program = make_train(env, spec.config, sampler=READINGS["mean"], priority=priority, learner=learner)
    epoch, measure = jax.jit(program.epoch, donate_argnums=0), jax.jit(shares, static_argnums=1)
    newest = spec.config.num_envs * spec.config.cycles_per_epoch
    each = steps_per_epoch(spec.config, env.episode_length)
    rows = []
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        state = jax.jit(program.init)(jax.random.key(seed), spec.hparams)
        for number in range(1, num_epochs(spec.config, env.episode_length) + 1):
            state, metrics = epoch(state)
            found = measure(state.replay, newest, state.hparams)
            shown = (metrics["success_rate"], metrics["priority_mean"], *(found[name] for name in READINGS))
            rows.append((seed, number, number * each, *(round(float(value), 4) for value in shown)))
            print(seed, number, rows[-1][3:], flush=True)
        save(args.out, rows, FIELDS)
    table = np.array(rows, float)
    means = [table[table[:, 1] == number][:, 1:].mean(0) for number in sorted(set(table[:, 1]))]
    print_table(FIELDS[1:], [(f"{row[0]:.0f}", f"{row[1]:,.0f}", *(f"{value:.2f}" for value in row[2:])) for row in means])


if __name__ == "__main__":
    main()
