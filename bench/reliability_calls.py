"""Edits of every field of config.json, and several hundred wrong calls."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sys
from pathlib import Path

from reliability_pairs import ROOT, SHAPES, of_run

from mjx_dher import Options, cli, envs, train_runs
from mjx_dher.runs import run_folder

sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "docs" / "examples")]
WITHOUT = {"config": None}  # of_run, but for what is edited


def call(*arguments):
    """The status of a command, and what it printed; a traceback is status -1."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            status = cli.main([str(argument) for argument in arguments])
        except Exception as error:
            return -1, f"{type(error).__name__}: {error}"
    return status, output.getvalue()


def leaves(content, path=()):
    if isinstance(content, dict):
        return [leaf for name, value in content.items() for leaf in leaves(value, (*path, name))]
    return [(path, content)]


def others(value):
    """Another value, others of the wrong type, and none."""
    if isinstance(value, str):
        other = {"linear": "softmax", "future": "final", "auto": "native", "none": "native", "float32": "bfloat16"}
        yield other.get(value, f"{value}x")
    elif isinstance(value, (int, float)):
        yield value + 1
        yield value * 2 + 0.125
        yield -value - 1
    elif isinstance(value, list):
        yield [*value, 8]
    yield from ([], {}, "x", 10**20, None)


def edits(folder):
    """Every field of a stopped and of a finished run, changed, of another type, and removed."""
    folder.mkdir()
    flags = [*SHAPES, "--total-steps", "80", "--checkpoint-every", "2"]
    assert call(*flags, "--out", folder / "whole")[0] == 0
    right = of_run(folder / "whole")
    spec = run_folder.read_spec(folder / "whole")
    seen = []
    train_runs(
        envs.make(spec.env),
        [spec],
        [folder / "stopped"],
        options=Options(final_episodes=4, checkpoint_every=2),
        on_epoch=lambda specs, progress: seen.append(progress.epoch),
        should_stop=lambda: seen[-1] == 2,
    )
    content = json.loads((folder / "whole" / "config.json").read_text())
    tried, faults = 0, []
    for path, value in leaves(content):
        for other in (*others(value), leaves):  # the function stands for a field that is removed
            changed = json.loads(json.dumps(content))
            inner = changed
            for part in path[:-1]:
                inner = inner[part]
            if other is leaves:
                del inner[path[-1]]
            elif other == value:
                continue
            else:
                inner[path[-1]] = other
            tried += 2
            shown = "removed" if other is leaves else repr(other)
            faults += [f"{'.'.join(path)} {shown}: {fault}" for fault in edited(folder, changed, path, right)]
    return tried, faults


def edited(folder, content, path, right):
    """The faults of `resume` and `eval` with this config.json."""
    found = []
    for name, command in (("stopped", "resume"), ("whole", "eval")):
        copy = folder / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(folder / name, copy)
        (copy / "config.json").write_text(json.dumps(content))
        status, text = call(command, copy)
        if status == -1:
            found.append(f"{command}: traceback {text[:200]}")
        elif status == 2:
            if not any(word in text for word in (path[-1], "config.json", *path)) or "error: " not in text:
                found.append(f"{command}: refused without its name: {text[-200:]}")
        elif status != 0:
            found.append(f"{command}: status {status}")
        elif command == "resume" and path[-1] in ("total_steps", "final_episodes", "physics"):
            if path[-1] not in text:
                found.append("resume: changed without a word")
        elif command == "resume" and {**of_run(copy), **WITHOUT} != {**right, **WITHOUT}:
            found.append("silent: another result")
    return found


def calls(folder):
    """All wrong calls of tests/wrong_calls.py; returns their number and the faults."""
    import wrong_calls

    folder.mkdir()
    env = envs.make("reach", engine="native")
    flags = [*wrong_calls.TINY, "--total-steps", "200", "--final-episodes", "2", "--eval-episodes", "2"]
    assert call(*flags, "--out", folder / "run")[0] == 0
    assert call("sweep", *flags, "--seeds", "1", "--sampler", "future", "--out", folder / "sweep")[0] == 0
    spec, seen = run_folder.read_spec(folder / "run"), []
    options = {
        "options": Options(final_episodes=2),
        "on_epoch": lambda *args: seen.append(1),
        "should_stop": lambda: bool(seen),
    }
    train_runs(env, [spec], [folder / "stopped"], **options)
    (folder / "places").mkdir()
    made = [folder / name for name in ("run", "stopped", "sweep")]
    wrong = wrong_calls.calls(folder / "places", *made)
    before, faults = everything(folder), []
    for arguments in wrong:
        status, text = call(*arguments)
        if status != 2 or not ("error: " in text or "--help" in text):
            faults.append(f"{arguments[0]} ... {arguments[-2:]}: status {status}: {text[-200:]}")
    return len(wrong), faults + [f"changed: {path}" for path, now in everything(folder).items() if before.get(path) != now]


def everything(folder: Path):
    return {path: (path.lstat().st_mtime_ns, path.lstat().st_size) for path in folder.rglob("*")}
