"""The report for a bug report: versions, devices, folders, and which engines and drawing backends work on this machine.

JAX and MuJoCo are loaded in child processes with a time limit, so a driver that hangs or crashes costs one line of the report.
A child process is this file, run as a program:

    python -m mjx_dher.tools.doctor machine|native|jax|warp
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

from mjx_dher import __version__, presets, spec
from mjx_dher.system import caches, memory, subprocesses
from mjx_dher.tools import render, transfer

LONGEST_SECONDS = 3600.0  # longest time limit of a child process
ENGINES = tuple(name for name in spec.ENGINES if name != "auto")
NOT_STEPPED = "jax"  # its step takes some 20 s to compile on two cores, that of native 1 s
MACHINE = ("cores", "devices", "memory", "auto", "preset")  # parts of the section `machine`
PROCESSES = 4  # most child processes at once
LONGEST_ERROR = 400  # characters

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy", "scipy")
EXTRAS = {  # extra: packages that only it installs
    "cuda": ("jax-cuda12-plugin", "warp-lang"),
    "gym": ("gymnasium",),
    "plot": ("matplotlib",),
    "video": ("imageio-ffmpeg",),
    "export": ("onnx", "safetensors"),
    "tensorboard": ("tensorboardX", "tensorboard"),
    "wandb": ("wandb",),
    "view": ("viser",),
    "ray": ("ray",),
    "docs": ("sphinx", "furo", "myst-nb"),
}
EXTRA_OF = {package: extra for extra, packages in EXTRAS.items() for package in packages}

# Texts for None in the report, by name; "unknown" for the others.
_NONE = {"MUJOCO_GL": "not set", "step": "not tried, because it takes long to compile", "bytes": "no such folder"}

Report = dict[str, dict[str, Any]]


def check(seconds: float) -> None:
    """Raises ValueError unless `seconds` is an allowed time limit of a child process."""
    if not 0 < seconds <= LONGEST_SECONDS:
        raise ValueError(f"seconds must lie in (0, {LONGEST_SECONDS:g}]; got {seconds:g}")


def examine(seconds: float) -> Report:
    """Examines the machine; on a GPU, Warp keeps the kernels that it compiles, and nothing else is left behind.

    Args:
      seconds: time limit of each child process.

    Returns:
      Sections of named parts, as JSON takes them. A part that could not be determined is {"error": ONE LINE}.
      versions: strings, None for a package that is not installed.
      machine: cores; memory, bytes that can be allocated; devices of JAX, a list of {platform, kind, memory in bytes};
        auto, the engine that it stands for; preset.
      engines: {works, import, build, step in s}, where step is None if it was not tried, or {works, error, ...}.
      drawing: MUJOCO_GL as the user has set it; {works} or {works, error} for each of its values ("system" where there is
        only one backend); ffmpeg, its path.
      folders: cache: {path, bytes}; originals: {path, ready}. Bytes are None if there is no such folder.
    """
    requested = os.environ.get("MUJOCO_GL")
    backends = dict.fromkeys([*(render.GL if sys.platform == "linux" else [""]), *([requested] if requested else [])])
    with ThreadPoolExecutor(min(PROCESSES, os.cpu_count() or 1)) as pool:
        engines = {name: pool.submit(ask, _command(name), seconds) for name in ENGINES}
        machine = pool.submit(ask, _command("machine"), seconds)
        drawing = {name or "system": pool.submit(render.try_gl, name, seconds) for name in backends}
    answer = machine.result()
    versions = {"mjx_dher": __version__, "python": platform.python_version(), "platform": platform.platform()}
    return {
        "versions": {**versions, **{name: version(name) for name in (*PACKAGES, *EXTRA_OF)}},
        "machine": {name: answer[name] if name in answer else {"error": answer["error"]} for name in MACHINE},
        "engines": {name: _trial(future.result()) for name, future in engines.items()},
        "drawing": {
            "MUJOCO_GL": requested,
            **{name: _trial({"error": future.result()} if future.result() else {}) for name, future in drawing.items()},
            "ffmpeg": guarded(lambda: _brief(render.ffmpeg())),
        },
        "folders": {"cache": guarded(_cache), "originals": guarded(_originals)},
    }


def some_engine_works(report: Report) -> bool:
    """Returns whether anything can be trained on this machine."""
    return any(engine.get("works") for engine in report["engines"].values())


def lines(report: Report) -> list[str]:
    """Formats the report of `examine` as text."""
    width = max(len(name) for parts in report.values() for name in parts)
    text = []
    for section, parts in report.items():
        text.append(section)
        for name, value in parts.items():
            shown = _missing(name) if section == "versions" and value is None else _text(name, value)
            text.append(f"  {name:{width}}  {shown}")
    return text


def _missing(package: str) -> str:
    return f"not installed (extra {EXTRA_OF[package]})" if package in EXTRA_OF else "not installed"


def _text(name: str, value: Any) -> str:
    if value is None:
        return _NONE.get(name, "unknown")
    if isinstance(value, dict):
        return ", ".join(f"{key}: {_text(key, inner)}" for key, inner in value.items())
    if isinstance(value, list):
        return "; ".join(_text(name, inner) for inner in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.1f} s"
    return memory.format_bytes(value) if name in ("memory", "bytes") else str(value)


def version(package: str) -> str | None:
    """Returns the version of a package, None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def guarded(part: Callable[[], Any]) -> Any:
    """Calls `part` and returns its result, or {"error": ONE LINE} if it raises."""
    try:
        return part()
    except Exception as error:
        return {"error": one_line(error)}


