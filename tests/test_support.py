"""Which models the fused kernel takes: every field of a model is read, without effect, or at its default."""

import copy

import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import envs
from mjx_dher.envs import engines
from mjx_dher.envs.engines.features import fields
from mjx_dher.envs.engines.fused import setup
from mjx_dher.envs.engines.fused.memory import layout_of
from mjx_dher.envs.engines.fused.sparse import sparse_of
from mjx_dher.envs.engines.fused.support import has_default, is_read, unsupported
from mjx_dher.envs.engines.pairs import all_pairs

WELDED = """
<mujoco>{}<worldbody><body name="t" mocap="true"/><body name="b"><joint name="j"/><geom name="g" type="{}" size="1 1 1"
contype="0" conaffinity="0"/></body><geom name="o" type="box" size="1 1 1" contype="0" conaffinity="0"/></worldbody>
<option>{}</option><equality><weld body1="t" body2="b" relpose="0 0 0 1 0 0 0"/></equality>
<contact><pair geom1="g" geom2="o" gap="{}"/></contact></mujoco>
"""

OFF_CENTRE = """
<mujoco><option integrator="implicitfast"/><worldbody><body><freejoint name="f"/><geom type="box" size="1 1 1" pos="1 0 0"/>
</body></worldbody></mujoco>
"""


EGGS = """
<mujoco><worldbody><body><freejoint/><geom name="g" type="ellipsoid" size="1 1 1"/></body>
<geom name="o" type="ellipsoid" size="1 1 1"/></worldbody></mujoco>
"""
SPATIAL = """
<worldbody><site name="s"/><site name="u" pos="1 0 0"/></worldbody>
<tendon><spatial name="far"><site site="s"/><site site="u"/></spatial></tendon>
"""
FEW = """
<default><joint frictionloss="1" range="-1 1"/></default>
<tendon><fixed name="f" range="0 1" frictionloss="1"><joint joint="j" coef="1"/></fixed></tendon>
<equality><joint joint1="j"/><tendon tendon1="f"/></equality>
"""


def welded(extra="", shape="box", options="", gap=0.0):
    return mujoco.MjModel.from_xml_string(WELDED.format(extra, shape, options, gap))


def test_unsupported_features_are_named_with_their_elements():
    motor = '<actuator><general name="m" joint="j" {}/></actuator>'
    cases = [
        (mujoco.MjModel.from_xml_string(EGGS), ["contacts of ellipsoid and ellipsoid", "'g'", "'o'"]),
        (welded(shape="ellipsoid", options='<flag nativeccd="disable"/>'), ["ellipsoid and box with nativeccd", "'g'", "'o'"]),
        (mujoco.MjModel.from_xml_string(OFF_CENTRE), ["free bodies", "implicitfast", "'f'"]),
        (welded(shape="cylinder", options='<flag nativeccd="disable"/>', gap=0.1), ["gaps of cylinders", "'g'"]),
        (welded(shape="cylinder"), ["nativeccd=disable", "'g'"]),
        (welded('<option integrator="RK4"/>'), ["integrator"]),
        (welded('<option solver="CG"/>'), ["solver"]),
        (welded('<option><flag gravity="disable" limit="disable"/></option>'), ["options disabled (limit)"]),
        (welded('<option density="1.2"/>'), ["medium"]),
        (welded('<default><joint range="0 0.1" margin="0.06"/></default>'), ["limits nearer", "'j'"]),
        (welded(SPATIAL), ["tendons that are not fixed", "'far'"]),
        (
            welded('<tendon><fixed name="f" armature="1"><joint joint="j" coef="1"/></fixed></tendon>'),
            ["tendon_armature", "'f'"],
        ),
        (welded('<default><joint stiffness="1 2"/></default>'), ["springs", "'j'"]),
        (welded('<option noslip_iterations="3"/>'), ["noslip"]),
        (welded('<actuator><motor site="s"/></actuator><worldbody><site name="s"/></worldbody>'), ["not on joints or tendons"]),
        (welded(motor.format('dyntype="filter"')), ["activations", "actuators with a state", "'m'"]),
        (welded(motor.format('delay="0.006" nsample="4"')), ["delays", "'m'"]),
        (welded('<equality><weld name="c" body1="b" torquescale="2"/></equality>'), ["equality constraints other than", "'c'"]),
        (mujoco.MjModel.from_xml_string("<mujoco/>"), ["degrees of freedom"]),
    ]
    for model, parts in cases:
        for part in parts:
            assert part in " ".join(unsupported(model)), part
    assert unsupported(welded()) == unsupported(welded('<option cone="elliptic"/>')) == []
    assert unsupported(welded('<sensor><jointpos joint="j"/></sensor>')) == []  # nobody reads it
    for task in ("reach", "push", "slide", "pick_and_place"):
        assert unsupported(envs.make(task, engine="native").model) == []


