"""The original Fetch tasks, which need a MuJoCo older than ours: zero-shot transfer in an environment of its own.

Run as a program in that environment, this file plays episodes and prints their outcomes; it needs gymnasium-robotics and
NumPy, but neither JAX nor this library's MuJoCo:

    python -m mjx_dher.tools.originals RUN EPISODES FIRST_SEED
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import subprocess
import sys
import tempfile
import venv
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher.host.caches import user_cache
from mjx_dher.runs.load import load_policy
from mjx_dher.runs.run_folder import read_config

ORIGINALS = {
    "push": "FetchPush-v4",
    "pick_and_place": "FetchPickAndPlace-v4",
    "slide": "FetchSlide-v4",
    "reach": "FetchReach-v4",
}
REQUIREMENTS = ("gymnasium-robotics==1.4.2", "mujoco==3.11.0")  # the tasks cannot be built on mujoco 3.12 or newer
REACHED = 0.05  # m


def default_environment() -> Path:
    """Where `set_up` makes the originals' environment: in the user's cache folder."""
    return user_cache() / "fetch-originals"


def set_up(environment: Path, requirements: tuple[str, ...] = REQUIREMENTS) -> None:
    """Makes a virtual environment with the original tasks, from the package index; leaves a whole one as it is.

    Raises:
      ValueError: pip failed, with what it said.
    """
    if is_ready(interpreter(environment), requirements):
        return
    venv.create(environment, with_pip=True, clear=True)
    python = str(interpreter(environment))
    command = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError(f"{environment} could not be set up: {done.stderr.strip()}")


def interpreter(environment: Path) -> Path:
    """The Python of a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def check(env_name: str, python: Path) -> str:
    """The original's name.

    Raises:
      ValueError: the task has no original, or `python` does not have the original tasks.
    """
    if env_name not in ORIGINALS:
        raise ValueError(f"{env_name} has no original to transfer to; the tasks that have: {', '.join(ORIGINALS)}")
    if not is_ready(python):
        raise ValueError(
            f"the original tasks need {' and '.join(REQUIREMENTS)} in an environment of their own, and {python} does not have"
            " them: --set-up makes one there (a download of 200 MB), or name the Python of yours with --python"
        )
    return ORIGINALS[env_name]


def play_apart(run: Path, python: Path, episodes: int, seed: int, workers: int) -> dict[str, np.ndarray]:
    """Plays a run's policy in its original task, in `workers` processes of another Python.

    Returns:
      success and reset_success, bool, and ret, the undiscounted sum of rewards; all [episodes].

    Raises:
      ValueError: a process failed, with what it said.
    """
    workers = min(workers, episodes)
    bounds = [episodes * i // workers for i in range(workers + 1)]
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        # Only this package is to be seen there, not what lies beside it: that environment has another NumPy and MuJoCo.
        (Path(folder) / "mjx_dher").symlink_to(Path(__file__).resolve().parent, target_is_directory=True)
        variables = {**os.environ, "PYTHONPATH": folder}
        processes = []
        for first, end in itertools.pairwise(bounds):
            arguments = [str(run.resolve()), str(end - first), str(seed + first)]
            command = [str(python), "-m", "mjx_dher.tools.originals", *arguments]
            process = subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            stack.callback(process.kill)
            processes.append(process)
        outcomes = []
        for process in processes:
            out, err = process.communicate()
            if process.returncode:
                raise ValueError(f"{python} failed to play the original task: {err.strip()[-2000:]}")
            outcomes.append(json.loads(out.splitlines()[-1]))
    return {name: np.concatenate([np.asarray(outcome[name]) for outcome in outcomes]) for name in outcomes[0]}


def play(run: Path, episodes: int, first_seed: int) -> dict[str, list[Any]]:
    """Plays a run's policy in its original task, here: one episode for each seed from `first_seed` on."""
    warnings.filterwarnings("ignore")
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env, policy = gymnasium.make(ORIGINALS[read_config(run).config.env]), load_policy(run)
    outcome: dict[str, list[Any]] = {"success": [], "reset_success": [], "ret": []}
    for seed in range(first_seed, first_seed + episodes):
        obs, _ = env.reset(seed=seed)
        distance = np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"])
        ended, ret = False, 0.0
        info: dict[str, Any] = {}
        while not ended:
            obs, reward, _, ended, info = env.step(policy(obs))
            ret += float(reward)
        outcome["success"].append(bool(info["is_success"]))
        outcome["reset_success"].append(bool(distance < REACHED))
        outcome["ret"].append(ret)
    return outcome


def is_ready(python: Path, requirements: tuple[str, ...] = REQUIREMENTS) -> bool:
    """Whether `python` is there and has the original tasks, in the versions that they need."""
    names = [requirement.split("==")[0] for requirement in requirements]
    code = f"from importlib import metadata as m; print(*[n + '==' + m.version(n).split('+')[0] for n in {names}])"
    try:
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
    except OSError:
        return False
    return tuple(done.stdout.split()) == requirements


def main(argv: Sequence[str]) -> None:
    """Prints the outcomes of `play` as JSON, in the last line."""
    run, episodes, first_seed = argv
    print(json.dumps(play(Path(run), int(episodes), int(first_seed))))


if __name__ == "__main__":
    main(sys.argv[1:])
