"""What a report of a fault needs to say of the machine: versions, devices, and which engines and ways to draw work here.

Whatever loads JAX or MuJoCo runs in a process of its own, for a limited time: a driver that hangs or crashes costs one line.
Such a process is this file, run as a program:

    python -m mjx_dher.tools.doctor machine|native|jax|warp
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import json
import os
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from mjx_dher import __version__, config, presets
from mjx_dher.host import caches, memory
from mjx_dher.tools import originals, render

LONGEST_SECONDS = 3600.0  # that one process can be given
ENGINES = tuple(name for name in config.ENGINES if name != "auto")
NOT_STEPPED = "jax"  # its step takes some 20 s to compile on two cores, that of native 1 s
MACHINE = "machine"
PROCESSES = 4  # at once, at most
LONGEST_ERROR = 400  # characters

# Packages to name the version of -> the extra that installs them; None: none does.
PACKAGES = {
    "jax": None,
    "jaxlib": None,
    "mujoco": None,
    "mujoco-mjx": None,
    "flax": None,
    "optax": None,
    "orbax-checkpoint": None,
    "numpy": None,
    "jax-cuda12-plugin": "cuda",
    "warp-lang": "cuda",
    "gymnasium": "gym",
    "matplotlib": "plot",
    "imageio-ffmpeg": "video",
    "onnx": "export",
    "safetensors": "export",
    "tensorboardX": "tensorboard",
    "tensorboard": "tensorboard",
    "wandb": "wandb",
}

Report = dict[str, dict[str, Any]]


def check(seconds: float) -> None:
    """Raises ValueError where a process cannot be given so many seconds."""
    if not 0 < seconds <= LONGEST_SECONDS:
        raise ValueError(f"seconds must lie in (0, {LONGEST_SECONDS:g}]; got {seconds:g}")


def examine(seconds: float) -> Report:
    """Looks at everything; leaves nothing behind but, on a GPU, the kernels that Warp compiles and keeps.

    Args:
      seconds: that each process may take.

    Returns:
      For each section its parts, as JSON takes them. A part that could not be found out is {"error": ONE LINE}.
      versions: strings, None where a package is not installed.
      machine: cores; memory, bytes that can be allocated; devices that JAX has, a list of {platform, kind, memory in bytes};
        auto, the engine that it stands for; preset.
      engines: {works, import, build, step in s}, where step is None if it was not tried, or {works, error}.
      drawing: MUJOCO_GL as the user has set it; for each value that it can have (where there is but one way, for "system")
        {works} or {works, error}; ffmpeg, its path.
      folders: cache: {path, bytes}; originals: {path, ready}. Bytes are None where there is no such folder.
    """
    asked = os.environ.get("MUJOCO_GL")
    ways = dict.fromkeys([*(render.GL if sys.platform == "linux" else [""]), *([asked] if asked else [])])
    with concurrent.futures.ThreadPoolExecutor(min(PROCESSES, os.cpu_count() or 1)) as pool:
        engines = {name: pool.submit(_engine, name, seconds) for name in ENGINES}
        machine = pool.submit(ask, _command(MACHINE), seconds)
        drawing = {name or "system": pool.submit(_drawing, name, seconds) for name in ways}
        parts: dict[str, dict[str, Callable[[], Any]]] = {
            "versions": {
                "mjx_dher": lambda: __version__,
                "python": platform.python_version,
                "platform": platform.platform,
                **{name: functools.partial(version, name) for name in PACKAGES},
            },
            "machine": {name: functools.partial(_answer, machine, name) for name in _PARTS},
            "engines": {name: found.result for name, found in engines.items()},
            "drawing": {
                "MUJOCO_GL": lambda: asked,
                **{name: found.result for name, found in drawing.items()},
                "ffmpeg": lambda: _brief(render.ffmpeg()),
            },
            "folders": {"cache": _cache, "originals": _originals},
        }
        return {section: {name: guarded(part) for name, part in found.items()} for section, found in parts.items()}


def some_engine_works(report: Report) -> bool:
    """Whether anything can be trained here."""
    return any(engine.get("works") for engine in report["engines"].values())


def lines(report: Report) -> list[str]:
    """What `examine` found, for a reader."""
    width = max(len(name) for parts in report.values() for name in parts)
    shown = []
    for section, parts in report.items():
        shown.append(section)
        for name, value in parts.items():
            text = f"error: {value['error']}" if _failed(value) else (_SHOWN.get(name) or _SHOWN[section])(name, value)
            shown.append(f"  {name:{width}}  {text}")
    return shown


def version(package: str) -> str | None:
    """Of an installed package; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def guarded(part: Callable[[], Any]) -> Any:
    """What `part` returns; {"error": ONE LINE} where it fails."""
    try:
        return part()
    except Exception as error:
        return {"error": one_line(error)}


def one_line(error: BaseException) -> str:
    """A caught error without line breaks, and with its kind and place where it is not a ValueError, which says enough."""
    text = str(error)
    if type(error) is not ValueError:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {text} ({Path(place.filename).name}, line {place.lineno})"
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_ERROR else text[:LONGEST_ERROR] + " ..."


def ask(command: Sequence[str], seconds: float) -> dict[str, Any]:
    """What a process finds: it prints a JSON object a line, which are put together.

    Under "error" stands, in one line, why it did not come to its end.
    """
    package = str(Path(__file__).resolve().parent.parent)
    variables = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")])),
        # Else the first of these processes would take three quarters of a GPU's memory, which a run may be using.
        "XLA_PYTHON_CLIENT_PREALLOCATE": os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE", "false"),
    }
    with subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        failed = {}
        try:
            out, err = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            out, err = process.communicate()
            failed = {"error": f"did not end within {seconds:g} s"}
    if process.returncode and not failed:
        last = (err.strip().splitlines() or [""])[-1]
        failed = {"error": f"crashed with exit status {process.returncode}: {last}"}
    found: dict[str, Any] = {}
    for line in out.splitlines():
        with contextlib.suppress(ValueError):  # half a line, of a process that was killed
            found |= json.loads(line)
    return found | failed


