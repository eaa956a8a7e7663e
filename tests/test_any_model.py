"""Engines on models that have nothing of a Fetch robot: an arm with joint servos, activations, several mocap bodies, none."""

import dataclasses
import importlib
import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import EXAMPLES, ROOT, names, refuses
from engine_models import BODY, MODELS, SUBSTEPS, arm, play, start

from mjx_dher import cli
from mjx_dher.envs import Simulator
from mjx_dher.envs.engines import graph, make_engine, pairs
from mjx_dher.envs.engines import mjx as mjx_engine
from mjx_dher.envs.engines.fused import simulation


@pytest.mark.parametrize("name", MODELS)
def test_native_is_a_loop_over_mj_step_for_any_model(name):
    """To the bit, in a batch, and again from the same start."""
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    engine = make_engine("native", model, SUBSTEPS, num_threads=2)
    first, controls = start(model, (3,))
    played = jax.jit(jax.vmap(lambda *given: play(engine, *given)))
    seen = played(first, controls)
    for again, once in zip(jax.tree.leaves(played(first, controls)), jax.tree.leaves(seen), strict=True):
        np.testing.assert_array_equal(again, once)
    for i in range(3):
        data = mujoco.MjData(model)
        data.qpos[:] = first.qpos[i]
        for t in range(8):
            data.ctrl[:], mocap = controls.ctrl[i, t], controls.mocap[i, t]
            data.mocap_pos[:], data.mocap_quat[:] = mocap[:, :3], mocap[:, 3:]
            for _ in range(SUBSTEPS):
                mujoco.mj_step(model, data)
            for field, name in (("qpos", "qpos"), ("qvel", "qvel"), ("act", "act"), ("warmstart", "qacc_warmstart")):
                value = getattr(data, name)
                np.testing.assert_array_equal(getattr(seen, field)[i, t], np.float32(value), err_msg=field)
                value[:] = np.float32(value)  # as between the steps of an engine


CLOSE = 2e-4  # m and rad, after 8 steps of 10 timesteps


@pytest.mark.parametrize(
    "name", [name if name.startswith("nothing") else pytest.param(name, marks=pytest.mark.slow) for name in MODELS]
)
def test_mujoco_warp_in_a_graph_follows_native_on_any_model(name):
    """On a CPU without the graph: the same kernels on the same memory, compiled for another device."""
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    first, controls = start(model, (3,))
    warp = make_engine("warp", model, SUBSTEPS, path="graph", allow_cpu=True)
    assert warp.path == "graph"
    native = make_engine("native", model, SUBSTEPS)
    played = jax.jit(jax.vmap(lambda *given: play(warp, *given)))
    here, there = played(first, controls), jax.jit(jax.vmap(lambda *given: play(native, *given)))(first, controls)
    np.testing.assert_allclose(here.qpos, there.qpos, atol=2 * CLOSE)
    np.testing.assert_allclose(here.act, there.act, atol=1e-5)
    for again, once in zip(jax.tree.leaves(played(first, controls)), jax.tree.leaves(here), strict=True):
        np.testing.assert_array_equal(again, once)  # nothing is left in memory from the steps before
    warp.check()


@pytest.mark.slow  # kernels compile for minutes
def test_contacts_without_memory_are_reported_by_the_graph():
    model = mujoco.MjModel.from_xml_string(arm())
    engine = make_engine("warp", model, SUBSTEPS, path="graph", contacts=1, constraints=2, allow_cpu=True)
    first, controls = start(model, (3,))
    jax.block_until_ready(jax.jit(jax.vmap(engine.advance))(first, jax.tree.map(lambda x: x[:, 0], controls)))
    with refuses("contacts=1", "constraints=2"):
        engine.check()
    engine.check()  # told once


