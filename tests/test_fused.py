"""The kernel of the engine warp, on a CPU, with one lane an environment. A GPU runs the same code with more."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import envs
from mjx_dher.envs.engines.base import Controls, Physics
from mjx_dher.envs.engines.fused import kernel, setup, simulation
from mjx_dher.envs.engines.fused.cylinder import cylinder_box
from mjx_dher.envs.engines.fused.memory import carve
from mjx_dher.envs.engines.fused.model import Memory
from mjx_dher.envs.engines.fused.simulation import Simulation, most_rows, most_warps
from mjx_dher.envs.engines.fused.sparse import sparse_of
from mjx_dher.envs.engines.fused.support import unsupported
from mjx_dher.system.warp_setup import wp

TASKS = ["slide", *(pytest.param(task, marks=pytest.mark.slow) for task in ("reach", "push", "pick_and_place"))]
NUM = 48  # environments


@pytest.fixture(scope="module", autouse=True)
def quick_compiler():
    """A third of the time, and code that is slower but computes the same."""
    make = kernel.make

    def quick(*args):
        kernel_ = make(*args)
        kernel_.module.options["optimization_level"] = 0
        return kernel_

    kernel.make = quick
    yield
    kernel.make = make


def floats(x):
    return wp.array(np.asarray(x, np.float32), dtype=float)


def touching(model, seed=0):
    """States [NUM, ...] at which an object lies between the fingers, or tilted in the table, and the gripper is pulled away."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    qpos = model.qpos0 + 0.05 * rng.standard_normal((NUM, model.nq))
    qvel, control = 0.5 * rng.standard_normal((NUM, model.nv)), 0.05 * rng.standard_normal((NUM, model.nu))
    poses = []
    for i in range(NUM):
        data.qpos[:] = qpos[i]
        mujoco.mj_kinematics(model, data)
        grip = data.body("gripper")
        poses.append(np.concatenate([grip.xpos + 0.02 * rng.standard_normal(3), grip.xquat]))
        if model.nq > 7:
            qpos[i, :3] = [1.3, 0.75, 0.42] + rng.standard_normal(3) * [0.1, 0.1, 0.003]
            if i % 2:
                qpos[i, :3] = grip.xpos + 0.01 * rng.standard_normal(3)
                qpos[i, 0] += 0.02
    return qpos, qvel, np.concatenate([poses, control], axis=1)


def in_c(model, qpos, qvel, inputs):
    """One timestep of MuJoCo C."""
    data, found = mujoco.MjData(model), []
    for i in range(NUM):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i], qvel[i], inputs[i, 7:]
        data.mocap_pos[0], data.mocap_quat[0] = inputs[i, :3], inputs[i, 3:7]
        mujoco.mj_step(model, data)
        found.append((data.nefc, *(x.copy() for x in (data.qacc, data.qvel, data.qpos))))
    return [np.array(x) for x in zip(*found)]


@pytest.mark.parametrize("task", TASKS)
def test_a_timestep_is_mujoco_c_s(task):
    """To single precision, from a cold start of the solver: nine of ten environments, and half of those of Slide. Boxes that
    are deep in one another may touch at other corners, and a cylinder in a box with another normal."""
    model = envs.make(task, engine="native").model
    model.opt.tolerance, (qpos, qvel, inputs) = 1e-12, touching(model)
    there = in_c(model, qpos, qvel, inputs)
    simulation = Simulation(model, NUM, substeps=1)
    result = [wp.zeros((NUM, n), dtype=float) for n in (model.nq, model.nv, model.nv)]
    simulation.advance((floats(qpos), floats(qvel), floats(np.zeros((NUM, model.nv)))), floats(inputs), tuple(result))
    here = [x.numpy() for x in result]
    assert there[0].max() > (20 if model.nq > 7 else 5)  # rows of constraints: the weld, and contacts
    for name, a, b, scale in zip(("qpos", "qvel", "qacc"), here, there[:0:-1], (1e-6, 1e-4, 1e-4)):
        error = np.quantile(np.abs(a - b).max(axis=1), 0.5 if task == "slide" else 0.9)
        assert error < scale * np.abs(b).max(), name


@wp.kernel(enable_backward=False, module="unique", module_options={"optimization_level": 0})
def collide(
    cylinder_pos: wp.array(dtype=wp.vec3),
    cylinder_mat: wp.array(dtype=wp.mat33),
    cylinder_size: wp.vec3,
    box_pos: wp.array(dtype=wp.vec3),
    box_mat: wp.array(dtype=wp.mat33),
    box_size: wp.vec3,
    margin: float,
    found: wp.array2d(dtype=float),
):
    i = wp.tid()
    distance, pos, normal = cylinder_box(
        cylinder_pos[i], cylinder_mat[i], cylinder_size, box_pos[i], box_mat[i], box_size, margin
    )
    found[i, 0] = distance
    for k in range(3):
        found[i, 1 + k] = pos[k]
        found[i, 4 + k] = normal[k]


