"""Timesteps of random robots in the fused kernel, against MuJoCo C: each feature of a model by itself, and all of them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_fused import NUM, floats, in_c, quick_compiler  # noqa: F401

from mjx_dher.envs.engines.fused import setup, varied
from mjx_dher.envs.engines.fused.simulation import Simulation
from mjx_dher.envs.engines.fused.support import unsupported
from mjx_dher.envs.engines.variation import Variation
from mjx_dher.system.warp_setup import wp

SHAPES = (
    *('<geom type="box" size="0.05 0.04 0.06"/>', '<geom type="sphere" size="0.06"/>'),
    *('<geom type="capsule" size="0.06 0.05"/>', '<geom type="capsule" size="0.06 0.05" euler="90 10 0"/>'),
)


EGG = '<geom type="ellipsoid" size="0.06 0.05 0.08"/>'


FEATURES = (
    "friction",
    "tendon friction",
    "tendon limits",
    "joints",
    "tendons",
    "connect",
    "weld",
    "springs",
    "motors",
    "elliptic",
)


def few_terms(rng, names, features):
    """MJCF of tendons and equalities, at random."""
    if not features:
        return ""

    def numbers(size, low=-1.0, high=1.0):
        return " ".join(f"{x:.3f}" for x in rng.uniform(low, high, size))

    tendons, (first, second, third) = "", rng.permutation(names)[:3]
    for number in range(4):
        terms = "".join(f'<joint joint="{name}" coef="{numbers(1)}"/>' for name in rng.permutation(names)[: 1 + number])
        if "side" in names and number == 1:
            terms = f'<joint joint="side" coef="1"/><joint joint="{first}" coef="{numbers(1)}"/>'
        friction = 'frictionloss="1.5" solreffriction="0.03 1.5"' if "tendon friction" in features and number % 2 else ""
        limits = 'range="-0.05 0.1" margin="0.01"' if "tendon limits" in features else ""
        springs = f'stiffness="{numbers(1, 0, 50)}" damping="{numbers(1, 0, 3)}" springlength="-0.02 0.05"'
        springs = springs if "springs" in features else ""
        tendons += f'<fixed name="t{number}" {limits} {friction} {springs}>{terms}</fixed>'
    equal = {
        "joints": f'<joint joint1="{first}" joint2="{second}" polycoef="{numbers(5, -0.1, 0.1)}" solref="0.05 1"/>'
        f'<joint joint1="{third}" polycoef="0.05 0 0 0 0"/>',
        "tendons": f'<tendon tendon1="t0" tendon2="t2" polycoef="{numbers(5)}"/><tendon tendon1="t3"/>',
        "connect": '<connect body1="box1" body2="link2" anchor="0.3 0 0"/><connect body1="link3" anchor="0 0 0.1"/>',
        "weld": '<weld body1="t" body2="box0" relpose="0 0 0 1 0 0 0"/>',
    }
    motors = f'<position tendon="t1" kp="20" kv="{numbers(1, 0, 3)}" gear="{numbers(1)}"/><motor tendon="t1" gear="-2"/>'
    motors += '<general tendon="t3" gainprm="3" biastype="affine" biasprm="0.1 -2 -1" forcerange="-1 1"/>'
    equalities = "".join(equal.get(feature, "") for feature in features)
    actuators = motors if "motors" in features else ""
    return f"<tendon>{tendons}</tendon><equality>{equalities}</equality><actuator>{actuators}</actuator>"


def robot(seed, features=()):
    """A chain with several joints a body, boxes and a floor that meet by contype, servos and motors: all at random.

    `features` says which constraints it has beside contacts and limits of joints.
    """
    rng = np.random.default_rng(seed)

    def numbers(size, low=-1.0, high=1.0):
        return " ".join(f"{x:.3f}" for x in rng.uniform(low, high, size))

    def some(text):
        return text if rng.random() < 0.5 else ""

    chain, motors, names = "", "", []
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
                f" {some(f'frictionloss={chr(34)}{numbers(1, 0.5, 3)}{chr(34)}') if 'friction' in features else ''}/>"
            )
            motors += rng.choice(
                [
                    f'<position joint="{name}" kp="{numbers(1, 1, 20)}" kv="{numbers(1, 0, 2)}" gear="{numbers(1)}"/>',
                    f'<motor joint="{name}" gear="{numbers(1, -2, 2)}" forcerange="-0.3 0.4" ctrlrange="-0.5 0.5"/>',
                    f'<general joint="{name}" gainprm="3" biastype="affine" biasprm="0.1 -2 -1" forcerange="-1 1"/>',
                ]
            )
        chain += f'<body name="link{link}" pos="{numbers(3, -0.2, 0.2)}" quat="{numbers(4)}">{joints}{rng.choice(SHAPES)}'
    side = ""
    if features == ("motors",):  # a tendon of joints that do not move one another
        side = '<body pos="0 0.5 0.5"><joint name="side" axis="0 1 0" armature="0.1"/><geom size="0.05" pos="0.1 0 0"/></body>'
        names.append("side")
    free = '<joint type="free" frictionloss="0.3"/>' if "friction" in features else "<freejoint/>"
    boxes = "".join(
        f'<body name="box{i}" pos="{numbers(2, -0.2, 0.2)} 0.05">{free}'
        f'{(rng.choice(SHAPES) if i or seed % 4 else EGG)[:-2]} name="o{i}"'
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
    integrator = "implicitfast" if side else rng.choice(["Euler", "implicitfast"])
    flags = '<flag gravity="disable" eulerdamp="disable" filterparent="disable"/>' if seed == 2 else ""
    cone = 'cone="elliptic" impratio="3"' if "elliptic" in features else ""
    return mujoco.MjModel.from_xml_string(
        f'''<mujoco>{few_terms(rng, names, features)}
<option {cone} integrator="{integrator}" tolerance="1e-12" ccd_tolerance="1e-9">{flags}</option>
<worldbody>
<body name="t" mocap="true"/><geom name="floor" type="plane" size="2 2 0.1"/>{boxes}
<body pos="0 0 0.3">{chain}{"</body>" * 5}{side}</worldbody><contact>{pairs}</contact><actuator>{motors}</actuator></mujoco>'''
    )


ROBOTS = [(0, FEATURES), *((seed, ()) for seed in (1, 2, 3)), *((4 + i, (name,)) for i, name in enumerate(FEATURES))]
VARIED = ("mass:box0 link1", "mass:link3", "friction:o*", "friction:floor", "damping:j*", "gain:j1* j2*")
ROBOTS += [(14, ("varied", "motors")), (15, ("varied", "elliptic"))]


@pytest.mark.parametrize(
    ("seed", "features"), [pytest.param(*kind, marks=[pytest.mark.slow] * (kind[0] > 0)) for kind in ROBOTS]
)
def test_a_timestep_of_a_random_robot_is_mujoco_c_s(seed, features, monkeypatch):
    """With two of four seeds, pairs that are near are looked for, as in models with many pairs."""
    monkeypatch.setattr(setup, "FEW", 64 * (seed % 4 // 2))
    model = robot(seed, features)
    assert unsupported(model) == []
    rng = np.random.default_rng(seed)
    qpos, qvel = np.tile(model.qpos0, (NUM, 1)), 0.3 * rng.standard_normal((NUM, model.nv))
    qpos[:, 14:] += 0.2 * rng.standard_normal((NUM, model.nq - 14))
    qpos[:, [0, 1, 7, 8]] += 0.1 * rng.standard_normal((NUM, 4))
    qpos[:, [*range(3, 7), *range(10, 14)]] += 0.02 * rng.standard_normal((NUM, 8))  # no parallel capsules
    inputs = np.concatenate([np.tile([0, 0, 0, 1, 0, 0, 0], (NUM, 1)), rng.uniform(-1, 1, (NUM, model.nu))], axis=1)
    variation = Variation(model, VARIED if "varied" in features else ())
    factors = rng.uniform(0.3, 2, (NUM, variation.size))
    numbers = varied.Numbers(model, variation, inputs.shape[1])
    row = jax.jit(lambda factors: jnp.concatenate([jnp.zeros(0), *numbers.row(variation.values(factors, jnp))]))

    def change(model, i):
        for field, value in variation.values(factors[i]).items():
            getattr(model, field)[...] = value

    there = in_c(model, qpos, qvel, inputs, change)
    inputs = np.concatenate([inputs, [row(jnp.float32(own)) for own in factors]], axis=1)
    here = [wp.zeros((NUM, n), dtype=float) for n in (model.nq, model.nv, model.nv)]
    state = floats(qpos), floats(qvel), floats(np.zeros((NUM, model.nv)))
    simulation = Simulation(model, NUM, substeps=1, varied=numbers.begins)
    simulation.advance(state, floats(inputs), tuple(here))
    assert simulation.overflow() == 0
    assert there[0].max() > 12
    for name, a, b, scale in zip(("qpos", "qvel", "qacc"), here, there[:0:-1], (2e-6, 1e-4, 1e-4)):
        error = np.quantile(np.abs(a.numpy() - b).max(axis=1), 0.8)
        assert error < scale * np.abs(b).max(), name
