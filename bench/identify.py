"""Where the numbers in envs/assets and envs/fetch.py come from, and whether fitting them to recordings would improve them.

`read` prints the numbers of the original's compiled model and ours, then the largest difference in each quantity. It needs a
separate virtual environment with an older MuJoCo:

    python -m venv .fetch && .fetch/bin/pip install gymnasium-robotics==1.4.2 mujoco==3.11.0
    PYTHONPATH=. .fetch/bin/python bench/identify.py read [--tasks push pick_and_place slide reach]

`fit` scales six groups of those numbers so that recorded episodes, replayed open loop in MuJoCo C, deviate least (Nelder-Mead
simplex from scipy, which JAX requires). It prints the errors before and after, also on held-out episodes, and changes nothing
in envs/assets: `python bench/identify.py fit [--evaluations 150]`, some minutes.
"""

import argparse
import ast
from pathlib import Path
from typing import Any

import fidelity
import mujoco
import numpy as np

ROOT = Path(__file__).parent.parent
ASSETS = ROOT / "envs" / "assets"
TASKS = ("push", "pick_and_place", "slide", "reach")
JOINTS = ("shoulder_pan", "shoulder_lift", "upperarm_roll", "elbow_flex", "forearm_roll", "wrist_flex", "wrist_roll")
FINGERS = ("r", "l")


def task_numbers(task):
    """The keywords of the task's `FetchTask(...)` in envs/fetch.py, read without importing it (and JAX)."""
    tree = ast.parse((ROOT / "envs" / "fetch.py").read_text())
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "FetchTask"]
    found = [{keyword.arg: ast.literal_eval(keyword.value) for keyword in call.keywords} for call in calls]
    return next(numbers for numbers in found if numbers["xml"] == f"{task}.xml")


def our_model(task):
    return mujoco.MjModel.from_xml_path(str(ASSETS / f"{task}.xml"))


# read


def settle(model, numbers):
    """Our model's data with the arm at the task's start."""
    data = mujoco.MjData(model)
    for name, angle in zip(JOINTS, numbers["arm_qpos"]):
        data.joint(name).qpos = angle
    mujoco.mj_forward(model, data)
    return data


def rows_of_bodies(there, here, there_data, here_data, has_fingers):
    """(quantity, part, original, ours) of the links, their joints, and the arm as a whole."""
    links = [(f"robot0:{name}_link", name) for name in (*JOINTS, "gripper")]
    fingers = [(f"robot0:{side}_gripper_finger_link", f"finger_{side}") for side in FINGERS]
    for theirs, ours in links + fingers * has_fingers:
        a, b = there.body(theirs), here.body(ours)
        if ours == JOINTS[0]:  # the original's hangs on a torso that has risen a little, ours on the base
            yield "link place in the world, m", ours, there_data.body(theirs).xpos, here_data.body(ours).xpos
        else:
            yield "link pos, m", ours, a.pos, b.pos
        yield "link quat", ours, a.quat, b.quat
        yield "link mass, kg", ours, a.mass, b.mass
        yield "centre of mass, m", ours, a.ipos, b.ipos
        yield "inertia's quat", ours, a.iquat * np.sign(a.iquat @ b.iquat), b.iquat
        yield "inertia, kg m^2", ours, a.inertia, b.inertia
    if not has_fingers:
        yield "fingers' mass, kg", "hand", sum(there.body(name).mass for name, _ in fingers), here.body("finger_hand").mass
    joints = [(f"robot0:{name}_joint", name) for name in JOINTS]
    joints += [(f"robot0:{side}_gripper_finger_joint", f"finger_{side}") for side in FINGERS] * has_fingers
    for theirs, ours in joints:
        a, b = there.joint(theirs), here.joint(ours)
        yield "joint axis", ours, a.axis, b.axis
        for name in ("armature", "damping", "stiffness", "qpos_spring"):
            yield f"joint {name}", ours, getattr(a, name), getattr(b, name)
        if ours.startswith("finger"):
            yield "finger range, m", ours, a.range, b.range
            yield "finger limit's solref", ours, there.jnt_solref[a.id], here.jnt_solref[b.id]
            yield "finger limit's solimp", ours, there.jnt_solimp[a.id], here.jnt_solimp[b.id]
    inertia = arm_inertia(there, there_data, "robot0:{}_joint"), arm_inertia(here, here_data)
    yield "arm's inertia matrix, kg m^2", "at the start", *inertia


