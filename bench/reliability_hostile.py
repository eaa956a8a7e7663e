"""Run folders made by an attacker: each tries to run code, to read or write elsewhere, or to end a command badly.

    python bench/reliability.py --parts hostile

`hostile` makes cases from a seed, opens each with a command in a separate process, and returns the faults. A case is a whole
run, or a sweep, of the point mass with one to three changes. All digests are forged so that they agree.
"""

import contextlib
import json
import os
import pickle
import random
import re
import shutil
import signal
import sys
import time

import numpy as np
from reliability_pairs import ROOT, SHAPES

from mjx_dher import cli
from mjx_dher.components import COMPONENTS
from mjx_dher.runs.folder import fingerprint, reading

SECONDS = 60  # time limit of a case
SERVED = 12  # seconds until a served page is closed
MODULE = """
import pathlib
pathlib.Path({canary!r}).touch()
from os import system
from subprocess import run, Popen
class Env:
    def __init__(self, *args, **kwargs): pathlib.Path({canary!r}).touch()
    action_size, episode_length = 2, 10
    reset = step = compute_reward = lambda *args: pathlib.Path({canary!r}).touch()
def make(*args, **kwargs): pathlib.Path({canary!r}).touch()
"""
PATHS = (
    *("evil:Env", "evil:make", "evil:system", "evil:run", "evil:Popen"),
    *("evil_parent.child:Env", "evil_parent:make", "evil_space.x:Env", "docs.examples.point_mass:PointMass"),
    *("os:system", "posix:system", "subprocess:Popen", "subprocess:run", "builtins:exec", "builtins:exit", "runpy:run_path"),
    *("ctypes:CDLL", "importlib:import_module", "pty:spawn", "os.path:exists", "json.tool:main", "numpy:load"),
    *("jax.numpy:load", "mujoco:MjModel", "warp:load_aot_module", "mjx_dher.cli:main", "mjx_dher.system.subprocesses:ask"),
    *("mjx_dher.tools.transfer:set_up", "mjx_dher.system.files:remove", "__main__:main", "evil", "evil:", ":Env", "..evil:Env"),
    *("evil:Env:x", "/tmp/evil:Env", "evil\x00:Env", "evil:__class__", "pip:main", "setuptools:setup", "this:s"),
)
TEXTS = ("\x1b[2J", "\x1b]0;x\x07", "\x9b31m", "\r\x08", "\u202e", "[link=http://x]y[/link]", "<b>x</b>", "$\\no$", "\ud800")
COMMANDS = {
    "dry-run": ("train", "--config", "received", "--dry-run"),
    "train": ("train", "--config", "received", "--out", "new", "--no-curve"),
    "resume": ("resume", "received", "--no-curve", "--total-steps", "120"),
    "eval": ("eval", "received", "--episodes", "2", "--json"),
    "view": ("view", "received", "--port", "0", "--no-open"),
    "render": ("render", "received", "--out", "x.png", "--episodes", "1"),
    "transfer": ("transfer", "received"),
    "plot": ("plot", "received"),
    "report": ("report", "received"),
    "film": ("report", "received", "--video"),
    "export": ("export", "received", "--format", "onnx"),
    "load": (),  # load_policy
    "plot-sweep": ("plot", "swept"),
    "report-sweep": ("report", "swept", "--video"),
    "sweep": ("sweep", *SHAPES, "--total-steps", "80", "--sampler", "future", "--seeds", "2", "--out", "swept"),
}


class Pickled:
    """Runs a command when it is unpickled."""

    def __init__(self, canary):
        self.canary = canary

    def __reduce__(self):
        return os.system, (f"touch {self.canary}",)