def main(argv: Sequence[str]) -> None:
    """One of the processes: prints what it finds as soon as it has, a JSON object a line."""
    (topic,) = argv
    results = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):  # for what libraries print
        if topic == MACHINE:
            for name, part in _PARTS.items():
                print(json.dumps({name: guarded(part)}), file=results, flush=True)
        else:
            try:
                for stage, seconds in _stages(topic):
                    print(json.dumps({stage: seconds}), file=results, flush=True)
            except Exception as error:
                print(json.dumps({"error": one_line(error)}), file=results, flush=True)


def _stages(engine: str) -> Iterator[tuple[str, float | None]]:
    """Tries an engine, by one step of `reach`; yields how long each stage took, s."""
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
    before, after = jax.device_get(jax.jit(lambda key: _first_step(env, key, action))(jax.random.key(0)))
    env.check()
    moved = after.obs["achieved_goal"] - before.obs["achieved_goal"]
    if after.failed or not (moved > 0).all():
        raise ValueError(f"a step that asks the gripper to move by 5 cm along x, y and z moved it by {moved.tolist()} m")
    yield "step", time.perf_counter() - start


def _first_step(env: Any, key: Any, action: Any) -> tuple[Any, Any]:
    state = env.reset(key)
    return state, env.step(state, action)


def _engine(name: str, seconds: float) -> dict[str, Any]:
    found = ask(_command(name), seconds)
    return {"works": "error" not in found, **found}


def _drawing(name: str, seconds: float) -> dict[str, Any]:
    why_not = render.try_gl(name, seconds)
    return {"works": True} if why_not is None else {"works": False, "error": why_not}


def _answer(machine: concurrent.futures.Future[dict[str, Any]], name: str) -> Any:
    found = machine.result()
    return found[name] if name in found else {"error": found["error"]}


def _command(topic: str) -> list[str]:
    # -P: no file of the folder that it is called from takes a library's place.
    return [sys.executable, "-P", "-m", "mjx_dher.tools.doctor", topic]


def _cores() -> int:
    from mjx_dher.envs.engines.native import usable_cores

    return usable_cores()


def _devices() -> list[dict[str, Any]]:
    import jax

    return [
        {
            "platform": device.platform,
            "kind": device.device_kind,
            "memory": (device.memory_stats() or {}).get("bytes_limit"),
        }
        for device in jax.devices()
    ]


def _auto() -> str:
    from mjx_dher.envs.engines import resolve_engine

    return resolve_engine("auto")


_PARTS: dict[str, Callable[[], Any]] = {
    "cores": _cores,
    "devices": _devices,
    "memory": memory.available_bytes,
    "auto": _auto,
    "preset": presets.machine_preset,
}


def _cache() -> dict[str, Any]:
    folder = caches.user_cache()
    files = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    return {"path": _brief(folder), "bytes": sum(path.stat().st_size for path in files) if folder.is_dir() else None}


def _originals() -> dict[str, Any]:
    environment = originals.default_environment()
    return {"path": _brief(environment), "ready": originals.is_ready(originals.interpreter(environment))}


def _brief(path: str | Path) -> str:
    """A path as it may be shown to others: without the name of the user's folder."""
    path = Path(path)
    return f"~/{path.relative_to(Path.home())}" if path.is_relative_to(Path.home()) else str(path)


def _failed(value: Any) -> bool:
    return isinstance(value, dict) and value.keys() == {"error"}


def _show_version(name: str, value: str | None) -> str:
    extra = PACKAGES.get(name)
    return value or "not installed" + (f" (extra {extra})" if extra else "")


def _show_bytes(name: str, value: int | None) -> str:
    return "unknown" if value is None else memory.format_bytes(value)


def _show_devices(name: str, value: list[dict[str, Any]]) -> str:
    return ", ".join(f"{d['platform']} {d['kind']} (memory {_show_bytes(name, d['memory'])})" for d in value)


def _show_trial(name: str, value: dict[str, Any]) -> str:
    stages = ", ".join(f"{stage} {value[stage]:.1f} s" for stage in ("import", "build", "step") if value.get(stage))
    if not value["works"]:
        return f"does not work: {value['error']}" + (f" ({stages})" if stages else "")
    untried = "; a step was not tried, because it takes long to compile" if "step" in value and value["step"] is None else ""
    return "works" + (f" ({stages}{untried})" if stages else "")


def _show_cache(name: str, value: dict[str, Any]) -> str:
    return f"{value['path']}, {'not there' if value['bytes'] is None else memory.format_bytes(value['bytes'])}"


def _show_originals(name: str, value: dict[str, Any]) -> str:
    return f"{value['path']}, {'set up' if value['ready'] else 'not set up'}"


# How a part, or else a part of a section, is shown.
_SHOWN: dict[str, Callable[[str, Any], str]] = {
    "versions": _show_version,
    "machine": lambda name, value: str(value),
    "memory": _show_bytes,
    "devices": _show_devices,
    "engines": _show_trial,
    "drawing": _show_trial,
    "MUJOCO_GL": lambda name, value: value or "not set",
    "ffmpeg": lambda name, value: value,
    "cache": _show_cache,
    "originals": _show_originals,
}


if __name__ == "__main__":
    main(sys.argv[1:])
