"""Table of the built-in components. Loads neither JAX nor MuJoCo; `load` imports a component."""

import functools
import importlib
from collections.abc import Mapping
from typing import Any, NamedTuple

from typing_extensions import Doc

from mjx_dher.lookup import check_function, check_name


class Component(NamedTuple):
    """A built-in component: one row of `COMPONENTS`."""

    path: str  # module:attribute
    line: str  # description in `list`
    reads: tuple[str, ...] = ()  # settings that it reads and others of its field do not
    group: str = "episodes"  # of a priority: what it chooses among. Runs of one program can differ within a group


_BY_METRIC = ("metric",)
_WEIGHTED = ("metric", "weight_kernel", "weight_normalization", "temperature", "weight_scale")
_NOISE = ("noise_std", "random_noise")
_REWARDS = ("hindsight_reward", "polyak")
_CRITICS = (*_REWARDS, "num_critics", "policy_delay", "reset_every")
_SMOOTHING = ("target_noise", "target_noise_clip")
_ENTROPY = ("entropy_weight", "entropy_target")
_CONTRAST = ("energy", "contrastive_loss", "representation_size", "same_episode", "logsumexp_penalty")
_QUANTILES = ("num_quantiles", "dropped_quantiles")

# Built-in components by `RunSpec` field and name. Paths are inside mjx_dher, and the attribute is the name unless it is given.
# Each field also takes a custom component as "module:attribute".
_TABLE = {
    "env": {
        "arm_reach": Component("envs.arms:ArmReach", "move the end of a Panda to a goal (JaxGCRL's arm_reach)"),
        "arm_push_easy": Component("envs.arms:ArmPushEasy", "push a cube to the square beside it (JaxGCRL's arm_push_easy)"),
        "arm_push_hard": Component("envs.arms:ArmPushHard", "the same on larger squares (JaxGCRL's arm_push_hard)"),
        "arm_grasp": Component("envs.arms:ArmGrasp", "close the gripper around a cube (JaxGCRL's arm_grasp)"),
        "arm_binpick_easy": Component("envs.arms:ArmBinpickEasy", "move a cube into another bin (JaxGCRL's arm_binpick_easy)"),
        "block": Component("envs.hand:Block", "bring a block in the Shadow hand to a pose (HandManipulateBlock-v1)"),
        "block_rotate_parallel": Component(
            "envs.hand:BlockRotateParallel", "turn a block to another face (HandManipulateBlockRotateParallel-v1)"
        ),
        "block_rotate_xyz": Component(
            "envs.hand:BlockRotateXYZ", "turn a block to any orientation (HandManipulateBlockRotateXYZ-v1)"
        ),
        "block_rotate_z": Component(
            "envs.hand:BlockRotateZ", "turn a block about the vertical (HandManipulateBlockRotateZ-v1)"
        ),
        "egg": Component("envs.hand:Egg", "bring an egg in the Shadow hand to a pose (HandManipulateEgg-v1)"),
        "egg_rotate": Component("envs.hand:EggRotate", "turn an egg to any orientation (HandManipulateEggRotate-v1)"),
        "hand_reach": Component("envs.hand:HandReach", "bring the fingertips to goals (HandReach-v3)"),
        "pen": Component("envs.hand:Pen", "bring a pen in the Shadow hand to a pose (HandManipulatePen-v1)"),
        "pen_rotate": Component("envs.hand:PenRotate", "turn a pen to any direction (HandManipulatePenRotate-v1)"),
        "pick_and_place": Component(
            "envs.fetch:PickAndPlace", "lift a block to a goal, half of which are in the air (FetchPickAndPlace-v4)"
        ),
        "push": Component("envs.fetch:Push", "push a block on the table to a goal (FetchPush-v4)"),
        "reach": Component("envs.fetch:Reach", "move the gripper to a goal (FetchReach-v4)"),
        "slide": Component("envs.fetch:Slide", "hit a puck so that it slides to a goal out of reach (FetchSlide-v4)"),
    },
    "sampler": {
        "random": Component("samplers", "any goal of any episode"),
        "episode": Component("samplers", "any goal of the episode"),
        "future": Component("samplers", "any goal after the step (Andrychowicz et al. 2017)"),
        "final": Component("samplers", "the last goal of the episode"),
        "geometric": Component("samplers", "goals after the step, those t steps later with weight gamma^t"),
        "closest": Component("by_distance", "the future goal nearest to the desired one (the paper's method 1)", _BY_METRIC),
        "epsilon_closest": Component(
            "by_distance", "any future goal with probability epsilon, else the closest (method 2)", (*_BY_METRIC, "epsilon")
        ),
        "weighted": Component("by_distance", "nearer future goals likelier (method 3)", _WEIGHTED),
        "next_future": Component("contrib.goals", "the next goal with probability 1/her_k, else any future one (Next-Future)"),
    },
    "weight_kernel": {
        "linear": Component("by_distance", "weights fall linearly with distance"),
        "inverse": Component("by_distance", "weights fall as a power of distance"),
        "softmax": Component("by_distance", "weights fall exponentially with distance"),
    },
    "weight_normalization": {
        "mean": Component("by_distance:by_mean", "distances relative to their mean"),
        "sum": Component("by_distance:by_sum", "distances relative to their sum: nearly future"),
        "max": Component("by_distance:by_max", "distances relative to the largest"),
        "minmax": Component("by_distance:by_range", "distances from the smallest to the largest, as 0 to 1"),
        "none": Component("by_distance:by_scale", "distances relative to weight_scale, in metres", ("weight_scale",)),
        "far": Component("by_distance:mirrored", "mean, mirrored: farther goals likelier"),
    },
    "metric": {
        "position": Component("samplers", "Euclidean distance between goals"),
        "velocity": Component("contrib.metrics", "distance in position and velocity to rest at the goal"),
        "resting_point": Component("contrib.metrics", "distance from the point where Slide's puck would come to rest"),
        "resting_point_rough": Component("contrib.metrics", "the same with the friction of Push's and PickAndPlace's block"),
    },
    "priority": {
        "eventful": Component("priorities", "episodes whose last achieved goal was not yet reached at their start"),
        "energy": Component("priorities", "episodes by the energy given to the object (EBP)"),
        "energy_clipped": Component("priorities", "the same, each step's energy clipped at 0.5 J per kg"),
        "max_entropy": Component("contrib.priorities", "episodes by how rare their achieved goals are in the ring (MEP)"),
        "diversity": Component("contrib.priorities", "episodes by how diverse their achieved goals are (DTGSH)"),
        "dpp": Component(
            "contrib.priorities",
            "diversity, and pairs of transitions with goals far apart (DTGSH's k-DPP)",
            group="transitions",
        ),
        "td_error": Component(
            "priorities", "episodes and relabelled transitions by their one-step errors (HGR)", ("renewals",), "transitions"
        ),
        "td_error_shared": Component(
            "priorities", "the same in less time: four places share each candidate's error", ("renewals",), "shared"
        ),
        "curriculum": Component(
            "contrib.priorities", "transitions with diverse goals at first, near goals later (CHER)", group="curriculum"
        ),
        "not_misleading": Component(
            "contrib.priorities",
            "transitions whose hindsight goal was not reached before they began (bias-reduced HER)",
            group="transitions",
        ),
    },
    "generator": {
        "reset": Component("contrib.generators", "goals from the environment's reset"),
        "hgg": Component("contrib.goals", "achieved goals on the way to the reset's goals (Hindsight Goal Generation)"),
    },
    "learner": {
        "ddpg": Component(
            "learners.ddpg:make", "DDPG (Lillicrap et al. 2016): deterministic actor, one critic", (*_NOISE, *_REWARDS)
        ),
        "td3": Component(
            "learners.actor_critic",
            "TD3 (Fujimoto et al. 2018): deterministic actor, twin critics, smoothed targets",
            (*_NOISE, *_CRITICS, *_SMOOTHING),
        ),
        "sac": Component(
            "learners.actor_critic",
            "SAC (Haarnoja et al. 2018): stochastic actor, twin critics, entropy",
            (*_CRITICS, *_ENTROPY),
        ),
        "csac": Component("learners.actor_critic", "sac with categorical critics", (*_CRITICS, "num_bins", *_ENTROPY)),
        "ctd3": Component(
            "learners.actor_critic", "td3 with categorical critics", (*_NOISE, *_CRITICS, "num_bins", *_SMOOTHING)
        ),
        "redq": Component(
            "learners.actor_critic",
            "REDQ (Chen et al. 2021): SAC with many critics, a random subset per target",
            (*_CRITICS, "subset_critics", *_ENTROPY),
        ),
        "tqc": Component(
            "learners.actor_critic",
            "TQC (Kuznetsov et al. 2020): SAC with quantile critics, the largest quantiles dropped",
            (*_CRITICS, *_QUANTILES, *_ENTROPY),
        ),
        "dtqc": Component(
            "learners.actor_critic", "tqc with a deterministic actor", (*_NOISE, *_CRITICS, *_QUANTILES, *_SMOOTHING)
        ),
        "crl": Component(
            "learners.crl:make",
            "contrastive RL (Eysenbach et al. 2022, JaxGCRL): InfoNCE critic without rewards, stochastic actor",
            ("policy_delay", "reset_every", *_ENTROPY, *_CONTRAST),
        ),
    },
    "networks": {
        "mlp": Component("networks", "hidden layers with ReLU"),
        "layer_norm": Component("networks", "mlp with layer normalization in the critics"),
        "fan_in": Component("networks", "mlp with PyTorch's initialization"),
        "unit_norm": Component("networks", "residual, with hidden weights projected to length 1"),
        "residual": Component("networks", "residual blocks with layer normalization and swish, of any depth"),
    },
}