class Recorded:
    """A model, or its options, that notes which fields are read."""

    def __init__(self, held, seen, prefix=""):
        self._held, self._seen, self._prefix = held, seen, prefix

    def __getattr__(self, name):
        value = getattr(self._held, name)
        if name in ("opt", "stat"):
            return Recorded(value, self._seen, f"{name}.")
        self._seen.add(self._prefix + name)
        return value


def test_every_field_of_a_model_is_read_without_effect_or_at_its_default():
    """A field that a newer MuJoCo adds, too."""
    seen = set()
    model = welded(FEW)
    assert unsupported(model) == []
    for each in (model, envs.make("slide", engine="native").model):
        recorded = Recorded(each, seen)
        contacts, dofs, sparse = setup.contacts_of(recorded), setup.dofs_of(recorded), sparse_of(recorded)
        setup.bodies_of(recorded)
        layout_of(recorded, setup.world_of(recorded, contacts, 100), contacts, dofs, sparse)
    read = {name for name, _ in fields(model) if is_read(name)}
    # What decides whether a model is taken, and what only contacts of geoms that no pair lists have.
    decides = {"actuator_biastype", "eq_objtype", "wrap_type"}
    mixed = {f"geom_{name}" for name in ("condim", "friction", "margin", "priority", "solimp", "solmix", "solref")}
    assert read - seen == decides | mixed
    assert not any(map(has_default, seen - {"stat.meaninertia"}))  # which follows from the masses
    model = welded('<actuator><motor name="m" joint="j"/></actuator>' + FEW)
    checked = [name for name, _ in fields(model) if has_default(name)]
    assert len(checked) > 30
    assert {"tendon_armature", "geom_surfacevel", "actuator_armature", "pair_adhesion", "opt.disableactuator"} <= {*checked}
    for name in checked:
        if name in ("na", "nflex", "nhistory", "nplugin"):
            continue  # cannot be set
        changed = copy.copy(model)
        holder, field = (changed.opt, name[4:]) if name.startswith("opt.") else (changed, name)
        if np.ndim(value := getattr(holder, field)):
            value[...] = np.where(value == 1, 0, 1)
        else:
            setattr(holder, field, value + 1)
        assert unsupported(changed), name


def test_an_unsupported_model_is_rejected():
    with refuses("engine", "warp", "ellipsoid"):
        engines.make_engine("warp", mujoco.MjModel.from_xml_string(EGGS), 20, path="fused", allow_cpu=True)
    with refuses("engine", "warp", "actuator_armature", "native"):
        model = welded('<actuator><motor name="m" joint="j" armature="1"/></actuator>')
        engines.make_engine("warp", model, 20, allow_cpu=True)


def test_contacts_are_mixed_from_geoms_as_in_mujoco_c():
    """Of every pair that meets: boxes of any priority, margin and softness in one another."""
    rng = np.random.default_rng(0)
    boxes = "".join(
        f'<body pos="{i * 0.01} 0 0"><freejoint/><geom type="box" size="1 1 1" contype="{rng.integers(4)}"'
        f' priority="{rng.integers(2)}" conaffinity="{rng.integers(4)}" condim="{rng.choice([1, 3, 4, 6])}"'
        f' solmix="{rng.choice([0, 0, 1, 3])}" margin="{rng.random():.3f}"'
        f' friction="{rng.random():.3f} {rng.random():.3f} {rng.random():.3f}"'
        f' solref="{rng.choice(["0.02 1", "0.03 0.5", "-100 -10"])}" solimp="{rng.uniform(0.5, 0.9):.3f} 0.95 0.01"/>'
        + ('<body><joint/><geom type="box" size="1 1 1"/></body>' if i % 3 == 0 else "")
        + "</body>"
        for i in range(8)
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>{boxes}<body name="x"><geom type="box" size="1 1 1"/></body>
</worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = all_pairs(model)
    ours = {tuple(sorted(ends)): i for i, ends in enumerate(zip(found.geom1.tolist(), found.geom2.tolist()))}
    theirs = {tuple(sorted(contact.geom.tolist())): contact for contact in data.contact}
    assert set(ours) == set(theirs)
    assert len(ours) > 20
    for ends, contact in theirs.items():
        i = ours[ends]
        np.testing.assert_allclose(found.friction[i], contact.friction, err_msg=str(ends))
        np.testing.assert_allclose(found.solimp[i], contact.solimp)
        np.testing.assert_allclose(found.solref[i], contact.solref)
        assert found.dim[i] == contact.dim
        assert found.margin[i] == pytest.approx(contact.includemargin)
