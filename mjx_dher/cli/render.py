"""The command `render`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from mjx_dher import envs
from mjx_dher.cli.commands import parse
from mjx_dher.cli.common import EnvKwargs, Physics, Trust, changed_arguments, check_play, find_run, make_env, read_run
from mjx_dher.lookup import check_name
from mjx_dher.runs.folder import run_folder
from mjx_dher.spec import RunSpec
from mjx_dher.system.caches import check_platform


@dataclasses.dataclass(frozen=True)
class RenderArgs:
    """Draw episodes of a run's or bundled policy, or of random actions, as a video or as stills.

    Needs no screen: EGL or OSMesa draws, as set by MUJOCO_GL. Needs the extra: `pip install -e ".[video]"`.
    """

    out: Path
    """File to write: .mp4, .gif or .png (stills of the first episode). Its folder must exist."""
    run: tyro.conf.Positional[Path | None] = None
    """Run folder, or a bundled policy such as push. Alternatively pass --env."""
    env: str | None = None
    """Environment (a name, or module:attribute) to play with uniformly random actions, instead of a run."""
    episodes: int = 4
    """Episodes to play, one after the other."""
    seed: int = 1
    """Seed of the starts, the goals and the random actions."""
    env_kwargs: EnvKwargs = ()
    engine: Physics = None
    trust: Trust = False
    width: int = 640
    """Width in pixels."""
    height: int = 480
    """Height in pixels."""
    overwrite: bool = False
    """Replace an existing file."""


def render_command(argv: list[str], console: Console) -> int:
    """Draws episodes of a run's policy, or of random actions."""
    from mjx_dher.policy.load import load_policy
    from mjx_dher.tools import render

    args = parse(RenderArgs, argv)
    render.check_output(args.out, args.width, args.height, args.overwrite)
    check_play(args.seed, args.engine, args.episodes, args.env_kwargs)
    if args.run is not None and args.env is None:
        folder = find_run(args.run, console)
        played, policy = read_run(folder, console), load_policy(folder)
    elif args.env is not None and args.run is None:
        check_name("env", args.env, envs.list_envs(), custom=True)
        played, policy = RunSpec(env=args.env), None
    else:
        raise ValueError(f"render needs either a run folder or --env (one of {', '.join(envs.list_envs())})")
    _draw(changed_arguments(played, args.env_kwargs), policy, args, console)
    return 0


def _draw(played: RunSpec, policy: Any, args: RenderArgs, console: Console) -> None:
    """Plays episodes and writes their pictures. Without a policy, actions are random."""
    from mjx_dher.contract import step_seconds
    from mjx_dher.policy.load import check_fits
    from mjx_dher.tools import render

    render.ffmpeg()
    gl = render.choose_gl()
    check_platform()
    env: Any = make_env(played, args.engine)  # Any: a GoalEnv need not have a model
    if policy is not None:
        check_fits(policy, env)
    import jax
    import jax.numpy as jnp

    def act(obs, key):
        if policy is None:
            return jax.random.uniform(key, (args.episodes, env.action_size), minval=-1.0, maxval=1.0)
        return policy.forward(obs["observation"], obs["desired_goal"], jnp)

    console.print(
        f"{played.env}: {args.episodes} episodes{'' if policy else ' of random actions'}, seed {args.seed},"
        f" physics {run_folder.engine_name(env)}, drawn with {gl} ...",
        soft_wrap=True,
    )
    qpos, goals, success = render.record_episodes(env, act, args.seed, args.episodes)
    pictures, fps = (env, qpos, goals, args.width, args.height), 1 / step_seconds(env)
    frames = [render.stills(*pictures)] if args.out.suffix.lower() == ".png" else render.film(*pictures, fps)
    render.write_frames(args.out, frames, fps)
    console.print(f"success in {int(success.sum())} of {args.episodes}; wrote {args.out}", soft_wrap=True)
