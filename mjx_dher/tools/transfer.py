"""Zero-shot transfer to the original Fetch tasks, which need an older MuJoCo in a separate virtual environment.

In that environment this file is a program that plays episodes and prints their outcomes. It needs gymnasium-robotics and
NumPy, but neither JAX nor this library's MuJoCo:

    python -m mjx_dher.tools.transfer RUN EPISODES FIRST_SEED
"""

import contextlib
import itertools
import json
import os
import sys
import venv
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_dher.policy.load import load_policy
from mjx_dher.runs.folder.reading import read_spec
from mjx_dher.system import subprocesses
from mjx_dher.system.machine import user_cache

ORIGINALS = {
    "push": "FetchPush-v4",
    "pick_and_place": "FetchPickAndPlace-v4",
    "slide": "FetchSlide-v4",
    "reach": "FetchReach-v4",
    "hand_reach": "HandReach-v3",
    "block_rotate_z": "HandManipulateBlockRotateZ-v1",
    "block_rotate_parallel": "HandManipulateBlockRotateParallel-v1",
    "block_rotate_xyz": "HandManipulateBlockRotateXYZ-v1",
    "block": "HandManipulateBlock-v1",
    "egg_rotate": "HandManipulateEggRotate-v1",
    "egg": "HandManipulateEgg-v1",
    "pen_rotate": "HandManipulatePenRotate-v1",
    "pen": "HandManipulatePen-v1",
}
REQUIREMENTS = ("gymnasium-robotics==1.4.2", "mujoco==3.11.0")  # the tasks cannot be built on mujoco 3.12 or newer
_ELSEWHERE = "import sys; sys.path[:] = filter(None, sys.path); "  # files of the current folder are not taken for modules


def default_environment() -> Path:
    """Folder of the virtual environment that `set_up` creates, in the user's cache folder."""
    return user_cache() / "fetch-originals"


def set_up(environment: Path, requirements: tuple[str, ...] = REQUIREMENTS) -> None:
    """Creates a virtual environment with the original tasks, unless it is complete. Raises ValueError with pip's output."""
    if is_ready(interpreter(environment), requirements):
        return
    venv.create(environment, with_pip=True, clear=True)
    pip = (*_running(interpreter(environment), "pip"), "install", "--quiet", "--disable-pip-version-check")
    answer = subprocesses.ask((*pip, *requirements))
    if answer.failure:
        raise ValueError(f"{environment} could not be set up: {answer.err.strip() or answer.failure}")


def interpreter(environment: Path) -> Path:
    """Python of a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def check_original(env_name: str, python: Path) -> str:
    """Gymnasium id of a task's original. Raises ValueError if it has none, or `python` does not have the original tasks."""
    if env_name not in ORIGINALS:
        raise ValueError(f"{env_name} has no original to transfer to; tasks with an original: {', '.join(ORIGINALS)}")
    if not is_ready(python):
        raise ValueError(
            f"the original tasks need {' and '.join(REQUIREMENTS)} in a separate virtual environment, and {python} does"
            " not have them: create one with --set-up (a download of 200 MB), or pass your Python with --python"
        )
    return ORIGINALS[env_name]


def play_apart(run: Path, python: Path, episodes: int, seed: int, workers: int) -> dict[str, np.ndarray]:
    """Plays a run's policy in its original task, in `workers` processes of another Python. Episode i has the seed `seed` + i.

    Returns arrays [episodes]: success and reset_success, bool, and ret, the undiscounted return. Raises ValueError if a process
    failed. The message includes the end of its output.
    """
    workers = min(workers, episodes)
    bounds = [episodes * i // workers for i in range(workers + 1)]
    with subprocesses.temporary_folder("mjx-dher-transfer-") as folder, contextlib.ExitStack() as stack:
        # A folder with only this package, because the other Python has its own NumPy and MuJoCo.
        (folder / "mjx_dher").symlink_to(subprocesses.PACKAGE, target_is_directory=True)
        processes = []
        for first, end in itertools.pairwise(bounds):
            arguments = (str(run.resolve()), str(end - first), str(seed + first))
            command = (*_running(python, "mjx_dher.tools.transfer"), *arguments)
            processes.append(stack.enter_context(subprocesses.started(command, {"PYTHONPATH": str(folder)})))
        outcomes = []
        for process in processes:
            answer = subprocesses.answer(process)
            if answer.failure:
                raise ValueError(f"{python} failed to play the original task: {answer.err.strip()[-2000:] or answer.failure}")
            outcomes.append(answer.last_json())
    return {name: np.concatenate([np.asarray(outcome[name]) for outcome in outcomes]) for name in outcomes[0]}


def play_original(run: Path, episodes: int, first_seed: int) -> dict[str, list[Any]]:
    """Plays a run's policy in its original task in this process. Episode i uses the seed `first_seed` + i."""
    warnings.filterwarnings("ignore")
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env, policy = gymnasium.make(ORIGINALS[read_spec(run).env]), load_policy(run)
    original: Any = env.unwrapped
    outcome: dict[str, list[Any]] = {"success": [], "reset_success": [], "ret": []}
    for seed in range(first_seed, first_seed + episodes):
        obs, _ = env.reset(seed=seed)
        reached = original._is_success(obs["achieved_goal"], obs["desired_goal"])
        ended, ret = False, 0.0
        info: dict[str, Any] = {}
        while not ended:
            obs, reward, _, ended, info = env.step(policy(obs))
            ret += float(reward)
        outcome["success"].append(bool(info["is_success"]))
        outcome["reset_success"].append(bool(reached))
        outcome["ret"].append(ret)
    return outcome


def is_ready(python: Path, requirements: tuple[str, ...] = REQUIREMENTS) -> bool:
    """Whether `python` exists and has the original tasks in the required versions."""
    names = [requirement.split("==")[0] for requirement in requirements]
    code = f"from importlib import metadata as m; print(*[n + '==' + m.version(n).split('+')[0] for n in {names}])"
    return tuple(subprocesses.ask((str(python), "-c", _ELSEWHERE + code)).out.split()) == requirements


def _running(python: Path, module: str) -> tuple[str, ...]:
    """Command that runs a module, which may not lie in the current folder."""
    return str(python), "-c", f"{_ELSEWHERE}import runpy; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"


def main(argv: Sequence[str]) -> None:
    """Prints the outcomes of `play_original` as JSON in the last line."""
    run, episodes, first_seed = argv
    print(json.dumps(play_original(Path(run), int(episodes), int(first_seed))))


if __name__ == "__main__":
    main(sys.argv[1:])
