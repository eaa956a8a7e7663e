"""Beside gymnasium-robotics and Stable-Baselines3, on this machine's CPU, one after the other: who does what how fast?

    python bench/peers.py --set-up [--parts env relabel train] [--minutes 20]

`--set-up` makes an environment of their own in the user's cache folder (they need a MuJoCo older than ours); without it, name
their Python with --python. Three comparisons on FetchPush, theirs and ours taking turns:

    env      environment steps a second with random actions: theirs in one process and in one process a core
    relabel  hindsight transitions a second: HerReplayBuffer.sample against drawing and relabelling here
    train    seconds and steps to a success of 0.90 in 100 episodes, evaluation not counted: their DDPG with HER with our
             networks, batch, updates per step, discount, step sizes, relabelling and noise; it is stopped after --minutes
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import time
import warnings
from pathlib import Path

import apart
import numpy as np

from mjx_dher import presets

REQUIREMENTS = ("gymnasium-robotics==1.4.2", "mujoco==3.11.0", "stable-baselines3==2.9.2", "torch==2.13.0")
TASK = "FetchPush-v4"
NUM_ENVS, BATCH_SIZE, UPDATES = 32, 1024, 40  # of the preset `cpu`
SUCCESS = 0.9


def cores():  # their Python has no JAX, and so not this library's usable_cores
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# Theirs: runs in their environment and prints a line of JSON. Neither JAX nor this library is there.


def make_theirs(seed=0):
    import gymnasium

    with contextlib.redirect_stderr(io.StringIO()):  # a notice about other tasks, once a process
        import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(TASK)
    env.reset(seed=seed)
    return env


def vector(num_envs, processes):
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    makers = [lambda seed=seed: Monitor(make_theirs(seed)) for seed in range(num_envs)]
    return SubprocVecEnv(makers, start_method="fork") if processes else DummyVecEnv(makers)


def their_env(_):
    rates = {}
    for name, num_envs in (("one process", 1), ("a process a core", cores())):
        env = vector(num_envs, processes=num_envs > 1)
        env.reset()
        rng = np.random.default_rng(0)
        start, steps = time.perf_counter(), 0
        while time.perf_counter() - start < 10:
            env.step(rng.uniform(-1, 1, (num_envs, 4)).astype(np.float32))
            steps += num_envs
        rates[name] = steps / (time.perf_counter() - start)
        env.close()
    return rates


def their_model(env, seed=0):
    import torch
    from stable_baselines3 import DDPG, HerReplayBuffer
    from stable_baselines3.common.noise import NormalActionNoise

    torch.set_num_threads(cores())
    return DDPG(
        "MultiInputPolicy",
        env,
        learning_rate=1e-3,
        buffer_size=1_000_000,
        learning_starts=NUM_ENVS * 50,
        batch_size=BATCH_SIZE,
        tau=0.02,
        gamma=0.95,
        train_freq=(50, "step"),
        gradient_steps=UPDATES,
        action_noise=NormalActionNoise(np.zeros(4), 0.4 * np.ones(4)),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 16, "goal_selection_strategy": "future"},
        policy_kwargs={"net_arch": [256, 256, 256]},
        seed=seed,
        device="cpu",
    )


def their_relabel(_):
    model = their_model(vector(NUM_ENVS, processes=True))
    model.learn(NUM_ENVS * 50 * 8)
    buffer = model.replay_buffer
    buffer.sample(BATCH_SIZE)
    times = []
    for _ in range(50):
        start = time.perf_counter()
        buffer.sample(BATCH_SIZE)
        times.append(time.perf_counter() - start)
    model.env.close()
    return {"transitions": BATCH_SIZE / float(np.median(times))}


def their_train(minutes):
    from stable_baselines3.common.callbacks import BaseCallback

    test = make_theirs(seed=10_000)

    class Watch(BaseCallback):
        """Evaluates every 24,000 steps, as the preset does, with the clock stopped; ends at SUCCESS or when time is up."""

        def __init__(self):
            super().__init__()
            self.started, self.paused, self.next, self.curve = time.perf_counter(), 0.0, 24_000, []

        def _on_step(self):
            if self.num_timesteps < self.next:
                return True
            self.next += 24_000
            now = time.perf_counter()
            seconds = now - self.started - self.paused
            successes = 0
            for _ in range(100):
                obs, ended = test.reset()[0], False
                while not ended:
                    obs, _, _, ended, info = test.step(self.model.predict(obs, deterministic=True)[0])
                successes += int(info["is_success"])
            self.paused += time.perf_counter() - now
            self.curve.append((round(seconds, 1), self.num_timesteps, successes / 100))
            print(*self.curve[-1], file=sys.stderr, flush=True)
            return successes < 100 * SUCCESS and seconds < 60 * minutes

    watch = Watch()
    their_model(vector(NUM_ENVS, processes=True)).learn(10**9, callback=watch)
    return {"curve": watch.curve}


# Ours.


def our_env():
    """Steps a second of a compiled rollout of random actions, native."""
    import jax
    from timing import median_seconds

    from mjx_dher import envs
    from mjx_dher.rollout import rollout

    env = envs.make("push", engine="native")
    rates = {}
    for num_envs in (NUM_ENVS, 128):
        shape = (env.episode_length, num_envs, env.action_size)
        actions = jax.random.uniform(jax.random.key(0), shape, minval=-1, maxval=1)
        play = jax.jit(lambda key, n=num_envs, a=actions: rollout(env, lambda action, obs: action, key, n, a))
        rates[num_envs] = num_envs * env.episode_length / median_seconds(lambda p=play: p(jax.random.key(1)))
    return rates


def our_relabel():
    """Transitions a second, drawn as many at once as in training."""
    import jax
    from learner import compute_reward, full_ring
    from timing import median_seconds

    from mjx_dher import HParams, replay, samplers
    from mjx_dher.relabel import draw_batches
    from mjx_dher.trainer import MAX_TRANSITIONS_PER_DRAW as NUM_DRAWN

    ring, hparams = full_ring(), HParams()
    cumulative = replay.cumulative_priority(ring)
    rates = {}
    for name in ("future", "weighted"):
        sampler = samplers.make(name)
        draw = jax.jit(lambda key, s=sampler: draw_batches(ring, key, (NUM_DRAWN,), s, compute_reward, hparams, cumulative))
        rates[name] = NUM_DRAWN / median_seconds(lambda d=draw: d(jax.random.key(0)))
    return rates


def our_train():
    """(seconds, env steps) to SUCCESS of the preset `cpu`, evaluations included and compilation apart; success there."""
    from mjx_dher import envs, samplers
    from mjx_dher.runs.loop import train

    spec, sampler = presets.preset("cpu", "push"), samplers.make("weighted")
    for progress in train(envs.make("push", engine="native"), spec.config, spec.hparams, seed=0, sampler=sampler):
        if progress.metrics["success_rate"] >= SUCCESS:
            break
    return progress.wall_seconds, progress.env_steps, progress.metrics["success_rate"]


def measure(part, minutes):
    """What `their_...` returns; their Python runs this."""
    warnings.filterwarnings("ignore")
    return {"env": their_env, "relabel": their_relabel, "train": their_train}[part](float(minutes))


def compare(python, parts, minutes):
    from timing import print_table

    def theirs(part):
        return apart.measured(__file__, (part, str(minutes)), python=str(python))

    rows = []
    if "env" in parts:
        there, here = theirs("env"), our_env()
        for name, rate in there.items():
            for num_envs, ours in here.items():
                rows.append(
                    ("env steps/s", name, f"{rate:,.0f}", f"native, {num_envs} envs", f"{ours:,.0f}", f"{ours / rate:.1f}")
                )
    if "relabel" in parts:
        rate, here = theirs("relabel")["transitions"], our_relabel()
        for name, ours in here.items():
            what = f"HerReplayBuffer, batch {BATCH_SIZE}"
            rows.append(("transitions relabelled/s", what, f"{rate:,.0f}", name, f"{ours:,.0f}", f"{ours / rate:.1f}"))
    if "train" in parts:
        (seconds, steps, success), curve = our_train(), theirs("train")["curve"]
        their_seconds, their_steps, their_success = curve[-1]
        reached = their_success >= SUCCESS
        there = f"{their_seconds:,.0f} s, {their_steps:,} steps: {their_success:.2f}"
        here = f"{seconds:,.0f} s, {steps:,} steps: {success:.2f}"
        ratio = f"{'' if reached else 'more than '}{their_seconds / seconds:.1f}"
        rows.append((f"to {SUCCESS} on Push", "DDPG + HerReplayBuffer", there, "preset cpu, weighted", here, ratio))
    print_table(("", "theirs", "", "ours", "", "ratio"), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=("env", "relabel", "train"), default=("env", "relabel", "train"))
    parser.add_argument("--minutes", type=float, default=20)
    parser.add_argument("--set-up", action="store_true")
    parser.add_argument("--python", type=Path)
    args = parser.parse_args()
    from mjx_dher.host.caches import user_cache
    from mjx_dher.tools import originals

    environment = user_cache() / "peers"
    if args.set_up:
        originals.set_up(environment, REQUIREMENTS)
    compare(args.python or originals.interpreter(environment), args.parts, args.minutes)


if __name__ == "__main__":
    apart.main(measure, main)
