"""Conformance tests: `check_env` for environments, and one for every other part of one's own.

In a test:

    from mjx_dher.testing import check_env, check_sampler

    check_env(MyTask())
    check_sampler(my_sampler, MyTask())
"""

from mjx_dher.testing.env import EnvError, check_env
from mjx_dher.testing.learner import check_learner
from mjx_dher.testing.methods import check_generator
from mjx_dher.testing.parts import (
    PartError,
    check_kernel,
    check_metric,
    check_normalization,
    check_parts,
    check_priority,
    check_sampler,
)

__all__ = [
    "EnvError",
    "PartError",
    "check_env",
    "check_generator",
    "check_kernel",
    "check_learner",
    "check_metric",
    "check_normalization",
    "check_parts",
    "check_priority",
    "check_sampler",
]
