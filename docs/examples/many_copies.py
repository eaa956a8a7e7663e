"""Steps thousands of copies of an environment in one compiled program: `vmap` over the batch, `scan` over time."""

import argparse
import time

import jax

from mjx_dher import envs


def main(argv=None):
    """Prints the steps per second, and the last rewards."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="push", help="a name, or module:attribute")
    parser.add_argument("--engine", default="auto", help="native, jax, warp or auto")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=50)
    args = parser.parse_args(argv)
    env = envs.make(args.env, engine=args.engine)

    @jax.jit
    def play(states, key):
        def step(states, key):
            actions = jax.random.uniform(key, (args.num_envs, env.action_size), minval=-1, maxval=1)
            states = jax.vmap(env.step)(states, actions)
            return states, states.reward

        return jax.lax.scan(step, states, jax.random.split(key, args.steps))

    first = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), args.num_envs))
    compiled = play.lower(first, jax.random.key(1)).compile()  # so that compiling is not measured
    started = time.perf_counter()
    states, rewards = jax.block_until_ready(compiled(first, jax.random.key(1)))  # rewards [steps, num_envs]
    seconds = time.perf_counter() - started
    print(f"{rewards.size:,} steps in {seconds:.2f} s: {rewards.size / seconds:,.0f} a second")
    print(f"observations {states.obs['observation'].shape}, mean reward {rewards.mean():.3f}")


if __name__ == "__main__":
    main()
