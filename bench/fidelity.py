"""Open-loop replay of recorded episodes of the original tasks: how far do the rebuilt ones deviate?

    python bench/fidelity.py [--engines native jax warp] [--tasks push pick_and_place slide]

Starts, goals and actions are taken from tests/data/fetch_TASK.npz. There is no feedback in 50 steps. `warp` runs on the CPU if
there is no GPU. With all tasks and engines (some minutes) it writes its tables into docs/fidelity.md and draws
docs/fidelity_trajectories.png (extra `plot`). With fewer it only prints.

The yardstick is the original, replayed in the same way with its object's start moved by 0.1 mm. It needs a separate virtual
environment with an older MuJoCo, and writes tests/data/fetch_yardstick.csv:

    python -m venv .fetch && .fetch/bin/pip install gymnasium-robotics==1.4.2 mujoco==3.11.0
    PYTHONPATH=. .fetch/bin/python bench/fidelity.py yardstick
"""

import argparse
import csv
import warnings
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
DATA = ROOT / "tests" / "data"
YARDSTICK = DATA / "fetch_yardstick.csv"
DOCUMENT = ROOT / "docs" / "fidelity.md"
PICTURE = ROOT / "docs" / "fidelity_trajectories.png"
BEGIN, END = "<!-- fidelity: begin -->", "<!-- fidelity: end -->"

TASKS = ("push", "pick_and_place", "slide")
ENGINES = ("native", "jax", "warp")
OPTIONS = {"warp": {"allow_cpu": True}}
KINDS = ("random actions", "script with noise", "script")
HEAD = ("task", "episodes", "run by", "grip, mean", "p95", "object, median", "p95", "moved agrees", "success agrees")
MOVED = 0.02  # m
SHIFTS = (0.0, 1e-4)  # m, of the yardstick
DIRECTIONS = 4  # of the yardstick's moves of each start
FALLS = 1000  # episodes in which fallen pucks are counted
PUCK_SPEED, FRICTION, GRAVITY = 0.5, 0.1, 9.81  # m/s, -, m/s^2


def load(name):
    """Recorded episodes of tests/data. bench/record_fetch.py and bench/fidelity_hand.py document the arrays."""
    with np.load(DATA / f"{name}.npz") as file:
        return {name: file[name] for name in file.files}


def figures(recorded, grip, obj, of):
    """Cells for the columns of HEAD from "grip, mean" on; mm and percent.

    Args:
      recorded: the task's episodes.
      grip: [K, T+1, 3] m, of K replayed episodes.
      obj: [K, 2, 3] first and last position of the object in m.
      of: [K] indices of the replayed episodes.
    """
    there, goal = recorded["achieved"][of][:, [0, -1]], recorded["goal"][of]
    grip_error = 1e3 * np.linalg.norm(grip - recorded["grip"][of], axis=-1)
    object_error = 1e3 * np.linalg.norm(obj[:, 1] - there[:, 1], axis=-1)

    def moved(ends):
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1) > MOVED

    def succeeded(ends):
        return np.linalg.norm(ends[:, 1] - goal, axis=-1) < 0.05

    return (
        f"{grip_error.mean():.1f}",
        f"{np.percentile(grip_error, 95):.1f}",
        f"{np.median(object_error):.1f}",
        f"{np.percentile(object_error, 95):.0f}",
        f"{np.mean(moved(obj) == moved(there)):.0%}",
        f"{np.mean(succeeded(obj) == succeeded(there)):.0%}",
    )


# The rebuilt tasks.


def replay(env, recorded):
    """(grip, object) positions [E, T+1, 3] of the recorded actions from the recorded starts."""
    import jax
    import jax.numpy as jnp

    def one(object_qpos, desired_goal, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, state.obs["observation"][:6]

        first = env.init_state(object_qpos, desired_goal)
        _, path = jax.lax.scan(step, first, actions)
        return jnp.concatenate([first.obs["observation"][None, :6], path])

    path = np.asarray(jax.jit(jax.vmap(one))(recorded["object_qpos"][:, 0], recorded["goal"], recorded["action"]))
    return path[..., :3], path[..., 3:]


def free_slide(engine):
    """Distance in m that a puck slides from PUCK_SPEED along x, touching only the table."""
    import jax
    import jax.numpy as jnp

    from mjx_dher import envs

    env: Any = envs.make("slide", engine=engine, **OPTIONS.get(engine, {}))
    state = env.init_state(jnp.array([1.2, 0.75, env.task.object_height, 1, 0, 0, 0]), jnp.ones(3))
    first = state.obs["achieved_goal"]
    velocity = env.model.joint("object").dofadr[0]
    state = state.replace(physics=state.physics.replace(qvel=state.physics.qvel.at[velocity].set(PUCK_SPEED)))
    state = jax.jit(lambda s: jax.lax.fori_loop(0, 30, lambda _, s: env.step(s, jnp.zeros(4)), s))(state)
    return float(jnp.linalg.norm(state.obs["achieved_goal"] - first))


def falls(engine):
    """Number of FALLS episodes of Slide that end with the puck below the table. Each pushes it on in its own direction."""
    import jax
    import jax.numpy as jnp

    from mjx_dher import envs

    env: Any = envs.make("slide", engine=engine, **OPTIONS.get(engine, {}))

    def episode(key):
        start, way = jax.random.split(key)
        action = jnp.append(jax.random.uniform(way, (2,), minval=-1), jnp.array([-0.1, 0.0]))
        return jax.lax.fori_loop(0, env.episode_length, lambda _, state: env.step(state, action), env.reset(start))

    ends = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), FALLS)).obs["achieved_goal"]
    return int(np.sum(np.asarray(ends)[:, 2] < env.task.object_height - 0.05))


