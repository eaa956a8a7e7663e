"""`RunSpec`, the description of a run: names of components, sizes, numbers and a seed; and `Options` of training, which do not
affect its result. Loads neither JAX nor MuJoCo.
"""

import contextlib
import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from typing_extensions import Doc

from mjx_dher import validation
from mjx_dher.components import COMPONENTS, doc
from mjx_dher.config import Config, HParams, plain
from mjx_dher.lookup import check_name, is_import_path, require_extra

Engine = Literal["auto", "native", "jax", "warp"]
ENGINES = get_args(Engine)
Argument = bool | int | float | str  # of an environment's constructor
LOGS = {"jsonl": None, "tensorboard": "tensorboardX", "wandb": "wandb"}  # logs next to metrics.csv, and their packages


@dataclasses.dataclass(frozen=True)
class RunSpec:
    """Everything that decides the result of a run. Components are built-in names or module:attribute."""

    env: Annotated[str, doc("env", "Environment")] = "push"
    engine: Annotated[
        Engine, Doc("Physics: native (MuJoCo C on all cores), warp (a kernel for NVIDIA GPUs), jax (MJX) or auto.")
    ] = "auto"
    env_kwargs: Annotated[
        tuple[str, ...], Doc("Arguments of the environment as NAME=VALUE, such as reward_type=dense distance_threshold=0.03.")
    ] = ()
    sampler: Annotated[str, doc("sampler", "Sampler of hindsight goals")] = "future"
    weight_kernel: Annotated[str, doc("weight_kernel", "Kernel that maps distances to weights")] = "linear"
    weight_normalization: Annotated[str, doc("weight_normalization", "Normalization of distances")] = "mean"
    metric: Annotated[str, doc("metric", "Distance between an achieved and a desired goal")] = "position"
    priority: Annotated[str, doc("priority", "Priority of episodes or transitions, for priority_fraction of each batch")] = (
        "eventful"
    )
    generator: Annotated[str, doc("generator", "Generator of the goals of training episodes")] = "reset"
    learner: Annotated[str, doc("learner", "Learner")] = "ddpg"
    networks: Annotated[str, doc("networks", "Networks of the learner")] = "mlp"
    demonstrations: Annotated[
        str | None, Doc("Episodes to fill the replay ring with at the start: an .npz, or a Minari data set by folder or name.")
    ] = None
    seed: int = 0
    """Random seed."""
    config: Config = dataclasses.field(default_factory=Config)
    """Sizes that shape the program."""
    hparams: HParams = dataclasses.field(default_factory=HParams)
    """Numbers of the algorithm."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", plain(self.seed))
        with contextlib.suppress(ValueError, TypeError):  # `validate` reports the problem
            object.__setattr__(self, "env_kwargs", to_texts(to_arguments(self.env_kwargs)))

    def replace(self, **settings: Any) -> "RunSpec":
        """Copy with other settings, by the names of fields of RunSpec, Config or HParams. Raises ValueError for other names."""
        fields, sizes = ([field.name for field in dataclasses.fields(owner)] for owner in (RunSpec, Config))
        for name in settings:
            check_name("a setting", name, (*fields, *sizes, *HParams._fields))
        if own := {name: settings.pop(name) for name in sizes if name in settings}:
            settings["config"] = dataclasses.replace(settings.get("config", self.config), **own)
        if own := {name: settings.pop(name) for name in HParams._fields if name in settings}:
            settings["hparams"] = settings.get("hparams", self.hparams)._replace(**own)
        return dataclasses.replace(self, **settings)

    @property
    def env_arguments(self) -> dict[str, Argument]:
        """Keyword arguments for `envs.make`."""
        return to_arguments(self.env_kwargs)

    @property
    def sampler_choice(self) -> tuple[str, str, str, str]:
        """Arguments of `samplers.make`."""
        return self.sampler, self.weight_kernel, self.metric, self.weight_normalization

    @property
    def program(self) -> "RunSpec":
        """The settings that all runs in one compiled program must share; all other fields have their defaults."""
        table, default = COMPONENTS["priority"], RunSpec(env=self.env)
        group = table[self.priority].group if self.priority in table else None
        alike = next((name for name, component in table.items() if component.group == group), self.priority)
        return dataclasses.replace(self, priority=alike, **{name: getattr(default, name) for name in _LANE_FIELDS})


# Fields that can differ between runs of one compiled program. Priorities can differ within a group.
_LANE_FIELDS = ("sampler", "weight_kernel", "weight_normalization", "metric", "generator", "seed", "hparams")


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of training that do not affect how a run learns: last evaluation, checkpoints, logs and an early stop."""

    final_episodes: int = 500
    """Episodes of the final evaluation."""
    checkpoint_every: int = 10
    """Epochs between checkpoints; 0 disables this. A checkpoint is also written after 2 minutes, then every 10 minutes, and
    when the run is stopped (Ctrl-C, SIGTERM, SIGHUP)."""
    keep: int = 2
    """Newest checkpoints to keep (one for parallel runs). They are deleted when the run has ended."""
    keep_end: bool = False
    """Keep the last checkpoint, so that `resume --total-steps` can extend the run. It is as large as the replay ring."""
    log: tuple[str, ...] = ()
    """Logs in addition to metrics.csv: jsonl, tensorboard, wandb."""
    stop_at: float | None = None
    """Stop a run early at this success rate, averaged over the last three evaluations."""

    def check(self, installed: bool = True) -> None:
        """Raises ValueError for an invalid option, or for a log whose package is missing, if packages must be `installed`."""
        validation.check_count("final_episodes", self.final_episodes)
        validation.check_number("checkpoint_every", self.checkpoint_every, "[0, 1000000]")
        validation.check_count("keep", self.keep)
        if not isinstance(self.keep_end, bool):
            raise ValueError(f"keep_end must be true or false; got {self.keep_end!r}")
        if not isinstance(self.log, (list, tuple)):
            raise ValueError(f"log must be names among {', '.join(LOGS)}; got {self.log!r}")
        for log in self.log:
            check_name("log", log, LOGS)
            if installed and (package := LOGS[log]):
                require_extra(f"log {log}", package, log)
        if self.stop_at is not None:
            validation.check_number("stop_at", self.stop_at, "(0, 1]", float)

    def check_many(self) -> None:
        """Raises ValueError for an option that only a single run supports."""
        if self.stop_at is not None:
            raise ValueError("stop_at is only for a single run, because the runs of a sweep are compared epoch by epoch")
        if self.keep_end:
            raise ValueError("keep_end is only for a single run: a sweep with another total_steps has other runs")

    def is_reached(self, success_rates: Sequence[float]) -> bool:
        """Whether a run with these success rates per epoch has reached `stop_at`."""
        last = [float(f"{rate:.6g}") for rate in success_rates[-3:]]  # as a resumed run reads them from metrics.csv
        return self.stop_at is not None and len(last) == 3 and sum(last) / 3 >= self.stop_at - 1e-9


