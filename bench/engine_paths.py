"""Both paths of the engine warp against native: the difference of their coordinates, and their speed.

    PYTHONPATH=.:tests python bench/engine_paths.py [--allow-cpu] [--models arm block_rotate_z] [--num-envs 1024 8192]
    PYTHONPATH=.:tests python bench/engine_paths.py --models push --varied mass:object friction:object
    PYTHONPATH=.:tests python bench/engine_paths.py --models block_rotate_z --threads 16 32 --warps 4 8 --constraints 96 128

A model is one of tests/engine_models.py, an MJCF file, or a task. Distances are the largest of all coordinates within 8
environment steps of 64 environments under random controls. A task has its own number of timesteps per step. The speed is
measured over the next 24 steps, of physics alone. Each line is printed as soon as it is measured. With --varied, the models
run with and without varied physics, by random factors from 0.5 to 1.5. On a GPU, the fused kernel can be tried with other
numbers of threads for an environment, of warps in a block at most, and of constraint rows than it chooses.
"""

import argparse
import dataclasses
import functools
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from engine_models import MODELS, SUBSTEPS, play, start
from timing import machine

from mjx_dher import envs
from mjx_dher.envs.engines import make_engine
from mjx_dher.envs.engines.fused import simulation

FEW = 64  # environments that `native` plays, too
HEAD = "| model | varied | path | environments | env steps/s | first call, s | median distance | largest |"


def load(name: str) -> tuple[mujoco.MjModel, int]:
    """A model and its timesteps per environment step."""
    if name in MODELS:
        return mujoco.MjModel.from_xml_string(MODELS[name]), SUBSTEPS
    if name.endswith(".xml"):
        return mujoco.MjModel.from_xml_path(name), SUBSTEPS
    env: Any = envs.make(name, engine="native")  # Any: a GoalEnv need not have a model
    return env.model, env.engine._substeps


def threads_of(asked: int, chosen: Callable[[mujoco.MjModel], int], model: mujoco.MjModel) -> int:
    """Threads of an environment: those asked for, or those chosen for a model if `asked` is 0."""
    return asked or chosen(model)


def measure(engine, model, num_envs: int, factors: int) -> tuple[float, float, np.ndarray]:
    """Environment steps per second, seconds of the first call, and coordinates [64, 8, nq]."""
    first, controls = start(model, (FEW,))
    if factors:
        first = dataclasses.replace(
            first, factors=jax.random.uniform(jax.random.key(0), (FEW, factors), minval=0.5, maxval=1.5)
        )
    many = lambda x: jnp.tile(x, (num_envs // FEW, *([1] * (x.ndim - 1))))  # noqa: E731
    first, controls = jax.tree.map(many, first), jax.tree.map(many, controls)
    played = jax.jit(jax.vmap(lambda *given: play(engine, *given)))
    began = time.perf_counter()
    states = jax.block_until_ready(played(first, controls))
    compiled = time.perf_counter() - began
    qpos = np.asarray(states.qpos[:FEW])
    last = lambda states: jax.tree.map(lambda x: x[:, -1], states)  # noqa: E731
    first = jax.block_until_ready(last(states))  # compiled before the clock starts
    began = time.perf_counter()
    for _ in range(3):
        first = last(played(first, controls))
    jax.block_until_ready(first)
    engine.check()
    return 24 * num_envs / (time.perf_counter() - began), compiled, qpos


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--allow-cpu", action="store_true")
    parser.add_argument("--models", nargs="+", default=[*MODELS, "docs/examples/arm.xml"])
    parser.add_argument("--paths", nargs="+", default=["fused", "graph"], choices=["fused", "graph"])
    parser.add_argument("--num-envs", type=int, nargs="+", default=[FEW], help=f"multiples of {FEW}")
    parser.add_argument("--varied", nargs="+", default=[], help='names of varied physics, such as "mass:object"')
    tried: dict[str, tuple[str, Any]] = {
        "threads": ("threads of an environment", (0, 1, 2, 4, 8, 16, 32)),
        "warps": ("most warps of a block", range(33)),
        "constraints": ("rows", None),  # make_engine checks them
    }
    for option, (of, allowed) in tried.items():
        help = f"{of}; 0: the kernel's choice"
        parser.add_argument(f"--{option}", type=int, nargs="+", default=[0], choices=allowed, metavar="N", help=help)
    args = parser.parse_args()
    chosen, most = simulation.threads_for, simulation.WARPS
    print(f"{machine()}\n\n{HEAD}\n|{'---|' * 8}", flush=True)
    for name, varied in itertools.product(args.models, [[], args.varied] if args.varied else [[]]):
        model, substeps = load(name)
        native = measure(make_engine("native", model, substeps, varied=varied), model, FEW, len(varied))
        row = f"| {name} | {', '.join(varied)} |"
        print(f"{row} native | {FEW} | {native[0]:,.0f} | {native[1]:.1f} | | |", flush=True)
        for path, threads, warps, rows in itertools.product(args.paths, args.threads, args.warps, args.constraints):
            if path == "graph" and (threads, warps) != (args.threads[0], args.warps[0]):
                continue  # it reads neither
            simulation.threads_for, simulation.WARPS = functools.partial(threads_of, threads, chosen), warps or most
            sizes = {"constraints": rows} if rows else {}
            given = {"rows": rows} if path == "graph" else {"threads": threads, "warps": warps, "rows": rows}
            shown = ", ".join([path, *(f"{number} {what}" for what, number in given.items() if number)])
            try:
                engine = make_engine("warp", model, substeps, path=path, allow_cpu=args.allow_cpu, varied=varied, **sizes)
                for num_envs in args.num_envs:
                    rate, compiled, qpos = measure(engine, model, num_envs, len(varied))
                    apart = np.abs(qpos - native[2]).max(axis=(1, 2))
                    distances = f"{np.median(apart):.1e} | {apart.max():.1e}"
                    print(f"{row} {shown} | {num_envs} | {rate:,.0f} | {compiled:.1f} | {distances} |", flush=True)
            except (ValueError, RuntimeError) as error:  # a model that does not fit, or a kernel that a GPU cannot launch
                print(f"{row} {shown} | {str(error).splitlines()[0]} | | | | |", flush=True)


if __name__ == "__main__":
    main()
