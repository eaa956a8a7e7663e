"""Edits of every field of config.json, and several hundred wrong calls, most of them in this process."""

import contextlib
import io
import json
import shutil
import subprocess
import sys
from pathlib import Path

from reliability_pairs import ROOT, SHAPES, of_run, of_sweep

from mjx_dher import Options, cli, envs, train_runs
from mjx_dher.runs.folder import reading

sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "docs" / "examples")]
TOLD = ("total_steps", "final_episodes")  # fields that `resume` accepts changed, with a message
REMOVED = object()
EVERY = 20  # every 20th wrong call is also made as a separate process


def call(*arguments):
    """Status of a command, and its output. A traceback is status -1."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            status = cli.main([str(argument) for argument in arguments])
        except Exception as error:
            return -1, f"{type(error).__name__}: {error}"
    return status, output.getvalue()


def fields(content, path=()):
    """Path and value of each field, groups of fields first."""
    for name, value in content.items():
        yield (*path, name), value
        if isinstance(value, dict):
            yield from fields(value, (*path, name))


def others(value):
    """Other values, values of the wrong type, and none."""
    if isinstance(value, str):
        other = {"linear": "softmax", "future": "final", "auto": "native", "none": "native", "float32": "bfloat16"}
        yield other.get(value, f"{value}x")
    elif isinstance(value, (int, float)):
        yield from (value + 1, value * 2 + 0.125, -value - 1, str(value), not value)
    elif isinstance(value, list):
        yield [*value, 8]
    yield from ([], {}, "x", 10**20, None, REMOVED)


def edits(folder):
    """Every field of a stopped run, of a finished one and of a sweep's, changed, of another type, and removed."""
    folder.mkdir()
    flags = [*SHAPES, "--total-steps", "80", "--checkpoint-every", "2"]
    assert call(*flags, "--out", folder / "whole")[0] == 0
    assert call("sweep", *flags, "--sampler", "future", "--seeds", "2", "--out", folder / "sweep")[0] == 0
    stop_after(2, reading.read_spec(folder / "whole"), folder / "stopped")
    (cell, *_) = sorted((folder / "sweep" / "cells").glob("*-s0-*"))
    commands = {
        "stopped": (".", lambda copy: ("resume", copy)),
        "whole": (".", lambda copy: ("eval", copy, "--episodes", "4")),
        "sweep": (cell.relative_to(folder / "sweep"), lambda copy: ("plot", copy, "--formats", "svg")),
    }
    right = {"stopped": of_run(folder / "whole"), "sweep": of_sweep(folder / "sweep")}
    right["whole"] = call("eval", folder / "whole", "--episodes", "4")[1]
    tried, faults = 0, []
    for name, (place, command) in commands.items():
        content = json.loads((folder / name / place / "config.json").read_text())
        for path, value in fields(content):
            for other in others(value):
                if other is value or (type(other) is type(value) and other == value):
                    continue
                copy = folder / "copy"
                shutil.rmtree(copy, ignore_errors=True)
                shutil.copytree(folder / name, copy)
                (copy / place / "config.json").write_text(json.dumps(changed(content, path, other)))
                before = everything(copy)
                status, text = call(*command(copy))
                tried += 1
                fault = fault_of(name, named_by(path[-1], value, other), status, text, copy, before, right[name])
                if fault:
                    shown = "removed" if other is REMOVED else repr(other)
                    faults.append(f"{command(copy)[0]}, {'.'.join(path)} {shown}: {fault}")
    done = f"{tried} edits of config.json, then resume, eval or plot"
    return done, "each refused by name, told, or without effect", faults


def stop_after(epochs, spec, folder):
    seen = []
    train_runs(
        envs.make(spec.env, engine=spec.engine),
        [spec],
        [folder],
        options=Options(final_episodes=4, checkpoint_every=2),
        on_epoch=lambda specs, progress: seen.append(progress.epoch),
        should_stop=lambda: seen[-1] == epochs,
    )


