"""Report for bug reports: versions, devices, and working engines and drawing backends.

JAX and MuJoCo are loaded in child processes with a time limit, so a driver that hangs or crashes costs only one line. A child
process runs this file: `python -m mjx_dher.tools.doctor machine|native|jax|warp`.
"""

import contextlib
import json
import os
import platform
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

from mjx_dher import __version__, presets, spec
from mjx_dher.system import machine, subprocesses
from mjx_dher.tools import render, transfer

ENGINES = tuple(name for name in spec.ENGINES if name != "auto")
LONGEST_ERROR = 400  # characters

Report = dict[str, dict[str, Any]]


def examine(seconds: float) -> Report:
    """Examines the machine, with a time limit in seconds for each child process. Only kernels that Warp compiles stay behind.

    Returns the sections `versions`, `machine`, `engines`, `drawing` and `folders`. Each value is a text, or for an engine one
    text per completed stage. The text of a failure begins with "error: ".
    """
    requested = os.environ.get("MUJOCO_GL", "")
    backends = dict.fromkeys([*(render.GL if sys.platform == "linux" else [""]), *([requested] if requested else [])])
    with ThreadPoolExecutor(min(4, machine.usable_cores())) as pool:
        asked = {topic: pool.submit(ask, topic, seconds) for topic in ("machine", *ENGINES)}
        drawn = {name or "system": pool.submit(render.try_gl, name, seconds) for name in backends}
    failures = {name: future.result() for name, future in drawn.items()}
    return {
        "versions": _versions(),
        "machine": asked["machine"].result(),
        "engines": {name: asked[name].result() for name in ENGINES},
        "drawing": {
            "MUJOCO_GL": requested or "not set",
            **{name: f"error: {failure}" if failure else "works" for name, failure in failures.items()},
            "ffmpeg": _guarded(lambda: _brief(render.ffmpeg())),
        },
        "folders": {"cache": _guarded(_cache), "originals": _guarded(_originals)},
    }


def works(engine: Mapping[str, str]) -> bool:
    """Whether a test of an engine was completed."""
    return "error" not in engine


def lines(report: Report) -> list[str]:
    """Formats the report of `examine` as text."""
    width = max(len(name) for values in report.values() for name in values)
    text = []
    for section, values in report.items():
        text.append(section)
        for name, value in values.items():
            stages = ["works" if works(value) else "fails", *map(": ".join, value.items())] if section == "engines" else [value]
            text.append(f"  {name:{width}}  {', '.join(stages)}")
    return text


def _versions() -> dict[str, str]:
    """Versions of this library and its requirements. A missing package of an extra names the extra."""
    versions = {"mjx_dher": __version__, "python": platform.python_version(), "platform": platform.platform()}
    versions |= dict.fromkeys(("jax", "jaxlib", "jax-cuda12-plugin", "mujoco"), "not installed")
    with contextlib.suppress(metadata.PackageNotFoundError):  # a checkout that is not installed
        for requirement in metadata.requires("mjx-dher") or ():
            name, _, extra = re.match(r"([\w.-]+)(.*extra == [\"'](\w+))?", requirement).groups()  # type: ignore[union-attr]
            if extra != "test":
                versions.setdefault(name, f"not installed (extra {extra})" if extra else "not installed")
    for name in list(versions)[3:]:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def ask(topic: str, seconds: float) -> dict[str, str]:
    """Runs a child process, which prints one JSON object per line. Returns their union.

    A failure is the value of "error", next to earlier results.
    """
    command = [sys.executable, "-P", "-m", "mjx_dher.tools.doctor", topic]  # -P: local files do not replace libraries
    variables = {
        "PYTHONPATH": os.pathsep.join(filter(None, [str(subprocesses.PACKAGE.parent), os.environ.get("PYTHONPATH")])),
        # Otherwise JAX would reserve three quarters of a GPU's memory, which a training run may be using.
        "XLA_PYTHON_CLIENT_PREALLOCATE": os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE", "false"),
    }
    answer = subprocesses.ask(command, variables, seconds)
    results: dict[str, str] = {}
    for line in answer.out.splitlines():
        with contextlib.suppress(ValueError):  # an unfinished line of a killed process
            results |= json.loads(line)
    return results | ({"error": answer.failure} if answer.failure else {})


