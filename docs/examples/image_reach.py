"""Observations as a dict with an image, and a custom encoder for them: a point in the plane, seen by a camera.

    python docs/examples/image_reach.py
    PYTHONPATH=docs/examples python train.py --env image_reach:ImageReach --networks image_reach:networks --batch-size 64

The goal is still a position [2]. The replay ring stores the image as uint8. The learner normalizes the float vectors of an
observation and leaves the image to the encoder.
"""

import argparse
import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp

from mjx_dher import Config, HParams, learners, make_train
from mjx_dher import networks as networks_lib
from mjx_dher.rollout import env_spec
from point_mass import PointMass

PIXELS = 12  # height and width of the image
VIEW = 1.2  # half the width of the square that the camera sees


class ImageReach:
    """A point mass that observes an image and its last action."""

    name = "image_reach"
    goal_size, action_size = 2, 2

    def __init__(self, episode_length: int = 10):
        self.episode_length = episode_length
        self.point = PointMass(episode_length)

    def compute_reward(self, achieved_goal, desired_goal):
        """Rewards of the point mass."""
        return self.point.compute_reward(achieved_goal, desired_goal)

    def reset(self, key):
        """Draws start and goal as the point mass does."""
        return self._seen(self.point.reset(key), jnp.zeros(2))

    def step(self, state, action):
        """State after `action` [2]."""
        return self._seen(self.point.step(state, action), jnp.clip(action, -1, 1))

    def _seen(self, state, action):
        """Replaces the observation by an image, in which the point is a blurred spot, and the last action."""
        axis = jnp.linspace(-VIEW, VIEW, PIXELS)
        squares = jnp.square((axis[:, None] - state.obs["achieved_goal"][None]) / (2 * VIEW / PIXELS))  # [PIXELS, 2]
        image = jnp.round(255 * jnp.exp(-0.5 * (squares[:, None, 0] + squares[None, :, 1]))).astype(jnp.uint8)[..., None]
        observation = {"image": image, "last_action": action.astype(jnp.float32)}
        return dataclasses.replace(state, obs={**state.obs, "observation": observation})


class Encoder(nn.Module):
    """Maps an observation to a vector [..., 34]: a convolution and a layer for the image, then the last action."""

    @nn.compact
    def __call__(self, observation):
        x = observation["image"].astype(jnp.float32) / 255
        x = nn.relu(nn.Conv(8, (3, 3), strides=2)(x))
        x = nn.Dense(32)(x.reshape(*x.shape[:-3], -1))
        return jnp.concatenate([nn.tanh(nn.LayerNorm()(x)), observation["last_action"]], axis=-1)


def networks(action_size, hidden_sizes, dtype="float32", heads=networks_lib.PLAIN):
    """The default networks behind the encoder, for `--networks image_reach:networks`."""
    return networks_lib.mlp(action_size, hidden_sizes, dtype, heads)._replace(encoder=Encoder())


def main(argv=None):
    """Trains and prints the success rate of each epoch."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    env = ImageReach()
    config = Config(
        num_envs=8,
        cycles_per_epoch=5,
        updates_per_cycle=40,
        target_period=1,
        batch_size=64,
        replay_size=10_000,
        hidden_sizes=(64, 64),
        eval_episodes=100,
        total_steps=400 * args.epochs,
    )
    hparams = HParams(gamma=0.9, polyak=0.95, action_l2=0.1)
    program = make_train(env, config, learner=learners.make("ddpg", config, env_spec(env), networks))
    state, epoch = program.init(jax.random.key(args.seed), hparams), jax.jit(program.epoch, donate_argnums=0)
    for number in range(1, args.epochs + 1):
        state, metrics = epoch(state)
        print(f"epoch {number}, {int(state.env_steps)} steps: success {float(metrics['success_rate']):.2f}")


if __name__ == "__main__":
    main()
