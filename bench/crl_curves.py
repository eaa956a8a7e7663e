"""Learning curves of JaxGCRL's own CRL next to the learner `crl`: same tasks, steps, updates, networks and losses.

    git clone https://github.com/MichalBortkiewicz/JaxGCRL /tmp/jaxgcrl
    pip install --no-deps brax==0.14.2 jaxopt ml_collections tensorboardX jinja2 MarkupSafe
    python bench/crl_curves.py theirs --jaxgcrl /tmp/jaxgcrl --tasks arm_reach --out theirs.csv
    python bench/crl_curves.py ours --tasks arm_reach --out ours.csv
    python bench/crl_curves.py matched --tasks arm_reach --out matched.csv   with five of JaxGCRL's details
    python bench/crl_curves.py report ours.csv theirs.csv matched.csv

docs/experiments/crl_jaxgcrl.md has the plan. JaxGCRL's tasks, learner and loop run unchanged. Its evaluator is replaced,
because it needs metrics that arm tasks lack. wandb and the removed part of Brax are empty modules.
"""

import argparse
import csv
import os
import sys
import tempfile
import time
import types
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_dher.cli.settings import check_writable
from mjx_dher.system.files import FolderError

ENVS, BATCH, EVALUATED = 256, 512, 100
WHO = ("ours", "matched", "theirs")
COLUMNS = ("who", "task", "seed", "env_steps", "success", "seconds")