PAIR = """
<mujoco><option><flag nativeccd="disable"/></option><worldbody>
  <body name="b" mocap="true"><geom name="b" type="box" size="{size}" contype="0" conaffinity="0"/></body>
  <body name="c"><freejoint/><geom name="c" type="cylinder" size="0.025 0.02" contype="0" conaffinity="0"/></body>
</worldbody><contact><pair geom1="c" geom2="b" margin="{margin}"/></contact></mujoco>
"""


@pytest.mark.parametrize(("shape", "margin"), [("table", 0.0), ("finger", 0.001)])
def test_a_cylinder_touches_a_box_as_in_mujoco_c(shape, margin):
    """Where they touch they agree in all of 1,000 cases; in nine of ten the distance to 1 % of the radius. The rest is depth at
    which the portal that is found first decides."""
    size = {"table": (0.625, 0.45, 0.2), "finger": (0.0385, 0.007, 0.0135)}[shape]
    model = mujoco.MjModel.from_xml_string(PAIR.format(size=" ".join(map(str, size)), margin=margin))
    data, rng, number = mujoco.MjData(model), np.random.default_rng(0), 1000
    poses, there = [], np.full((number, 7), np.inf)
    for i in range(number):
        mujoco.mju_euler2Quat(data.qpos[3:], rng.standard_normal(3) * (0.02 if shape == "finger" else 1e-3), "xyz")
        data.qpos[:3] = rng.uniform(-1, 1, 3) * [0.065, 0.036, 0.04]
        if shape == "table":
            data.qpos[:3] = [rng.uniform(-0.64, 0.64), rng.uniform(-0.46, 0.46), 0.22 - abs(rng.normal()) * 1e-4]
        mujoco.mj_fwdPosition(model, data)
        poses.append([x.copy() for x in (data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3))])
        if data.ncon:
            there[i] = (data.contact[0].dist, *data.contact[0].pos, *data.contact[0].frame[:3])
    pos, mat = (np.array(x, np.float32) for x in zip(*poses))
    here = wp.zeros((number, 7), dtype=float)
    arrays = [
        *(wp.array(pos[:, 1], dtype=wp.vec3), wp.array(mat[:, 1], dtype=wp.mat33), wp.vec3(0.025, 0.02, 0.0)),
        *(wp.array(pos[:, 0], dtype=wp.vec3), wp.array(mat[:, 0], dtype=wp.mat33), wp.vec3(*size)),
    ]
    wp.launch(collide, dim=number, inputs=[*arrays, margin], outputs=[here])
    here, touches = here.numpy(), np.isfinite(there[:, 0])
    assert touches.mean() > 0.5
    assert (touches == (here[:, 0] < margin)).mean() > 0.999
    error = np.abs(here - there)[touches]
    assert np.quantile(error[:, 0], 0.9) < 2.5e-4
    assert np.quantile(error[:, 4:].max(axis=1), 0.9) < 1e-2


def test_fields_of_memory_follow_one_another():
    """`carve` numbers them by hand, in the order in which they are declared."""
    names = list(Memory.vars)
    source = "".join(line for line in carve.adj.source.splitlines() if line.strip().startswith("memory."))
    fields = [source.index(f"memory.{name} = ") for name in names]
    numbers = [source.index(f"begin[{i}], length[{i}]") for i in range(len(names))]
    assert fields == sorted(fields)
    assert numbers == sorted(numbers)
    model = envs.make("push", engine="native").model
    contacts, dofs, sparse = setup.contacts_of(model), setup.dofs_of(model), sparse_of(model)
    for rows in (10, 96):
        layout = setup.layout_of(model, setup.world_of(model, contacts, rows), contacts, dofs, sparse)
        begin = dict(zip(names, layout.begin.numpy()))
        own = [begin[name] for name in names if name not in ("factor", "jacobian")]
        assert own == sorted(own)
        assert begin["jacobian"] == own[0] == 0
        assert begin["inertia"] == 3 * model.nbody  # moments, three numbers each
        assert begin["factor"] == begin["pos"] == max(6 * model.nv + begin["momentum"], rows * model.nv)
        assert begin["mass"] >= begin["pos"] + model.nv**2  # neither of them reaches into what stays
        assert 0 <= layout.size - begin["change"] - rows <= 1
    assert 4 * layout.size < 48 * 1024  # bytes of shared memory that every GPU gives a block


SHAPES = (
    *('<geom type="box" size="0.05 0.04 0.06"/>', '<geom type="sphere" size="0.06"/>'),
    *('<geom type="capsule" size="0.06 0.05"/>', '<geom type="capsule" size="0.06 0.05" euler="90 10 0"/>'),
)


