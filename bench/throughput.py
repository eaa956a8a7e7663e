"""Environment steps a second, inside a jitted rollout as training makes it: the policy network and exploration included.

    python bench/throughput.py [--env push pick_and_place slide] [--engines native jax] [--num-envs 16 32 128]

On a GPU: --engines warp --num-envs 2048 8192 32768.
"""

from __future__ import annotations

import argparse
import itertools
import time

import jax
from timing import median_seconds, print_table

from mjx_dher import Config, HParams, envs, learners
from mjx_dher.rollout import rollout
from mjx_dher.trainer import env_sizes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["push"])
    parser.add_argument("--engines", nargs="+", default=["native", "jax"])
    parser.add_argument("--num-envs", type=int, nargs="+", default=[16, 32, 128])
    args = parser.parse_args()
    hparams = HParams()
    rows = []
    for task, engine in itertools.product(args.env, args.engines):
        env = envs.make(task, engine=engine)
        learner = learners.make("ddpg", Config(), env_sizes(env))
        state = learner.init(jax.random.key(0))
        for num_envs in args.num_envs:

            @jax.jit
            def play(key, env=env, num_envs=num_envs, learner=learner, state=state):
                noise = learner.noise(key, env.episode_length, num_envs, hparams)
                policy = lambda noise, obs: learner.explore(state, obs, noise, hparams)  # noqa: E731
                return rollout(env, policy, key, num_envs, noise)

            start = time.perf_counter()
            jax.block_until_ready(play(jax.random.key(1)))
            compiled = time.perf_counter() - start
            keys = iter(jax.random.split(jax.random.key(2), 100))
            seconds = median_seconds(lambda: play(next(keys)), repeats=5)
            rate = num_envs * env.episode_length / seconds
            env.check()
            rows.append((task, engine, num_envs, f"{rate:,.0f}", f"{compiled:.1f}"))
    print_table(("task", "engine", "num_envs", "env steps/s", "first call, s"), rows)


if __name__ == "__main__":
    main()
