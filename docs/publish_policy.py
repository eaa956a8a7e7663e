"""Puts the policy of a run into the package, with a card: `python docs/publish_policy.py RUN --machine "..." --commit ...`.

Copies the run folder to mjx_dher/policy/bundled, under the name of its task, and replaces the policy there. First it plays the
policy here and, if the originals' environment is set up (`train.py transfer --set-up`), in the original task.
"""

import argparse
import datetime
import shutil
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from mjx_dher import envs, presets, spec  # noqa: E402
from mjx_dher.policy import bundled  # noqa: E402
from mjx_dher.runs.folder import fingerprint, reading, results, run_folder  # noqa: E402
from mjx_dher.spec import RunSpec  # noqa: E402
from mjx_dher.system import files  # noqa: E402

LIMIT = 9_000_000  # bytes of all policies together
KEPT = (run_folder.CONFIG_FILE, run_folder.METRICS_FILE, run_folder.POLICY_FILE, run_folder.RESULT_FILE)
TITLES = {"push": "Push", "pick_and_place": "PickAndPlace", "slide": "Slide", "reach": "Reach"}
TITLES |= {"block_rotate_z": "Block, rotate z", "egg_rotate": "Egg, rotate"}


def command(run: RunSpec) -> list[str]:
    """Arguments of train.py for a run: the preset that needs the fewest others, and those."""
    return min((_arguments(name, run) for name in presets.PRESETS), key=len)


def _arguments(preset: str, run: RunSpec) -> list[str]:
    base = presets.preset(preset, run.env, run.learner)
    given = ["--env", run.env, "--preset", preset]
    if run.learner != presets.preset(preset, run.env).learner:
        given += ["--learner", run.learner]
    default = fingerprint.settings(base)
    for name, value in fingerprint.settings(run).items():
        if name not in ("env", "learner") and value != default[name]:
            words = map(str, value) if isinstance(value, tuple) else [fingerprint.text(value)]
            given += [f"--{name.replace('_', '-')}", *words]
    return [*given, "--seed", str(run.seed)]


def card(folder: Path) -> str:
    """Card of the policy in `folder`, from its config.json, result.json and card.json."""
    content, run = reading.read_run(folder)
    result, facts = results.read_result(folder), bundled.facts(folder)
    versions = content["versions"]
    sizes = ", ".join(map(str, run.config.hidden_sizes))
    rows = {
        "success here": f"{_rate(facts['here'])}, on `{facts['here']['physics']}`",
        "success in the original": _original(facts["original"]),
        "already at reset": f"{facts['here']['reset_success_rate']:.3f} of the episodes here",
        "learner": f"`{run.learner}`, networks `{run.networks}`, hidden layers of {sizes}",
        "sampler, priority, seed": f"`{run.sampler}`, `{run.priority}`, {run.seed}",
        "environment steps": f"{result['env_steps']:,}",
        "training": f"{result['wall_seconds']:,.0f} s on {facts['machine']}, physics `{content['physics']}`",
        "commit": f"`{facts['commit']}`",
        "versions": ", ".join(f"{name} {versions[name]}" for name in ("jax", "mujoco", "numpy", "python")),
        "published": facts["date"],
    }
    today = fingerprint.settings(run)  # an option that was removed since had its default
    settings = {name: value for name, value in {**content["config"], **content["hparams"]}.items() if name in today}
    numbers = ", ".join(f"{name} {fingerprint.text(value)}" for name, value in settings.items())
    return "\n".join(
        (
            f"# The policy `{folder.name}`",
            "",
            f"Plays {TITLES[run.env]}: `python train.py view {folder.name}`, `mjx_dher.load_policy({folder.name!r})`.",
            "",
            "| | |",
            "|---|---|",
            *(f"| {name} | {value} |" for name, value in rows.items()),
            "",
            "This command trains it again. Rounding differs between machines and versions, so the trained policy differs, too.",
            "",
            "```bash",
            f"python train.py {' '.join(command(run))}",
            "```",
            "",
            *textwrap.wrap(f"Its settings: {numbers}.", 150, break_long_words=False),
            "",
        )
    )


def _rate(outcome: dict[str, Any]) -> str:
    low, high = outcome["success_low"], outcome["success_high"]
    return (
        f"**{outcome['success_rate']:.3f}** (95 % interval {low:.3f} to {high:.3f}, {outcome['episodes']:,} episodes from seed"
        f" {outcome['seed']})"
    )