def test_the_path_of_warp_and_its_memory_follow_from_the_model(monkeypatch):
    model = mujoco.MjModel.from_xml_string(MODELS["activations, implicitfast"])
    engine = make_engine("warp", model, SUBSTEPS, allow_cpu=True)
    assert engine.path == "graph"
    assert "activations" in engine.note
    with refuses("path", "grahp", "graph"):
        make_engine("warp", model, SUBSTEPS, path="grahp", allow_cpu=True)
    with refuses("fused", "activations"):
        make_engine("warp", model, SUBSTEPS, path="fused", allow_cpu=True)
    monkeypatch.setattr(simulation, "shared_memory", lambda: 1000)
    small = make_engine("warp", mujoco.MjModel.from_xml_string(arm()), SUBSTEPS, allow_cpu=True)
    assert small.path == "graph"
    names(small.note, "1,000", "bytes")
    # The cube's four corners on the floor; 4 of 4 rows, 12 joints' friction and 5 limits with two sides.
    assert pairs.most(mujoco.MjModel.from_xml_string(arm())) == (4, 4 * 4 + 12 + 2 * 5)
    crowd = "".join(BODY.format(i, f"b{i}") for i in range(8))
    crowded = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{crowd}</worldbody></mujoco>")
    assert pairs.most(crowded)[0] == 28 * 8
    assert graph.memory_for(crowded) == (graph._FEW_CONTACTS, graph._FEW_ROWS)
    assert len(pairs.meeting(crowded)) == 28


@pytest.mark.parametrize(
    "name",
    [
        name if name.startswith("nothing") else pytest.param(name, marks=pytest.mark.slow)
        for name in MODELS
        if name != "fingers"  # noslip
    ],
)
def test_jax_follows_native_on_any_model(name):
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    first, controls = start(model)
    mjx, native = (make_engine(engine, model, SUBSTEPS) for engine in ("jax", "native"))
    here, there = (jax.jit(lambda *x, engine=engine: play(engine, *x))(first, controls) for engine in (mjx, native))
    assert np.ptp(there.qpos, axis=0).max() > 0.01
    np.testing.assert_allclose(here.qpos, there.qpos, atol=CLOSE)
    np.testing.assert_allclose(here.act, there.act, atol=1e-5)


def test_what_an_engine_cannot_do_is_rejected_when_it_is_made():
    delayed = '<sensor><jointpos joint="a" nsample="4" delay="0.006"/></sensor></mujoco>'
    model = mujoco.MjModel.from_xml_string(MODELS["activations, implicitfast"].replace("</mujoco>", delayed))
    for engine in ("native", "jax"):
        with pytest.raises(ValueError, match=r"delays.*Simulator"):
            make_engine(engine, model, SUBSTEPS)
    asleep = mujoco.MjModel.from_xml_string(f'<mujoco><option><flag sleep="enable"/></option>{MODELS["arm"][9:]}')
    for engine in ("native", "jax", "warp"):
        with refuses("sleeping", "sleep"):
            make_engine(engine, asleep, SUBSTEPS)
    with pytest.raises(ValueError, match="delays"):
        Simulator(model).advance(*start(model))
    cylinder = arm().replace('type="box" size=".02 .02 .04"', 'type="cylinder" size=".02 .04" contype="1"')
    with pytest.raises(ValueError, match=r"engine jax: MJX .*CYLINDER.*; .*<pair>.*NAME_stand_in.*use engine native"):
        make_engine("jax", mujoco.MjModel.from_xml_string(cylinder), SUBSTEPS)


def test_what_mjx_ignores_is_rejected_with_the_element():
    for name in mjx_engine._IGNORED:
        model = mujoco.MjModel.from_xml_string(arm())
        holder, field = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
        if np.ndim(getattr(holder, field)):
            getattr(holder, field)[:1] = 1
        else:
            setattr(holder, field, 1)
        if np.size(getattr(holder, field)):  # it has no tendons and no pairs
            with pytest.raises(ValueError, match=r"engine jax.*; use engine native"):
                make_engine("jax", model, SUBSTEPS)
    model.actuator_armature[1] = 1
    with refuses("engine", "jax", "actuator_armature", "actuator 1"):
        make_engine("jax", model, SUBSTEPS)


@pytest.mark.parametrize("is_chain", [pytest.param(True, marks=pytest.mark.slow), False])
def test_mjx_has_inertia_of_tendons_along_one_chain_only(is_chain):
    body = '<body pos="0 0 {}"><joint name="{}" axis="0 1 0"/><geom size=".05" mass="1" pos=".1 0 0" contype="0"/>'
    first, second = body.format(1, "a"), body.format(0.2, "b")
    bodies = f"{first}{second}</body></body>" if is_chain else f"{first}</body>{second}</body>"
    joints = '<joint joint="b" coef=".5"/><joint joint="a" coef=".5"/>'
    tendon = f'<tendon><fixed name="both" armature="0.3">{joints}</fixed></tendon><actuator><motor joint="a"/></actuator>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody>{tendon}</mujoco>")
    if not is_chain:
        with refuses("engine jax", "armature", "both"):
            make_engine("jax", model, SUBSTEPS)
        return
    physics, controls = start(model)
    controls = jax.tree.map(lambda x: x[0] + 1, controls)
    here, there = (jax.jit(make_engine(engine, model, SUBSTEPS).advance)(physics, controls) for engine in ("jax", "native"))
    np.testing.assert_allclose(here.qvel, there.qvel, atol=1e-5)


