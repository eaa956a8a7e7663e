"""The critic of a run, from its newest checkpoint. A finished run has none, because its checkpoints are deleted."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.runs.folder import checkpoint
from mjx_dher.runs.program import loop, program
from mjx_dher.spec import RunSpec
from mjx_dher.system.files import FolderError
from mjx_dher.types import Env


class Critic(NamedTuple):
    """Value function of a run's critic, and its age."""

    value: Callable[[Mapping[str, Any], Any], float]  # observation of one state, action [A] -> expected return
    epoch: int  # epochs that had ended


def load(folder: Path, run: RunSpec, env: Env) -> Critic:
    """Critic in the newest checkpoint of a run that was trained alone. Raises FolderError if no checkpoint is usable, or the
    run's learner has no `value`.
    """
    run = dataclasses.replace(run, demonstrations=None)  # the checkpoint's ring holds them
    train = program.make_loop(env, run, program.choices_of([run]))
    learner: Any = train.learner
    if not callable(getattr(learner, "value", None)):
        raise FolderError(f"learner {run.learner!r} has no method value")
    restored = checkpoint.restore(folder, loop.state_template(train))
    state = restored.state.learner

    @jax.jit
    def value(state: Any, obs: Any, action: Any) -> Any:
        return learner.value(state, obs, action, run.hparams)

    def expect(obs: Mapping[str, Any], action: Any) -> float:
        return float(np.asarray(value(state, dict(obs), jnp.asarray(action))))

    return Critic(expect, restored.epoch)
