"""The command `check`."""

from __future__ import annotations

import dataclasses

import tyro
from rich.console import Console

from mjx_dher import envs, lookup, presets, spec
from mjx_dher.cli.common import make_env
from mjx_dher.spec import Engine
from mjx_dher.system.caches import prepare


@dataclasses.dataclass(frozen=True)
class CheckArgs:
    """Try out parts of your own (module:attribute) on random episodes, as `train` does before it begins.

    Ends with status 0 if all of them are as they should be, else with 2 and a sentence about the first that is not.
    """

    env: str = "reach"
    """Environment to try, or to try the other parts in: a name, or module:attribute."""
    engine: Engine = "auto"
    """Physics: native, warp, jax or auto."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments of the environment, NAME=VALUE each."""
    sampler: str = "future"
    """Sampler of hindsight goals."""
    weight_kernel: str = "linear"
    """Kernel; with the sampler weighted, which reads it."""
    weight_normalization: str = "mean"
    """Normalization of distances; with the sampler weighted, which reads it."""
    metric: str = "position"
    """Distance; with a sampler that reads it: closest, epsilon_closest or weighted."""
    priority: str = "eventful"
    """Priority of episodes or transitions."""
    generator: str = "reset"
    """Generator of goals to play for."""
    learner: str = "ddpg"
    """Learner."""
    networks: str = "mlp"
    """Networks of the learner."""


def check_command(argv: list[str], console: Console) -> int:
    """Tries out parts of the user's own."""
    args = tyro.cli(CheckArgs, prog=f"{lookup.program()} check", args=argv)
    run = presets.preset("cpu", args.env, **{name: getattr(args, name) for name in ("engine", "env_kwargs", *spec.PARTS)})
    spec.validate(run, envs.list_envs())
    if not spec.own_parts(run):
        raise ValueError("check takes one or more parts as module:attribute; all of these are built in")
    prepare()
    from mjx_dher.testing import check_parts

    for line in check_parts(make_env(run), run):
        console.print(line, soft_wrap=True)
    return 0
