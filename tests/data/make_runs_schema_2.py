"""Makes runs_schema_2.tar.xz: tiny runs and a sweep of Reach, and how those that were stopped ended. See README.md here.

Made at commit 070bb8d with `XLA_FLAGS` as in conftest.py: python make_runs_schema_2.py FOLDER
"""

import contextlib
import dataclasses
import shutil
import sys
import tarfile
from pathlib import Path

import numpy as np

import mjx_dher
from mjx_dher import Config, HParams, Options, RunSpec, cli, envs
from mjx_dher.sweeps import grid

ARGUMENTS = ("episode_length=10",)
CONFIG = Config(
    num_envs=2,
    cycles_per_epoch=2,
    updates_per_cycle=4,
    target_period=2,
    batch_size=16,
    total_steps=160,  # four epochs
    replay_size=100,
    hidden_sizes=(8,),
    eval_episodes=4,
)
HPARAMS = HParams(priority_fraction=0.5)
BASE = RunSpec(env="reach", engine="native", env_kwargs=ARGUMENTS, config=CONFIG, hparams=HPARAMS)
RUNS = {
    "ddpg": dataclasses.replace(BASE, sampler="weighted", seed=3),
    "tqc": dataclasses.replace(
        BASE, learner="tqc", priority="td_error", seed=4, config=dataclasses.replace(CONFIG, renewals=2)
    ),
}
SWEEP = grid.trials([dataclasses.replace(BASE, sampler=sampler) for sampler in ("future", "weighted")], (5, 6))
OPTIONS = Options(final_episodes=8, checkpoint_every=1)
OBS = {"observation": np.linspace(-1, 1, 50, dtype=np.float32).reshape(5, 10), "desired_goal": np.ones((5, 3), np.float32)}


def make_env(spec: RunSpec):
    return envs.make(spec.env, engine="native", **spec.env_arguments)


def train(spec: RunSpec, folder: Path, stop: int = 99, options: Options = OPTIONS):
    seen: list[int] = []
    mjx_dher.train_runs(
        make_env(spec),
        [spec],
        [folder],
        options=options,
        on_epoch=lambda specs, progress: seen.append(progress.epoch),
        should_stop=lambda: seen[-1] >= stop,
    )


def make_runs(root: Path):
    for name, spec in RUNS.items():
        ended, stopped = root / f"{name}_ended", root / f"{name}_stopped"
        train(spec, ended, options=dataclasses.replace(OPTIONS, keep_end=True))
        train(spec, stopped, stop=2)
        shutil.copytree(stopped, root / "expected" / stopped.name)
        train(spec, root / "expected" / stopped.name)
        np.save(root / "expected" / f"{name}_actions.npy", mjx_dher.load_policy(ended)(OBS))
        with (root / "expected" / f"{name}_eval.json").open("w") as file, contextlib.redirect_stdout(file):
            cli.main(["eval", str(ended), "--episodes", "600", "--seed", "11", "--json"])
        longer = dataclasses.replace(spec, config=dataclasses.replace(spec.config, total_steps=200))
        shutil.copytree(ended, root / "expected" / ended.name)
        train(longer, root / "expected" / ended.name)


def make_sweep(root: Path):
    """One pair of runs has ended, and the other pair was stopped after two epochs."""
    folder, seen = root / "sweep", []
    grid.train(folder, SWEEP[:2], make_env, options=OPTIONS, lanes=2)
    grid.train(
        folder,
        SWEEP,
        make_env,
        options=OPTIONS,
        lanes=2,
        on_epoch=lambda specs, progress: seen.append(progress.epoch),
        should_stop=lambda: seen[-1] >= 2,
    )
    shutil.copytree(folder, root / "expected" / "sweep")
    grid.train(root / "expected" / "sweep", SWEEP, make_env, options=OPTIONS, lanes=2)


def main(root: Path):
    make_runs(root)
    make_sweep(root)
    for path in (root / "expected").rglob("*"):  # of what was gone on with, the numbers are enough
        if (
            path.is_file()
            and path.name != "metrics.csv"
            and not path.name.endswith(("result.json", "actions.npy", "eval.json"))
        ):
            path.unlink()
    with tarfile.open(Path(__file__).with_name("runs_schema_2.tar.xz"), "w:xz") as archive:
        for path in sorted(root.iterdir()):
            archive.add(path, path.name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
