"""Each function of `private_api` is still needed: a test that fails says which one to delete."""

import importlib.metadata
import importlib.util
import inspect
import re
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import ROOT
from mujoco import mjx
from mujoco.mjx._src import derivative

from mjx_dher.system import private_api
from mjx_dher.system.warp_setup import wp


def no_longer_needed(what, name):
    return f"no longer needed: {what}; delete private_api.{name}"


def test_importing_it_imports_no_library():
    code = (
        "import sys; from mjx_dher.system import private_api;"
        "print({'jax', 'mujoco', 'warp', 'orbax', 'numpy'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert (run.stdout, run.stderr) == ("set()\n", "")


def test_every_function_says_why_and_since_when():
    functions = [
        f for _, f in inspect.getmembers(private_api, callable) if getattr(f, "__module__", "") == private_api.__name__
    ]
    for function in functions:
        doc = inspect.getdoc(function)
        assert re.search(
            r"\nPrivate: .*\nWhy: .*\nNeeded by: (mujoco|mujoco-mjx|warp-lang|orbax-checkpoint|viser) \d", doc, re.S
        )
        assert "https://github.com/" in doc or "No upstream issue known" in doc


def test_mujoco_still_chooses_how_to_draw_when_it_is_imported(monkeypatch):
    contexts = sys.modules[mujoco.Renderer.__module__].gl_context
    before = contexts.GLContext
    monkeypatch.setenv("MUJOCO_GL", "egl" if before.__module__ != "mujoco.egl" else "glfw")
    assert contexts.GLContext is before, no_longer_needed("MuJoCo reads MUJOCO_GL when it draws", "drawing_with")
    with private_api.drawing_with("glfw"):
        assert contexts.GLContext.__module__ == "mujoco.glfw"
    assert contexts.GLContext is before


def chain(length):
    link = '<body pos="0 0 .1"><joint axis="0 1 0"/><geom size=".1"/>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{link * length}{'</body>' * length}</worldbody></mujoco>")


@pytest.mark.slow
def test_xla_still_repeats_the_ancestors_of_a_body():
    model = mjx.put_model(chain(5), impl="jax")
    data = mjx.make_data(model, impl="jax")
    angles = jnp.zeros((16, 5))

    def kinematics(qpos):
        return mjx.kinematics(model, data.replace(qpos=qpos)).xpos

    def seconds(compiled):
        times = []
        for _ in range(20):
            start = time.perf_counter()
            compiled(angles).block_until_ready()
            times.append(time.perf_counter() - start)
        return min(times)

    emitters = {"xla_cpu_use_fusion_emitters": True}  # off by default on an AMD EPYC
    plain = jax.jit(jax.vmap(kinematics)).lower(angles).compile(emitters)
    with private_api.bodies_computed_once():
        once = jax.jit(jax.vmap(lambda qpos: kinematics(qpos))).lower(angles).compile(emitters)
    np.testing.assert_allclose(plain(angles), once(angles), atol=1e-6)
    what = "MJX's kinematics are as fast without barriers"  # measured: 30 times slower, and 20 for each further body
    assert seconds(plain) > 5 * seconds(once), no_longer_needed(what, "bodies_computed_once")


WELDED = """
<mujoco><worldbody><body mocap="true" name="hand"/>
<body><joint axis="0 1 0"/><geom size=".1" pos=".5 0 0"/>
<body pos="1 0 0" name="tip"><joint axis="0 0 1"/><geom size=".1" pos=".2 0 0"/></body></body></worldbody>
<equality><weld body1="hand" body2="tip" relpose="0 0 0 1 0 0 0"/></equality></mujoco>
"""


def test_mjx_still_drops_the_velocity_term_of_a_weld():
    model = mujoco.MjModel.from_xml_string(WELDED)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0.3, -0.2], [1.0, 2.0]
    mujoco.mj_forward(model, data)
    m = mjx.put_model(model, impl="jax")
    d = mjx.make_data(model, impl="jax").replace(qpos=jnp.array(data.qpos), qvel=jnp.array(data.qvel))
    d = jax.jit(lambda d: mjx.fwd_velocity(m, mjx.fwd_position(m, d)))(d)
    difference = np.asarray(d._impl.efc_aref)[:6] - data.efc_aref[:6]
    what = "MJX's reference acceleration of a weld is MuJoCo's"
    assert np.abs(difference).max() > 0.1, no_longer_needed(
        what, "shift_reference_acceleration, and engines.corrections.Equality"
    )
    shifted = private_api.shift_reference_acceleration(d, -difference)
    np.testing.assert_allclose(shifted._impl.efc_aref[:6], data.efc_aref[:6], rtol=1e-5)
    np.testing.assert_array_equal(shifted._impl.efc_aref[6:], d._impl.efc_aref[6:])


