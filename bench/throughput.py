"""Environment steps per second inside a jitted rollout as in training, with the policy network and exploration.

    python bench/throughput.py [--env push pick_and_place slide] [--engines native jax] [--num-envs 16 32 128]

On a GPU: --engines warp --num-envs 2048 8192 32768. A custom task is module:attribute. --path selects how warp runs the model
(both: --path fused graph), and --random plays random actions in place of the policy's. Each line is printed as soon as it is
measured. Hands, each case in less than a minute after kernels are compiled:

    python bench/throughput.py --env block_rotate_z --engines warp --path fused graph --num-envs 1024 8192 --random --repeats 2
"""

import argparse
import itertools
import time
from typing import Any

import jax
from timing import machine, median_seconds

from mjx_dher import Config, HParams, envs, learners
from mjx_dher.contract import env_spec
from mjx_dher.rollout import rollout


def measure(task: str, engine: str, num_envs: int, path: str, random: bool, repeats: int) -> tuple[str, float, float]:
    """The engine and its path, environment steps per second, and seconds of the first call, which compiles."""
    env: Any = envs.make(task, engine=engine, **({"path": path} if engine == "warp" else {}))
    hparams, learner = HParams(), learners.make("ddpg", Config(), env_spec(env))
    state = learner.init(jax.random.key(0))

    @jax.jit
    def play(key):
        if random:
            shape = (env.episode_length, num_envs, env.action_size)
            actions = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
            return rollout(env, lambda action, obs: action, key, num_envs, actions)
        noise = learner.noise(key, env.episode_length, num_envs, hparams)
        policy = lambda noise, obs: learner.explore(state, obs, noise, hparams)  # noqa: E731
        return rollout(env, policy, key, num_envs, noise)

    start = time.perf_counter()
    jax.block_until_ready(play(jax.random.key(1)))
    compiled = time.perf_counter() - start
    keys = iter(jax.random.split(jax.random.key(2), 2 + repeats))
    seconds = median_seconds(lambda: play(next(keys)), repeats=repeats)
    env.check()
    name = f"{engine} {env.engine.path}" if engine == "warp" else engine
    return name, num_envs * env.episode_length / seconds, compiled


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["push"])
    parser.add_argument("--engines", nargs="+", default=["native", "jax"])
    parser.add_argument("--num-envs", type=int, nargs="+", default=[16, 32, 128])
    parser.add_argument("--path", nargs="+", default=["auto"], choices=["auto", "fused", "graph"])
    parser.add_argument("--random", action="store_true", help="random actions")
    parser.add_argument("--repeats", type=int, default=5, help="timed episodes")
    args = parser.parse_args()
    print(f"{machine()}\n\n| task | engine | num_envs | env steps/s | first call, s |\n|{'---|' * 5}", flush=True)
    for task, engine, num_envs, path in itertools.product(args.env, args.engines, args.num_envs, args.path):
        name, rate, compiled = measure(task, engine, num_envs, path, args.random, args.repeats)
        print(f"| {task} | {name} | {num_envs} | {rate:,.0f} | {compiled:.1f} |", flush=True)


if __name__ == "__main__":
    main()
