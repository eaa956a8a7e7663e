"""Demonstrations: episodes from a file that fill the replay ring before the first cycle.

A file is a Minari data set, or an .npz with the arrays of a batched `Episode`. Leaves of an observation tree are named
"observation/NAME".
"""

import functools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from mjx_dher import lookup
from mjx_dher.context import reached_fn
from mjx_dher.contract import env_spec, episode_template
from mjx_dher.spec import find_demonstrations
from mjx_dher.system import npz
from mjx_dher.types import Env, Episode

_OPTIONAL = ("length", "terminal")


def write_demonstrations(path: Path, episodes: Episode) -> None:
    """Writes N episodes from `rollout` to an .npz file. Raises ValueError if `path` does not end in .npz."""
    if not os.fspath(path).endswith(".npz"):
        raise ValueError(f"path must end in .npz, which `read_demonstrations` needs; got {os.fspath(path)!r}")
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in _named(episodes).items()}
    np.savez_compressed(path, **arrays)


def read_demonstrations(source: str | os.PathLike[str], env: Env, max_episodes: int) -> Episode:
    """Reads at most `max_episodes` episodes from an .npz file, or the folder or name of a Minari data set.

    They are padded to the environment's episode length. Raises ValueError if the file cannot be read, or its episodes do not
    fit the environment. The message names each invalid array.
    """
    path, template = find_demonstrations(source), episode_template(env)
    names = _named(template)
    try:
        check = functools.partial(_check_arrays, names=names, env=env, max_episodes=max_episodes)
        arrays = npz.read(path, check=check) if path.is_file() else _read_minari(path, names, env)
        check(arrays)
        _check_values(arrays, names, env, arrays["action"].shape[1])
    except ValueError as error:
        raise ValueError("\n".join(f"demonstrations {source}: {line}" for line in str(error).splitlines())) from error
    return _padded(arrays, template, env.episode_length)


def _named(episode: Episode) -> dict[str, Any]:
    """Leaves of an episode and their names: "observation", or "observation/NAME" for each leaf of a tree."""
    leaves = jax.tree_util.tree_leaves_with_path(episode)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _read_minari(path: Path, names: Mapping[str, Any], env: Env) -> dict[str, np.ndarray]:
    """Reads the episodes of a Minari data set of a goal environment, padded to the length of `env`'s.

    Their terminal states are terminal for every goal, except those that ended at the goal where `env` does so.
    """
    lookup.require_extra("a Minari data set", "minari", "minari")
    from minari import MinariDataset

    try:
        episodes = list(MinariDataset(path / "data"))
        rows = [_minari_row(episode, names, env.episode_length) for episode in episodes]
        arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        if env_spec(env).ends_at_goal:
            last: Any = arrays["achieved_goal"][np.arange(len(rows)), arrays["length"]]
            arrays["terminal"] &= ~np.asarray(reached_fn(env)(last, cast(Any, arrays["desired_goal"])))
        return arrays
    except (OSError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"must be a Minari data set with goal observations; {type(error).__name__}: {error}") from error


def _minari_row(episode: Any, names: Mapping[str, Any], num_steps: int) -> dict[str, np.ndarray]:
    """Arrays of one episode. Raises ValueError if it is too long or its goal changes."""
    length, goals = len(episode.actions), np.asarray(episode.observations["desired_goal"])
    if length > num_steps:
        raise ValueError(
            f"episodes must have at most {num_steps} steps, as the environment's; episode {episode.id} has {length}"
        )
    if np.any(goals != goals[0]):
        raise ValueError(f"desired_goal must be the same throughout an episode; in episode {episode.id} it changes")
    row = {"desired_goal": goals[0], "length": length, "terminal": bool(episode.terminations[-1])}
    for name in names:
        if name.startswith(("observation", "achieved_goal", "action")):
            value: Any = {**episode.observations, "action": episode.actions}
            for key in name.split("/"):
                value = value[key]
            row[name] = np.pad(value, [(0, num_steps - length)] + [(0, 0)] * (np.ndim(value) - 1))
    return {name: np.asarray(value) for name, value in row.items()}