def _original(outcome: dict[str, Any] | None) -> str:
    return "not measured" if outcome is None else f"{_rate(outcome)}, {outcome['task']} on {' and '.join(outcome['versions'])}"


def check(folder: Path, run: RunSpec) -> None:
    """Raises ValueError for a run that cannot be part of the package."""
    if (problem := results.result_problem(folder)) is not None:
        raise ValueError(problem)
    if results.read_result(folder)["status"] != run_folder.FINISHED:
        raise ValueError(f"{folder} has failed; a policy of the package is of a run that has ended well")
    if run.env not in TITLES or spec.custom_components(run):
        raise ValueError(f"{folder} is of parts of its user's own, which a user of the package does not have")


def measure(folder: Path, run: RunSpec, episodes: int, seed: int, python: Path) -> dict[str, Any]:
    """Plays the policy here, on native, and in the original if `python` has it. Returns both summaries."""
    from mjx_dher.evaluate import play_policy, summarize
    from mjx_dher.policy.load import check_fits, load_plain
    from mjx_dher.system.machine import keep_compiled_programs, usable_cores
    from mjx_dher.tools import transfer

    policy = load_plain(folder, "the package")
    keep_compiled_programs()
    env = envs.make(run.env, engine="native")
    check_fits(policy, env)
    here = {**summarize(*play_policy(env, policy, episodes, seed)[:4]), "seed": seed, "physics": "native"}
    if not transfer.is_ready(python):
        return {"here": here, "original": None}
    theirs = transfer.play_apart(folder, python, episodes, seed, workers=usable_cores())
    summary = summarize(theirs["success"], theirs["reset_success"], theirs["ret"])
    about = {"seed": seed, "task": transfer.ORIGINALS[run.env], "versions": list(transfer.REQUIREMENTS)}
    return {"here": here, "original": {**summary, **about}}


def publish(folder: Path, target: Path, facts: dict[str, Any], anyway: bool) -> None:
    """Writes a run folder, with its card, in place of `target`.

    Raises:
      ValueError: the policy there is better, unless `anyway`, or all policies together are too large.
    """
    if (target / bundled.FACTS).exists() and not anyway:
        before = bundled.facts(target)["here"]["success_rate"]
        if before > facts["here"]["success_rate"]:
            raise ValueError(
                f"the policy there scores {before:.3f}, this one {facts['here']['success_rate']:.3f}; see --anyway"
            )
    others = sum(path.stat().st_size for path in target.parent.rglob("*") if path.is_file() and target not in path.parents)
    if (size := others + sum((folder / name).stat().st_size for name in KEPT)) > LIMIT:
        raise ValueError(f"all policies together would take {size:,} bytes; the limit is {LIMIT:,}")
    if target.exists():
        shutil.rmtree(target)
    files.make_folder(target)
    for name in KEPT:
        shutil.copyfile(folder / name, target / name)
    files.write_json(target / bundled.FACTS, facts)
    (target / bundled.CARD).write_text(card(target))


def main(argv: Sequence[str]) -> None:
    """Publishes a run's policy."""
    from mjx_dher.tools import transfer

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--cards", action="store_true", help="only rewrite the cards of all bundled policies")
    parser.add_argument("--machine", help='machine of the training, for the card: "2 cores of ..."')
    parser.add_argument("--commit", help="commit of the training")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--python", type=Path, default=transfer.interpreter(transfer.default_environment()))
    parser.add_argument("--anyway", action="store_true", help="replace a better policy, too")
    args = parser.parse_args(argv)
    if args.cards:
        for name in bundled.names():
            (bundled.FOLDER / name / bundled.CARD).write_text(card(bundled.FOLDER / name))
        return
    if None in (args.run, args.machine, args.commit):
        raise ValueError("a run, --machine and --commit are needed")
    run = reading.read_spec(args.run)
    check(args.run, run)
    facts = {"machine": args.machine, "commit": args.commit, "date": datetime.date.today().isoformat()}
    facts |= measure(args.run, run, args.episodes, args.seed, args.python)
    target = bundled.FOLDER / run.env
    publish(args.run, target, facts, args.anyway)
    print((target / bundled.CARD).read_text())


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except ValueError as error:
        sys.exit(f"error: {error}")