def arm_inertia(model, data, name="{}"):
    """[7, 7] joint-space inertia of the arm's joints, armature included."""
    dofs = [int(model.joint(name.format(joint)).dofadr[0]) for joint in JOINTS]
    columns = np.zeros((len(dofs), model.nv))
    for column, unit in zip(columns, np.eye(model.nv)[dofs]):
        mujoco.mj_mulM(model, data, column, unit)
    return columns[:, dofs]


def rows_of_weld(there, here):
    """The weld. Its impedance d acts through (1 - d) / d times the body's inverse inertia: see envs/assets/common.xml."""

    def softness(model, body, part):
        impedance = model.eq_solimp[0, :2]
        return (1 - impedance) / impedance * model.body(body).invweight0[part]

    yield "weld solref", "weld", there.eq_solref[0], here.eq_solref[0]
    yield "weld solimp, as written", "weld", there.eq_solimp[0], here.eq_solimp[0]
    yield "weld data", "weld", there.eq_data[0], here.eq_data[0]
    for part, name in enumerate(("weld softness, position, 1/kg", "weld softness, turning, 1/(kg m^2)")):
        yield name, "gripper", softness(there, "robot0:gripper_link", part), softness(here, "gripper", part)


def rows_of_contacts(there, here):
    """Sizes, and each of our pairs against MuJoCo's mix of the original's two geoms."""
    geoms = {
        "finger_both": "robot0:r_gripper_finger_link",
        "finger_r": "robot0:r_gripper_finger_link",
        "finger_l": "robot0:l_gripper_finger_link",
        "palm": "robot0:gripper_link",
        "object": "object0",
        "object_stand_in": "object0",
        "floor": "floor0",
        "table_stand_in": None,
        "table": None,
    }
    table = int(there.body("table0").geomadr[0])

    def original(ours):
        return there.geom(geoms[ours] or table)

    for pair in range(here.npair):
        names = [here.geom(int(ids[pair])).name for ids in (here.pair_geom1, here.pair_geom2)]
        a, b = (original(name) for name in names)
        part = " - ".join(names)
        slide, spin, roll = np.maximum(a.friction, b.friction)
        yield "contact friction", part, [slide, slide, spin, roll, roll], here.pair_friction[pair]
        yield "contact condim", part, np.maximum(a.condim, b.condim), here.pair_dim[pair]
        yield "contact margin, m", part, np.maximum(a.margin, b.margin), here.pair_margin[pair]
        yield "contact solref", part, (a.solref + b.solref) / 2, here.pair_solref[pair]
        yield "contact solimp", part, (a.solimp + b.solimp) / 2, here.pair_solimp[pair]
    yield "table size, m", "table", there.geom(table).size, here.geom("table").size
    yield "table pos, m", "table", there.body("table0").pos, here.geom("table").pos
    fingers = [name for name in ("finger_r", "finger_l") if name in _names(here)]
    for ours in fingers:
        yield "finger size, m", ours, original(ours).size, here.geom(ours).size
        yield "finger pos, m", ours, original(ours).pos, here.geom(ours).pos
    if not fingers:
        body, geom = there.body(geoms["finger_r"]), original("finger_r")
        hull = [geom.size[0], body.pos[1] + geom.pos[1] + geom.size[1], geom.size[2]]
        yield "finger size, m", "finger_both (hull of two)", hull, here.geom("finger_both").size
    yield "grip site, m", "grip", there.site("robot0:grip").pos, here.site("grip").pos


def _names(model):
    return {model.geom(index).name for index in range(model.ngeom)}


def _joints(model):
    return {model.joint(index).name for index in range(model.njnt)}


def rows_of_object(there, here):
    a, b = there.body("object0"), here.body("object")
    yield "object mass, kg", "object", a.mass, b.mass
    yield "object inertia, kg m^2", "object", a.inertia, b.inertia
    yield "object size, m", "object", there.geom("object0").size[:2], here.geom("object").size[:2]
    yield "object damping", "object", there.joint("object0:joint").damping, here.joint("object").damping


def rows_of_actuators(there, here):
    for side in FINGERS:
        a, b = there.actuator(f"robot0:{side}_gripper_finger_joint"), here.actuator(f"finger_{side}")
        for name in ("gainprm", "biasprm", "ctrlrange"):
            yield f"actuator {name}", f"finger_{side}", getattr(a, name), getattr(b, name)


