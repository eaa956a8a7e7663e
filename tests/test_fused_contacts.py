"""Contacts of the fused kernel by themselves, against MuJoCo C."""

import mujoco
import numpy as np
import pytest

from mjx_dher.envs.engines.fused import setup
from mjx_dher.envs.engines.fused.ellipsoid import collide_ellipsoids
from mjx_dher.envs.engines.fused.model import Contacts, Memory
from mjx_dher.system.warp_setup import wp

NUM = 300  # poses
PAIR = """
<mujoco><worldbody><body name="a" mocap="true"><geom name="a" type="{}" size="{}" contype="0" conaffinity="0"/></body>
<body name="e"><freejoint/><geom name="e" type="ellipsoid" size="0.03 0.025 0.04" contype="0" conaffinity="0"/></body>
</worldbody><contact><pair geom1="a" geom2="e" margin="{}"/></contact></mujoco>
"""


@wp.kernel(enable_backward=False, module="unique", module_options={"optimization_level": 0})
def collide(
    contacts: Contacts,
    pos: wp.array2d(dtype=wp.vec3),
    mat: wp.array2d(dtype=wp.mat33),
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
    collide_ellipsoids(contacts, memory, 0, 1)


def in_c(model, reach, rng):
    """Poses at which C finds a contact no deeper than 4 mm, or none, and distance, place and normal [NUM, 7]."""
    data, poses, there = mujoco.MjData(model), [], []
    while len(there) < NUM:
        for quat in (data.mocap_quat[0], data.qpos[3:]):
            quat[:] = rng.standard_normal(4)
            quat /= np.linalg.norm(quat)
        data.qpos[:3] = rng.uniform(-reach, reach, 3)
        mujoco.mj_fwdPosition(model, data)
        near = data.contact[0] if data.ncon else None
        if (near is None and rng.random() < 0.1) or (near is not None and near.dist > -0.004):
            poses.append((data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy()))
            there.append(np.full(7, np.inf) if near is None else [near.dist, *near.pos, *near.frame[:3]])
    return *(np.array(x, np.float32) for x in zip(*poses)), np.array(there)


@pytest.mark.slow  # it compiles for five seconds; robots of tests/test_fused.py have ellipsoids, too
@pytest.mark.parametrize(
    ("shape", "size", "margin"),
    [
        ("plane", "1 1 1", 0.0),
        ("sphere", "0.01", 0.002),
        ("capsule", "0.008 0.02", 0.0),
        ("box", "0.03 0.02 0.01", 0.001),
    ],
)
def test_an_ellipsoid_touches_other_shapes_as_in_mujoco_c(shape, size, margin):
    """In all poses, if C's solver is told to be exact; by default it stops at 1e-6 m."""
    model = mujoco.MjModel.from_xml_string(PAIR.format(shape, size, margin))
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-12, 200
    pos, mat, there = in_c(model, 0.08, np.random.default_rng(0))
    distance, place, normal = (wp.full((NUM, 1), 1e10, dtype=dtype) for dtype in (float, wp.vec3, wp.vec3))
    arrays = [wp.array(pos, dtype=wp.vec3), wp.array(mat, dtype=wp.mat33)]
    wp.launch(collide, dim=NUM, inputs=[setup.contacts_of(model), *arrays], outputs=[distance, place, normal])
    here = np.concatenate([distance.numpy(), place.numpy()[:, 0], normal.numpy()[:, 0]], axis=1)
    touches = np.isfinite(there[:, 0])
    assert 0.2 < touches.mean() < 0.9
    assert (touches == (here[:, 0] < margin)).all()
    error = np.abs(here - there)[touches]
    assert error[:, :4].max() < 1e-6
    assert error[:, 4:].max() < 1e-4