def test_arrays_of_another_shape_are_rejected():
    model = mujoco.MjModel.from_xml_string(MODELS["nothing but a ball"])
    physics, controls = start(model)
    controls = jax.tree.map(lambda x: x[0], controls)
    for engine in ("native", "jax"):
        advance = make_engine(engine, model, SUBSTEPS).advance
        for field in ("qpos", "act", "ctrl", "mocap"):
            wrong = [dataclasses.replace(x, **{field: jnp.ones(5)}) if hasattr(x, field) else x for x in (physics, controls)]
            with pytest.raises(ValueError, match=rf"{field} has shape \[5\]; the model's is"):
                advance(*wrong)


class Own:
    """As much of a task as has a model."""

    action_size, episode_length = 6, 5
    reset = step = compute_reward = None

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(arm().replace("<worldbody>", '<option integrator="RK4"/><worldbody>'))


def test_the_command_engines_says_what_takes_a_model_and_what_helps(capsys):
    assert cli.main(["engines", "push", "--json"]) == 0
    verdicts = {each["engine"]: each for each in json.loads(capsys.readouterr().out)}
    assert [each["supported"] for each in verdicts.values()] == [True] * 4
    assert cli.main(["engines", "test_any_model:Own", "--json"]) == 0
    verdicts = {each["engine"]: each for each in json.loads(capsys.readouterr().out)}
    assert [name for name, each in verdicts.items() if not each["supported"]] == ["warp fused"]
    assert "integrator" in verdicts["warp fused"]["reason"]
    assert "Euler" in verdicts["warp fused"]["cure"]
    assert cli.main(["engines", "push"]) == 0
    assert "warp graph" in capsys.readouterr().out
    assert cli.main(["engines", "point_mass:PointMass"]) == 2
    names(capsys.readouterr().err, "point_mass:PointMass", "model")


def test_too_little_memory_of_a_gpu_is_reported_with_a_cure(monkeypatch):
    engine = make_engine("warp", mujoco.MjModel.from_xml_string(MODELS["nothing but a ball"]), SUBSTEPS, allow_cpu=True)
    for message, kind in (("Failed to allocate 9 bytes on device 'cuda:0'", MemoryError), ("another", RuntimeError)):

        def made(num_envs, message=message):
            raise RuntimeError(message)

        monkeypatch.setattr(engine, "_made", made)
        with refuses(*(["4096", "num_envs", message] if kind is MemoryError else [message]), error=kind):
            engine._simulation("cpu", 4096)


def test_the_benchmark_of_third_party_models_compares_with_mj_step(monkeypatch, capsys):
    monkeypatch.syspath_prepend(ROOT / "bench")
    third_party = importlib.import_module("third_party")
    monkeypatch.setattr("sys.argv", ["third_party.py", f"arm={EXAMPLES / 'arm.xml'}", "--engines", "native", "warp"])
    third_party.main()
    (row,) = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| arm")]
    assert int(row[2]) == 12
    assert 0 <= float(row[3]) < 1e-3
    assert "no: engine warp needs" in row[4]


def test_both_other_engines_reject_limits_within_their_margin():
    body = '<body><joint name="j" range="-6 6" limited="true" margin="{}"/><geom size="1"/></body>'
    texts = (f"<mujoco><worldbody>{body.format(margin)}</worldbody></mujoco>" for margin in (0.2, 0.02))
    near, apart = map(mujoco.MjModel.from_xml_string, texts)
    told = "limits nearer to each other than twice their margin ('j')"
    assert graph.unsupported(near) == [*mjx_engine._ignored(near, False)] == [told]
    assert graph.unsupported(apart) == [*mjx_engine._ignored(apart, False)] == []