def between_engines(recorded, paths):
    """Lines that compare the engines with one another on Slide."""
    script = recorded["policy"] == KINDS.index("script")
    ends = {engine: paths["slide", engine][1][script][:, -1] for engine in ENGINES}
    apart = {engine: 1e3 * np.linalg.norm(ends[engine] - ends["native"], axis=-1) for engine in ENGINES[1:]}
    went = 1e3 * np.linalg.norm(np.diff(paths["slide", "native"][1][script][:, [0, -1]], axis=1), axis=-1)
    coulomb = 1e3 * PUCK_SPEED**2 / (2 * FRICTION * GRAVITY)
    free = {engine: 1e3 * free_slide(engine) for engine in ENGINES}
    return [
        f"- A puck at {PUCK_SPEED} m/s that nothing else touches slides"
        f" {', '.join(f'{length:.1f} mm on `{engine}`' for engine, length in free.items())}; v²/(2μg) is {coulomb:.1f} mm.",
        f"- Hit by the recorded script, it goes {np.median(went):.0f} mm on `native` in the median; from there it ends "
        + ", ".join(f"{np.median(d):.1f} mm on `{engine}` (p95 {np.percentile(d, 95):.0f} mm)" for engine, d in apart.items())
        + ".",
        f"- Pushed on by the same action for an episode, of {FALLS:,} pucks "
        + ", ".join(f"{falls(engine)} fall off the table on `{engine}`" for engine in ENGINES)
        + ".",
    ]


def report(tasks, engines):
    """(the block of docs/fidelity.md, the recorded episodes, the replayed (grip, object) by task and engine)."""
    from timing import table

    from mjx_dher import envs

    recorded = {task: load(f"fetch_{task}") for task in tasks}
    paths = {
        (task, engine): replay(envs.make(task, engine=engine, **OPTIONS.get(engine, {})), recorded[task])
        for task in tasks
        for engine in engines
    }
    originals, rows = moved_originals(YARDSTICK), []
    for task in tasks:
        for kind, name in enumerate(KINDS):
            of = recorded[task]["policy"] == kind
            for engine in engines:
                grip, obj = paths[task, engine]
                rows.append((task, name, engine, *figures(recorded[task], grip[of], obj[of][:, [0, -1]], of)))
            rows += [row for row in originals if row[:2] == (task, name)]
    block = table(HEAD, rows)
    if "slide" in tasks and set(ENGINES) <= set(engines):
        lines = between_engines(recorded["slide"], paths)
        block = "\n".join([block, "", "Slide, the engines against one another:", "", *lines])
    return block, recorded, paths


def draw(recorded, paths):
    """Draws three scripted episodes per task, recorded and replayed on `native`, from above and over time."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(TASKS), figsize=(12, 7.6), height_ratios=(1.5, 1), layout="constrained")
    # Wide and pale below, thin and dark on top: readable without colour. Gripper and object differ in their line, too.
    looks = {"gripper": ("#a9cbe8", "#0b3c6d", "-"), "object": ("#f5bd76", "#7a2a00", (0, (3, 2)))}
    for (top, side), task in zip(axes.T, TASKS):
        there = {"gripper": 1e2 * recorded[task]["grip"], "object": 1e2 * recorded[task]["achieved"]}
        here = {name: 1e2 * path for name, path in zip(looks, paths[task, "native"])}
        time = 0.04 * np.arange(there["object"].shape[1])
        script = np.flatnonzero(recorded[task]["policy"] == KINDS.index("script"))
        error = np.linalg.norm((here["object"] - there["object"])[script, -1], axis=-1)
        # The episodes at 25, 50 and 90 % of the order by the object's error.
        chosen = np.argsort(error)[[len(script) * share // 100 for share in (25, 50, 90)]]
        for name, (pale, dark, line) in looks.items():
            for episode in script[chosen]:
                label = name if episode == script[chosen[0]] else None
                for panel, *xy in (
                    (top, there[name][episode, :, :2].T, here[name][episode, :, :2].T),
                    (side, (time, there[name][episode, :, 2]), (time, here[name][episode, :, 2])),
                ):
                    panel.plot(*xy[0], color=pale, linewidth=5, solid_capstyle="round", label=label and f"{label}, original")
                    panel.plot(*xy[1], color=dark, linewidth=1.2, linestyle=line, label=label and f"{label}, here")
        for letter, episode in zip("ABC", script[chosen]):
            label = top.annotate(letter, there["object"][episode, 0, :2], (6, 6), textcoords="offset points", weight="bold")
            label.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5})
            top.plot(*there["object"][episode, -1, :2], "o", color=looks["object"][0], markersize=10)
            top.plot(*here["object"][episode, -1, :2], "o", color=looks["object"][1], markersize=4)
        apart = ", ".join(f"{letter} {10 * e:.1f}" for letter, e in zip("ABC", error[chosen]))
        top.set_title(f"{task}\nobject at the end, mm apart: {apart}", fontsize=10)
        top.margins(0.08)
        top.set_aspect("equal", adjustable="datalim")
        top.set_xlabel("x, cm")
        side.set_xlabel("time, s")
        for panel in (top, side):
            panel.grid(alpha=0.25)
    axes[0, 0].set_ylabel("y, cm (from above)")
    axes[1, 0].set_ylabel("z, cm")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(PICTURE, dpi=100, pil_kwargs={"optimize": True})


def put_into_document(block, begin=BEGIN, end=END):
    """Replaces the text between the markers in docs/fidelity.md."""
    text = DOCUMENT.read_text()
    first, last = text.index(begin) + len(begin), text.index(end)
    DOCUMENT.write_text(f"{text[:first]}\n{block}\n{text[last:]}")


# The originals.


def run_by(shift):
    return f"original, moved {1e3 * shift:.1f} mm"


def moved_originals(path):
    """Rows of a yardstick's file with the larger of SHIFTS."""
    with path.open(encoding="utf-8") as file:
        return [tuple(row) for row in csv.reader(file) if row[2] == run_by(SHIFTS[-1])]


