"""Calls of the host by a name: values, batches, errors, a second process that has compiled nothing."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refuses

from mjx_dher.envs.engines import host_call

ROWS = jnp.arange(12.0).reshape(4, 3)


def double(rows):
    return np.concatenate([2 * rows, rows.sum(-1, keepdims=True)], axis=-1, dtype=np.float32)


def write_double(rows, results):
    results[...] = double(rows)


class Object:
    """Has a method to register."""

    def __init__(self, name, function):
        self._function = function
        host_call.register(name, self.answer)

    def answer(self, rows, results):
        self._function(rows, results)


def test_a_function_is_called_once_for_all_batch_axes():
    seen = []

    def noting(rows, results):
        seen.append(rows.shape)
        write_double(rows, results)

    kept = Object("test_noting", noting)
    call = lambda row: host_call.call("test_noting", (4,), row)  # noqa: E731
    np.testing.assert_array_equal(jax.jit(call)(ROWS[1]), double(np.asarray(ROWS[1])))
    nested = jax.jit(jax.vmap(jax.vmap(call)))(ROWS.reshape(2, 2, 3))
    np.testing.assert_array_equal(nested.reshape(4, 4), double(np.asarray(ROWS)))
    scanned = jax.jit(lambda x: jax.lax.scan(lambda x, _: (call(x)[:3], None), x, length=3)[0])(ROWS[1])
    np.testing.assert_array_equal(scanned, 8 * ROWS[1])
    assert kept._function is noting
    assert seen == [(3,), (2, 2, 3), (3,), (3,), (3,)]


def test_numbers_of_64_bits_are_handed_over_as_32():
    kept = Object("test_bits", write_double)
    with jax.enable_x64(True):
        rows = jnp.asarray(ROWS, jnp.float64)
        assert rows.dtype == jnp.float64
        given = jax.jit(jax.vmap(lambda row: host_call.call("test_bits", (4,), row)))(rows)
    np.testing.assert_array_equal(given, double(np.asarray(ROWS)))
    del kept


def test_programs_for_other_devices_call_the_function_itself(monkeypatch):
    kept = Object("test_elsewhere", write_double)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    call = lambda row: host_call.call("test_elsewhere", (4,), row)  # noqa: E731
    program = jax.jit(jax.vmap(call))
    assert "pure_callback" in str(jax.make_jaxpr(program)(ROWS))
    np.testing.assert_array_equal(program(ROWS), double(np.asarray(ROWS)))
    del kept


def test_a_name_ends_with_the_last_of_its_objects():
    first, second = Object("test_two", write_double), Object("test_two", write_double)
    call = jax.jit(lambda row: host_call.call("test_two", (4,), row))
    expected = np.asarray(call(ROWS[0]))
    del first
    np.testing.assert_array_equal(call(ROWS[0]), expected)
    del second
    with refuses("simulator", "exists", error=(jax.errors.JaxRuntimeError, ValueError)):
        jax.block_until_ready(call(ROWS[0]))
    kept = Object("test_three", write_double)
    assert "test_two" not in host_call._methods
    assert "test_three" in host_call._methods
    del kept


def test_an_error_ends_the_program_with_its_message():
    cases = [
        (lambda rows, results: 1 / 0, "ZeroDivisionError"),
        (lambda rows, results: np.copyto(results, rows[:2]), "(2,)"),
    ]
    call = jax.jit(lambda row: host_call.call("test_error", (4,), row))
    for function, message in cases:
        kept = Object("test_error", function)
        with refuses(message, error=(jax.errors.JaxRuntimeError, ValueError)):
            jax.block_until_ready(call(ROWS[0]))
        del kept


PROGRAM = """
import sys
import jax
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
from mjx_dher import envs
from mjx_dher.rollout import rollout
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))
env = envs.make("reach", engine="native", num_threads=1)
play = jax.jit(lambda key, a: rollout(env, lambda a, obs: a, key, 2, a))
_, outcome = play(jax.random.key(0), jax.numpy.zeros((50, 2, 4)))
print(outcome.rewards.sum() if hasattr(outcome, "rewards") else outcome[0].sum())
print(hits.count("/jax/compilation_cache/cache_hits"))
"""


@pytest.mark.slow  # two processes
def test_a_program_with_native_physics_is_kept_for_the_next_process(tmp_path):
    results = []
    for _ in range(2):
        ran = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(tmp_path)], capture_output=True, text=True, check=True, timeout=300
        )
        results.append(ran.stdout.split())
    (first, none), (second, hits) = results
    assert first == second
    assert int(hits) > int(none)
    assert list(tmp_path.glob("jit__lambda*"))


ENDS = """
import jax
from mjx_dher import envs
env = envs.make("reach", engine="native", num_threads=1)
still = jax.numpy.zeros((8, 4))
play = jax.jit(lambda state: jax.lax.fori_loop(0, 20_000, lambda i, state: jax.vmap(env.step)(state, still), state))
states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 8))
{} = play(states)
{}
print("end")
"""


@pytest.mark.parametrize("drop", ["", pytest.param("del out", marks=pytest.mark.slow)])
def test_python_ends_in_order_while_a_program_simulates(drop):
    ran = subprocess.run(
        [sys.executable, "-c", ENDS.format("out", drop)], capture_output=True, text=True, timeout=120, check=False
    )
    assert (ran.returncode, ran.stdout.strip()) == (0, "end"), ran.stderr