def rows_of_start(env, numbers):
    """Values marked as settled in envs/fetch.py, and the ranges of object and goal."""
    joints = [env.data.joint(f"robot0:{name}_joint") for name in JOINTS]
    yield "settled angles, rad", "arm", [j.qpos[0] for j in joints], numbers["arm_qpos"]
    yield "settled rates, rad/s", "arm", [j.qvel[0] for j in joints], numbers["arm_qvel"]
    yield "settled grip place, m", "grip", env.initial_gripper_xpos, numbers["initial_grip_pos"]
    yield "goal's range, m", "goal", env.target_range, numbers["target_range"]
    yield "goal's offset, m", "goal", env.target_offset + np.zeros(3), numbers.get("target_offset", (0, 0, 0))
    if env.has_object:
        yield "settled object height, m", "object", env.height_offset, numbers["object_height"]
        yield "object's range, m", "object", env.obj_range, numbers.get("object_range", 0.15)


def read(tasks):
    from mjx_dher.tools.transfer import ORIGINALS

    np.set_printoptions(precision=7, suppress=True, linewidth=200, threshold=60)
    largest: dict[str, dict[str, float]] = {}
    for task in tasks:
        env: Any = fidelity.make_original(task)
        numbers, here = task_numbers(task), our_model(task)
        env.reset(seed=0)
        there, here_data = env.model, settle(here, numbers)
        rows = [*rows_of_start(env, numbers), *rows_of_bodies(there, here, env.data, here_data, "finger_r" in _joints(here))]
        rows += [*rows_of_weld(there, here), *rows_of_contacts(there, here)]
        if env.has_object:
            rows += rows_of_object(there, here)
        rows += rows_of_actuators(there, here) if here.nu else []
        print(f"\n{ORIGINALS[task]}: quantity, part, original, here (where it differs)\n")
        for quantity, part, *values in rows:
            a, b = (np.squeeze(np.asarray(value, float)) for value in values)
            apart = float(np.abs(a - b).max())
            largest.setdefault(quantity, {})[task] = max(apart, largest.get(quantity, {}).get(task, 0.0))
            a, b = (np.diag(value) if value.ndim == 2 else value for value in (a, b))  # only the diagonal of a matrix
            print(f"{quantity:34s} {part:26s} {a}" + (f"  here {b}" if apart > 1e-6 else ""))
    print(f"\nLargest difference\n\n{'':36s}" + "".join(f"{task:>16s}" for task in tasks))
    for quantity, by_task in largest.items():
        print(f"{quantity:36s}" + "".join(f"{by_task[task]:16.1e}" if task in by_task else f"{'-':>16s}" for task in tasks))


# fit

SUBSTEPS, ACTION_SCALE, CAP = 20, 0.05, 0.05  # -, m, m: a cap keeps single episodes from dominating the fit
SCALED = ("joint damping", "joint armature", "weld time", "weld softness", "finger friction", "object friction")


def scaled_model(task, scale):
    """Our model with the quantities named in SCALED multiplied by `scale` [6]."""
    model, scale = our_model(task), dict(zip(SCALED, scale))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)  # as the engine does
    arm = [int(model.joint(name).dofadr[0]) for name in JOINTS]
    model.dof_damping[arm] *= scale["joint damping"]
    model.dof_armature[arm] *= scale["joint armature"]
    model.eq_solref[0, 0] *= scale["weld time"]
    impedance = model.eq_solimp[0, :2]
    model.eq_solimp[0, :2] = 1 / (1 + scale["weld softness"] * (1 - impedance) / impedance)
    for pair in range(model.npair):
        fingers = model.geom(int(model.pair_geom1[pair])).name.startswith("finger")
        model.pair_friction[pair] *= scale["finger friction" if fingers else "object friction"]
    return model


