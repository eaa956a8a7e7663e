"""Writes envs/assets/hand/*.xml from the numbers of the original hand tasks' compiled models.

Needs a separate virtual environment, because gymnasium-robotics 1.4.2 requires an older MuJoCo:

    python -m venv .fetch && .fetch/bin/pip install gymnasium-robotics==1.4.2 mujoco==3.11.0
    .fetch/bin/python bench/hand_model.py

It then compares the compiled models, original and ours, and prints the largest difference in each quantity.

Differences: meshes that nothing touches, the drawn target's body, and two boxes of 2 mm in the thumb's joints, which random
actions never touch, are left out. The forearm's convex mesh is a capsule. The hand does not touch the floor: random actions
never made it do so in 480,000 timesteps.

Two things are written otherwise, because MuJoCo computes the same from them in less time. Contacts with the object are listed
as pairs, so that MuJoCo does not search for geoms that are near. And 38 of 44 tendons are left out, which have only a limit:
their joints' limits keep them 0.4 rad away from it. Random extremes of the controls exceed a joint's limit by 0.04 rad at most.
"""

import textwrap
from pathlib import Path

import mujoco
import numpy as np

OUT = Path(__file__).parent.parent / "envs" / "assets" / "hand"
OBJECTS = {
    "block": 'type="box" rgba="0.1 0.4 0.85 1"',
    "egg": 'type="ellipsoid" rgba="0.95 0.75 0.3 1"',
    "pen": 'type="capsule" rgba="0.1 0.55 0.5 1"',
}
PREFIX = "robot0:"
TINY = ("V_thbase", "V_thhub")  # boxes of 2 mm
FAR = 0.4  # rad; distance of a tendon's limit that no joint can bridge
# A cylinder of this radius with a blunt end, from 0.04 to 0.268 m; within 5 mm of the mesh from 0.04 to 0.26 m.
FOREARM = 'fromto="0 0.01 0.1075 0 0.01 0.19" size="0.0675"'
# Colours of marks.
COLORS = ("0.9 0.25 0.2 1", "0.2 0.65 0.3 1", "0.95 0.8 0.2 1", "0.95 0.95 0.95 1", "0.6 0.3 0.75 1", "0.95 0.55 0.15 1")
SKIN, SHELL = "0.85 0.87 0.9 1", "0.35 0.37 0.42 1"


def originals():
    """Compiled models of the originals by object (`reach` has none), and HandReach's initial angles by joint."""
    import gymnasium_robotics
    from gymnasium_robotics.envs.shadow_dexterous_hand.reach import DEFAULT_INITIAL_QPOS

    folder = Path(gymnasium_robotics.__file__).parent / "envs" / "assets" / "hand"
    files = {**{name: f"manipulate_{name}.xml" for name in OBJECTS}, "reach": "reach.xml"}
    return {name: mujoco.MjModel.from_xml_path(str(folder / file)) for name, file in files.items()}, DEFAULT_INITIAL_QPOS


def numbers(values):
    """Numbers as MJCF writes them, to nine digits."""
    return " ".join(f"{0.0 if abs(value) < 1e-12 else value:.9g}" for value in np.atleast_1d(values))


def own(name):
    """Our name of an element: without the robot's prefix and the marker of its kind."""
    name = name.removeprefix(PREFIX)
    return name[2:] if name[:2] in ("C_", "S_", "A_", "T_") else name


