"""`Simulator` with few states of small models, compared with a plain loop over `mj_step`, on one core or more.

    python bench/few_states.py [--states 1 2 4] [--hz 25] [--cpu-time]

Environment steps a second in the fastest of many short trials, which take turns. On a busy machine, count seconds of the CPU
(--cpu-time) and simulate on one core (taskset -c 0).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from timing import print_table

from mjx_dher.envs import Simulator
from mjx_dher.envs.engines import Controls, Physics

MAZE = """
<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .1">
<joint name="x" type="slide" axis="1 0 0" damping="1"/><joint name="y" type="slide" axis="0 1 0" damping="1"/><geom size=".1"/>
</body><geom type="box" size=".1 1 .2" pos="1 0 .2"/></worldbody><actuator><motor joint="x"/><motor joint="y"/></actuator>
</mujoco>"""
PENDULUM = '<mujoco><worldbody><body><joint axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/></body></worldbody></mujoco>'
ARM = Path(__file__).parent.parent / "docs" / "examples" / "arm.xml"
SECONDS, TRIALS = 0.01, 30  # of a trial, and how many


def runs(model: mujoco.MjModel, states: int, substeps: int, length: int):
    """Functions that simulate `length` steps: a loop, `step` and `advance`."""
    sim = Simulator(model, substeps=substeps)
    ctrl = np.random.default_rng(0).uniform(-1, 1, (length, states, model.nu)).astype(np.float32)
    datas = [mujoco.MjData(model) for _ in range(states)]

    def loop():
        for row in ctrl:
            for data, each in zip(datas, row):
                data.ctrl[:] = each
                for _ in range(substeps):
                    mujoco.mj_step(model, data)

    many = lambda tree: jax.tree.map(lambda x: jnp.broadcast_to(x, (states, *x.shape)), tree)  # noqa: E731
    data = sim.make_data()
    physics = Physics(data.qpos, data.qvel, data.qacc_warmstart, data.act)
    mocap = jnp.concatenate([data.mocap_pos, data.mocap_quat], axis=1)
    step = jax.jit(lambda x: jax.lax.scan(lambda x, u: (jax.vmap(sim.step)(x, u), None), x, ctrl)[0])
    advance = jax.jit(
        lambda x: jax.lax.scan(
            lambda x, u: (jax.vmap(lambda x, u: sim.advance(x, Controls(u, mocap)))(x, u), None), x, jnp.asarray(ctrl)
        )[0]
    )
    data, physics = many(data), many(physics)
    return [loop, lambda: jax.block_until_ready(step(data)), lambda: jax.block_until_ready(advance(physics))]


def fastest(functions, clock) -> list[float]:
    """Seconds of each function, the least of trials that take turns."""
    seconds = [np.inf] * len(functions)
    for _ in range(TRIALS):
        for number, function in enumerate(functions):
            begun = clock()
            function()
            seconds[number] = min(seconds[number], clock() - begun)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--hz", type=float, default=25)
    parser.add_argument("--cpu-time", action="store_true")
    args = parser.parse_args()
    clock = time.process_time if args.cpu_time else time.perf_counter
    models = {"pendulum": mujoco.MjModel.from_xml_string(PENDULUM), "point maze": mujoco.MjModel.from_xml_string(MAZE)}
    models["guide's arm"] = mujoco.MjModel.from_xml_path(str(ARM))
    rows = []
    for name, model in models.items():
        substeps = max(1, round(1 / (args.hz * model.opt.timestep)))
        for states in args.states:
            (alone,) = fastest(runs(model, states, substeps, 5)[:1], clock)
            length = int(np.clip(5 * SECONDS / alone, 5, 1000))
            rates = [f"{states * length / each:,.0f}" for each in fastest(runs(model, states, substeps, length), clock)]
            rows.append((name, substeps, states, *rates))
    print_table(("model", "timesteps a step", "states", "loop over mj_step", "Simulator.step", "Simulator.advance"), rows)


if __name__ == "__main__":
    main()
