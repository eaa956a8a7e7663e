"""mjx-dher: goal-conditioned robot manipulation with Hindsight Experience Replay, compiled whole.

Importing this package loads neither JAX nor MuJoCo; each name below loads what it needs when it is first used.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# In a checkout that was not installed, the environments lie beside this package, not in it.
_checkout = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
if not os.path.isdir(os.path.join(_checkout, "mjx_dher", "envs")) and os.path.isfile(
    os.path.join(_checkout, "envs", "fetch.py")
):
    __path__.append(_checkout)

if TYPE_CHECKING:
    from mjx_dher import config, ddpg, envs, normalizer, relabel, replay, rollout, samplers, stats, testing, trainer
    from mjx_dher.config import Config, HParams, preset
    from mjx_dher.policy import Policy, load_policy
    from mjx_dher.trainer import TrainState, make_train, train

__all__ = [
    "Config",
    "HParams",
    "Policy",
    "TrainState",
    "config",
    "ddpg",
    "envs",
    "load_policy",
    "make_train",
    "normalizer",
    "preset",
    "relabel",
    "replay",
    "rollout",
    "samplers",
    "stats",
    "testing",
    "train",
    "trainer",
]

_HOME = {
    "Config": "config",
    "HParams": "config",
    "preset": "config",
    "Policy": "policy",
    "load_policy": "policy",
    "TrainState": "trainer",
    "make_train": "trainer",
    "train": "trainer",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"mjx_dher.{_HOME[name]}"), name)
    if name in __all__:
        return importlib.import_module(f"mjx_dher.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
