r"""A learner in one file: contrastive RL (Eysenbach et al. 2022, arXiv 2206.07568) with the InfoNCE loss.

It uses no reward and no bootstrapping. The critic f(s, a, g) learns to distinguish goals that an episode reached after (s, a)
from goals of other episodes. The actor learns the action for which its goal is most likely to be reached.

    python docs/examples/contrastive.py
    PYTHONPATH=docs/examples python train.py --env point_mass:PointMass --learner contrastive:make \
      --sampler contrastive:geometric --her-k inf --gamma 0.8
"""

import argparse
import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from mjx_dher import Config, HParams, make_train, rollout
from mjx_dher.learners import Learner
from point_mass import PointMass


def geometric(achieved, desired, step, hparams):
    """Sampler: the goal t steps later has weight gamma^t, so f estimates a discounted probability. Log weights [T+1]."""
    later = jnp.arange(achieved.shape[0]) - step
    return jnp.where(later > 0, later * jnp.log(hparams.gamma), -jnp.inf)


class MLP(nn.Module):
    """Two hidden layers."""

    hidden_sizes: tuple[int, ...]
    output_size: int

    @nn.compact
    def __call__(self, *inputs):
        x = jnp.concatenate(inputs, axis=-1)
        for size in self.hidden_sizes:
            x = nn.swish(nn.Dense(size)(x))
        return nn.Dense(self.output_size)(x)


@dataclasses.dataclass(frozen=True)
class Contrastive(Learner):
    """f(s, a, g) = -|phi(s, a) - psi(g)|, and a deterministic actor that maximizes it."""

    sizes: tuple[int, int, int]  # of observation, goal and action
    hidden_sizes: tuple[int, ...]
    representation_size: int = 16

    @property
    def networks(self) -> dict[str, MLP]:
        """Modules by name."""
        outputs = {"actor": self.sizes[2], "phi": self.representation_size, "psi": self.representation_size}
        return {name: MLP(self.hidden_sizes, size) for name, size in outputs.items()}

    def init(self, key):
        """Makes the parameters and Adam's moments."""
        obs, goal, action = (jnp.zeros(size) for size in self.sizes)
        inputs = {"actor": (obs, goal), "phi": (obs, action), "psi": (goal,)}
        params = {
            name: net.init(jax.random.fold_in(key, i), *inputs[name]) for i, (name, net) in enumerate(self.networks.items())
        }
        return {"params": params, "adam": optax.adam(1e-3).init(params)}

    def pi(self, params: Any, observation: Any, goal: Any) -> Any:
        """Actions [..., A] of parameters."""
        return jnp.tanh(self.networks["actor"].apply(params["actor"], observation, goal))

    def act(self, state, obs, hparams):
        """Deterministic actions [..., A]."""
        return self.pi(state["params"], obs["observation"], obs["desired_goal"])

    def explore(self, state, obs, noise, hparams):
        """Actions [N, A] with Gaussian noise. `noise` is a key for each environment, [N]."""
        action = self.act(state, obs, hparams)
        return jnp.clip(
            action + hparams.noise_std * jax.vmap(lambda key: jax.random.normal(key, action.shape[1:]))(noise), -1, 1
        )

    def update(self, state, batch, hparams):
        """One step of Adam on the sum of the losses of critic and actor."""
        nets, adam = self.networks, optax.adam(hparams.critic_lr)
        number = len(batch.row)
        # Goals of the same episode are no negative examples: the action may lead to them, too.
        same_episode = (batch.row[:, None] == batch.row[None]) & ~jnp.eye(number, dtype=bool)

        def loss(params):
            phi = nets["phi"].apply(params["phi"], batch.observation, batch.action)
            psi = nets["psi"].apply(params["psi"], batch.desired_goal)
            logits = -jnp.sqrt(jnp.sum((phi[:, None] - psi[None]) ** 2, axis=-1) + 1e-6)  # [B, B] of pair i with goal j
            logits = jnp.where(same_episode, -jnp.inf, logits)
            partition = jax.nn.logsumexp(logits, axis=1)
            critic_loss = jnp.mean(partition - jnp.diag(logits)) + 0.1 * jnp.mean(partition**2)
            fixed = jax.lax.stop_gradient(params)
            action = self.pi(params, batch.observation, batch.desired_goal)
            there = nets["phi"].apply(fixed["phi"], batch.observation, action) - nets["psi"].apply(
                fixed["psi"], batch.desired_goal
            )
            actor_loss = jnp.mean(jnp.sqrt(jnp.sum(there**2, axis=-1) + 1e-6))
            accuracy = jnp.mean(jnp.argmax(logits, axis=1) == jnp.arange(number))
            return critic_loss + actor_loss, {"critic_loss": critic_loss, "actor_loss": actor_loss, "accuracy": accuracy}

        gradients, metrics = jax.grad(loss, has_aux=True)(state["params"])
        changes, moments = adam.update(gradients, state["adam"])
        return {"params": optax.apply_updates(state["params"], changes), "adam": moments}, metrics


def make(config, spec, networks):
    """Makes the learner, for `--learner contrastive:make`."""
    return Contrastive((spec.observation_size, spec.goal_size, spec.action_size), config.hidden_sizes)


def main(argv=None):
    """Trains on the point mass and prints the success rate of each epoch."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    env = PointMass()
    config = Config(
        num_envs=8,
        cycles_per_epoch=5,
        updates_per_cycle=40,
        batch_size=128,
        replay_size=10_000,
        hidden_sizes=(64, 64),
        eval_episodes=100,
        total_steps=400 * args.epochs,
    )
    hparams = HParams(gamma=0.8, noise_std=0.4, her_k=float("inf"))
    learner = make(config, rollout.env_spec(env), None)
    program = make_train(env, config, sampler=geometric, learner=learner)
    state, epoch = program.init(jax.random.key(args.seed), hparams), jax.jit(program.epoch, donate_argnums=0)
    for number in range(1, args.epochs + 1):
        state, metrics = epoch(state)
        success, accuracy = (float(metrics[name]) for name in ("success_rate", "accuracy"))
        print(f"epoch {number}, {int(state.env_steps)} steps: success {success:.2f}, accuracy {accuracy:.2f}")


if __name__ == "__main__":
    main()
