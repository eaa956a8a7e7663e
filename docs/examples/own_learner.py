"""Replay and weighted relabelling in a custom training loop.

The learner is not DDPG but a regression (goal-conditioned supervised learning, Ghosh et al. 2021): which action was taken in
episodes that later reached a goal? Rewards are not used; `relabel.relabel` would return them with the goals.
"""

import argparse

import jax
import jax.numpy as jnp
import optax

from mjx_dher import HParams, relabel, replay, rollout, samplers
from mjx_dher.contract import episode_template
from mjx_dher.networks import Actor
from point_mass import PointMass


def main(argv=None):
    """Prints the success rate of each round's episodes, which are played with noise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--updates", type=int, default=100, help="updates per round of 64 episodes, of 256 transitions each")
    args = parser.parse_args(argv)
    env, actor, adam, weighted = PointMass(), Actor(2, (64, 64)), optax.adam(1e-3), samplers.make("weighted")
    ring = replay.init(episode_template(env), num_episodes=1000)
    params = actor.init(jax.random.key(0), jnp.zeros(2), jnp.zeros(2))
    moments = adam.init(params)

    def loss(params, sample, goal):
        return jnp.mean(jnp.square(actor.apply(params, sample.observation, goal) - sample.action))

    @jax.jit
    def play_and_learn(params, moments, ring, key):
        play_key, noise_key, learn_key = jax.random.split(key, 3)
        noise = 0.3 * jax.random.normal(noise_key, (env.episode_length, 64, 2), jnp.float32)

        def act(noise, obs):
            return jnp.clip(actor.apply(params, obs["observation"], obs["desired_goal"]) + noise, -1, 1)

        episodes, outcome = rollout.rollout(env, act, play_key, 64, noise)
        ring = replay.add(ring, episodes)

        def update(learner, key):
            sample_key, goal_key = jax.random.split(key)
            sample = replay.sample(ring, sample_key, 256)
            goal = relabel.hindsight_goals(sample, weighted, HParams(), goal_key).goals
            steps, moments = adam.update(jax.grad(loss)(learner[0], sample, goal), learner[1])
            return (optax.apply_updates(learner[0], steps), moments), None

        (params, moments), _ = jax.lax.scan(update, (params, moments), jax.random.split(learn_key, args.updates))
        return params, moments, ring, outcome.success.mean()

    for number, key in enumerate(jax.random.split(jax.random.key(1), args.rounds), 1):
        params, moments, ring, success = play_and_learn(params, moments, ring, key)
        print(f"round {number}: success {success:.2f}")


if __name__ == "__main__":
    main()
