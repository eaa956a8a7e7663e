"""Time of a gradient update, and the share of drawing and relabelling its batch.

    python bench/learner.py [--learners ddpg td3 sac redq tqc dtqc] [--networks mlp] [--batch-sizes 256 512 1024] [--seeds 1]
        [--sampler weighted] [--dtype bfloat16] [--num-critics 2] [--policy-delay 1]
        [--hidden-sizes 256 256 256] [--updates 500]

As in training, as many batches as trainer.MAX_TRANSITIONS_PER_DRAW allows are drawn at once, then learned from one by one,
until at least `--updates` are made, all in one program. Several seeds are one vmapped program, and times are per update of one
seed. The last column is the time of a learner's gradients relative to ddpg, each per product.
"""

import argparse
import itertools
from typing import Any

import jax
import jax.numpy as jnp
from timing import median_seconds, print_table

from mjx_dher import Config, HParams, learners, replay, samplers
from mjx_dher.components import COMPONENTS
from mjx_dher.context import Context
from mjx_dher.relabel import draw_batches
from mjx_dher.trainer import MAX_TRANSITIONS_PER_DRAW
from mjx_dher.types import EnvSpec, Episode

SPEC = EnvSpec(jax.ShapeDtypeStruct((25,), jnp.float32), 3, 4, episode_length=50)  # of Push


def compute_reward(achieved_goal, desired_goal):
    return -(jnp.linalg.norm(achieved_goal - desired_goal, axis=-1) > 0.05).astype(jnp.float32)


def full_ring(num_episodes: int = 20_000, num_steps: int = 50) -> replay.ReplayState:
    """A ring of 10^6 transitions of random numbers, shaped like Push."""

    def shape(*sizes: int) -> Any:
        return jax.ShapeDtypeStruct(sizes, jnp.float32)

    shapes = Episode(
        observation=shape(num_steps + 1, 25),
        achieved_goal=shape(num_steps + 1, 3),
        desired_goal=shape(3),
        action=shape(num_steps, 4),
    )
    episodes = jax.tree.map(lambda x: 0.1 * jax.random.normal(jax.random.key(0), (num_episodes, *x.shape)), shapes)
    priority = (jnp.arange(num_episodes) % 3 == 0).astype(jnp.float32)
    return jax.jit(replay.add)(replay.init(shapes, num_episodes), episodes, priority)


def flops(learner: Any, batch_size: int, hidden_sizes: tuple[int, ...]) -> float:
    """Matrix-product operations of an update, averaged over the policy delay.

    Counted in passes through a network: 1 forward, 2 backward, or 1 backward to the inputs alone. Actors run forward as
    target, and forward and backward. Critics run forward as target, forward and backward, and for the actor forward and
    backward to the inputs.
    """
    sizes = (28, *hidden_sizes)
    hidden = sum(a * b for a, b in itertools.pairwise(sizes))
    delay, parts = getattr(learner, "policy_delay", 1), getattr(learner, "critics", None)
    number, size = (1, 1) if parts is None else (parts.number, parts.size)
    judges = number if parts is None or parts.num_judges is None else parts.num_judges
    heads = 2 if parts is not None and learner.actor.is_gaussian else 1
    actor, critic = hidden + heads * 4 * sizes[-1], hidden + 4 * sizes[1] + size * sizes[-1]
    return 2 * batch_size * (actor * (1 + 3 / delay) + critic * (4 * number + 2 * judges / delay))


