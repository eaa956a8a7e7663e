"""What the viewer draws and plays: scenes, critics, runs that are still being trained."""

import dataclasses
import shutil
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from conftest import refuses

from mjx_dher import Options, RunSpec, envs
from mjx_dher.config import Config
from mjx_dher.policy import bundled
from mjx_dher.runs import driver
from mjx_dher.runs.folder import run_folder
from mjx_dher.system.files import FolderError
from mjx_dher.viewer import scene, sources

TINY = Config(
    num_envs=2,
    cycles_per_epoch=1,
    updates_per_cycle=2,
    target_period=1,
    batch_size=16,
    total_steps=200,
    replay_size=1000,
    hidden_sizes=(8, 8),
    eval_episodes=2,
)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of Reach that was stopped after its first epoch, and so has a checkpoint: (folder, spec)."""
    folder = tmp_path_factory.mktemp("view") / "run"
    run = RunSpec(env="reach", engine="native", config=TINY)
    driver.train_runs(reach(), [run], [folder], options=Options(final_episodes=2), should_stop=lambda: True)
    return folder, run


def reach():
    return envs.make("reach", engine="native")


def of_package(name):
    return sources.of_run(name, bundled.FOLDER / name)


# The scene


@pytest.mark.parametrize("name", ["push", "pick_and_place", "slide", "reach"])
def test_what_can_be_seen_of_a_task_is_drawn(name):
    model = envs.make(name, engine="native").model
    drawn = {model.geom(i).name or f"geom_{i}" for i in scene.visible(model)}
    visible = {model.geom(i).name or f"geom_{i}" for i in range(model.ngeom) if model.geom_rgba[i, 3] > 0}
    assert drawn == visible
    assert {"floor", "table"} <= drawn
    assert ("object" in drawn) == (name != "reach")
    assert not any("stand_in" in name for name in drawn)


def test_geoms_lie_where_mujoco_has_them():
    """A geom's place in its body's frame, moved with the body, is MuJoCo's own place of the geom."""
    env = envs.make("slide", engine="native")
    qpos = np.asarray(env.reset(jax.random.key(0)).physics.qpos, float)
    positions, orientations = scene.Poses(env.model).at(qpos)
    data = mujoco.MjData(env.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(env.model, data)
    assert len(scene.visible(env.model)) > 10
    for geom in scene.visible(env.model):
        turned, body = np.zeros(3), env.model.geom_bodyid[geom]
        mujoco.mju_rotVecQuat(turned, env.model.geom_pos[geom], orientations[body])
        np.testing.assert_allclose(positions[body] + turned, data.geom_xpos[geom], atol=1e-12)


def test_every_kind_of_geom_is_drawn():
    kinds = {
        "plane": 'size="1 1 1"',
        "sphere": 'size="0.1"',
        "capsule": 'size="0.1 0.3"',
        "ellipsoid": 'size="0.1 0.2 0.3"',
        "cylinder": 'size="0.1 0.3"',
        "box": 'size="0.1 0.2 0.3"',
    }
    geoms = "".join(f'<geom name="{kind}" type="{kind}" {size}/>' for kind, size in kinds.items())
    tetrahedron = '<asset><mesh name="t" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>'
    mesh = '<geom name="mesh" type="mesh" mesh="t"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{tetrahedron}<worldbody>{geoms}{mesh}</worldbody></mujoco>")
    added = Recorder()
    nodes = scene.add(added, model)
    assert set(nodes) == {0}
    names = [call.rsplit("/", 1)[-1] for call, _, _ in added.calls]
    assert names == ["0", *kinds, "mesh"]
    by_name = {call.rsplit("/", 1)[-1]: (args, options) for call, args, options in added.calls}
    for kind, half in (("capsule", (0.1, 0.1, 0.4)), ("ellipsoid", (0.1, 0.2, 0.3))):
        vertices = by_name[kind][0][0]
        np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], [np.negative(half), half], atol=2e-3)
    vertices, faces = by_name["mesh"][0]
    assert (vertices.shape, faces.shape) == ((4, 3), (4, 3))
    assert by_name["box"][1]["dimensions"] == (0.2, 0.4, 0.6)