def test_mjx_still_couples_branches_by_a_damped_tendon():
    body = '<body><joint name="{0}" type="slide"/><geom size=".1"/></body>'
    tendon = '<tendon><fixed damping="5"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>'
    xml = f"<mujoco><worldbody>{body.format('a')}{body.format('b')}</worldbody>{tendon}</mujoco>"
    model = mjx.put_model(mujoco.MjModel.from_xml_string(xml), impl="jax")
    full = jax.jit(lambda: derivative.deriv_smooth_vel(model, mjx.forward(model, mjx.make_data(model, impl="jax"))))()
    what = "MJX leaves out derivatives between branches"
    assert full[0, 1] == -5.0, no_longer_needed(what, "mask_of_velocity_derivative, and engines.corrections._in_common")


def test_mjx_still_brings_a_mujoco_warp_of_its_own():
    required = importlib.metadata.requires("mujoco-mjx") or []
    assert not any(re.match(r"mujoco[-_]warp\b", line) for line in required), no_longer_needed(
        "MJX depends on the package mujoco-warp", "mujoco_warp_shapes, which that package has"
    )


def test_the_shapes_of_mujoco_warp_are_still_private():
    shapes = vars(private_api.mujoco_warp_shapes())
    from mujoco.mjx.third_party import mujoco_warp as library

    exported = [name for name in shapes if hasattr(library, name)]
    assert not exported, no_longer_needed(f"MuJoCo Warp exports {exported}", "mujoco_warp_shapes' fields of these names")


def test_warp_still_writes_the_number_of_a_trace_into_the_program():
    def double(x: wp.array(dtype=float), y: wp.array(dtype=float)):
        wp.copy(y, x)

    call = wp.jax_callable(double, num_outputs=1, module_preload_mode=wp.JaxModulePreloadMode.NONE)

    def program():
        return jax.jit(lambda x: call(x)).lower(jnp.zeros(3)).as_text()

    first, second = program(), program()
    assert first != second, no_longer_needed("Warp's programs are the same at every trace", "reset_call_id")
    private_api.reset_call_id(call)
    assert program() == first


def test_orbax_still_has_its_older_interface_only():
    """Outside of `experimental`."""
    name = "array_checkpointer: read the arrays by orbax.checkpoint.v1"
    assert importlib.util.find_spec("orbax.checkpoint.v1") is None, no_longer_needed("orbax's new interface is stable", name)


def test_viser_still_serves_whoever_calls():
    viser = pytest.importorskip("viser")
    options = set(inspect.signature(viser.ViserServer.__init__).parameters)
    assert not options & {"origins", "process_request", "max_clients", "create_connection"}, no_longer_needed(
        "an option of ViserServer", "viser_served_with"
    )


def test_viser_still_names_controls_in_private_alone():
    handles = pytest.importorskip("viser")._gui_handles
    assert not hasattr(handles.GuiInputHandle, "uuid"), no_longer_needed("a public uuid", "viser_control_id")
