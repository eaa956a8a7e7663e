"""Identity of a run: its settings, digests of custom source files, and a digest of all of these that its files carry."""

import dataclasses
import functools
import hashlib
import json
import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_dher.components import reads
from mjx_dher.config import Config, HParams
from mjx_dher.spec import RunSpec, custom_components, find_demonstrations

MAY_CHANGE = ("total_steps", "physics", "sources")  # may differ when a run is resumed
# JAX flags that change results by more than rounding, and their defaults. Digests include flags that differ.
JAX_FLAGS: dict[str, Any] = {
    "JAX_ENABLE_X64": 0,
    "JAX_DEFAULT_MATMUL_PRECISION": "default",  # read on GPUs
    "JAX_THREEFRY_PARTITIONABLE": 1,
    "JAX_DEFAULT_PRNG_IMPL": "threefry2x32",
    "JAX_RANDOM_SEED_OFFSET": 0,
}
_WORDS = {**dict.fromkeys(("y", "yes", "t", "true", "on", "1"), 1), **dict.fromkeys(("n", "no", "f", "false", "off", "0"), 0)}
# Settings that every version has written and that a digest always includes. It includes others only if they differ from
# their default, so a new setting changes neither digests nor names of trials.
ALWAYS = frozenset(
    (
        *("env", "engine", "sampler", "weight_kernel", "metric", "num_envs", "cycles_per_epoch", "updates_per_cycle"),
        *("target_period", "batch_size", "total_steps", "replay_size", "hidden_sizes", "learner_dtype"),
        *("eval_episodes", "actor_lr", "critic_lr", "lr_end", "gamma", "polyak", "action_l2", "random_eps", "noise_std"),
        *("her_k", "priority_fraction", "epsilon", "temperature", "obs_clip", "norm_clip", "norm_eps"),
    )
)
REMOVED = {"learner_kernels": "auto"}  # a removed setting, which older digests include


def settings(spec: RunSpec) -> dict[str, Any]:
    """All settings of a run by their names, without the seed."""
    parts = {field.name: getattr(spec, field.name) for field in dataclasses.fields(spec)}
    return {
        **{name: value for name, value in parts.items() if name not in ("config", "hparams", "seed")},
        **dataclasses.asdict(spec.config),
        **spec.hparams._asdict(),
    }


def with_unread_of(base: RunSpec, spec: RunSpec) -> RunSpec:
    """Copy of `spec` in which settings that its sampler and learner do not read come from `base`."""
    values, others = settings(spec), settings(base)
    return spec.replace(**{name: others[name] for name in values if not reads(values, name)})


def groups(spec: RunSpec) -> dict[str, dict[str, Any]]:
    """Settings that a run reads, and its seed, in the groups run, sizes and numbers."""
    values = {**settings(spec), "seed": spec.seed}
    sizes, numbers = [field.name for field in dataclasses.fields(Config)], list(HParams._fields)
    names = {"run": [name for name in values if name not in (*sizes, *numbers)], "sizes": sizes, "numbers": numbers}
    return {group: {name: values[name] for name in own if reads(values, name)} for group, own in names.items()}


def text(value: Any) -> str:
    """A setting's value as on a command line."""
    if isinstance(value, (tuple, list)):
        return " ".join(map(str, value)) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def named(name: str, value: Any) -> str:
    """A setting in the name of a run: a component's name alone, or a value with the setting's name."""
    return value if value and isinstance(value, str) else f"{name} {text(value) or 'unknown'}"


