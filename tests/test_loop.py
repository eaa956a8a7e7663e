"""How the compiler is asked."""

import types

import jax
import pytest

from mjx_dher import Config, HParams, make_train
from mjx_dher.runs import loop
from probes import PointMass


@pytest.mark.parametrize(
    ("backend", "flags", "updates", "triton"),
    [
        ("cpu", "", 10**6, None),
        ("gpu", "", 499_999, False),
        ("gpu", "", 500_000, True),
        ("gpu", "--xla_gpu_enable_triton_gemm=x", 1, None),
    ],
)
def test_the_compiler_searches_for_fast_products_only_where_many_updates_follow(backend, flags, updates, triton, monkeypatch):
    asked = []

    class Compiled:
        def memory_analysis(self):
            return None

    class Lowered:
        def compile(self, compiler_options):
            asked.append(compiler_options.get("xla_gpu_enable_triton_gemm"))
            return Compiled()

    program = make_train(PointMass(), Config())
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(loop.jax, "jit", lambda f, **options: types.SimpleNamespace(lower=lambda *args: Lowered()))
    monkeypatch.setenv("XLA_FLAGS", flags)
    loop.compile_program(program, jax.random.key(0), HParams(), updates)
    init = None if triton is None else False
    assert sorted(asked, key=str) == sorted([init, triton], key=str)  # of init, and of the epoch


@pytest.mark.parametrize(("backend", "level"), [("cpu", 0), ("gpu", None)])
def test_a_plain_program_is_not_optimized_on_a_cpu(backend, level, monkeypatch):
    asked = []
    lowered = types.SimpleNamespace(compile=lambda compiler_options: asked.append(compiler_options))
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    loop.compile_lowered(lowered, plain=True)
    loop.compile_lowered(lowered)
    assert [options.get("xla_backend_optimization_level") for options in asked] == [level, None]


@pytest.mark.parametrize(
    ("backend", "flags", "expected"),
    [("cpu", "", "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"), ("cpu", f"--{loop._YNN}=", None), ("gpu", "", None)],
)
def test_on_a_cpu_matrix_products_alone_are_handed_over_unless_the_user_says_otherwise(backend, flags, expected, monkeypatch):
    asked = []
    lowered = types.SimpleNamespace(compile=lambda compiler_options: asked.append(compiler_options))
    known = {loop._YNN: loop._PRODUCTS}
    assert jax.jit(lambda x: x + 1).lower(1.0).compile(compiler_options=known)(1.0) == 2.0
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setenv("XLA_FLAGS", flags)
    loop.compile_lowered(lowered)
    assert [options.get(loop._YNN) for options in asked] == [expected]


def test_an_option_that_the_compiler_does_not_have_is_left_out(monkeypatch):
    monkeypatch.setattr(loop, "_YNN", "xla_cpu_no_such_option")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    assert loop.compile_lowered(jax.jit(lambda x: x + 1).lower(1.0))(1.0) == 2.0


def test_the_options_of_a_plain_program_are_known_to_the_compiler():
    compiled = loop.compile_lowered(jax.jit(lambda x: x + 1).lower(1.0), plain=True)
    assert compiled(1.0) == 2.0