def main(argv: Sequence[str]) -> None:
    """Runs a child process, which prints each result at once as a JSON object on a line."""
    (topic,) = argv
    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):  # for what libraries print
        try:
            for name, value in _examine_machine() if topic == "machine" else _try_engine(topic):
                print(json.dumps({name: value}), file=out, flush=True)
        except Exception as error:
            print(json.dumps({"error": one_line(error)}), file=out, flush=True)


def _examine_machine() -> Iterator[tuple[str, str]]:
    import jax

    from mjx_dher.envs import engines

    def devices() -> str:
        sizes = {device: (device.memory_stats() or {}).get("bytes_limit") for device in jax.devices()}
        return "; ".join(f"{d.device_kind}{f', {machine.format_bytes(size)}' if size else ''}" for d, size in sizes.items())

    yield "cores", str(machine.usable_cores())
    yield "devices", _guarded(devices)
    yield "memory", _guarded(lambda: machine.format_bytes(machine.available_bytes() or 0))
    yield "engine", _guarded(lambda: engines.resolve_engine("auto"))
    yield "preset", _guarded(presets.machine_preset)


def _try_engine(engine: str) -> Iterator[tuple[str, str]]:
    """Tests an engine with one step of `reach`. Yields the name and duration of each stage."""
    start = time.perf_counter()
    import jax
    import jax.numpy as jnp

    from mjx_dher import envs
    from mjx_dher.envs import engines, fetch  # noqa: F401 - as `make` will

    yield "import", f"{time.perf_counter() - start:.1f} s"
    start = time.perf_counter()
    env = envs.make("reach", engine=engine)
    yield "build", f"{time.perf_counter() - start:.1f} s"
    if engine == "jax":  # its step takes some 20 s to compile on two cores, that of native 1 s
        yield "step", "not tested, because it takes long to compile"
        return
    start = time.perf_counter()
    action = jnp.ones(env.action_size)
    first_step = jax.jit(lambda key: (state := env.reset(key), env.step(state, action)))
    before, after = jax.device_get(first_step(jax.random.key(0)))
    env.check()
    moved = after.obs["achieved_goal"] - before.obs["achieved_goal"]
    if after.failed or not (moved > 0).all():
        raise ValueError(f"a step must move the gripper by about 5 cm along x, y and z; it moved by {moved.tolist()} m")
    yield "step", f"{time.perf_counter() - start:.1f} s"


def _guarded(part: Callable[[], str]) -> str:
    try:
        return part()
    except Exception as error:
        return f"error: {one_line(error)}"


def one_line(error: BaseException) -> str:
    """Formats a caught error in one line, with its type and place unless it is a ValueError."""
    text = str(error)
    if type(error) is not ValueError:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {text} ({Path(place.filename).name}, line {place.lineno})"
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_ERROR else text[:LONGEST_ERROR] + " ..."


def _cache() -> str:
    folder = machine.user_cache()
    files = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    size = machine.format_bytes(sum(path.stat().st_size for path in files))
    return f"{_brief(folder)}, {size if folder.is_dir() else 'not there'}"


def _originals() -> str:
    environment = transfer.default_environment()
    ready = transfer.is_ready(transfer.interpreter(environment))
    return f"{_brief(environment)}, {'ready' if ready else 'not ready'}"


def _brief(path: str | Path) -> str:
    """A path without the user's home folder, so that it can be shared."""
    path, home = Path(path), os.path.expanduser("~")  # "~" without a home folder
    return f"~/{path.relative_to(home)}" if path.is_relative_to(home) else str(path)


if __name__ == "__main__":
    main(sys.argv[1:])
