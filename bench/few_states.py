"""`Simulator` with few states, compared with a plain loop over `mj_step`, on one core.

    taskset -c 0 python bench/few_states.py [--states 1 2 4 8] [--timesteps 1 10]

The loop has an MjData for each state. Before each step it writes `ctrl`, then it calls `mj_step(model, data, timesteps)`, and
then it copies `qpos` and `qvel`. `step` and `advance` run in a compiled `scan` of equal length, from the same states and with
the same `ctrl`. A cell has the loop's µs of one core's time for each state and step, and how many times as fast `step` and
`advance` are: medians of many short trials, which take turns in one process.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from timing import print_table

from mjx_dher import envs
from mjx_dher.envs import Simulator
from mjx_dher.envs.engines import Controls, Physics

ARM = Path(__file__).parent.parent / "docs" / "examples" / "arm.xml"
SECONDS, TRIALS = 0.03, 21  # of a trial, and how many


def runs(model: mujoco.MjModel, states: int, timesteps: int, length: int):
    """Functions that simulate `length` steps: a loop, `step` and `advance`."""
    sim, rng = Simulator(model, substeps=timesteps), np.random.default_rng(0)
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-1, 1)).T
    ctrl = rng.uniform(low, high, (length, states, model.nu)).astype(np.float32)
    datas = [mujoco.MjData(model) for _ in range(states)]
    data = sim.make_data(0 if model.nkey else None)
    parts = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    start = np.zeros(mujoco.mj_stateSize(model, parts))

    def loop():
        seen = []
        for each in datas:
            mujoco.mj_setState(model, each, start, parts)
        for row in ctrl:
            for each, inputs in zip(datas, row):
                each.ctrl = inputs
                mujoco.mj_step(model, each, timesteps)
                seen.append((each.qpos.copy(), each.qvel.copy()))

    mujoco.mj_resetDataKeyframe(model, datas[0], 0) if model.nkey else mujoco.mj_resetData(model, datas[0])
    mujoco.mj_getState(model, datas[0], start, parts)
    mocap = jnp.concatenate([data.mocap_pos, data.mocap_quat], axis=1)

    def scan(step):
        return jax.jit(lambda x: jax.lax.scan(lambda x, u: ((x := jax.vmap(step)(x, u)), (x.qpos, x.qvel)), x, ctrl)[1])

    many = lambda tree: jax.tree.map(lambda x: jnp.broadcast_to(x, (states, *x.shape)), tree)  # noqa: E731
    step, advance = scan(sim.step), scan(lambda x, u: sim.advance(x, Controls(u, mocap)))
    data, physics = many(data), many(Physics(data.qpos, data.qvel, data.qacc_warmstart, data.act))
    return [loop, lambda: jax.block_until_ready(step(data)), lambda: jax.block_until_ready(advance(physics))]


def medians(functions) -> list[float]:
    """Seconds of this process that each function takes, the median of trials that take turns."""
    seconds: list[list[float]] = [[] for _ in functions]
    for _ in range(TRIALS):
        for taken, function in zip(seconds, functions):
            begun = time.process_time()
            function()
            taken.append(time.process_time() - begun)
    return [statistics.median(taken[1:]) for taken in seconds]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--timesteps", type=int, nargs="+", default=[1, 10])
    args = parser.parse_args()
    models = {"guide's arm": mujoco.MjModel.from_xml_path(str(ARM))}
    made: dict[str, Any] = {name: envs.make(name, engine="native") for name in ("push", "block_rotate_z")}
    models |= {f"`{name}`": env.model for name, env in made.items()}
    rows = []
    for name, model in models.items():
        for timesteps in args.timesteps:
            row = [name, timesteps]
            for states in args.states:
                (alone,) = medians(runs(model, states, timesteps, 5)[:1])
                length = int(np.clip(5 * SECONDS / max(alone, 1e-6), 5, 1000))
                loop, *ours = (1e6 * each / states / length for each in medians(runs(model, states, timesteps, length)))
                row.append(f"{loop:.0f}: {loop / ours[0]:.2f}, {loop / ours[1]:.2f}")
            rows.append(row)
    print_table(("model", "timesteps", *(f"states: {states}" for states in args.states)), rows)


if __name__ == "__main__":
    main()