def body(model, index):
    """Lines of a body of the hand, with everything attached to it."""
    it = model.body(index)
    frame = f' pos="{numbers(it.pos)}"' if it.pos.any() else ""
    if abs(it.quat[0] - 1) > 1e-9:
        frame += f' quat="{numbers(it.quat)}"'
    turned = f' quat="{numbers(it.iquat)}"' if abs(it.iquat[0] - 1) > 1e-9 else ""
    lines = [
        f'<body name="{own(it.name).replace(" ", "_")}"{frame}>',
        f'  <inertial pos="{numbers(it.ipos)}"{turned} mass="{numbers(it.mass)}" diaginertia="{numbers(it.inertia)}"/>',
    ]
    for i in range(model.body_jntadr[index], model.body_jntadr[index] + model.body_jntnum[index]):
        joint, dof = model.joint(i), model.jnt_dofadr[i]
        assert not joint.pos.any()
        assert joint.type == mujoco.mjtJoint.mjJNT_HINGE
        wrist = (model.dof_damping[dof], model.dof_armature[dof]) != (0.1, 0.001)
        extra = f' damping="{numbers(model.dof_damping[dof])}" armature="{numbers(model.dof_armature[dof])}"' * wrist
        lines.append(f'  <joint name="{own(joint.name)}" axis="{numbers(joint.axis)}" range="{numbers(joint.range)}"{extra}/>')
    for i in np.flatnonzero(model.geom_bodyid == index).tolist():
        lines += geom(model, i)
    for i in np.flatnonzero(model.site_bodyid == index).tolist():
        if (name := model.site(i).name).startswith(f"{PREFIX}S_"):
            lines.append(f'  <site name="{own(name)}" pos="{numbers(model.site(i).pos)}"/>')
    for child in np.flatnonzero(model.body_parentid == index):
        lines += ["  " + line for line in body(model, child)]
    return [*lines, "</body>"]


def geom(model, i):
    """The line of a geom of the hand, or none if it cannot touch anything."""
    it = model.geom(i)
    if not model.geom_contype[i] or it.name.removeprefix(PREFIX) in TINY:
        return []
    condim = f' condim="{int(model.geom_condim[i])}"' if model.geom_condim[i] != 3 else ""
    if it.type == mujoco.mjtGeom.mjGEOM_MESH:
        return [f'  <geom name="{own(it.name)}" type="capsule" {FOREARM} rgba="{SHELL}"/>']
    kind = "box" if it.type == mujoco.mjtGeom.mjGEOM_BOX else "capsule"
    size = it.size if kind == "box" else it.size[:2]
    turned = f' quat="{numbers(it.quat)}"' if abs(it.quat[0] - 1) > 1e-9 else ""
    color = SKIN if condim else SHELL
    name = shown(model, i)
    return [
        f'  <geom name="{name}" type="{kind}" size="{numbers(size)}" pos="{numbers(it.pos)}"{turned}{condim} rgba="{color}"/>'
    ]


def pairs(model):
    """Lines of the contacts between parts of the hand."""
    for i in range(model.npair):
        first, second = (shown(model, int(g[i])) for g in (model.pair_geom1, model.pair_geom2))
        yield f'<pair geom1="{first}" geom2="{second}" condim="{int(model.pair_dim[i])}"/>'


def touching(model):
    """Lines of the object's contacts, with the floor and with each geom of the hand."""
    item = model.geom("object")
    for i in range(model.ngeom):
        it = model.geom(i)
        hand_s = it.name.startswith(PREFIX) and geom(model, i)
        if hand_s or it.name == "floor0":
            assert max(it.condim, item.condim) == 4
            for field in ("friction", "solref", "solimp", "margin", "gap", "priority", "solmix"):
                assert np.all(getattr(it, field) == getattr(item, field)), field
            first = shown(model, i) if hand_s else "floor"
            yield f'<pair geom1="{first}" geom2="object" condim="4"/>'


def shown(model, i):
    """Our name of a geom."""
    name = own(model.geom(i).name)
    return {"palm0": "palm", "palm1": "palm_side"}.get(name, name)


def tendons(model):
    """Lines of the fixed tendons whose limit acts."""
    for i in range(model.ntendon):
        wraps = range(model.tendon_adr[i], model.tendon_adr[i] + model.tendon_num[i])
        joints = [int(model.wrap_objid[w]) for w in wraps]
        coefs = model.wrap_prm[list(wraps)]
        ends = np.sort(coefs[:, None] * model.jnt_range[joints], axis=1).sum(axis=0)  # shortest and longest
        low, high = model.tendon_range[i]
        for field in ("stiffness", "damping", "frictionloss", "armature"):
            assert not np.any(getattr(model, f"tendon_{field}")[i])
        if min(ends[0] - low, high - ends[1]) < FAR * np.abs(coefs).sum():
            parts = "".join(f'<joint joint="{own(model.joint(j).name)}" coef="{numbers(c)}"/>' for j, c in zip(joints, coefs))
            limits = f'limited="true" range="{numbers(model.tendon_range[i])}"'
            yield f'<fixed name="{own(model.tendon(i).name)}" {limits}>{parts}</fixed>'