EGG = '<geom type="ellipsoid" size="0.06 0.05 0.08"/>'


def robot(seed):
    """A chain with several joints a body, boxes and a floor that meet by contype, servos and motors: all at random.

    Half of them have friction, tendons, and equalities of joints and tendons.
    """
    rng = np.random.default_rng(seed)

    def numbers(size, low=-1.0, high=1.0):
        return " ".join(f"{x:.3f}" for x in rng.uniform(low, high, size))

    def some(text):
        return text if rng.random() < 0.5 else ""

    chain, motors, names = "", "", []
    few = seed % 2 == 0  # whether there are rows with few terms
    for link in range(4):
        joints = ""
        for j in range(rng.integers(1, 4)):
            name, kind = f"j{link}{j}", rng.choice(["hinge", "hinge", "slide"])
            names.append(name)
            joints += (
                f'<joint name="{name}" type="{kind}" axis="{numbers(3)}" pos="{numbers(3, -0.1, 0.1)}"'
                f' damping="{numbers(1, 0.1, 1)}" armature="{numbers(1, 0.05, 0.1)}"'
                f" {some(f'stiffness={chr(34)}{numbers(1, 0, 2)}{chr(34)}')}"
                f" {some(f'range={chr(34)}-0.3 0.3{chr(34)}')} {some(f'actuatorfrcrange={chr(34)}-0.5 0.7{chr(34)}')}"
                f" {some(f'frictionloss={chr(34)}{numbers(1, 0, 0.3)}{chr(34)}') if few else ''}/>"
            )
            motors += rng.choice(
                [
                    f'<position joint="{name}" kp="{numbers(1, 1, 20)}" kv="{numbers(1, 0, 2)}" gear="{numbers(1)}"/>',
                    f'<motor joint="{name}" gear="{numbers(1, -2, 2)}" forcerange="-0.3 0.4" ctrlrange="-0.5 0.5"/>',
                    f'<general joint="{name}" gainprm="3" biastype="affine" biasprm="0.1 -2 -1" forcerange="-1 1"/>',
                ]
            )
        chain += f'<body pos="{numbers(3, -0.2, 0.2)}" quat="{numbers(4)}">{joints}{rng.choice(SHAPES)}'
    boxes = "".join(
        f'<body pos="{numbers(2, -0.2, 0.2)} 0.05"><freejoint/>{(rng.choice(SHAPES) if i or seed % 4 else EGG)[:-2]}'
        f' name="o{i}"'
        f' priority="{rng.integers(2)}" friction="{numbers(1, 0.3, 1)} 0.02 0.01" condim="{rng.choice([1, 3, 4, 6])}"'
        f' solmix="{numbers(1, 0.5, 2)}" solref="{numbers(1, 0.01, 0.03)} 1" margin="0.002"/></body>'
        for i in range(2)
    )
    pairs = "".join(
        f'<pair geom1="{geom1}" geom2="{geom2}" condim="{rng.choice([1, 3, 4, 6])}"'
        f' friction="{numbers(2, 0.3, 1)} {numbers(3, 0.01, 0.1)}"'
        f' margin="{numbers(1, 0, 0.01)}" gap="{numbers(1, 0, 0.02)}" solref="-900 -40" solimp="0.8 0.9 0.01 0.4 3"/>'
        for geom1, geom2 in (("floor", "o0"), ("o1", "o0"))
    )
    tendons, equal = "", ""
    for number in range(4):
        terms = "".join(f'<joint joint="{name}" coef="{numbers(1)}"/>' for name in rng.permutation(names)[: 1 + number])
        friction = some('frictionloss="0.2" solreffriction="0.03 1.5"')
        tendons += f'<fixed name="t{number}" range="-0.05 0.1" margin="0.01" {friction}>{terms}</fixed>'
    first, second, third = rng.permutation(names)[:3]
    equal += f'<joint joint1="{first}" joint2="{second}" polycoef="{numbers(5, -0.1, 0.1)}" solref="0.05 1"/>'
    equal += f'<joint joint1="{third}" polycoef="0.05 0 0 0 0"/><tendon tendon1="t0" tendon2="t2" polycoef="{numbers(5)}"/>'
    few_terms = f"<tendon>{tendons}</tendon><equality>{equal}</equality>" if few else ""
    return mujoco.MjModel.from_xml_string(
        f'''<mujoco>{few_terms}
<option integrator="{rng.choice(["Euler", "implicitfast"])}" tolerance="1e-12" ccd_tolerance="1e-9"/>
<worldbody>
<body name="t" mocap="true"/><geom name="floor" type="plane" size="2 2 0.1"/>{boxes}
<body pos="0 0 0.3">{chain}{"</body>" * 5}</worldbody><contact>{pairs}</contact><actuator>{motors}</actuator></mujoco>'''
    )


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_a_timestep_of_a_random_robot_is_mujoco_c_s(seed, monkeypatch):
    """With two of four seeds, pairs that are near are looked for, as in models with many pairs."""
    monkeypatch.setattr(setup, "FEW", 64 * (seed % 4 // 2))
    model = robot(seed)
    assert unsupported(model) == []
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    qpos, qvel = np.tile(model.qpos0, (NUM, 1)), 0.3 * rng.standard_normal((NUM, model.nv))
    qpos[:, 14:] += 0.2 * rng.standard_normal((NUM, model.nq - 14))
    qpos[:, [0, 1, 7, 8]] += 0.1 * rng.standard_normal((NUM, 4))
    qpos[:, [*range(3, 7), *range(10, 14)]] += 0.02 * rng.standard_normal((NUM, 8))  # no parallel capsules
    inputs = np.concatenate([np.tile([0, 0, 0, 1, 0, 0, 0], (NUM, 1)), rng.uniform(-1, 1, (NUM, model.nu))], axis=1)
    there = in_c(model, qpos, qvel, inputs)
    here = [wp.zeros((NUM, n), dtype=float) for n in (model.nq, model.nv, model.nv)]
    state = floats(qpos), floats(qvel), floats(np.zeros((NUM, model.nv)))
    simulation = Simulation(model, NUM, substeps=1)
    simulation.advance(state, floats(inputs), tuple(here))
    assert simulation.overflow() == 0
    assert there[0].max() > 12
    assert data.nefc == 0
    for name, a, b, scale in zip(("qpos", "qvel", "qacc"), here, there[:0:-1], (1e-6, 1e-4, 1e-4)):
        error = np.quantile(np.abs(a.numpy() - b).max(axis=1), 0.8)
        assert error < scale * np.abs(b).max(), name


def test_most_rows_are_what_all_pairs_can_give_at_once():
    """slide: two fingers on the puck 5 contacts each of 6 rows, both on a plane 4 and the puck on the table 5 and on the
    floor 4 of 4 rows; the weld 6 rows, and each finger's limits 1 at a time."""
    assert most_rows(envs.make("slide", engine="native").model) == 6 + 2 + 2 * 5 * 6 + (4 + 4 + 5 + 4) * 4


def test_a_block_has_as_many_warps_as_its_memory_has_room_for():
    """A warp has two environments of 3,000 floats: 24,000 bytes."""
    assert [most_warps(3000, shared) for shared in (24_000, 101_376, 232_448)] == [1, 4, simulation.WARPS]
    with refuses("24,000", "23,999", "constraints"):
        most_warps(3000, 23_999)


def test_bodies_below_one_another_are_neighbours():
    """1 has 2 and 4 below it, 2 has 3, 4 has 5."""
    body = "<body>{}</body>".format
    tree = body(body(body("")) + body(body(""))) + body("")
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{tree}</worldbody></mujoco>")
    assert setup.bodies_of(model).last.numpy().tolist() == [6, 5, 3, 3, 5, 5, 6]


def test_contacts_that_there_is_no_room_for_are_told():
    """Slide's puck, between the fingers or in the table, needs more than 12 rows, 6 of them the weld's."""
    made = envs.make("slide", engine="warp", allow_cpu=True, constraints=12)
    model = envs.make("slide", engine="native").model
    (qpos, qvel, inputs), engine = touching(model), made.engine
    physics = Physics(*(jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros_like(qvel), np.zeros((NUM, 0)))))
    controls = Controls(ctrl=jnp.asarray(inputs[:, 7:]), mocap=jnp.asarray(inputs[:, None, :7]))
    after = jax.jit(jax.vmap(engine.advance))(physics, controls)
    assert np.isfinite(after.qpos).all()
    with refuses("contacts", "constraints=12"):
        engine.check()
    engine.check()  # told once


def test_the_engine_follows_native():
    """Thirty random steps of Slide: pucks are dragged and fall; under vmap, from a jitted scan."""
    native, warp = (envs.make("slide", engine=e, **o) for e, o in (("native", {}), ("warp", {"allow_cpu": True})))
    keys = jax.random.split(jax.random.key(0), 8)
    actions = jax.random.uniform(jax.random.key(1), (30, 8, 4), minval=-1)
    states = jax.jit(jax.vmap(native.reset))(keys)

    def play(env):
        def step(states, action):
            states = jax.vmap(env.step)(states, action)
            return states, (states.obs["observation"], states.failed)

        return jax.jit(lambda s: jax.lax.scan(step, s, actions)[1])(states)

    (there, _), (here, failed) = play(native), play(warp)
    assert not failed.any()
    error = np.abs(here - there)[-1]
    assert error[:, :3].max() < 2e-3  # grip, m
    assert np.median(error[:, 3:6].max(axis=1)) < 1e-3  # puck, m
    warp.check()
