"""The command `list`: all tasks, parts, engines and presets by name."""

from __future__ import annotations

import dataclasses
import json

import tyro
from rich.console import Console

from mjx_dher import lookup
from mjx_dher.policy import bundled

# By kind, each name and what it is, in a line. A test holds the names to the tables in spec.py, presets.py and envs.
KINDS: dict[str, dict[str, str]] = {
    "tasks": {
        "push": "push a block on the table to a goal (FetchPush-v4)",
        "pick_and_place": "lift a block to a goal, half of which are in the air (FetchPickAndPlace-v4)",
        "slide": "hit a puck so that it slides to a goal out of reach (FetchSlide-v4)",
        "reach": "move the gripper to a goal (FetchReach-v4)",
    },
    "engines": {
        "auto": "native on a CPU, warp on an NVIDIA GPU, else jax",
        "native": "MuJoCo C on all cores of the host",
        "jax": "MJX, wherever JAX runs",
        "warp": "a kernel of this library for NVIDIA GPUs (extra cuda)",
    },
    "presets": {
        "auto": "cpu or gpu, the one for this machine",
        "cpu": "tuned for time to success on two cores, with native",
        "gpu": "tuned for time to success on one NVIDIA GPU, with warp",
        "frugal": "tuned for success after few environment steps",
        "paper": "the settings of the paper",
    },
    "samplers": {
        "random": "any goal of any episode",
        "episode": "any goal of the episode",
        "future": "any goal after the step (Andrychowicz et al. 2017)",
        "final": "the last goal of the episode",
        "closest": "the future goal nearest to the desired one (the paper's method 1); reads metric",
        "epsilon_closest": "any future goal with probability epsilon, else the closest (method 2); reads metric, epsilon",
        "weighted": "nearer future goals likelier (method 3); reads metric, weight_kernel, weight_normalization, temperature",
        "next_future": "the step's own next goal, one time in her_k, else any future one (Next-Future)",
    },
    "kernels": {
        "linear": "weights that fall linearly with the relative distance",
        "inverse": "weights that fall as a power of the relative distance",
        "softmax": "weights that fall exponentially with the relative distance",
    },
    "normalizations": {
        "mean": "distances relative to their mean",
        "sum": "distances relative to their sum: all but future",
        "max": "distances relative to the largest",
        "minmax": "distances from the smallest to the largest, as 0 to 1",
        "none": "distances relative to weight_scale, in metres",
        "far": "mean, mirrored: farther goals likelier",
    },
    "metrics": {
        "position": "Euclidean distance between goals",
        "velocity": "distance in position and velocity to rest at the goal",
        "resting_point": "distance of where Slide's puck would come to rest",
        "resting_point_rough": "the same with the friction of Push's and PickAndPlace's block",
        "time_to_goal": "steps from there to the goal, by the learner's critic",
    },
    "priorities": {
        "eventful": "episodes whose last achieved goal was not yet reached at their start",
        "energy": "episodes by the energy that the object was given (EBP)",
        "max_entropy": "episodes by how rare their achieved goals are in the ring (MEP)",
        "diversity": "episodes by how diverse their achieved goals are (DTGSH)",
        "dpp": "that, and of transitions two with goals apart (DTGSH's k-DPP)",
        "td_error": "episodes, and transitions with hindsight goals, by their errors of one step (HGR)",
        "curriculum": "transitions with goals diverse at first, near later (CHER)",
        "not_misleading": "transitions whose hindsight goal was not reached before they began (bias-reduced HER)",
    },
    "generators": {
        "reset": "the goals that the resets drew",
        "hgg": "goals achieved before, on the way to those of the resets (Hindsight Goal Generation)",
    },
    "learners": {
        "ddpg": "DDPG (Lillicrap et al. 2016): deterministic actor, one critic",
        "td3": "TD3 (Fujimoto et al. 2018): deterministic actor, twin critics, smoothed targets",
        "sac": "SAC (Haarnoja et al. 2018): stochastic actor, twin critics, entropy",
        "redq": "REDQ (Chen et al. 2021): SAC with many critics, some of them drawn for each target",
        "tqc": "TQC (Kuznetsov et al. 2020): SAC with quantile critics, the largest quantiles dropped",
        "dtqc": "tqc with a deterministic actor",
    },
    "networks": {
        "mlp": "hidden layers with ReLU",
        "layer_norm": "mlp with layer normalization in the critics",
        "fan_in": "mlp with first weights and biases as PyTorch's",
    },
    "policies": {
        name: f"of the package: success {bundled.facts(bundled.FOLDER / name)['here']['success_rate']:.3f}"
        for name in bundled.names()
    },
}
# The option that takes a name of each kind; those with "module:attribute" take a part of the user's own, too.
OPTIONS = {
    "tasks": "--env",
    "engines": "--engine",
    "presets": "--preset",
    "samplers": "--sampler",
    "kernels": "--weight-kernel",
    "normalizations": "--weight-normalization",
    "metrics": "--metric",
    "priorities": "--priority",
    "generators": "--generator",
    "learners": "--learner",
    "networks": "--networks",
    "policies": "in place of RUN",
}


@dataclasses.dataclass(frozen=True)
class ListArgs:
    """Name all tasks, engines, presets, parts (samplers, kernels, learners and so on) and policies, in a line each.

    All but engines, presets and policies can be your own, too, as module:attribute (docs/tutorial.md).
    """

    kinds: tyro.conf.Positional[tuple[str, ...]] = ()
    """Kinds to name, such as tasks; all unless given."""
    json: bool = False
    """Print one JSON object instead: name and line by kind."""


def list_command(argv: list[str], console: Console) -> int:
    """Names all tasks and parts."""
    args = tyro.cli(ListArgs, prog=f"{lookup.program()} list", args=argv)
    for kind in args.kinds:
        lookup.check_name("kind", kind, KINDS)
    chosen = {kind: KINDS[kind] for kind in args.kinds or KINDS}
    if args.json:
        print(json.dumps(chosen, indent=2))
        return 0
    width = max(len(name) for lines in chosen.values() for name in lines)
    for kind, lines in chosen.items():
        console.print(f"{kind} ({OPTIONS[kind]})")
        for name, line in lines.items():
            console.print(f"  {name:{width}}  {line}", soft_wrap=True)
    return 0