def actuators(model):
    """Lines of the position servos."""
    for i in range(model.nu):
        it, gain = model.actuator(i), model.actuator_gainprm[i, 0]
        assert model.actuator_biasprm[i, 1] == -gain
        assert model.actuator_gear[i, 0] == 1
        ranges = f'ctrlrange="{numbers(it.ctrlrange)}" forcerange="{numbers(it.forcerange)}"'
        yield f'<position name="{own(it.name)}" joint="{own(it.name)}" kp="{numbers(gain)}" {ranges}/>'


def hand(model):
    """The file that all tasks include."""
    option = model.opt
    sections = "\n".join(
        f"  <{name}>\n" + textwrap.indent("\n".join(lines), "    ") + f"\n  </{name}>"
        for name, lines in (
            ("worldbody", body(model, mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"{PREFIX}hand mount"))),
            ("contact", pairs(model)),
            ("tendon", tendons(model)),
            ("actuator", actuators(model)),
        )
    )
    return f"""<!--
  The Shadow hand of gymnasium-robotics 1.4.2, with the numbers of its compiled model. Written by bench/hand_model.py.
  Geoms touch where a pair says so. Of the original's tendons, those whose limit acts are here.
-->
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{numbers(option.timestep)}" iterations="{option.iterations}">
    <!-- Splitting the constraints into islands costs more than it saves. -->
    <flag island="disable"/>
  </option>
  <default>
    <geom contype="0" conaffinity="0"/>
    <joint limited="true" margin="0.01" damping="0.1" armature="0.001" frictionloss="0.001"/>
    <site size="0.004" rgba="0 0 0 0"/>
    <default class="object">
      <geom condim="4"/>
      <joint limited="false" margin="0" damping="0.01" armature="0" frictionloss="0"/>
      <default class="mark">
        <geom mass="0"/>
      </default>
    </default>
  </default>
  <statistic center="1 0.92 0.15" extent="0.45"/>
  <visual>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.25 0.25 0.25" specular="0 0 0"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.93 0.95 0.97" rgb2="0.75 0.82 0.88" width="64" height="384"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1="0.55 0.58 0.62" rgb2="0.6 0.63 0.67" width="512" height="512"/>
    <material name="tiles" texture="tiles" texrepeat="8 8"/>
  </asset>
  <worldbody>
    <light directional="true" pos="1 0.6 2" dir="-0.1 0.25 -1" diffuse="0.55 0.55 0.55" specular="0.2 0.2 0.2"/>
    <camera name="front" pos="1.140 0.670 0.432" xyaxes="0.909 0.416 -0.000 -0.308 0.674 0.671"/>
  </worldbody>
{sections}
</mujoco>
"""


def task(name, model, angles):
    """The file of a task."""
    floor = model.geom("floor0").pos[2]
    carried = contacts = ""
    if name != "reach":
        contacts = "\n  <contact>\n" + textwrap.indent("\n".join(touching(model)), "    ") + "\n  </contact>"
        it, shape = model.body("object"), model.geom("object")
        size = shape.size[:2] if name == "pen" else shape.size
        turned = f' quat="{numbers(it.quat)}"' if abs(it.quat[0] - 1) > 1e-9 else ""
        dof = model.joint("object:joint").dofadr[0]
        assert model.dof_damping[dof] == 0.01
        assert shape.condim == 4
        carried = f"""
    <body name="object" pos="{numbers(it.pos)}"{turned} childclass="object">
      <inertial pos="0 0 0" mass="{numbers(it.mass)}" diaginertia="{numbers(it.inertia)}"/>
      <joint name="object" type="free"/>
      <geom name="object" {OBJECTS[name]} size="{numbers(size)}"/>{"".join(marks(name))}
    </body>"""
        qpos = numbers([*np.zeros(24), *it.pos, *it.quat])
    else:
        qpos = numbers([angles[model.joint(i).name] for i in range(model.njnt)])
    middle = "" if name == "reach" else f' ctrl="{numbers(model.actuator_ctrlrange.mean(axis=1))}"'
    key = "\n".join(textwrap.wrap(f'<key name="start" qpos="{qpos}"{middle}/>', 120, subsequent_indent="         "))
    return f"""<!-- The Shadow hand and {"no object" if name == "reach" else f"a {name}"}. Written by bench/hand_model.py. -->
<mujoco model="hand_{name}">
  <include file="hand.xml"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1" pos="1 1 {numbers(floor)}" material="tiles"/>{carried}
  </worldbody>{contacts}
  <keyframe>
    {key}
  </keyframe>
</mujoco>
"""


