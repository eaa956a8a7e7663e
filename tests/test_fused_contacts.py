"""Contacts of two shapes in the fused kernel, against MuJoCo C."""

import mujoco
import numpy as np
import pytest

from mjx_dher.envs.engines.fused import kernel, setup, simulation
from mjx_dher.envs.engines.fused.model import CYLINDER_BOX, Contacts, Layout, Memory
from mjx_dher.system.warp_setup import wp

pytestmark = pytest.mark.slow  # the functions compile for half a minute; robots of tests/test_fused.py have all shapes, too
NUM = 400  # poses
SHAPES = {
    "plane": "1 1 1",
    "sphere": ".02",
    "capsule": ".01 .03",
    "ellipsoid": ".03 .025 .04",
    "box": ".03 .02 .015",
    "cylinder": ".02 .03",
}
PAIRS = [("plane", shape) for shape in SHAPES if shape != "plane"] + [
    *(("sphere", shape) for shape in ("sphere", "capsule", "ellipsoid", "box", "cylinder")),
    *(("capsule", shape) for shape in ("capsule", "ellipsoid", "box", "cylinder")),
    *(("box", shape) for shape in ("ellipsoid", "box")),
]
MODEL = """
<mujoco><option ccd_tolerance="1e-12" ccd_iterations="200"/><worldbody>
<body mocap="true"><geom name="a" type="{}" size="{}"/></body>
<body><freejoint/><geom name="b" type="{}" size="{}"/></body></worldbody>
<contact><pair geom1="a" geom2="b" margin="{}" condim="1"/></contact></mujoco>
"""


@pytest.fixture(scope="module")
def collide():
    """A kernel that computes `distance`, `place` and `normal` [slots] and returns the number of contacts."""
    kinds = tuple(kind for kind, _ in setup.CONTACT_KINDS.values() if kind != CYLINDER_BOX)
    every = kernel._collision(kinds, False, 0)

    @wp.kernel(enable_backward=False, module="unique", module_options={"optimization_level": 0})
    def collide(
        contacts: Contacts,
        layout: Layout,
        spare: wp.array2d(dtype=float),
        lost: wp.array(dtype=int),
        pos: wp.array2d(dtype=wp.vec3),
        mat: wp.array2d(dtype=wp.mat33),
        number: wp.array(dtype=int),
        distance: wp.array2d(dtype=float),
        place: wp.array2d(dtype=wp.vec3),
        normal: wp.array2d(dtype=wp.vec3),
    ):
        i = wp.tid()
        memory = Memory()
        memory.pos = pos[i]
        memory.mat = mat[i]
        memory.distance = distance[i]
        memory.place = place[i]
        memory.normal = normal[i]
        held = every(contacts, memory, layout, spare[i], lost, 0, 1)
        number[i] = held.slots

    return collide


def in_c(model, flat, rng):
    """Poses at which C finds contacts no deeper than 3 mm, or none; and their distance, place and normal, [n, 7] for each pose.

    Args:
      flat: how far, in radians, the axes of the two shapes are from parallel; or None for any pose.
    """
    data, poses, there = mujoco.MjData(model), [], []
    reach = np.minimum(model.geom_rbound.sum(), 0.1)
    while len(there) < NUM:
        data.mocap_quat[0] = rng.standard_normal(4)
        data.mocap_quat[0] /= np.linalg.norm(data.mocap_quat[0])
        data.qpos[3:] = rng.standard_normal(4) if flat is None else data.mocap_quat[0] + flat * rng.standard_normal(4)
        data.qpos[:3] = rng.uniform(-reach, reach, 3)
        mujoco.mj_fwdPosition(model, data)
        rows = [(*(near.dist, *near.pos), *near.frame[:3]) for near in data.contact]
        if min((row[0] for row in rows), default=0) > -0.003 and (rows or rng.random() < 0.1):
            poses.append((data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy()))
            there.append(np.reshape(rows, (-1, 7)))
    return *(np.array(x, np.float32) for x in zip(*poses)), there


def in_the_kernel(model, pos, mat, collide):
    """Number [NUM] of contacts, and distance, place and normal [NUM, slots, 7]."""
    *_, contacts, _, layout = simulation.structs_of(model, 10**6)
    memory = [wp.zeros((NUM, layout.size), dtype=float), wp.zeros(1, dtype=int)]
    found = [wp.zeros((NUM, contacts.slots), dtype=dtype) for dtype in (float, wp.vec3, wp.vec3)]
    number = wp.zeros(NUM, dtype=int)
    poses = [wp.array(pos, dtype=wp.vec3), wp.array(mat, dtype=wp.mat33)]
    wp.launch(collide, dim=NUM, inputs=[contacts, layout, *memory, *poses], outputs=[number, *found])
    return number.numpy(), np.concatenate([found[0].numpy()[..., None], *(x.numpy() for x in found[1:])], axis=2)


@pytest.mark.parametrize(("shape1", "shape2"), PAIRS)
@pytest.mark.parametrize("flat", [None, 0.02])
def test_two_shapes_touch_as_in_mujoco_c(shape1, shape2, flat, collide, monkeypatch):
    """In all poses; ellipsoids if C's solver is told to be exact, by default it stops at 1e-6 m."""
    monkeypatch.setattr(setup, "FEW", 0)
    margin = 0.0 if flat is None else 0.002
    model = mujoco.MjModel.from_xml_string(MODEL.format(shape1, SHAPES[shape1], shape2, SHAPES[shape2], margin))
    pos, mat, there = in_c(model, flat, np.random.default_rng(0))
    number, here = in_the_kernel(model, pos, mat, collide)
    lies = (shape1, shape2) == ("capsule", "cylinder")  # maybe on an end, which is a polygon in C
    same = number == [len(rows) for rows in there]
    assert same.mean() > 0.99 if lies else same.all()
    assert max(number) > 0
    errors = []
    for ours, theirs in zip(here[same], [rows for rows, agree in zip(there, same) if agree]):
        for row in theirs:
            error = np.abs(ours[: len(theirs)] - row)
            errors.append(error[error[:, 1:4].sum(axis=1).argmin()])  # of the nearest one
    errors = np.array(errors)
    assert errors[:, 0].max() < (1e-4 if lies else 5e-6)
    assert errors[:, 1:4].max() < (2e-3 if lies else 5e-6)
    assert np.quantile(errors[:, :4], 0.9) < 1e-6
    assert errors[:, 4:].max() < (0.05 if lies else 1e-4)


@pytest.mark.parametrize("size", [".003 .03 .03", ".003 .003 .05"])
def test_a_thin_ellipsoid_never_misses_a_box(size, collide, monkeypatch):
    monkeypatch.setattr(setup, "FEW", 0)
    model = mujoco.MjModel.from_xml_string(MODEL.format("ellipsoid", size, "box", SHAPES["box"], 0.0))
    pos, mat, there = in_c(model, None, np.random.default_rng(0))
    number, _ = in_the_kernel(model, pos, mat, collide)
    assert number.tolist() == [len(rows) for rows in there]
    assert sum(number) > 20
