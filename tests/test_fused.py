"""The kernel of the engine warp, on a CPU, with one lane an environment. A GPU runs the same code with more."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import envs
from mjx_dher.envs.engines import Controls, Physics
from mjx_dher.envs.engines.fused import kernel, setup, simulation
from mjx_dher.envs.engines.fused.cylinder import cylinder_box
from mjx_dher.envs.engines.fused.memory import carve, layout_of
from mjx_dher.envs.engines.fused.model import Memory
from mjx_dher.envs.engines.fused.simulation import Simulation, most_rows, most_warps
from mjx_dher.envs.engines.fused.sparse import sparse_of
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


def in_c(model, qpos, qvel, inputs, change=lambda model, i: None):
    """One timestep of MuJoCo C, of each environment in a model that `change` may have changed."""
    model, found = copy.copy(model), []
    data = mujoco.MjData(model)
    for i in range(NUM):
        change(model, i)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i], qvel[i], inputs[i, 7 : 7 + model.nu]
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
        layout = layout_of(model, setup.world_of(model, contacts, rows), contacts, dofs, sparse)
        begin = dict(zip(names, layout.begin.numpy()))
        own = [begin[name] for name in names if name not in ("factor", "jacobian")]
        assert own == sorted(own)
        assert begin["jacobian"] == own[0] == 0
        assert begin["inertia"] == 3 * model.nbody  # moments, three numbers each
        assert begin["factor"] == begin["pos"] == max(6 * model.nv + begin["momentum"], rows * model.nv)
        assert begin["mass"] >= begin["pos"] + model.nv * (model.nv + 1) // 2  # neither of them reaches into what stays
        assert 0 <= layout.size - begin["change"] - rows <= 1
    assert 4 * layout.size < 48 * 1024  # bytes of shared memory that every GPU gives a block


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
    advance = jax.jit(jax.vmap(engine.advance))
    after = advance(physics, controls)
    lost = np.isnan(after.qpos)
    assert 0 < lost.any(axis=1).sum() < NUM
    assert (lost.all(axis=1) == lost.any(axis=1)).all()
    with refuses("contacts", "constraints=12"):
        engine.check()
    engine.check()  # told once
    engine._asked = False  # as if 12 were the most that fit
    advance(physics, controls)
    with pytest.warns(UserWarning, match=r"no room for all contacts .* NaN"):
        engine.check()


def test_the_engine_follows_native():
    """Thirty random steps of Slide: pucks are dragged and fall; under vmap, from a jitted scan."""
    native, warp = (envs.make("slide", engine=e, **o) for e, o in (("native", {}), ("warp", {"allow_cpu": True})))
    keys = jax.random.split(jax.random.key(0), 4)
    actions = jax.random.uniform(jax.random.key(1), (30, 4, 4), minval=-1)
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


@pytest.mark.slow
@pytest.mark.parametrize("task", ["slide", "block"])  # a cylinder, a search for near pairs
def test_the_kernel_compiles_for_a_gpu(task, tmp_path):
    """Warp compiles CUDA code without a GPU, too."""
    model, shared = envs.make(task, engine="native").model, 230_000  # bytes of a block on an H100
    structs, threads = simulation.structs_of(model, simulation.rows_for(model, shared)), simulation.threads_for(model)
    made = simulation.kernel_of(model, structs, threads, most_warps(structs[-1].size, shared, threads))
    made.module.options["optimization_level"] = 3  # otherwise it takes ten minutes
    wp.compile_aot_module(made.module, arch=90, module_dir=tmp_path, use_ptx=True)
    (ptx,) = tmp_path.glob("*.sm90.ptx")
    assert ".visible .entry" in ptx.read_text()