def changed(content, path, other):
    """The content with another value of the field at `path`, or without it."""
    copy = json.loads(json.dumps(content))
    inner = copy
    for part in path[:-1]:
        inner = inner[part]
    if other is REMOVED:
        del inner[path[-1]]
    else:
        inner[path[-1]] = other
    return copy


def named_by(field, value, other):
    """Words that identify the edit to a reader: the field, a nested field, or the new value's text."""
    return [field, *(value if isinstance(value, dict) else ()), *([repr(other)] if isinstance(other, str) else ())]


def fault_of(kind, names, status, text, folder, before, right):
    """Fault of a command on an edited folder, or an empty text."""
    if status == 0:
        return silent(kind, names[0], text, folder, right)
    if status == -1:
        return f"traceback: {text[:200]}"
    if status != 2 or "error: " not in text:
        return f"status {status} without a sentence: {text[-200:]}"
    if not any(name in text for name in names):
        return f"refused without the field's name: {text[-200:]}"
    written = [name for name in differing(before, everything(folder)) if not name.endswith(".lock")]
    return f"refused, and changed: {written[:3]}" if written else ""


def silent(kind, field, text, folder, right):
    """Results that changed through the edit without a message."""
    if kind == "whole":
        return "" if text == right else f"silent: another evaluation: {text[-200:]}"
    if kind == "sweep":
        return "" if of_sweep(folder) == right else "silent: other tables"
    if field in TOLD:
        return "" if field in text else "silent: changed without a word"
    now = {**of_run(folder), "config": right["config"]}  # the edited one
    if field == "keep_end":  # an option that means what it says: the last checkpoint may stay
        now["files"] = [file for file in now["files"] if not file.startswith("checkpoints")]
    return "" if now == right else "silent: another result"


def calls(folder):
    """All wrong calls of tests/wrong_calls.py, in an empty folder."""
    import wrong_calls

    folder.mkdir()
    flags = [*wrong_calls.TINY, "--total-steps", "200", "--final-episodes", "2", "--eval-episodes", "2"]
    assert call(*flags, "--out", folder / "run")[0] == 0
    assert call("sweep", *flags, "--seeds", "1", "--sampler", "future", "--out", folder / "sweep")[0] == 0
    stop_after(1, reading.read_spec(folder / "run"), folder / "stopped")
    (folder / "places").mkdir()
    (folder / "here").mkdir()
    made = [folder / name for name in ("run", "stopped", "sweep")]
    wrong, faults = wrong_calls.calls(folder / "places", *made), []
    with contextlib.chdir(folder / "here"):
        for number, arguments in enumerate(wrong):
            before = everything(folder)
            status, text = call(*arguments)
            results = [(status, text)]
            if number % EVERY == 0 and not any("\0" in argument for argument in arguments):
                results.append(call_apart(*arguments))
            for status, text in results:
                if status == -1 or "Traceback" in text:
                    faults.append(f"{shown(arguments)}: traceback: {text[-200:]}")
                elif status != 2 or not ("error: " in text or "--help" in text):
                    faults.append(f"{shown(arguments)}: status {status}: {text[-200:]}")
            if names := differing(before, everything(folder)):
                faults.append(f"{shown(arguments)}: written or changed: {', '.join(names[:3])}")
    done = f"{len(wrong)} wrong calls of the command line"
    return done, "each a sentence and status 2; nothing written, no traceback", faults


def call_apart(*arguments):
    command = [sys.executable, str(ROOT / "train.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def shown(arguments):
    return f"{arguments[0]} ... {[argument[-60:] for argument in arguments[-3:]]}"


def differing(before, now):
    return sorted(str(path) for path in {**before, **now} if before.get(path) != now.get(path))


def everything(folder: Path):
    """Modification time and size of each file of a folder, and the names of its folders."""
    paths = [(path, path.lstat()) for path in folder.rglob("*")]
    return {path: () if path.is_dir() else (status.st_mtime_ns, status.st_size) for path, status in paths}
