"""Goal-conditioned robot manipulation with Hindsight Experience Replay, compiled as one JAX program.

Importing this package loads neither JAX nor MuJoCo. Each name below loads its module on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:  # for type checkers; `_HOME` says the same when the program runs
    from mjx_dher import config as config
    from mjx_dher import envs as envs
    from mjx_dher import learners as learners
    from mjx_dher import normalizer as normalizer
    from mjx_dher import presets as presets
    from mjx_dher import priorities as priorities
    from mjx_dher import relabel as relabel
    from mjx_dher import replay as replay
    from mjx_dher import rollout as rollout
    from mjx_dher import samplers as samplers
    from mjx_dher import stats as stats
    from mjx_dher import testing as testing
    from mjx_dher import trainer as trainer
    from mjx_dher.config import Config as Config
    from mjx_dher.config import HParams as HParams
    from mjx_dher.learners import ddpg as ddpg
    from mjx_dher.policy import Policy as Policy
    from mjx_dher.policy.load import load_policy as load_policy
    from mjx_dher.presets import preset as preset
    from mjx_dher.runs.driver import train_runs as train_runs
    from mjx_dher.runs.loop import train as train
    from mjx_dher.spec import Options as Options
    from mjx_dher.spec import RunSpec as RunSpec
    from mjx_dher.trainer import TrainState as TrainState
    from mjx_dher.trainer import make_train as make_train

_MODULES = "config envs learners normalizer presets priorities relabel replay rollout samplers stats testing trainer"
_HOME = {
    **{name: name for name in _MODULES.split()},
    "Config": "config:Config",
    "HParams": "config:HParams",
    "Options": "spec:Options",
    "Policy": "policy:Policy",
    "RunSpec": "spec:RunSpec",
    "TrainState": "trainer:TrainState",
    "ddpg": "learners.ddpg",
    "load_policy": "policy.load:load_policy",
    "make_train": "trainer:make_train",
    "preset": "presets:preset",
    "train": "runs.loop:train",
    "train_runs": "runs.driver:train_runs",
}
__all__ = [*_HOME]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    value = importlib.import_module(f"mjx_dher.{module}")
    return getattr(value, attribute) if attribute else value


def __dir__() -> list[str]:
    return sorted(__all__)
