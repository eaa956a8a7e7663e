"""Agreement of the learner `crl` with JaxGCRL's own code: losses and gradients of one batch, with equal parameters.

    git clone https://github.com/MichalBortkiewicz/JaxGCRL /tmp/jaxgcrl
    python bench/crl_agreement.py /tmp/jaxgcrl/jaxgcrl/agents/crl

It loads JaxGCRL's losses.py and networks.py, which need JAX and Flax alone. Encoders are JaxGCRL's, with our parameters. The
actor is ours in both, because JaxGCRL bounds standard deviations in another way. Its outputs are small, because JaxGCRL adds
1e-6 to 1 - a^2 and so differs for actions at their bounds. The energy `cosine` is left out: JaxGCRL divides by the lengths of
whole batches.
"""

import argparse
import dataclasses
import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.training.train_state import TrainState

from mjx_dher import HParams, learners
from mjx_dher.config import Config
from mjx_dher.types import Batch, EnvSpec

STATE, GOAL, ACTION, BATCH = 10, 3, 4, 64
LOSSES = {"forward": "fwd_infonce", "backward": "bwd_infonce", "symmetric": "sym_infonce"}
HPARAMS = HParams(action_l2=0.0, entropy_target=-0.5)
STYLES: dict[str, dict[str, Any]] = {"mlp": {"use_relu": True}, "residual": {"use_ln": True, "skip_connections": 2}}


def load(folder: Path, name: str) -> ModuleType:
    """A module of JaxGCRL, by its file."""
    spec = importlib.util.spec_from_file_location(f"jaxgcrl_{name}", folder / f"{name}.py")
    if spec is None or spec.loader is None or not (folder / f"{name}.py").is_file():
        raise SystemExit(f"{folder} must be JaxGCRL's folder jaxgcrl/agents/crl; it has no {name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def batch() -> Batch:
    """Random transitions whose goals are both kinds of goal."""
    keys = jax.random.split(jax.random.key(1), 3)
    observation = jax.random.normal(keys[0], (BATCH, STATE))
    action = jnp.tanh(jax.random.normal(keys[1], (BATCH, ACTION)))
    goal = jax.random.normal(keys[2], (BATCH, GOAL))
    ones = jnp.ones(BATCH)
    return Batch(observation, observation, goal, action, ones, ones, jnp.arange(BATCH), goal)


def small_actor(state: Any, last: int) -> Any:
    """The state with a tenth of the weights in the actor's layer `last`."""
    network = state.params.actor["network"]["params"]
    layer = {**network[f"Dense_{last}"], "kernel": 0.1 * network[f"Dense_{last}"]["kernel"]}
    actor = {**state.params.actor, "network": {"params": {**network, f"Dense_{last}": layer}}}
    return dataclasses.replace(state, params=dataclasses.replace(state.params, actor=actor))


def ours(learner: Any, state: Any) -> dict[str, Any]:
    """Losses and gradients of an update: Adam's first moments are a tenth of the gradient after one step."""
    after, metrics = jax.jit(learner.update)(state, batch(), HPARAMS)
    critic, actor = (jax.tree.map(lambda x: x / 0.1, moments.mu) for moments in (after.critic_moments, after.actor_moments))
    # The entropy weight's loss is 0 at the start, where log alpha is, and so adds only its gradient, which JaxGCRL has, too.
    return {"critic_loss": metrics["critic_loss"], "actor_loss": metrics["actor_loss"], "critic": critic, "actor": actor}


def theirs(
    losses: ModuleType, networks: ModuleType, learner: Any, state: Any, run: Config, style: dict[str, Any]
) -> dict[str, Any]:
    """The same by JaxGCRL's functions; a step of plain gradient descent of size 1 gives the gradients."""
    encoder = networks.Encoder(run.representation_size, run.hidden_sizes[0], len(run.hidden_sizes), **style)
    critic = {f"{name}_encoder": {"params": state.params.critic["params"][own]} for name, own in (("sa", "phi"), ("g", "psi"))}
    actor = SimpleNamespace(apply=lambda params, both: learner.networks.actor.apply(params, both[:, :STATE], both[:, STATE:]))
    modules = {"actor": actor, "sa_encoder": encoder, "g_encoder": encoder}
    config = {
        "state_size": STATE,
        "goal_indices": jnp.arange(GOAL),
        "energy_fn": run.energy,
        "contrastive_loss_fn": LOSSES[run.contrastive_loss],
        "logsumexp_penalty_coeff": HPARAMS.logsumexp_penalty,
        "target_entropy": HPARAMS.entropy_target * ACTION,
    }
    transitions = batch()
    future = jnp.zeros((BATCH, STATE)).at[:, :GOAL].set(transitions.desired_goal)
    theirs = SimpleNamespace(
        observation=jnp.concatenate([transitions.observation, transitions.desired_goal], axis=1),
        action=transitions.action,
        extras={"future_state": future},
    )

    @dataclasses.dataclass
    class Training:
        actor_state: TrainState
        critic_state: TrainState
        alpha_state: TrainState

        def replace(self, **fields: Any) -> "Training":
            return dataclasses.replace(self, **fields)

    def start(params: Any) -> TrainState:
        return TrainState.create(apply_fn=None, params=params, tx=optax.sgd(1.0))

    alpha = {"log_alpha": state.params.actor["log_alpha"]}
    before = Training(start(state.params.actor["network"]), start(critic), start(alpha))
    # The key of the actor's noise: that of our update.
    key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.num_updates + 1)
    after, actor_metrics = losses.update_actor_and_alpha(config, modules, theirs, before, key)
    after, critic_metrics = losses.update_critic(config, modules, theirs, after, key)
    difference = lambda name: jax.tree.map(  # noqa: E731
        lambda x, y: x - y, getattr(before, name).params, getattr(after, name).params
    )
    moved = difference("critic_state")
    return {
        "critic_loss": critic_metrics["critic_loss"],
        "actor_loss": actor_metrics["actor_loss"],
        "critic": {"params": {"phi": moved["sa_encoder"]["params"], "psi": moved["g_encoder"]["params"]}},
        "actor": {"network": difference("actor_state"), "log_alpha": difference("alpha_state")["log_alpha"]},
    }