class Timed:
    """Programs of a learner's updates, for a batch size and a number of seeds."""

    def __init__(self, learner: Any, batch_size: int, seeds: int, sampler: Any, updates: int):
        self.delay = learners.policy_delay(learner)
        self.at_once = max(1, MAX_TRANSITIONS_PER_DRAW // batch_size // self.delay) * self.delay
        self.draws = -(-updates // self.at_once)
        self.shape = (self.at_once // self.delay, self.delay, batch_size)
        self.learner, self.sampler, self.ring = learner, sampler, full_ring()
        self.hparams = jax.tree.map(jnp.float32, HParams(priority_fraction=0.5))
        self.cumulative = replay.cumulative(self.ring)
        self.keys = jax.random.split(jax.random.key(2), seeds)
        self.states = jax.vmap(learner.init)(self.keys)
        self.each = self.at_once * self.draws * seeds

    def draw(self, key: Any) -> Any:
        return draw_batches(self.ring, key, self.shape, self.sampler, Context(compute_reward, self.hparams), self.cumulative)

    def draw_all(self, key: Any) -> Any:
        """[draws] one number of each batch, so that the compiler omits none."""
        add_up = lambda _, key: (None, sum(jnp.sum(x) for x in jax.tree.leaves(self.draw(key))))  # noqa: E731
        return jax.lax.scan(add_up, None, jax.random.split(key, self.draws))[1]

    def update(self, state: Any, batches: Any) -> Any:
        for i in range(self.delay):
            flags: Any = {} if i == self.delay - 1 else {"with_actor": False}
            state, losses = self.learner.update(state, jax.tree.map(lambda x, i=i: x[i], batches), self.hparams, **flags)
            state = self.learner.update_target(state, self.hparams)
        return state, losses

    def updates_only(self, state: Any, batches: Any) -> Any:
        return jax.lax.scan(lambda state, _: jax.lax.scan(self.update, state, batches), state, length=self.draws)

    def both(self, state: Any, key: Any) -> Any:
        draw_and_update = lambda state, key: jax.lax.scan(self.update, state, self.draw(key))  # noqa: E731
        return jax.lax.scan(draw_and_update, state, jax.random.split(key, self.draws))

    def seconds(self) -> tuple[float, float, float]:
        """Seconds per update of one seed: total, gradients, drawing."""
        drawing, updating, whole = (jax.jit(jax.vmap(f)) for f in (self.draw_all, self.updates_only, self.both))
        batches = jax.jit(jax.vmap(self.draw))(self.keys)
        calls = (lambda: whole(self.states, self.keys), lambda: updating(self.states, batches), lambda: drawing(self.keys))
        both, update, draw = (median_seconds(call) / self.each for call in calls)
        return both, update, draw


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--learners", nargs="+", default=["ddpg"], choices=COMPONENTS["learner"])
    parser.add_argument("--networks", default="mlp")
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=[256, 512, 1024])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--sampler", default="weighted")
    parser.add_argument("--dtype", default="float32", help="of the hidden layers: float32 or bfloat16")
    parser.add_argument("--hidden-sizes", type=int, nargs="+", default=list(Config.hidden_sizes))
    parser.add_argument("--updates", type=int, default=500, help="minimum number in each timed program")
    parser.add_argument("--num-critics", type=int, default=2)
    parser.add_argument("--policy-delay", type=int, default=1)
    args = parser.parse_args()
    rows, per_flop = [], {}
    for batch_size, seeds, name in itertools.product(args.batch_sizes, args.seeds, args.learners):
        config = Config(
            batch_size=batch_size,
            learner_dtype=args.dtype,
            hidden_sizes=tuple(args.hidden_sizes),
            num_critics=args.num_critics,
            policy_delay=args.policy_delay,
        )
        try:
            learner = learners.make(name, config, SPEC, args.networks)
        except ValueError as error:
            parser.error(str(error))
        both, update, draw = Timed(learner, batch_size, seeds, samplers.make(args.sampler), args.updates).seconds()
        products = flops(learner, batch_size, config.hidden_sizes)
        per_flop[batch_size, seeds, name] = update / products
        first = per_flop.get((batch_size, seeds, "ddpg"))
        rows.append(
            (
                name,
                batch_size,
                seeds,
                f"{both * 1e6:,.1f}",
                f"{1 / both:,.0f}",
                f"{update * 1e6:,.1f}",
                f"{draw * 1e6:,.1f}",
                f"{draw / update:.1%}",
                f"{products / update / 1e9:,.0f}",
                f"{update / products / first:.2f}" if first else "",
            )
        )
    head = ("learner", "batch", "seeds", "µs/update", "updates/s")
    print_table((*head, "of it: gradients, µs", "drawing, µs", "share", "GFLOP/s", "to ddpg"), rows)


if __name__ == "__main__":
    main()
