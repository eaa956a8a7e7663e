"""Cached verdicts: components that have passed are not checked again until one of their dependencies changes."""

import contextlib
import dataclasses
import hashlib
import os
import sys
import sysconfig
import time
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mjx_dher import components
from mjx_dher.config import Config
from mjx_dher.contract import env_spec
from mjx_dher.spec import RunSpec, custom_components
from mjx_dher.system.machine import user_cache
from mjx_dher.system.subprocesses import PACKAGE
from mjx_dher.testing.components import check_components
from mjx_dher.types import Env

KEPT_SECONDS = 90 * 24 * 3600.0  # lifetime of a verdict
_METADATA = ("METADATA", "PKG-INFO")  # files of an installed package, of which it has one


def check(env: Env, specs: Sequence[RunSpec], again: bool = False) -> Iterator[str]:
    """Checks custom components of runs of `env`, each once, or `again`. Yields lines. Raises ComponentError if one fails."""
    runs = list(dict.fromkeys(_read(spec) for spec in specs if custom_components(spec)))
    if not runs:
        return
    names = ", ".join(dict.fromkeys(f"{field} {name}" for run in runs for field, name in custom_components(run).items()))
    verdict = _verdict(env, runs)
    if verdict is not None and verdict.is_file() and not again:
        yield f"{names}: passed before, unchanged since"
        return
    yield f"testing {names} on random episodes ..."
    for number, run in enumerate(runs):
        yield from check_components(env, run, with_env=number == 0)
    if verdict is not None:
        with contextlib.suppress(OSError):
            verdict.parent.mkdir(parents=True, exist_ok=True)
            verdict.touch()
            for old in verdict.parent.glob("?" * len(verdict.name)):  # nothing but verdicts
                if time.time() - old.stat().st_mtime > KEPT_SECONDS:
                    old.unlink()


def _read(spec: RunSpec) -> RunSpec:
    """The run with only the settings that its custom components may read. Others have their defaults."""
    if custom_components(spec).keys() == {"env"}:
        return RunSpec(env=spec.env, env_kwargs=spec.env_kwargs, engine=spec.engine)
    config = dataclasses.replace(spec.config, total_steps=Config().total_steps)
    return dataclasses.replace(spec, seed=0, demonstrations=None, config=config)


def _verdict(env: Any, runs: Sequence[RunSpec]) -> Path | None:
    """File that exists if these components have passed, or None if their dependencies are unknown.

    Its name is a digest of the settings, the compiled environment (which includes data from files), the code of this library
    and of modules that are not installed, and the metadata of installed packages, such as their versions.
    """
    content = hashlib.sha256(repr(runs).encode())
    try:
        for run in runs:
            for field, name in custom_components(run).items():
                components.load(field, name)
        spec, key = env_spec(env), jax.random.key(0)
        action, goal = (jax.ShapeDtypeStruct((size,), jnp.float32) for size in (spec.action_size, spec.goal_size))
        functions = [getattr(env, name) for name in ("compute_reward", "reached", "goal_distance") if hasattr(env, name)]
        texts = [jax.jit(function).lower(goal, goal).as_text() for function in functions]
        texts.append(jax.jit(lambda key, action: env.step(env.reset(key), action)).lower(key, action).as_text())
        # Parsing these files would take twenty times as long as reading them.
        texts += [next(filter(None, map(package.read_text, _METADATA)), "") for package in metadata.distributions()]
        for text in (repr(spec), sys.version, jax.default_backend(), *texts):
            content.update(text.encode())
        for file in sorted({*PACKAGE.rglob("*.py"), *_own_files()}):
            content.update(f"{file}".encode() + file.read_bytes())
        return user_cache() / "checked" / content.hexdigest()
    except Exception:  # from the component, whose check reports it, or from the cache
        return None


def _own_files() -> Iterator[Path]:
    """Files of loaded modules outside Python's folders."""
    installed = tuple(sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib"))
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if file and not file.startswith(installed) and Path(file).is_file():
            yield Path(file)