def compare(mine: dict[str, Any], other: dict[str, Any]) -> list[float]:
    """Relative differences of both losses, and of both gradients by their norms."""
    found = [abs(float(mine[name] - other[name])) / abs(float(other[name])) for name in ("critic_loss", "actor_loss")]
    for name in ("critic", "actor"):
        ours, theirs = (optax.tree.norm(x) for x in (jax.tree.map(jnp.subtract, mine[name], other[name]), other[name]))
        found.append(float(ours / theirs))
    return found


def main() -> int:
    """Prints a table of differences; ends with status 1 if one is above 1e-4."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="JaxGCRL's folder jaxgcrl/agents/crl")
    folder = parser.parse_args().folder
    losses, networks = load(folder, "losses"), load(folder, "networks")
    spec = EnvSpec(jax.ShapeDtypeStruct((STATE,), jnp.float32), GOAL, ACTION, 50)
    worst = 0.0
    print("| networks | energy | loss | critic's loss | actor's loss | critic's gradient | actor's gradient |")
    print("|---|---|---|---|---|---|---|")
    for name, style in STYLES.items():
        for energy in ("norm", "l2", "dot"):
            for loss in LOSSES:
                run = Config(hidden_sizes=(32,) * 4, energy=energy, contrastive_loss=loss, representation_size=16)  # type: ignore[arg-type]
                learner = learners.make("crl", run, spec, name)
                state = small_actor(learner.init(jax.random.key(0)), len(run.hidden_sizes))
                found = compare(ours(learner, state), theirs(losses, networks, learner, state, run, style))
                worst = float(np.maximum(worst, np.max(found)))
                print(f"| `{name}` | `{energy}` | `{loss}` | {' | '.join(f'{value:.1e}' for value in found)} |")
    print(f"largest relative difference: {worst:.1e}")
    return int(not worst <= 1e-4)


if __name__ == "__main__":
    sys.exit(main())
