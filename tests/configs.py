"""Small settings that tests share, for the point mass, whose episodes have 10 steps."""

import dataclasses

from mjx_dher.config import Config

# One epoch of one cycle.
TINY = Config(
    num_envs=4,
    cycles_per_epoch=1,
    updates_per_cycle=2,
    target_period=1,
    batch_size=16,
    total_steps=40,
    replay_size=80,
    hidden_sizes=(8,),
    eval_episodes=4,
)
# Three epochs of two cycles.
SHORT = dataclasses.replace(TINY, num_envs=2, cycles_per_epoch=2, updates_per_cycle=4, total_steps=120, replay_size=100)
# Two epochs of three cycles; the targets follow after every second update.
SMALL = Config(
    num_envs=4,
    cycles_per_epoch=3,
    updates_per_cycle=4,
    target_period=2,
    batch_size=32,
    total_steps=240,
    replay_size=200,
    hidden_sizes=(16, 16),
    eval_episodes=8,
)
# Ten epochs, after which a learner solves the point mass.
LEARNS = Config(
    num_envs=16,
    cycles_per_epoch=5,
    updates_per_cycle=20,
    target_period=1,
    batch_size=128,
    total_steps=8_000,
    replay_size=20_000,
    hidden_sizes=(32, 32),
    eval_episodes=200,
)


def flags(config: Config, env: str = "point_mass:PointMass") -> list[str]:
    """The settings that differ from the defaults, as arguments of a command line."""
    words = ["--env", env, "--preset", "cpu"]
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value != field.default:
            words += [f"--{field.name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else [value])]
    return words