def replay(model, task, recorded):
    """(grip, object) positions [E, T+1, 3] of the recorded actions from the recorded starts, as envs/fetch.py steps."""
    from mujoco.batch import Batch

    numbers, data = task_numbers(task), mujoco.MjData(model)
    episodes, steps = recorded["action"].shape[:2]
    batch = Batch(model, episodes)
    qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
    for name, angle, rate in zip(JOINTS, numbers["arm_qpos"], numbers["arm_qvel"]):
        qpos[:, int(model.joint(name).qposadr[0])] = angle
        qvel[:, int(model.joint(name).dofadr[0])] = rate
    obj = int(model.joint("object").qposadr[0])
    qpos[:, obj : obj + 7] = recorded["object_qpos"][:, 0]
    jointed = "finger_r" in _joints(model)
    if jointed:
        finger, rate = int(model.joint("finger_r").qposadr[0]), int(model.joint("finger_r").dofadr[0])
        qvel[:, rate : rate + 2] = numbers.get("finger_qvel", (0.0, 0.0))
    gripper, site = model.body("gripper").id, model.site("grip").id

    def look():
        """Gripper's pose [E, 7], grip and object positions [E, 6]."""
        pose, seen = np.empty((episodes, 7)), np.empty((episodes, 6))
        for episode in range(episodes):
            data.qpos[:] = qpos[episode]
            mujoco.mj_kinematics(model, data)
            pose[episode] = *data.xpos[gripper], *data.xquat[gripper]
            seen[episode] = *data.site_xpos[site], *qpos[episode, obj : obj + 3]
        return pose, seen

    pose, seen = look()
    path = [seen]
    for step in range(steps):
        action = recorded["action"][:, step]
        quat = pose[:, 3:] + (1.0, 0.0, 1.0, 0.0)
        batch.bind("mocap_pos")[:, 0] = pose[:, :3] + ACTION_SCALE * action[:, :3]
        batch.bind("mocap_quat")[:, 0] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        if model.nu:
            batch.bind("ctrl")[:] = qpos[:, finger : finger + 2] + action[:, 3:]
        # Where fingers are driven, the original sees positions one substep late; where they are blocked, it puts them back.
        late = int(model.nu > 0)
        batch.step(nstep=SUBSTEPS - late)
        if jointed and not late:
            qpos[:, finger : finger + 2] = 0
        pose, seen = look()
        if late:
            batch.step(nstep=late)
        path.append(seen)
    return np.split(np.stack(path, axis=1), 2, axis=-1)


def errors(scale, recorded):
    """{task: (grip [E, T+1], object [E, T+1])}, m."""
    out = {}
    for task, data in recorded.items():
        grip, obj = replay(scaled_model(task, scale), task, data)
        out[task] = np.linalg.norm(grip - data["grip"], axis=-1), np.linalg.norm(obj - data["achieved"], axis=-1)
    return out


def load(task, part):
    """Every second scripted episode, with noise and without, starting from the first (`part` 0) or the second (1)."""
    data = fidelity.load(f"fetch_{task}")
    rows = np.concatenate([np.flatnonzero(data["policy"] == kind)[part::2] for kind in (1, 2)])
    return {name: array[rows] for name, array in data.items()}


def fit(evaluations):
    from scipy.optimize import minimize
    from timing import print_table

    parts = {name: {task: load(task, part) for task in TASKS[:3]} for part, name in enumerate(("fit", "held out"))}

    def loss(log_scale):
        by_task = errors(np.exp(log_scale), parts["fit"]).values()
        return np.mean([np.minimum(grip, CAP).mean() + np.minimum(obj, CAP).mean() for grip, obj in by_task])

    start = np.zeros(len(SCALED))
    simplex = np.vstack([start, 0.1 * np.eye(len(SCALED))])  # steps of 10 %
    result = minimize(loss, start, method="Nelder-Mead", options={"maxfev": evaluations, "initial_simplex": simplex})
    rows = []
    for name, recorded in parts.items():
        before, after = errors(np.exp(start), recorded), errors(np.exp(result.x), recorded)
        for task, data in recorded.items():
            cells = []
            for grip, obj in (before[task], after[task]):
                end, script = obj[:, -1], data["policy"] == 2
                measured = (grip.mean(), np.minimum(obj, CAP).mean(), np.median(end[~script]), np.median(end[script]))
                cells.append([f"{1e3 * value:.2f}" for value in measured])
            rows.append((name, task, *(f"{a} -> {b}" for a, b in zip(*cells))))
    columns = ("grip, mean", "object, mean, capped", "at the end, median, noisy script", "script")
    print_table(("episodes", "task", *columns), rows)
    print(f"\nmm, before -> after {result.nfev} evaluations; loss {1e3 * loss(start):.3f} -> {1e3 * result.fun:.3f}")
    print("factors: " + ", ".join(f"{name} {value:.3f}" for name, value in zip(SCALED, np.exp(result.x))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=("read", "fit"))
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS, help="for read")
    parser.add_argument("--evaluations", type=int, default=150, help="for fit: maximum number of replays of all tasks")
    args = parser.parse_args()
    if args.mode == "read":
        read(args.tasks)
    else:
        fit(args.evaluations)


if __name__ == "__main__":
    main()
