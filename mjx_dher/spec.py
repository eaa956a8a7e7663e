"""A run's description: its parts by name, its sizes, its numbers and its seed. Loads neither JAX nor MuJoCo."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

from mjx_dher import config as config_lib
from mjx_dher.config import Config, HParams, ReadBy
from mjx_dher.lookup import check_name, is_import_path

Engine = Literal["auto", "native", "jax", "warp"]
ENGINES = get_args(Engine)
SAMPLERS = ("random", "episode", "future", "final", "closest", "epsilon_closest", "weighted", "next_future")
SAMPLERS_ELSEWHERE = {"next_future": "mjx_dher.contrib.goals:next_future"}  # the others are in mjx_dher.samplers
# Parts by name, and where they are; an own one is named by its place alone.
WEIGHT_KERNELS = {name: f"mjx_dher.samplers:{name}" for name in ("linear", "inverse", "softmax")}
WEIGHT_NORMALIZATIONS = {
    name: f"mjx_dher.distance_normalization:{function}"
    for name, function in {
        "mean": "by_mean",
        "sum": "by_sum",
        "max": "by_max",
        "minmax": "by_range",
        "none": "by_scale",
        "far": "mirrored",
    }.items()
}
METRICS = {
    "position": "mjx_dher.samplers:position",
    **{
        name: f"mjx_dher.contrib.metrics:{name}"
        for name in ("velocity", "resting_point", "resting_point_rough", "time_to_goal")
    },
}
# Those that weigh whole episodes, and those that choose among transitions; lanes of a program can differ within either.
EPISODE_PRIORITIES = {
    "eventful": "mjx_dher.priorities:eventful",
    **{name: f"mjx_dher.contrib.episodes:{name}" for name in ("energy", "max_entropy", "diversity")},
}
TRANSITION_PRIORITIES = {
    name: f"mjx_dher.contrib.transitions:{name}" for name in ("dpp", "td_error", "curriculum", "not_misleading")
}
PRIORITIES = {**EPISODE_PRIORITIES, **TRANSITION_PRIORITIES}
GENERATORS = {"reset": "mjx_dher.generators:reset", "hgg": "mjx_dher.contrib.goals:hgg"}
LEARNERS = {
    **{name: f"mjx_dher.learners.{name}:make" for name in ("ddpg", "td3", "sac", "redq", "tqc")},
    "dtqc": "mjx_dher.learners.tqc:make_deterministic",
}
Argument = bool | int | float | str  # of an environment's constructor
NETWORKS = {name: f"mjx_dher.networks:{name}" for name in ("mlp", "layer_norm", "fan_in")}


@dataclasses.dataclass(frozen=True)
class RunSpec:
    """Everything that decides what a run computes. Each part is a name, or an own one as module:attribute."""

    env: str = "push"
    """Environment: push, pick_and_place, slide or reach, or module:attribute."""
    engine: Engine = "auto"
    """Physics: native (MuJoCo C on all cores), warp (a kernel for NVIDIA GPUs), jax (MJX) or auto, which picks."""
    env_kwargs: tuple[str, ...] = ()
    """Arguments of the environment, NAME=VALUE each: reward_type=dense distance_threshold=0.03 episode_length=80."""
    sampler: str = "future"
    """Sampler of hindsight goals: random, episode, future, final, closest, epsilon_closest, weighted or next_future, or
    module:attribute."""
    weight_kernel: Annotated[str, ReadBy("weighted")] = "linear"
    """Fall of the weights with distance, for the sampler weighted: linear, inverse or softmax, or module:attribute."""
    weight_normalization: Annotated[str, ReadBy("weighted")] = "mean"
    """Normalization of distances, for the sampler weighted: mean, sum, max, minmax, none (by weight_scale, in metres) or far
    (the weights rise with distance), or module:attribute."""
    metric: Annotated[str, ReadBy("closest", "epsilon_closest", "weighted")] = "position"
    """Distance between an achieved and a desired goal that closest, epsilon_closest and weighted go by: position, velocity,
    resting_point, resting_point_rough or time_to_goal, or module:attribute."""
    priority: str = "eventful"
    """Priority in replay, for priority_fraction of each batch: of episodes eventful, energy, max_entropy or diversity, of
    transitions dpp, td_error, curriculum or not_misleading, or module:attribute."""
    generator: str = "reset"
    """Generator of the goals that training episodes are played for: reset (the environment's own), hgg, or
    module:attribute."""
    learner: str = "ddpg"
    """Learner: ddpg, td3, sac, redq, tqc, dtqc (tqc with a deterministic actor), or module:attribute."""
    networks: str = "mlp"
    """Networks of the learner: mlp, layer_norm (in its critics), fan_in (mlp that begins as PyTorch's), or
    module:attribute."""
    seed: int = 0
    """Random seed."""
    config: Config = dataclasses.field(default_factory=Config)
    """Sizes that shape the program."""
    hparams: HParams = dataclasses.field(default_factory=HParams)
    """Numbers of the algorithm."""

    def __post_init__(self) -> None:
        with contextlib.suppress(ValueError, TypeError):  # `validate` says what is wrong
            object.__setattr__(self, "env_kwargs", to_texts(to_arguments(self.env_kwargs)))

    @property
    def env_arguments(self) -> dict[str, Argument]:
        """Arguments for `envs.make`, by name."""
        return to_arguments(self.env_kwargs)

    @property
    def sampler_choice(self) -> tuple[str, str, str, str]:
        """Arguments of `samplers.make`."""
        return self.sampler, self.weight_kernel, self.metric, self.weight_normalization

    @property
    def program(self) -> RunSpec:
        """Description of the compiled program that the run can share: all that its lanes must agree in."""
        alike = next((own[0] for own in map(list, _PRIORITIES_OF_LANES) if self.priority in own), self.priority)
        shared = dataclasses.replace(self, sampler="future", weight_kernel="linear", metric="position", seed=0)
        return dataclasses.replace(shared, weight_normalization="mean", priority=alike, generator="reset", hparams=HParams())


_PRIORITIES_OF_LANES = (EPISODE_PRIORITIES, TRANSITION_PRIORITIES)
PARTS = {  # by field, the names that are built in; each field takes module:attribute, too
    "sampler": SAMPLERS,
    "weight_kernel": WEIGHT_KERNELS,
    "weight_normalization": WEIGHT_NORMALIZATIONS,
    "metric": METRICS,
    "priority": PRIORITIES,
    "generator": GENERATORS,
    "learner": LEARNERS,
    "networks": NETWORKS,
}


def to_arguments(texts: Sequence[str]) -> dict[str, Argument]:
    """Returns the arguments that "NAME=VALUE" texts stand for; a value is true, false, a number, or else a text.

    Raises:
      ValueError: one is no such text, a number is not finite, or a name comes twice or is that of an option of its own.
    """
    arguments: dict[str, Argument] = {}
    for text in texts:
        name, _, value = str(text).partition("=")
        if not (isinstance(text, str) and name.isidentifier() and value):
            raise ValueError(f"env_kwargs must be NAME=VALUE each, such as reward_type=dense; got {text!r}")
        if name in arguments:
            raise ValueError(f"env_kwargs has {name} twice")
        if name == "engine":
            raise ValueError("env_kwargs cannot have engine, which is a setting of its own: --engine")
        arguments[name] = _to_argument(value)
        if arguments[name] in (math.inf, -math.inf) or arguments[name] != arguments[name]:
            raise ValueError(f"env_kwargs: {name} must be finite; got {value}")
    return arguments


def to_texts(arguments: Mapping[str, Argument]) -> tuple[str, ...]:
    """Returns arguments as texts "NAME=VALUE" in the order of their names, the inverse of `to_arguments`."""
    return tuple(f"{name}={str(x).lower() if isinstance(x, bool) else x}" for name, x in sorted(arguments.items()))


def _to_argument(value: str) -> Argument:
    if value in ("true", "false"):
        return value == "true"
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(value)
    return value


def own_parts(spec: RunSpec) -> list[str]:
    """Returns the fields of a run that name parts of the user's own, as module:attribute."""
    return [field for field in ("env", *PARTS) if is_import_path(getattr(spec, field))]


def read_by() -> dict[str, ReadBy]:
    """Returns the samplers or learners that read a setting, for those that not every run reads."""
    return {name: parts for owner in (RunSpec, Config, HParams) for name, parts in config_lib.metadata(owner, ReadBy).items()}


def reads(sampler: str, learner: str, field: str, normalization: str = "none") -> bool:
    """Returns whether a setting makes a difference to runs with this sampler, learner and `weight_normalization`.

    A sampler, learner or normalization of one's own may read any setting that some sampler, learner or normalization reads.
    """
    if field == "weight_scale" and sampler in SAMPLERS and normalization in WEIGHT_NORMALIZATIONS and normalization != "none":
        return False
    parts = read_by().get(field)
    if parts is None:
        return True
    part, known = (sampler, SAMPLERS) if parts[0] in SAMPLERS else (learner, LEARNERS)
    return part in parts or part not in known


def validate_values(spec: RunSpec) -> None:
    """Refuses a description with a value that no run has, whatever its environment and its parts are.

    Raises:
      ValueError: names every field at fault, its value and what is allowed.
    """
    names = [(_check_text, name, getattr(spec, name)) for name in ("env", *PARTS)]
    _check_all(spec, [*names, (to_arguments, spec.env_kwargs), (config_lib.validate, spec.config, spec.hparams, 1)])


def validate(spec: RunSpec, env_names: tuple[str, ...], episode_length: int | None = None) -> None:
    """Refuses a description that cannot run, without importing a part.

    Args:
      spec: the run.
      env_names: the environments known by name.
      episode_length: of the environment, where it is known; else that of the tasks here, and 1 for an environment of the
        user's own, of which nothing is assumed.

    Raises:
      ValueError: names every field at fault, its value and what is allowed.
    """
    if episode_length is None:
        episode_length = 1 if is_import_path(spec.env) else _episode_length(spec)
    names = [(check_name, field, getattr(spec, field), known, True) for field, known in (("env", env_names), *PARTS.items())]
    checks = [(to_arguments, spec.env_kwargs), (config_lib.validate, spec.config, spec.hparams, episode_length)]
    _check_all(spec, [*names, *checks])


def _episode_length(spec: RunSpec) -> Any:
    try:
        return spec.env_arguments.get("episode_length", 50)
    except (ValueError, TypeError):
        return 50


def _check_all(spec: RunSpec, checks: Sequence[tuple[Any, ...]]) -> None:
    """Makes the calls in `checks`, and those of what any spec must be; raises ValueError with all that they found."""
    problems: list[str] = []
    for check, *arguments in (*checks, (config_lib.check_number, "seed", spec.seed, "[0, 4294967295]")):
        try:
            check(*arguments)
        except ValueError as error:
            problems.append(str(error))
    problems += config_lib.choice_problems(spec)
    if problems:
        raise ValueError("\n".join(problems))


def _check_text(field: str, value: Any) -> None:
    if not isinstance(value, str):
        raise ValueError(f"{field} must be a name; got {value!r}")