def one_line(error: BaseException) -> str:
    """Formats a caught error in one line, with its type and place unless it is a ValueError, whose text is enough."""
    text = str(error)
    if type(error) is not ValueError:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {text} ({Path(place.filename).name}, line {place.lineno})"
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_ERROR else text[:LONGEST_ERROR] + " ..."


def ask(command: Sequence[str], seconds: float) -> dict[str, Any]:
    """Runs a child process that prints one JSON object per line, and returns their union.

    If it fails, "error" says why in one line, beside the results from before the failure.
    """
    root = str(subprocesses.PACKAGE.parent)
    variables = {
        "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
        # Otherwise JAX would reserve three quarters of a GPU's memory, which a training run may be using.
        "XLA_PYTHON_CLIENT_PREALLOCATE": os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE", "false"),
    }
    answer = subprocesses.ask(command, variables, seconds)
    results: dict[str, Any] = {}
    for line in answer.out.splitlines():
        with contextlib.suppress(ValueError):  # an unfinished line of a killed process
            results |= json.loads(line)
    return results | ({"error": answer.failure} if answer.failure else {})


def main(argv: Sequence[str]) -> None:
    """Runs a child process: prints each result as soon as it is known, one JSON object per line."""
    (topic,) = argv
    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):  # for what libraries print
        try:
            for name, value in _examine_machine() if topic == "machine" else _try_engine(topic):
                print(json.dumps({name: value}), file=out, flush=True)
        except Exception as error:
            print(json.dumps({"error": one_line(error)}), file=out, flush=True)


def _examine_machine() -> Iterator[tuple[str, Any]]:
    """Yields the name and the value of each part of the section `machine`."""
    import jax

    from mjx_dher.envs import engines
    from mjx_dher.envs.engines import native

    def devices() -> list[dict[str, Any]]:
        limit = lambda device: (device.memory_stats() or {}).get("bytes_limit")  # noqa: E731
        return [{"platform": d.platform, "kind": d.device_kind, "memory": limit(d)} for d in jax.devices()]

    functions: list[Callable[[], Any]] = [
        native.usable_cores,
        devices,
        memory.available_bytes,
        lambda: engines.resolve_engine("auto"),
        presets.machine_preset,
    ]
    for name, function in zip(MACHINE, functions):
        yield name, guarded(function)


def _try_engine(engine: str) -> Iterator[tuple[str, float | None]]:
    """Tries an engine with one step of `reach`; yields the name and the duration in s of each stage."""
    start = time.perf_counter()
    import jax
    import jax.numpy as jnp

    from mjx_dher import envs
    from mjx_dher.envs import engines, reach  # noqa: F401 - as `make` will

    yield "import", time.perf_counter() - start
    start = time.perf_counter()
    env = envs.make("reach", engine=engine)
    yield "build", time.perf_counter() - start
    if engine == NOT_STEPPED:
        yield "step", None
        return
    start = time.perf_counter()
    action = jnp.ones(env.action_size)
    first_step = jax.jit(lambda key: (state := env.reset(key), env.step(state, action)))
    before, after = jax.device_get(first_step(jax.random.key(0)))
    env.check()
    moved = after.obs["achieved_goal"] - before.obs["achieved_goal"]
    if after.failed or not (moved > 0).all():
        raise ValueError(f"a step that asks the gripper to move by 5 cm along x, y and z moved it by {moved.tolist()} m")
    yield "step", time.perf_counter() - start


def _trial(answer: dict[str, Any]) -> dict[str, Any]:
    return {"works": "error" not in answer, **answer}


def _command(topic: str) -> list[str]:
    # -P: a file in the current folder must not take a library's place.
    return [sys.executable, "-P", "-m", "mjx_dher.tools.doctor", topic]


def _cache() -> dict[str, Any]:
    folder = caches.user_cache()
    files = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    return {"path": _brief(folder), "bytes": sum(path.stat().st_size for path in files) if folder.is_dir() else None}


def _originals() -> dict[str, Any]:
    environment = transfer.default_environment()
    return {"path": _brief(environment), "ready": transfer.is_ready(transfer.interpreter(environment))}


def _brief(path: str | Path) -> str:
    """Returns a path that can be shown to others: without the user's home folder."""
    path = Path(path)
    return f"~/{path.relative_to(Path.home())}" if path.is_relative_to(Path.home()) else str(path)


if __name__ == "__main__":
    main(sys.argv[1:])
