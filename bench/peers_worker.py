"""The peers of bench/peers.py: Stable-Baselines3 and sb3-contrib on the tasks of gymnasium-robotics, in a separate Python.

    python bench/peers_worker.py '{"part": "train", "task": "FetchPush-v4", ...}'

It prints lines of JSON, the last one with the result. It imports neither JAX nor this library.

`ZOO` has the numbers that rl-baselines3-zoo sets for TQC with HER on FetchPush, FetchPickAndPlace and FetchSlide, one set for
all three (DLR-RM/rl-baselines3-zoo, hyperparams/tqc.yml at commit eec15dc2, entries Fetch*-v1). Observations are not
normalized, and there is no time feature. Unset values have the libraries' defaults. The zoo's sac.yml has no settings for
these tasks, so SAC takes the same numbers.
"""
# mypy: disable-error-code="import-not-found"
# The peers are not installed where types are checked.

import contextlib
import io
import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

PEERS = {"tqc": "sb3-contrib TQC", "sac": "Stable-Baselines3 SAC"}
ZOO: dict[str, Any] = {
    "learning_rate": 1e-3,
    "buffer_size": 1_000_000,
    "batch_size": 2048,
    "gamma": 0.95,
    "tau": 0.05,
    "net_arch": [512, 512, 512],
    "n_critics": 2,
    "n_sampled_goal": 4,
    # The libraries' defaults:
    "learning_starts": 100,
    "train_freq": 1,
    "gradient_steps": 1,
    "n_envs": 1,
}
EPISODE_LENGTH = 50
TEST_ENVS = 10  # in separate processes: evaluations use all cores, as ours do
FIRST_SEED = 1000  # of the final episodes


def usable_cores() -> int:
    """Number of cores that this process and its children may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def emit(**content: Any) -> None:
    """Prints a line of JSON."""
    print(json.dumps(content), flush=True)


def make_env(task: str) -> Any:
    """Makes a task of gymnasium-robotics."""
    import gymnasium

    with contextlib.redirect_stderr(io.StringIO()):  # a notice about other tasks, once per process
        import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(task)


def make_vector(task: str, num_envs: int) -> Any:
    """Makes a vectorized task of Stable-Baselines3: one environment in this process, or several in one process each."""
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    makers = [lambda: Monitor(make_env(task))] * num_envs
    return SubprocVecEnv(makers, start_method="fork") if num_envs > 1 else DummyVecEnv(makers)


def make_model(learner: str, settings: dict[str, Any], env: Any, seed: int) -> Any:
    """Makes a learner with HerReplayBuffer (strategy "future") on the CPU; `settings` has the names of `ZOO`."""
    from sb3_contrib import TQC
    from stable_baselines3 import SAC, HerReplayBuffer

    rest = dict(settings)
    del rest["n_envs"]
    policy = {"net_arch": rest.pop("net_arch"), "n_critics": rest.pop("n_critics")}
    her = {"n_sampled_goal": rest.pop("n_sampled_goal"), "goal_selection_strategy": "future"}
    parts = {"policy_kwargs": policy, "replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": her}
    return {"tqc": TQC, "sac": SAC}[learner]("MultiInputPolicy", env, seed=seed, device="cpu", **parts, **rest)


def play(model: Any, envs: Any, episodes: int, first_seed: int | None = None) -> tuple[list[int], list[float]]:
    """Plays the deterministic policy, episode i with the seed `first_seed` + i; without one, from the current state of `envs`.

    Returns:
      Success at the end, 0 or 1, and the undiscounted return of each episode.
    """
    successes: list[int] = []
    returns: list[float] = []
    for first in range(0, episodes, envs.num_envs):
        if first_seed is not None:
            envs.seed(first_seed + first)
        obs, totals, ended = envs.reset(), np.zeros(envs.num_envs), False
        while not ended:  # all episodes have the same length
            obs, rewards, dones, infos = envs.step(model.predict(obs, deterministic=True)[0])
            totals, ended = totals + rewards, dones.all()
        successes += [int(info["is_success"]) for info in infos]
        returns += totals.tolist()
    return successes[:episodes], returns[:episodes]


def train(
    task: str, learner: str, settings: dict[str, Any], seed: int, seconds: float, every: float, episodes: int, final: int
) -> dict[str, Any]:
    """Trains for `seconds` of wall clock, evaluations included, and prints a line for each evaluation.

    Args:
      task: gymnasium id.
      learner: a key of `PEERS`.
      settings: as `ZOO`.
      seed: of the learner and its environments.
      seconds: budget. The last evaluation is completed beyond it.
      every: seconds from the end of an evaluation to the beginning of the next.
      episodes: per evaluation.
      final: episodes of the last policy, with the seeds `FIRST_SEED` + i; they are not timed.

    Returns:
      final_success [final], 0 or 1, and final_return [final].
    """
    tests = make_vector(task, TEST_ENVS)
    tests.seed(100_000 + 1000 * seed)
    model = make_model(learner, settings, make_vector(task, settings["n_envs"]), seed)
    model.learn(10**9, callback=make_watch(lambda: play(model, tests, episodes), seconds, every))
    success, returns = play(model, tests, final, first_seed=FIRST_SEED)
    return {"final_success": success, "final_return": returns}


def make_watch(evaluate: Callable[[], tuple[list[int], list[float]]], seconds: float, every: float) -> Any:
    """Makes the callback that evaluates and prints every `every` seconds, and ends training after `seconds`."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Watch(BaseCallback):
        def _on_training_start(self) -> None:
            self.started, self.next = time.perf_counter(), every
            emit(started=True)

        def _on_step(self) -> bool:
            began = time.perf_counter() - self.started
            if began < min(self.next, seconds):
                return True
            success, returns = evaluate()
            now = time.perf_counter() - self.started
            counts = {"env_steps": self.num_timesteps, "updates": self.model._n_updates}
            means = {"success_rate": float(np.mean(success)), "return_mean": float(np.mean(returns))}
            emit(seconds=now, evaluation=now - began, **counts, **means)
            self.next = now + every
            return now < seconds

    return Watch()