def custom_components(spec: RunSpec) -> dict[str, str]:
    """Custom components of a run, module:attribute by field."""
    return {field: getattr(spec, field) for field in COMPONENTS if is_import_path(getattr(spec, field))}


def to_arguments(texts: Sequence[str]) -> dict[str, Argument]:
    """Parses "NAME=VALUE" texts. A value is true, false, a number, or a string. Quote strings that look like numbers ("007").
    Raises ValueError for an invalid text, a number that is not finite, or a name that is repeated or has its own option.
    """
    arguments: dict[str, Argument] = {}
    for text in texts:
        name, _, value = str(text).partition("=")
        if not (isinstance(text, str) and name.isidentifier() and value):
            raise ValueError(f"env_kwargs must be NAME=VALUE, such as reward_type=dense; got {text!r}")
        if name in arguments:
            raise ValueError(f"env_kwargs has {name} twice")
        if name == "engine":
            raise ValueError("env_kwargs cannot have engine; use the setting engine (--engine)")
        arguments[name] = _to_argument(value)
        if arguments[name] in (math.inf, -math.inf) or arguments[name] != arguments[name]:
            raise ValueError(f"env_kwargs: {name} must be finite; got {value}")
    return arguments


def to_texts(arguments: Mapping[str, Argument]) -> tuple[str, ...]:
    """Formats arguments as sorted "NAME=VALUE" texts. Inverse of `to_arguments`."""
    return tuple(f"{name}={_to_text(value)}" for name, value in sorted(arguments.items()))


def _to_text(value: Argument) -> str:
    if isinstance(value, str):
        return value if value and _to_argument(value) == value else json.dumps(value, ensure_ascii=False)
    return str(value).lower() if isinstance(value, bool) else str(value)


def _to_argument(value: str) -> Argument:
    if value.lower() in ("true", "false"):
        return value.lower() == "true"
    if value.startswith('"') and value.endswith('"'):
        with contextlib.suppress(ValueError):
            return str(json.loads(value))
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(value)
    return value


def validate_values(spec: RunSpec) -> None:
    """Checks each value alone, for any environment and components. Raises ValueError with each invalid field and value."""
    validation.check_all(
        *((_check_text, name, getattr(spec, name)) for name in COMPONENTS),
        (_check_text, "demonstrations", "" if spec.demonstrations is None else spec.demonstrations),
        *_checks(spec, 1),
    )


def validate(spec: RunSpec, episode_length: int | None = None) -> None:
    """Checks that a run is possible. Imports no component.

    Args:
      episode_length: steps of an existing environment, whose name is then not checked. Default: the argument of that name or
        50. Sizes that depend on a custom environment's are not checked without it.

    Raises:
      ValueError: names each invalid field, its value and the allowed values.
    """
    names = [(check_name, field, getattr(spec, field), table, True) for field, table in COMPONENTS.items()]
    if episode_length is None:
        episode_length = None if is_import_path(spec.env) else _episode_length(spec)
    else:
        del names[0]
    files = [] if spec.demonstrations is None else [(find_demonstrations, spec.demonstrations)]
    validation.check_all(*names, *files, *_checks(spec, episode_length))


def find_demonstrations(source: str | os.PathLike[str]) -> Path:
    """Path of an .npz file or Minari data set. Raises ValueError if it does not exist or is not trusted (`trust`)."""
    source, root = os.fspath(source), Path(os.environ.get("MINARI_DATASETS_PATH") or os.path.expanduser("~/.minari/datasets"))
    for path in (Path(source), root / source):
        if (source.endswith(".npz") and path.is_file()) or (source and (path / "data").is_dir()):
            from mjx_dher import trust

            trust.check("demonstrations", source, path)
            return path
    raise ValueError(f"demonstrations must be an .npz file, or the folder or name of a Minari data set; got {source!r}")


def _episode_length(spec: RunSpec) -> Any:
    try:
        return spec.env_arguments.get("episode_length", 50)
    except (ValueError, TypeError):
        return 50


def _checks(spec: RunSpec, episode_length: Any) -> list[tuple[Any, ...]]:
    return [
        (to_arguments, spec.env_kwargs),
        (validation.validate, spec.config, spec.hparams, episode_length),
        (validation.check_seed, spec.seed),
        (check_name, "engine", spec.engine, ENGINES),
    ]


def _check_text(field: str, value: Any) -> None:
    if not isinstance(value, str):
        raise ValueError(f"{field} must be a name; got {value!r}")