def make_original(task):
    """The original task, in an environment that has it."""
    import gymnasium
    import gymnasium_robotics

    from mjx_dher.tools.transfer import ORIGINALS

    warnings.filterwarnings("ignore")
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(ORIGINALS[task]).unwrapped


def replay_original(env, recorded, shift, rng):
    """Grip [E, T+1, 3] and the object's first and last position [E, 2, 3] in m, in the original itself.

    The object starts `shift` m from its recorded start, in a random direction of the plane. Recordings are rounded to float32,
    so a shift of 0 is no exact replay either.
    """
    import mujoco

    joint = env.model.joint("object0:joint")
    qpos, qvel = int(joint.qposadr[0]), int(joint.dofadr[0])
    grips, ends = [], []
    for episode, actions in enumerate(recorded["action"]):
        env.reset(seed=0)
        start = recorded["object_qpos"][episode, 0].astype(float)
        angle = rng.uniform(0, 2 * np.pi)
        start[:2] += shift * np.array([np.cos(angle), np.sin(angle)])
        env.data.qpos[qpos : qpos + 7] = start
        env.data.qvel[qvel : qvel + 6] = recorded["object_qvel"][episode, 0]
        mujoco.mj_forward(env.model, env.data)
        seen = [env.step(action)[0]["observation"][:6] for action in actions]
        grips.append([recorded["grip"][episode, 0], *(obs[:3] for obs in seen)])
        ends.append([start[:3], seen[-1][3:]])
    return np.array(grips), np.array(ends)


def yardstick(path, head, recordings, kinds, replay, cells):
    """Writes the figures of originals, replayed from starts moved by SHIFTS.

    Args:
      path, head: CSV file, and its columns.
      recordings: name of each task's file, and of its array with the kind of each episode, an index into `kinds`.
      kinds: names of the kinds.
      replay: arrays of replayed episodes, from an original, its recording, a shift in m and random numbers.
      cells: last cells of a row, from a recording, those arrays and the indices of their episodes.
    """
    rng = np.random.default_rng(0)
    with open(path, "w", encoding="utf-8", newline="") as file:
        out = csv.writer(file)
        out.writerow(head)
        for name, kind in recordings:
            task, recorded = name.partition("_")[2], load(name)
            env = make_original(task)
            for shift in SHIFTS:
                runs = DIRECTIONS if shift else 1
                parts = [np.concatenate(part) for part in zip(*(replay(env, recorded, shift, rng) for _ in range(runs)))]
                of = np.tile(np.arange(len(recorded[kind])), runs)
                for number, said in enumerate(kinds):
                    rows = recorded[kind][of] == number
                    row = (task, said, run_by(shift), *cells(recorded, *(part[rows] for part in parts), of[rows]))
                    out.writerow(row)
                    print(*row, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", nargs="?", choices=("report", "yardstick"), default="report")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=ENGINES)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    args = parser.parse_args()
    if args.mode == "yardstick":
        return yardstick(YARDSTICK, HEAD, [(f"fetch_{task}", "policy") for task in TASKS], KINDS, replay_original, figures)
    block, recorded, paths = report(args.tasks, args.engines)
    print(block)
    if set(args.tasks) == set(TASKS) and set(args.engines) == set(ENGINES):
        put_into_document(block)
        draw(recorded, paths)


if __name__ == "__main__":
    main()