class Size(NamedTuple):
    """Lengths of a task's runs. After each unroll, JaxGCRL updates on the batches of one stored episode per environment."""

    length: int  # steps of an episode
    unroll: int  # steps between updates
    unrolls: int  # per evaluation
    evaluations: int = 20

    @property
    def updates(self) -> int:
        """Updates after each unroll."""
        return ENVS * self.length // BATCH

    @property
    def first(self) -> int:
        """Unrolls before the first update, with at least one episode."""
        return -(-(self.length + 1) // self.unroll)

    @property
    def total(self) -> int:
        """Environment steps."""
        return ENVS * self.unroll * (self.first + self.unrolls * self.evaluations)


SIZES = {"arm_reach": Size(100, 8, 6), "arm_push_easy": Size(150, 11, 13)}


def match_jaxgcrl() -> None:
    """Gives the learner `crl` of this process JaxGCRL's inputs, first weights, standard deviations, loss of alpha and goals."""
    import flax.linen as nn
    import jax
    import jax.numpy as jnp

    from mjx_dher import networks, normalizer, samplers
    from mjx_dher.learners import gaussian

    def moments(network: Any, params: Any, observation: Any, goal: Any) -> tuple[Any, Any]:
        mean, raw = network.apply(params["network"], observation, goal)
        return mean, -5.0 + 3.5 * (jnp.tanh(raw) + 1.0)

    def loss(
        self: Any, network: Any, params: Any, observation: Any, goal: Any, judge: Any, normal: Any, hparams: Any
    ) -> tuple[Any, dict]:
        action, log_prob = gaussian.sample_action(network, params, observation, goal, normal)
        alpha, surplus = gaussian._alpha(params, hparams), jnp.mean(log_prob) + hparams.entropy_target * action.shape[-1]
        policy_loss = jnp.mean(jax.lax.stop_gradient(alpha) * log_prob - judge(action))
        return policy_loss - alpha * jax.lax.stop_gradient(surplus), {"entropy_weight": alpha, "entropy": -jnp.mean(log_prob)}

    def within_a_window(achieved: Any, desired: Any, step: Any, hparams: Any, length: Any = None) -> Any:
        """`geometric`, but an episode ends with a window, at each of its later steps with equal probability."""
        later = jnp.arange(len(achieved)) - step
        weights = jnp.where(later > 0, hparams.gamma**later, 0.0)
        totals = jnp.maximum(jnp.cumsum(weights), 1e-30)  # of a window that ends in each step
        shares = jnp.cumsum(jnp.where(later > 0, 1.0 / totals, 0.0)[::-1])[::-1]  # of the windows that end there or later
        return jnp.log(weights * (shares + step / totals[-1]))  # for windows that end before, the episode's end counts

    first = {"kernel_init": nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")}
    replaced: Any = {
        (normalizer, "normalize"): lambda state, values, *others: values,
        (networks, "_initializers"): lambda *others: first,
        (gaussian, "_moments"): moments,
        (gaussian.Gaussian, "loss"): loss,
        (samplers, "geometric"): within_a_window,
    }
    for (owner, name), new in replaced.items():
        assert hasattr(owner, name), name
        setattr(owner, name, new)


def train_ours(who: str, task: str, seeds: range, toy: bool) -> Iterable[tuple]:
    """Rows of the learner `crl`, with JaxGCRL's numbers."""
    from mjx_dher import cli
    from mjx_dher.sweeps import comparison, tables

    size = SIZES[task]
    updates = 1 if toy else round(size.length * size.updates / size.unroll)
    total = 2 * 2 * size.length if toy else size.total
    with tempfile.TemporaryDirectory() as out:
        options = (
            f"--env {task} --preset gpu --learner crl --networks layer_norm --sampler geometric --hidden-sizes 256 256"
            " --sweep.priority-fraction 0 --sweep.her-k inf --sweep.random-eps 0 --sweep.actor-lr 3e-4 --sweep.critic-lr 3e-4"
            " --sweep.gamma 0.99 --sweep.entropy-target -0.5"
            f" --num-envs {2 if toy else ENVS} --cycles-per-epoch 1 --updates-per-cycle {updates} --batch-size {BATCH}"
            f" --target-period 1 --total-steps {total} --replay-size {max(total, 2 * BATCH)}"
            f" --eval-episodes {2 if toy else EVALUATED}"
            f" --seeds {len(seeds)} --first-seed {seeds[0]} --out {out}/sweep"
        )
        if status := cli.main(["sweep", *options.split()]):
            raise SystemExit(status)
        for groups in comparison.groups(tables.read(Path(out) / "sweep")).values():
            for group in groups:
                for seed, success in zip(group.seeds, group.success):
                    yield from ((who, task, seed, int(s), float(x), "") for s, x in zip(group.env_steps, success))


def train_theirs(folder: Path, task: str, seed: int, toy: bool) -> Iterable[tuple]:
    """Rows of JaxGCRL's CRL."""
    make_importable(folder)
    import jax
    from jaxgcrl.agents.crl import crl
    from jaxgcrl.utils.config import RunConfig
    from jaxgcrl.utils.env import create_env

    size = Size(2, 2, 1, 2) if toy else SIZES[task]
    envs, batch, rows, start = (2 if toy else ENVS), (4 if toy else BATCH), [], time.perf_counter()
    crl.ActorEvaluator = evaluator(EVALUATED if not toy else 2)
    agent = crl.CRL(
        batch_size=batch,
        max_replay_size=size.total // ENVS,
        min_replay_size=size.first * size.unroll,
        unroll_length=size.unroll,
        skip_connections=0,
        use_relu=True,
        use_ln=True,
    )

    def progress(steps: int, metrics: dict[str, Any], *others: Any, **more: Any) -> None:
        rows.append(("theirs", task, seed, steps, float(metrics["success"]), round(time.perf_counter() - start, 1)))
        print(*rows[-1], flush=True)

    env = create_env(task, "mjx")
    env.goal_indices = np.asarray(env.goal_indices)  # JaxGCRL hashes them, which arrays of a newer JAX do not allow in a trace
    jax.config.update("jax_compilation_cache_dir", str(Path(tempfile.gettempdir(), "crl_curves")))  # seeds share programs
    with tempfile.TemporaryDirectory() as kept:
        config = RunConfig(
            env=task,
            seed=seed,
            num_envs=envs,
            total_env_steps=size.total // ENVS * envs,
            episode_length=size.length + 1,  # of which each gives `length` transitions with a later goal
            num_evals=size.evaluations,
            checkpoint_logdir=kept,  # JaxGCRL's loop needs one
        )
        agent.train_fn(config=config, train_env=env, eval_env=env, progress_fn=progress)
    return rows


def make_importable(folder: Path) -> None:
    """Adds empty modules for the missing ones, and enters the folder that JaxGCRL's paths start from."""
    sys.path.insert(0, str(folder))
    for name in ("brax.v1", "brax.v1.envs", "wandb", "wandb_osh", "wandb_osh.hooks"):
        module: Any = types.ModuleType(name)
        module.Env = module.Wrapper = module.State = module.TriggerWandbSyncHook = object
        sys.modules.setdefault(name, module)
    sys.modules["brax.v1"].envs = sys.modules["brax.v1.envs"]  # type: ignore[attr-defined]
    os.chdir(folder / "jaxgcrl")


def evaluator(episodes: int) -> type:
    """A class with the interface of JaxGCRL's evaluator. Success is taken from an episode's last state."""
    import jax

    class LastState:
        def __init__(self, actor_step: Any, eval_env: Any, num_eval_envs: int, episode_length: int, key: jax.Array):
            def play(training_state: Any, key: jax.Array) -> jax.Array:
                def step(state: Any, _: None) -> tuple[Any, jax.Array]:
                    state, _ = actor_step(training_state, eval_env, state, extra_fields=())
                    return state, state.metrics["success"]

                first = eval_env.reset(jax.random.split(key, episodes))
                # The last step of the wrapper already belongs to the next episode.
                return jax.lax.scan(step, first, None, length=episode_length - 1)[1][-1].mean()

            self._play, self._key = jax.jit(play), key

        def run_evaluation(self, training_state: Any, metrics: dict[str, Any]) -> dict[str, Any]:
            self._key, key = jax.random.split(self._key)
            return {**metrics, "success": self._play(training_state, key)}

    return LastState


def _rows(path: Path) -> list[dict[str, str]]:
    """Rows of a file of curves, none if it does not exist."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def report(paths: list[Path]) -> str:
    """Table of mean success over the steps that all have, and the difference to JaxGCRL's with Welch's interval."""
    from scipy import stats

    curves: dict[tuple[str, str], dict[str, list]] = {}
    for path in paths:
        for row in _rows(path):
            point = (float(row["env_steps"]), float(row["success"]))
            curves.setdefault((row["task"], row["who"]), {}).setdefault(row["seed"], []).append(point)
    lines = ["| task | who | seeds | mean success | last | difference | 95 % interval |", "|---|---|---|---|---|---|---|"]
    for task in dict.fromkeys(task for task, who in curves if who == "theirs"):
        own = {who: [np.array(points) for points in curves[task, who].values()] for who in WHO if (task, who) in curves}
        every = [curve for each in own.values() for curve in each]
        grid = np.linspace(max(curve[0, 0] for curve in every), min(curve[-1, 0] for curve in every), 200)
        means = {who: np.array([np.interp(grid, *curve.T).mean() for curve in each]) for who, each in own.items()}
        for who, each in own.items():
            last, cells = np.mean([np.interp(grid[-1], *curve.T) for curve in each]), ["", ""]
            if who != "theirs":
                low, high = stats.ttest_ind(means[who], means["theirs"], equal_var=False).confidence_interval()
                cells = [f"{means[who].mean() - means['theirs'].mean():+.3f}", f"{low:+.3f} to {high:+.3f}"]
            lines.append(
                " | ".join([f"| `{task}`", who, str(len(each)), f"{means[who].mean():.3f}", f"{last:.3f}", *cells]) + " |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=(*WHO, "report"))
    parser.add_argument("files", nargs="*", type=Path, help="for report: curves that --out wrote")
    parser.add_argument("--jaxgcrl", type=Path, help="JaxGCRL's checkout")
    parser.add_argument("--tasks", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=10)
    parser.add_argument("--out", type=Path, help="file of the curves; rows are added")
    parser.add_argument("--toy", action="store_true", help="sizes that a CPU trains in minutes")
    args = parser.parse_args()
    if args.what == "report":
        whos = {row["who"] for path in args.files for row in _rows(path)}
        if "theirs" not in whos or len(whos) == 1:
            given = ", ".join(map(str, args.files)) or "none"
            parser.error(f"report needs files with curves of theirs, and of ours or matched; got {given}")
        print(report(args.files))
        return
    if args.out is None or (args.what == "theirs") != (args.jaxgcrl is not None):
        parser.error("ours and matched need --out, theirs --out and --jaxgcrl")
    if args.seeds < 1 or args.first_seed < 0:
        parser.error(f"--seeds is 1 or more, and --first-seed 0 or more; got {args.seeds} and {args.first_seed}")
    seeds, out = range(args.first_seed, args.first_seed + args.seeds), args.out.resolve()
    try:
        check_writable(out.parent)
    except FolderError as error:
        parser.error(str(error))
    out.parent.mkdir(parents=True, exist_ok=True)
    known = {(row["who"], row["task"], int(row["seed"])) for row in _rows(out)}
    if twice := known & {(args.what, task, seed) for task in args.tasks for seed in seeds}:
        parser.error(f"{out} already has {', '.join(map(str, sorted(twice)))}; choose other seeds, tasks or another file")
    if args.what == "matched":
        match_jaxgcrl()
    for task in args.tasks:
        parts = (
            (train_theirs(args.jaxgcrl.resolve(), task, seed, args.toy) for seed in seeds)
            if args.what == "theirs"
            else [train_ours(args.what, task, seeds, args.toy)]
        )
        for rows in map(list, parts):
            head = [] if out.exists() else [COLUMNS]
            with out.open("a", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows([*head, *rows])


if __name__ == "__main__":
    main()