def marks(name):
    """Lines of geoms that show how the object is turned; they touch nothing and weigh nothing."""
    if name == "block":
        for i, color in enumerate(COLORS):
            size, place = np.full(3, 0.017), np.zeros(3)
            size[i // 2], place[i // 2] = 0.0005, 0.025 * (1 - 2 * (i % 2))
            yield f'\n      <geom class="mark" type="box" size="{numbers(size)}" pos="{numbers(place)}" rgba="{color}"/>'
    else:
        radius, end = (0.0084, 0.1) if name == "pen" else (0.012, 0.029)
        for sign, color in zip((1, -1), COLORS):
            yield f'\n      <geom class="mark" type="sphere" size="{radius}" pos="0 0 {sign * end}" rgba="{color}"/>'


def hand_pairs(model):
    """Indices of the pairs without the object."""
    objects = [i for i in range(model.ngeom) if model.geom(i).name == "object"]
    return ~(np.isin(model.pair_geom1, objects) | np.isin(model.pair_geom2, objects))


def compare(name, there):
    """Prints the largest differences between the original's compiled model and ours."""
    here = mujoco.MjModel.from_xml_path(str(OUT / f"{name}.xml"))
    theirs = {own(there.body(i).name).replace(" ", "_"): i for i in range(there.nbody)}
    bodies = [theirs[here.body(i).name] for i in range(1, here.nbody)]
    largest = {}
    for field in ("body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "body_iquat"):
        largest[field] = np.abs(getattr(here, field)[1:] - getattr(there, field)[bodies]).max()
    for field in ("jnt_axis", "jnt_range", "jnt_margin", "jnt_solref", "jnt_solimp"):
        largest[field] = np.abs(getattr(here, field) - getattr(there, field)[: here.njnt]).max()
    for field in ("dof_damping", "dof_armature", "dof_frictionloss", "dof_invweight0"):
        largest[field] = np.abs(getattr(here, field) - getattr(there, field)[: here.nv]).max()
    largest["qpos0"] = np.abs(here.qpos0 - there.qpos0[: here.nq]).max()
    tendons_there = [own(there.tendon(i).name) for i in range(there.ntendon)]
    same = {"actuator": [*range(here.nu)], "pair": [*range(there.npair)]}
    same["tendon"] = [tendons_there.index(here.tendon(i).name) for i in range(here.ntendon)]
    for field in dir(here):
        kind = field.split("_")[0]
        if kind in same and not field.endswith("_user"):
            a, b = getattr(here, field), getattr(there, field, np.zeros(0))
            if isinstance(a, np.ndarray) and a.dtype.kind == "f" and np.ndim(b) and np.size(b) and len(b) > max(same[kind]):
                a = a[hand_pairs(here)] if kind == "pair" else a
                if a.shape[1:] == b.shape[1:]:
                    largest[field] = np.abs(a - b[same[kind]]).max()
    print(f"{name}: {len(largest)} quantities,", {field: f"{value:.1e}" for field, value in largest.items() if value > 1e-9})


def main():
    models, angles = originals()
    OUT.mkdir(exist_ok=True)
    (OUT / "hand.xml").write_text(hand(models["reach"]))
    for name, model in models.items():
        (OUT / f"{name}.xml").write_text(task(name, model, angles))
        compare(name, model)


if __name__ == "__main__":
    main()
