"""Conformance tests for custom components, one function per kind.

In a test:

    from mjx_dher.testing import check_env, check_sampler

    check_env(MyTask())
    check_sampler(my_sampler, MyTask())
"""

from mjx_dher.testing.components import (
    check_components,
    check_generator,
    check_kernel,
    check_metric,
    check_normalization,
    check_priority,
    check_sampler,
)
from mjx_dher.testing.env import check_env
from mjx_dher.testing.learner import check_learner
from mjx_dher.testing.trial import ComponentError

__all__ = [
    "ComponentError",
    "check_components",
    "check_env",
    "check_generator",
    "check_kernel",
    "check_learner",
    "check_metric",
    "check_normalization",
    "check_priority",
    "check_sampler",
]