class Case:
    """One hostile folder, inside a separate folder."""

    def __init__(self, place, base, rng):
        self.place, self.rng, self.told = place, rng, []
        self.canary, self.secret = str(place / "canary"), place / "secret"
        shutil.copytree(base, place, symlinks=True)
        (place / "mine").mkdir()
        self.secret.write_text("token-of-the-user")
        for name in ("evil.py", "evil_parent/__init__.py", "evil_parent/child.py", "evil_space/x.py"):
            (place / name).parent.mkdir(exist_ok=True)
            (place / name).write_text(MODULE.format(canary=self.canary))
        self.command = rng.choice(list(COMMANDS))
        self.sweep = "sweep" in self.command
        self.run = rng.choice(sorted((place / "swept" / "cells").iterdir())) if self.sweep else place / "received"
        chosen = {rng.choice(CHANGES) for _ in range(rng.choice((1, 1, 2, 3)))}
        for change in sorted(chosen, key=lambda change: (change in BREAKING, change.__name__)):
            self.told.append(change.__name__)
            with contextlib.suppress(OSError, ValueError, KeyError):  # made impossible by the previous change
                change(self)

    def edit(self, **changes):
        """Changes entries of config.json, and forges every digest of the run."""
        file = self.run / "config.json"
        content = json.loads(file.read_text())
        before = content["digest"]
        content |= changes
        file.write_text(json.dumps(content))
        identity = reading.identity_of(content, reading.to_spec(file, content))
        now = fingerprint.digest(identity)
        for name in ("config.json", "result.json", "metrics.csv"):
            with contextlib.suppress(OSError):
                (self.run / name).write_text((self.run / name).read_text().replace(before, now))
        with np.load(self.run / "policy.npz") as arrays:
            kept = {name: array for name, array in arrays.items() if name != "settings"}
        settings = np.frombuffer(json.dumps(identity).encode(), np.uint8)
        np.savez(self.run / "policy.npz", **kept, settings=settings)
        shutil.rmtree(self.run / "checkpoints", ignore_errors=self.rng.random() < 0.5)

    def arguments(self):
        """Arguments that would leave the canary, for several callables."""
        kinds: tuple[list[str], ...] = (
            [f"command=touch {self.canary}"],
            [f"args=touch {self.canary}", "shell=true"],
            [f"cmd=touch {self.canary}"],
            [f"source=open({self.canary!r},'w')"],
            [f"path_name={self.place / 'evil.py'}"],
            [f"path={self.secret}"],
            ["name=evil"],
            [],
        )
        return self.rng.choice(kinds)


def environment(case):
    case.edit(env=case.rng.choice(PATHS), env_kwargs=case.arguments(), sources={})


def component(case):
    field = case.rng.choice([field for field in COMPONENTS if field != "env"])
    case.edit(**{field: case.rng.choice(PATHS)}, **({"sampler": "weighted"} if field == "weight_kernel" else {}))


def learner(case):
    case.edit(**{case.rng.choice(("learner", "networks")): case.rng.choice(PATHS)})
    with np.load(case.run / "policy.npz") as arrays:
        settings = arrays["settings"]
    dtype = '{"observation": {"shape": [1], "dtype": "evil:Env"}, "reward_range": [0, 1]}'
    spec = case.rng.choice(("{}", "[]", '{"observation": []}', "[" * 5000, dtype))
    np.savez(case.run / "policy.npz", env_spec=np.array(spec), state0000=np.zeros(3), settings=settings)


def demonstrations(case):
    os.mkfifo(case.place / "pipe.npz")
    np.savez(case.place / "objects.npz", episodes=np.array([Pickled(case.canary)], object))
    (case.place / "minari" / "data").mkdir(parents=True)
    os.mkfifo(case.place / "minari" / "data" / "main_data.hdf5")
    case.edit(demonstrations=case.rng.choice(("pipe.npz", "objects.npz", "minari", "/dev/zero", "../../etc", str(case.secret))))


def link(case):
    read = ("metrics.csv", "policy.npz", "result.json", "config.json", "x.gif", "v.webm")
    written = ("report.html", "curve.png", "checkpoints", "tensorboard", "metrics.jsonl", ".lock", "policy.npz.partial")
    path = case.run / case.rng.choice((*read, *written))
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(case.rng.choice((case.secret, case.place / "mine", case.place / "nowhere", path)))


def folder_link(case):
    paths = ("swept/cells/other", "swept/unfinished", "swept/x.gif", "received/checkpoints/epoch-000009")
    path = case.place / case.rng.choice(paths)
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(case.rng.choice((case.secret, case.place / "mine")))


def names(case):
    folder = case.place / "swept" / "unfinished" / "x"
    folder.mkdir(parents=True)
    listed = case.rng.choice((["../../mine"], ["/etc"], [5], {"a": 1}, "x", None, [[]]))
    (folder / "cells.json").write_text(json.dumps({"schema": 2, "cells": listed}))


def text(case):
    words = case.rng.choice(TEXTS)
    changes = ({"versions": {"mjx_dher": words}}, {"physics": words}, {"env": words}, {"sampler": words + ":x"})
    case.edit(**case.rng.choice(changes))


def file(case):
    path = case.run / case.rng.choice(("config.json", "result.json", "metrics.csv", "policy.npz"))
    path.unlink()
    kind = case.rng.choice(("pipe", "huge", "deep", "utf-16", "yaml", "numbers", "folder"))
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "huge":
        with path.open("wb") as stream:
            stream.truncate(1 << 36)
    elif kind == "folder":
        path.mkdir()
    else:
        texts = {"deep": "[" * 200_000, "yaml": f"!!python/object/apply:os.system ['touch {case.canary}']"}
        numbers = '{"schema": 2, "config": {"x": ' + "9" * 5000 + "}}"
        path.write_text(texts.get(kind, numbers), "utf-16" if kind == "utf-16" else "utf-8")