def _check_arrays(arrays: Mapping[str, Any], names: Mapping[str, Any], env: Env, max_episodes: int) -> None:
    """Raises ValueError with one line per array that is missing, unknown or does not fit the environment."""
    action, num_steps = arrays.get("action"), env.episode_length
    if action is None or action.ndim != 3 or not 1 <= action.shape[1] <= num_steps:
        given = "none" if action is None else f"{action.dtype}{list(action.shape)}"
        raise ValueError(f"action must have shape [N, T, A] with T at most {num_steps}; got {given}")
    played = action.shape[:2]
    if not 1 <= played[0] <= max_episodes:
        raise ValueError(f"must have 1 to {max_episodes} episodes, the capacity of replay_size; got {played[0]}")
    problems = [f"{name} is not an array of an episode: {', '.join(names)}" for name in arrays if name not in names]
    for name, leaf in names.items():
        lead = (played[0], *((played[1] + leaf.shape[0] - num_steps,) if name not in ("desired_goal", *_OPTIONAL) else ()))
        shape = (*lead, *leaf.shape[len(lead) - 1 :])
        value = arrays.get(name)
        if value is None and name in _OPTIONAL:
            continue
        if value is None or value.shape != shape or not np.can_cast(value.dtype, leaf.dtype, "same_kind"):
            given = "none" if value is None else f"{value.dtype}{list(value.shape)}"
            why = "" if name == "action" else f", as action has shape {list(action.shape)}"
            problems.append(f"{name} must be {leaf.dtype}{list(shape)}{why}; got {given}")
    if problems:
        raise ValueError("\n".join(problems))


def _check_values(arrays: dict[str, np.ndarray], names: Mapping[str, Any], env: Env, num_steps: int) -> None:
    for name, value in arrays.items():
        if value.dtype.kind == "f" and not np.all(np.abs(value) <= np.finfo(names[name].dtype).max):
            raise ValueError(f"{name} must be finite, as {names[name].dtype}")
    spec = env_spec(env)
    if np.any(np.abs(arrays["action"]) > 1):
        raise ValueError(f"action must lie in [-1, 1]; the largest magnitude is {np.abs(arrays['action']).max():g}")
    length = arrays.get("length", np.array([num_steps]))
    low = 1 if spec.ends else spec.episode_length
    if np.any((length < low) | (length > min(num_steps, spec.episode_length))):
        allowed = f"in [1, {num_steps}]" if spec.ends else f"{low}, because the environment's episodes do not end early"
        raise ValueError(f"length must be {allowed}; got {sorted({int(x) for x in length})[0]} to {int(length.max())}")
    if np.any(arrays.get("terminal", False)) and not spec.ends:
        raise ValueError("terminal must be False, because the environment's episodes do not end early; got True")


def _padded(arrays: dict[str, np.ndarray], template: Episode, num_steps: int) -> Episode:
    """Pads episodes to `num_steps` by repeating the last observation, with actions 0."""
    number, own_steps = arrays["action"].shape[:2]
    length = np.asarray(arrays.get("length", np.full(number, own_steps)), np.int32)
    rows, steps = np.arange(number)[:, None], np.minimum(np.arange(num_steps + 1), length[:, None])

    def pad(name: str, leaf: Any) -> Any:
        if name == "length":
            return length
        value = arrays.get(name, np.zeros(number, bool)).astype(leaf.dtype)
        if name in ("desired_goal", "terminal"):
            return value
        if name == "action":
            moved = value[rows, np.minimum(steps[:, :-1], own_steps - 1)]
            return np.where((np.arange(num_steps) < length[:, None])[..., None], moved, 0)
        return value[rows, steps]

    leaves = [pad(name, leaf) for name, leaf in _named(template).items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