def varying(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of settings in which runs differ."""
    return [name for name in settings[0] if len({str(each.get(name)) for each in settings}) > 1]


def sources(spec: RunSpec) -> dict[str, str]:
    """Names and digests of the files of custom components and demonstrations, by field: "push2d.py 3fa9c1d2e4".

    A component's digest includes the models that it names, with their meshes and other files (`model_files`), but not the
    files that it imports. Each file is read once per process, like its module.
    """
    read = {name: _source(value) for name, value in custom_components(spec).items()}
    if spec.demonstrations is not None:
        read["demonstrations"] = _demonstrations(spec.demonstrations)
    return {name: source for name, source in read.items() if source is not None}


@functools.cache
def _source(import_path: str) -> str | None:
    from mjx_dher.import_paths import module_file
    from mjx_dher.runs.folder.model_files import model_files

    file = module_file(import_path)
    if file is None:
        return None
    return _name_and_digest(file, [file, *model_files(file)])


@functools.cache
def _demonstrations(source: str) -> str | None:
    try:
        path = find_demonstrations(source)
    except ValueError:
        return None
    return _name_and_digest(path, [path] if path.is_file() else sorted(x for x in (path / "data").rglob("*") if x.is_file()))


def _name_and_digest(path: Path, files: Sequence[Path]) -> str:
    content = hashlib.sha256()
    for file in files:
        with file.open("rb") as opened:
            hashlib.file_digest(opened, lambda: content)  # in parts, as a data set may be larger than the memory
    return f"{path.name} {content.hexdigest()[:10]}"


def jax_flags() -> dict[str, Any]:
    """Flags in `JAX_FLAGS` that differ from JAX's defaults, from JAX if it is imported, else from the environment."""
    config, flags = getattr(sys.modules.get("jax"), "config", None), {}
    for name, default in JAX_FLAGS.items():
        value = os.environ.get(name) if config is None else getattr(config, name.lower(), None)
        word = str(default if value is None else value)
        flags[name] = _WORDS.get(word.lower(), word) if isinstance(default, int) else word
    return {name: value for name, value in flags.items() if value != JAX_FLAGS[name]}


def _not_default(spec: RunSpec) -> dict[str, Any]:
    defaults = settings(RunSpec())
    kept = {name: value for name, value in settings(spec).items() if name in ALWAYS or value != defaults[name]}
    kept.pop("demonstrations", None)  # the file's digest is among the sources
    return kept


def identity(
    spec: RunSpec, physics: str, own_sources: Mapping[str, str], flags: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Everything that determines a run's result, as JSON: settings, seed, physics, custom source files and JAX flags."""
    kept = _not_default(spec)
    numbers = {name: float(kept[name]) for name in HParams._fields if name in kept}
    kept |= {"env_kwargs": list(kept["env_kwargs"])} if "env_kwargs" in kept else {}
    content = {**kept, **numbers, "hidden_sizes": list(spec.config.hidden_sizes), "seed": spec.seed, "physics": physics}
    return {**content, **REMOVED, "sources": dict(own_sources), **(flags or {})}


def digest(content: Mapping[str, Any]) -> str:
    """Ten hexadecimal digits of an `identity`."""
    return sha256_of(content)[:10]


def trial_name(spec: RunSpec) -> str:
    """Name of a trial's folder: readable settings, and a digest of all settings, custom code and JAX flags."""
    kept = _not_default(spec) | REMOVED
    numbers = {name: float(kept.pop(name)) for name in HParams._fields if name in kept}
    numbers["eventful_share"] = numbers.pop("priority_fraction")  # its name in the first digests
    beside = [own for own in (sources(spec), jax_flags()) if own]
    hashed = sha256_of([1, kept, numbers, spec.seed, *beside])
    return f"{in_a_path(spec.env)}-{in_a_path(spec.sampler)}-s{spec.seed}-{hashed[:10]}"


def in_a_path(name: str) -> str:
    """Name of an environment or sampler as part of a file name: "Tasks:Mine" becomes tasks-mine."""
    return re.sub(r"[^a-z0-9_]+", "-", name.lower())


def in_paths(names: Iterable[str]) -> dict[str, str]:
    """`in_a_path` of each name, with a digest where several would be equal."""
    short = {name: in_a_path(name) for name in names}
    same = [stem for stem in short.values() if list(short.values()).count(stem) > 1]
    return {name: f"{stem}-{sha256_of(name)[:6]}" if stem in same else stem for name, stem in short.items()}


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, str]:
    """Differences between two identities, one sentence per name: "gamma was 0.98 and is 0.1"."""
    defaults = {**settings(RunSpec()), "sources": {}, **JAX_FLAGS}

    def value(content: Mapping[str, Any], name: str) -> Any:
        return content.get(name, defaults.get(name))

    changed = [name for name in {**before, **now} if value(before, name) != value(now, name)]
    told = {name: f"{name} was {value(before, name)!r} and is {value(now, name)!r}" for name in changed}
    if "sources" in told:
        told["sources"] = _changed_files(value(before, "sources"), value(now, "sources"))
    return told


def _changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    changed = [(name, before.get(name), now.get(name)) for name in {**before, **now} if before.get(name) != now.get(name)]
    return "; ".join(f"{file_of(name, new or old or '')} has changed ({name})" for name, old, new in changed)


def file_of(field: str, source: str) -> str:
    """File of a component's source, and for an environment what else its digest covers."""
    return source.split(maxsplit=1)[0] + (" or a file of its model" if field == "env" else "")


def sha256_of(content: Any) -> str:
    """SHA-256 of a JSON value."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