def unpickled(case):
    where = case.rng.choice(("policy", "array", "checkpoint"))
    objects = np.array([Pickled(case.canary)], object)
    if where == "policy":
        np.savez(case.run / "policy.npz", layer0_kernel=objects)
    elif where == "array":
        (case.run / "policy.npz").write_bytes(pickle.dumps(Pickled(case.canary)))
    else:
        for path in (case.run / "checkpoints").rglob("*"):
            if path.is_file() and path.suffix != ".json":
                path.write_bytes(pickle.dumps(Pickled(case.canary)))


def manifest(case):
    for path in (case.run / "checkpoints").rglob("*.json"):
        content = path.read_text()
        content = content.replace('"state', f'"../../../../{case.secret.name}', 1)
        path.write_text(content.replace("future", case.rng.choice(PATHS)))


CHANGES = [environment, environment, environment, component, component, learner, demonstrations, link, link, folder_link, names]
BREAKING = (link, folder_link, file)  # their results cannot be edited further
CHANGES += [text, file, unpickled, manifest]


def in_a_process(place, act, seconds=SECONDS):
    """Exit status of `act`, called in a fork in the folder `place` with its output in the file "output". None: timed out."""
    if (pid := os.fork()) == 0:
        status = 99
        try:
            os.chdir(place)
            os.environ["XDG_STATE_HOME"] = str(place / "state")
            output = os.open(place / "output", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for number in (1, 2):
                os.dup2(output, number)
            sys.stdout, sys.stderr = (os.fdopen(number, "w", errors="backslashreplace") for number in (1, 2))
            status = act()
        except BaseException as error:
            print(f"Traceback: {type(error).__name__}: {error}", file=sys.stderr)
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(status)
    start, served = time.monotonic(), False
    while time.monotonic() - start < seconds:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return 0 if served else os.waitstatus_to_exitcode(status)
        if time.monotonic() - start > SERVED and b"showing " in (place / "output").read_bytes() and not served:
            served = True
            os.kill(pid, signal.SIGINT)
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return None


def make_base(base):
    """A finished run with a checkpoint, and a sweep, as an attacker with a separate state folder would train them."""

    def act():
        train = [*SHAPES, "--total-steps", "80", "--keep-end", "--out", "received", "--no-curve"]
        return cli.main(train) or cli.main([*COMMANDS["sweep"]])

    base.mkdir(parents=True)
    assert in_a_process(base, act, 600) == 0, (base / "output").read_text()
    shutil.rmtree(base / "state")


def opened(case):
    """Opens the folder with the command of the case."""
    if not COMMANDS[case.command]:
        import mjx_dher

        try:
            mjx_dher.load_policy("received")
        except ValueError as error:
            print(type(error).__name__)
            return 2
        return 0
    return cli.main(list(COMMANDS[case.command]))


def faults_of(case, status):
    """Forbidden effects of a case."""
    output = (case.place / "output").read_text(errors="replace")
    if os.path.exists(case.canary):
        yield "code ran"
    if status not in (0, 2):
        yield f"status {status}: {output[-200:]!r}"
    if "Traceback" in output:
        yield f"traceback: {output[-200:]!r}"
    if re.search("[\x00-\x08\x0b-\x0c\x0e-\x1f\x7f\u202e]", output.replace("\x1b[0m", "")):
        yield "control characters"
    if case.secret.read_text() != "token-of-the-user" or any((case.place / "mine").iterdir()):
        yield "something outside was written"
    pages = [path for path in case.place.rglob("report.html") if not path.is_symlink()]
    if any("dG9rZW4tb2YtdGhlLXVzZXI" in page.read_text() or "token-of-the-user" in page.read_text() for page in pages):
        yield "a page has the secret"


def hostile(folder, count=200, seed=0):
    """Makes and opens `count` cases."""
    sys.path[:0] = [str(ROOT / "docs" / "examples"), ""]
    rng, base, ended, faults = random.Random(seed), folder / "base", dict[int | None, int](), []
    make_base(base)
    for number in range(count):
        case = Case(folder / f"case-{number:03d}", base, rng)
        status = in_a_process(case.place, lambda case=case: opened(case))
        ended[status] = ended.get(status, 0) + 1
        new = [f"case {number} ({case.command}; {', '.join(case.told)}): {fault}" for fault in faults_of(case, status)]
        faults += new
        if not new:
            shutil.rmtree(case.place)
    done = f"{count} folders that name code, link elsewhere or are damaged, opened by {len(COMMANDS)} commands"
    return done, f"no code ran; {ended.get(2, 0)} errors with status 2, {ended.get(0, 0)} without effect", faults
