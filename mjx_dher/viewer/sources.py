"""Policies for the viewer: of run folders, which may still be training, bundled ones, and random actions."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.components import robot
from mjx_dher.policy import bundled, load
from mjx_dher.runs import loop, program
from mjx_dher.runs.folder import reading, restoring, results, run_folder
from mjx_dher.spec import RunSpec, to_arguments, to_texts
from mjx_dher.system.files import FolderError
from mjx_dher.types import Env
from mjx_dher.viewer.player import Act, Value

RANDOM = "random actions"


@dataclasses.dataclass(frozen=True)
class Source:
    """A named policy and its environment."""

    label: str
    env: str
    folder: Path | None = None  # run folder; None for random actions
    run: RunSpec | None = None
    env_kwargs: tuple[str, ...] = ()  # arguments of the environment as NAME=VALUE

    @property
    def place(self) -> tuple[str, tuple[str, ...]]:
        return self.env, self.env_kwargs


def of_run(label: str, folder: Path, env: str | None = None, env_kwargs: Sequence[str] = ()) -> Source:
    """Source of a run's policy, which must exist, in its own environment or in `env`. `env_kwargs` override the run's.

    Raises FolderError if it is not a run folder, or has no policy, and ValueError if the policy is of another Shadow-hand task,
    whose observations and goals have the same sizes.
    """
    run = reading.read_spec(folder)
    if env not in (None, run.env) and "hand" == robot(env) == robot(run.env):
        raise ValueError(f"{label} is a policy of {run.env} and cannot be played in {env}, which looks alike")
    load.policy_file(folder)
    arguments = {**(run.env_arguments if env is None else {}), **to_arguments(env_kwargs)}
    return Source(label, env or run.env, folder.absolute(), run, to_texts(arguments))


def of_package() -> list[Source]:
    """Sources of the bundled policies."""
    return [of_run(name, bundled.FOLDER / name) for name in bundled.names()]


def by_random(env: str, env_kwargs: Sequence[str] = ()) -> Source:
    """Source of uniformly random actions in an environment."""
    return Source(f"{RANDOM}, {env}", env, env_kwargs=to_texts(to_arguments(env_kwargs)))


class Cast:
    """Policy of a source and its critic, if any, in an environment. Follows a run that is still training. Raises ValueError if
    the policy cannot be read, or does not fit the environment.
    """

    def __init__(self, source: Source, env: Any):
        self.source, self._env = source, env
        self.value: Value | None = None
        self.act: Act = _random(env.action_size)
        self.critic = "Random actions have no critic."
        self._seen: tuple[int, ...] = ()
        self._critic_seen: Path | None = None
        if source.folder is not None:
            self.critic = "No critic: it is in a run's checkpoints, and this run has none (--keep-end keeps the last one)."
            if bundled.is_shipped(source.folder):
                self.critic = "No critic: bundled policies come without one."
            self._load()
            self._load_critic()

    def refresh(self) -> bool:
        """Loads a newer policy. Returns False if there is none."""
        if self.source.folder is None or self._stamp() == self._seen:
            return False
        try:
            self._load()
        except ValueError:  # removed or damaged since it was read; the old one continues
            self._seen = self._stamp()
            return False
        self._load_critic()
        return True

    def about(self) -> str:
        """Progress of the run, as Markdown."""
        folder, text = self.source.folder, f"`{self.source.env}`"
        if folder is None:
            return f"{RANDOM} in {text}"
        try:
            if results.has_result(folder):
                result = results.read_result(folder)
                measured = bundled.facts(folder)["here"] if bundled.is_shipped(folder) else result
                return (
                    f"{text}, trained{self._where()}: success {measured['success_rate']:.3f} in"
                    f" {measured['episodes']:,} episodes after {result['env_steps']:,} steps"
                )
            row: Mapping[str, Any] = results.read_metrics(folder)[-1]
            news = f"success {row['success_rate']:.2f} after {row['env_steps']:,} steps"
            return f"{text}, epoch {row['epoch']}{self._where()}: {news}"
        except (FolderError, KeyError, IndexError, OSError, ValueError):  # the policy itself is intact
            return text

    def _where(self) -> str:
        """Says where a success rate was measured, if not in this environment."""
        source, run = self.source, self.source.run
        assert run is not None
        if source.env != run.env:
            return f" in `{run.env}`"
        return "" if source.env_kwargs == to_texts(run.env_arguments) else " with other arguments"

    def _stamp(self) -> tuple[int, ...]:
        assert self.source.folder is not None
        try:
            stat = (self.source.folder / run_folder.POLICY_FILE).stat()
        except OSError:
            return ()
        return stat.st_mtime_ns, stat.st_size, stat.st_ino

    def _load(self) -> None:
        assert self.source.folder is not None
        stamp = self._stamp()
        policy = load.load_policy(self.source.folder)
        try:
            load.check_fits(policy, self._env)
        except ValueError as error:
            raise ValueError(f"{self.source.label} cannot be played in {self.source.env}: {error}") from None
        self.act, self._seen = policy, stamp

    def _load_critic(self) -> None:
        """Loads the critic in the newest checkpoint, unless it is loaded."""
        folder, run = self.source.folder, self.source.run
        assert folder is not None
        assert run is not None
        newest = next(iter(run_folder.checkpoints(folder)), None)
        if newest in (None, self._critic_seen):
            return
        self._critic_seen = newest
        try:
            self.value, epoch = load_critic(folder, run, self._env)
            self.critic = f"Critic of epoch {epoch}."
        except (ValueError, OSError) as error:
            self.critic = f"No critic: {error}."


def load_critic(folder: Path, run: RunSpec, env: Env) -> tuple[Value, int]:
    """Critic in the newest checkpoint of a run that was trained alone, and the epochs that had ended. A finished run has none,
    because its checkpoints are deleted. Raises FolderError if no checkpoint is usable, or the run's learner has no `value`.
    """
    run = dataclasses.replace(run, demonstrations=None)  # the checkpoint's ring holds them
    train = program.make_loop(env, run, program.choices_of([run]))
    learner: Any = train.learner
    if not callable(getattr(learner, "value", None)):
        raise FolderError(f"learner {run.learner!r} has no method value")
    restored = restoring.restore(folder, loop.state_template(train))
    state = restored.state.learner

    @jax.jit
    def value(state: Any, obs: Any, action: Any) -> Any:
        return learner.value(state, obs, action, run.hparams)

    def expect(obs: Mapping[str, Any], action: Any) -> float:
        return float(np.asarray(value(state, dict(obs), jnp.asarray(action))))

    return expect, restored.epoch


def _random(action_size: int) -> Callable[[Mapping[str, np.ndarray]], np.ndarray]:
    draws = np.random.default_rng(0)
    return lambda obs: draws.uniform(-1.0, 1.0, action_size).astype(np.float32)