def step_rates(task: str, seconds: float = 10.0) -> dict[str, float]:
    """Environment steps per second with random actions, in one process and in one process per core."""
    rates = {}
    for name, num_envs in (("one process", 1), ("a process a core", usable_cores())):
        env = make_vector(task, num_envs)
        env.reset()
        rng = np.random.default_rng(0)
        start, steps = time.perf_counter(), 0
        while time.perf_counter() - start < seconds:
            env.step(rng.uniform(-1, 1, (num_envs, 4)).astype(np.float32))
            steps += num_envs
        rates[f"environment steps, {name}"] = steps / (time.perf_counter() - start)
        env.close()
    return rates


def relabel_rate(task: str) -> dict[str, float]:
    """Hindsight transitions per second drawn by HerReplayBuffer, after 256 episodes of random actions."""
    steps, num_envs = 256 * EPISODE_LENGTH, 32
    model = make_model("sac", {**ZOO, "learning_starts": steps}, make_vector(task, num_envs), seed=0)
    model.learn(steps)
    batch = ZOO["batch_size"]
    model.replay_buffer.sample(batch)
    times = []
    for _ in range(50):
        start = time.perf_counter()
        model.replay_buffer.sample(batch)
        times.append(time.perf_counter() - start)
    return {f"hindsight transitions, batch {batch}": batch / float(np.median(times))}


PARTS: dict[str, Callable[..., Any]] = {"train": train, "steps": step_rates, "relabel": relabel_rate}


def main() -> None:
    import torch

    warnings.filterwarnings("ignore")
    request = json.loads(sys.argv[1])
    torch.set_num_threads(usable_cores())
    emit(result=PARTS[request.pop("part")](**request))


if __name__ == "__main__":
    main()
