"""Trains many seeds at once: `make_train` returns pure functions, and `vmap` makes every seed a lane of one program."""

import argparse

import jax
import jax.numpy as jnp

from mjx_dher import Config, HParams, make_train, samplers, stats
from point_mass import PointMass


def main(argv=None):
    """Prints, after each epoch, the interquartile mean of the seeds' success rates and its 95 % bootstrap interval."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--epochs", type=int, default=8)
    args = parser.parse_args(argv)
    config = Config(
        num_envs=4,
        cycles_per_epoch=5,
        updates_per_cycle=20,
        target_period=1,
        batch_size=64,
        replay_size=10_000,
        hidden_sizes=(32, 32),
        eval_episodes=100,
        total_steps=200 * args.epochs,
    )
    program = make_train(PointMass(), config, sampler=samplers.make("weighted"))
    keys = jax.vmap(jax.random.key)(jnp.arange(args.seeds))
    # One value per lane. To compare values, replace one: `hparams._replace(gamma=jnp.linspace(0.9, 0.95, args.seeds))`.
    hparams = jax.tree.map(lambda x: jnp.full(args.seeds, x), HParams(gamma=0.9, polyak=0.98))
    states = jax.jit(jax.vmap(program.init))(keys, hparams)
    epoch = jax.jit(jax.vmap(program.epoch), donate_argnums=0)
    for number in range(1, args.epochs + 1):
        states, metrics = epoch(states)
        success = jax.device_get(metrics["success_rate"])  # [seeds]
        low, high = stats.bootstrap_interval(success)
        steps = int(states.env_steps[0])
        print(f"epoch {number}, {steps} steps: success {stats.interquartile_mean(success):.2f} ({low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