def test_a_geom_s_name_may_have_slashes():
    """Names are paths in viser: `arm/hand` would lie in the frame of the geom `arm`."""
    geoms = '<geom name="arm" size=".1" pos="0 0 1"/><geom name="arm/hand" size=".1"/>'
    added = Recorder()
    scene.add(added, mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>"))
    assert [call.count("/") for call, _, _ in added.calls] == [2, 3, 3]


@pytest.mark.parametrize("mode", ["", 'mode="trackcom"', 'mode="targetbodycom" target="ball"'])
def test_the_camera_front_may_be_in_a_body(mode):
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody><body name="arm" pos="0 0 2"><joint/><geom size=".1"/>
        <camera name="front" pos="1 0 0" fovy="30" {mode}/></body>
        <body name="ball"><geom size=".1"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[:] = 0.5
    mujoco.mj_forward(model, data)
    position, direction, angle = scene.front(model, data.qpos)
    np.testing.assert_allclose(position, data.cam_xpos[0])
    np.testing.assert_allclose(direction, -data.cam_xmat[0].reshape(3, 3)[:, 2])
    assert angle == pytest.approx(np.radians(30))
    assert scene.front(mujoco.MjModel.from_xml_string("<mujoco/>"), np.zeros(0)) is None


class Recorder:
    """A scene of viser's that notes what is added."""

    def __init__(self):
        self.calls = []

    def __getattr__(self, method):
        return lambda name, *args, **options: self.calls.append((name, args, options)) or object()


FIELD = """<mujoco><asset><hfield name="h" nrow="2" ncol="3" size="1 2 4 1" elevation="0 0 1 0 2 0"/></asset>
    <worldbody><geom type="hfield" hfield="h"/></worldbody></mujoco>"""


def test_a_geom_that_cannot_be_drawn_is_named():
    model = mujoco.MjModel.from_xml_string(FIELD)
    model.geom_type[:] = mujoco.mjtGeom.mjGEOM_SDF
    with refuses("mjGEOM_SDF"):
        scene.visible(model)


def test_a_height_field_is_drawn_where_a_ray_meets_it():
    """Each vertex and the middle of each triangle, on which a ray from above ends."""
    model = mujoco.MjModel.from_xml_string(FIELD)
    scene.add(recorder := Recorder(), model)
    ((_, (vertices, faces), _),) = [call for call in recorder.calls if len(call[1]) == 2]
    assert (vertices.shape, faces.shape) == ((6, 3), (4, 3))
    assert vertices.max(0).tolist() == [1, 2, 4]
    corners = vertices[faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()  # seen from above
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for point in [*(0.999 * vertices), *corners.mean(1)]:
        far = mujoco.mj_ray(model, data, [*point[:2], 9.0], [0.0, 0, -1], None, 1, -1, np.zeros(1, np.int32))
        assert 9 - far == pytest.approx(point[2], abs=0.02)


# Critics


def test_a_critic_is_in_a_checkpoint(stopped):
    folder, run = stopped
    value, epoch = sources.load_critic(folder, run, reach())
    assert epoch == 1
    obs = {"observation": np.zeros(10, np.float32), "achieved_goal": np.zeros(3), "desired_goal": np.ones(3, np.float32)}
    assert value(obs, np.zeros(4, np.float32)) != value(obs, np.ones(4, np.float32))
    with refuses("checkpoint", error=FolderError):
        sources.load_critic(bundled.FOLDER / "reach", dataclasses.replace(run), reach())


# What is played


def test_a_run_that_goes_on_is_followed(stopped, tmp_path):
    folder, run = tmp_path / "run", stopped[1]
    shutil.copytree(stopped[0], folder)
    cast = sources.Cast(sources.of_run("mine", folder), reach())
    assert cast.critic == "Critic of epoch 1."
    assert cast.about() == "`reach`, epoch 1: success 0.00 after 100 steps"
    assert not cast.refresh()
    obs = {"observation": np.ones(10), "achieved_goal": np.zeros(3), "desired_goal": np.ones(3)}
    before = cast.act(obs)
    driver.train_runs(reach(), [run], [folder], options=Options(final_episodes=2))
    assert cast.refresh()
    assert not np.array_equal(cast.act(obs), before)
    assert cast.about().startswith("`reach`, trained: success 0.")
    (folder / "policy.npz").write_bytes(b"damaged")
    assert not cast.refresh()
    assert not np.array_equal(cast.act(obs), before)  # what was read last goes on


def test_why_there_is_no_critic_is_told():
    assert sources.Cast(of_package("reach"), reach()).critic == "No critic: bundled policies come without one."
    assert sources.Cast(sources.by_random("reach"), reach()).critic == "Random actions have no critic."


def test_an_environment_has_the_arguments_of_its_run_or_those_given(stopped, tmp_path):
    folder, run = tmp_path / "run", dataclasses.replace(stopped[1], env_kwargs=("episode_length=20", "reward_type=dense"))
    run_folder.write_config(folder, run, "native", {})
    (folder / "policy.npz").write_bytes(b"")
    assert sources.of_run("mine", folder).env_kwargs == run.env_kwargs
    assert sources.of_run("mine", folder, None, ("episode_length=30",)).env_kwargs == ("episode_length=30", "reward_type=dense")
    assert sources.of_run("mine", folder, "push", ("episode_length=30",)).env_kwargs == ("episode_length=30",)


def test_success_is_said_to_be_of_where_it_was_measured():
    """The numbers of a policy are those of its own task, whatever it plays in."""
    own = sources.of_run("push", bundled.FOLDER / "push")
    other = dataclasses.replace(own, env="slide")
    noisy = sources.of_run("push", bundled.FOLDER / "push", None, ("episode_length=20",))
    texts = []
    for source in (own, other, noisy):
        cast = object.__new__(sources.Cast)
        cast.source = source
        texts.append(cast.about().partition(":")[0])
    assert texts == ["`push`, trained", "`slide`, trained in `push`", "`push`, trained with other arguments"]


def test_a_run_named_like_a_bundled_policy_is_not_replaced_by_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(bundled.FOLDER / "reach", "reach")
    cast = sources.Cast(sources.of_run("reach", Path("reach")), reach())
    before = cast.act
    shutil.rmtree("reach")
    assert not cast.refresh()
    assert cast.act is before


def test_a_policy_of_another_environment_is_refused():
    with refuses("push", "reach", 25):
        sources.Cast(sources.of_run("push", bundled.FOLDER / "push", "reach"), reach())


def test_a_run_without_a_policy_is_refused(tmp_path, stopped):
    shutil.copytree(stopped[0], tmp_path / "run")
    (tmp_path / "run" / "policy.npz").unlink()
    with refuses("policy.npz", error=FolderError):
        sources.of_run("mine", tmp_path / "run")
