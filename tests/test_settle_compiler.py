"""The compiler's setting for MJX on a CPU."""

import os

import pytest

from mjx_dher.cli.common import settle_compiler

ADDED = "--xla_cpu_enable_concurrency_optimized_scheduler=false"


@pytest.mark.parametrize(
    ("engine", "before", "after"),
    [
        ("native", "", ""),
        ("jax", "", ADDED),
        ("jax", "--xla_a=1", f"--xla_a=1 {ADDED}"),
        (
            "jax",
            "--xla_cpu_enable_concurrency_optimized_scheduler=true",
            "--xla_cpu_enable_concurrency_optimized_scheduler=true",
        ),
    ],
)
def test_only_programs_of_mjx_are_ordered_otherwise_and_the_user_s_word_counts(engine, before, after, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", before)
    settle_compiler(engine)
    assert os.environ["XLA_FLAGS"] == after
