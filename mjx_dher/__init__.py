"""mjx-dher: goal-conditioned robot manipulation with Hindsight Experience Replay, compiled whole.

Importing this package loads neither JAX nor MuJoCo; each name below loads what it needs when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from mjx_dher import (
        config,
        envs,
        generators,
        learners,
        normalizer,
        presets,
        priorities,
        relabel,
        replay,
        rollout,
        samplers,
        stats,
        testing,
        trainer,
    )
    from mjx_dher.config import Config, HParams
    from mjx_dher.learners import ddpg
    from mjx_dher.policy import Policy
    from mjx_dher.policy.load import load_policy
    from mjx_dher.presets import preset
    from mjx_dher.runs.driver import train_runs
    from mjx_dher.runs.options import Options
    from mjx_dher.runs.program.loop import train
    from mjx_dher.spec import RunSpec
    from mjx_dher.trainer import TrainState, make_train

__all__ = [
    "Config",
    "HParams",
    "Options",
    "Policy",
    "RunSpec",
    "TrainState",
    "config",
    "ddpg",
    "envs",
    "generators",
    "learners",
    "load_policy",
    "make_train",
    "normalizer",
    "preset",
    "presets",
    "priorities",
    "relabel",
    "replay",
    "rollout",
    "samplers",
    "stats",
    "testing",
    "train",
    "train_runs",
    "trainer",
]

# Names that are no modules of this package's own, and where each one is.
_HOME = {
    "Config": "config",
    "HParams": "config",
    "Options": "runs.options",
    "Policy": "policy",
    "RunSpec": "spec",
    "TrainState": "trainer",
    "ddpg": "learners.ddpg",
    "load_policy": "policy.load",
    "make_train": "trainer",
    "preset": "presets",
    "train": "runs.program.loop",
    "train_runs": "runs.driver",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        module = importlib.import_module(f"mjx_dher.{_HOME[name]}")
        return module if module.__name__.endswith(f".{name}") else getattr(module, name)
    if name in __all__:
        return importlib.import_module(f"mjx_dher.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