def _located(name: str, row: Component) -> Component:
    path = row.path if ":" in row.path else f"{row.path}:{name}"
    return row._replace(path=f"mjx_dher.{path}")


COMPONENTS: dict[str, dict[str, Component]] = {
    field: {name: _located(name, row) for name, row in rows.items()} for field, rows in _TABLE.items()
}


def load(field: str, value: Any, *parameters: str) -> Any:
    """Imports the component called `value`, a built-in name or module:attribute. Other values are returned as they are. Raises
    ValueError if there is no such name, module or attribute, or it is no function of `parameters`, if given.
    """
    if isinstance(value, str):
        table = COMPONENTS[field]
        check_name(field, value, table, custom=True)
        if value in table:
            module, _, attribute = table[value].path.partition(":")
            value = getattr(importlib.import_module(module), attribute)
        else:
            from mjx_dher import import_paths

            value = import_paths.load(field, value)
    return check_function(field, value, parameters) if parameters else value


def robot(env: Any) -> str:
    """Module of a built-in environment, by its name: `fetch`, `hand` or `arms`. Empty for any other environment."""
    built_in = COMPONENTS["env"].get(env) if isinstance(env, str) else None
    return built_in.path.partition(":")[0].rpartition(".")[2] if built_in else ""


def doc(field: str, text: str) -> Doc:
    """Help text of a component's option, with the built-in names and the components that read it."""
    readers = [name for table in COMPONENTS.values() for name, component in table.items() if field in component.reads]
    read = f" Read by {', '.join(readers)}." if readers else ""
    return Doc(f"{text}: {', '.join(COMPONENTS[field])}, or module:attribute.{read}")


@functools.cache
def _owners(setting: str) -> tuple[str, ...]:
    """Fields with components that read `setting`, if not every component reads it."""
    return tuple(field for field, table in COMPONENTS.items() if any(setting in row.reads for row in table.values()))


def reads(settings: Mapping[str, Any], setting: str) -> bool:
    """Whether `setting` affects a run with these settings.

    A custom component may read any setting that a built-in component of its field reads.
    """
    rows = [COMPONENTS[field].get(settings[field]) for field in _owners(setting) if reads(settings, field)]
    return None in rows or (len(rows) == len(_owners(setting)) and all(row and setting in row.reads for row in rows))
