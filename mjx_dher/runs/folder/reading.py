"""Reads the files of a run, and checks that they belong together."""

import contextlib
import dataclasses
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_dher import lookup
from mjx_dher import spec as spec_lib
from mjx_dher.config import Config, HParams
from mjx_dher.runs.folder import fingerprint, run_folder
from mjx_dher.spec import RunSpec
from mjx_dher.system import files, npz
from mjx_dher.system.files import FolderError
from mjx_dher.validation import check_number

POLICY_RATIO = 20.0  # largest ratio of a policy's arrays to its uncompressed file

# A form is a type, a pattern for a string, (kind, interval) of a number, [form] for a list, or a dict of forms by key. The key
# "*" means all keys, and a key that ends in "?" may be missing.
Form = Any
_DIGEST = "[0-9a-f]{10}"
_COUNT, _LANES = (int, "[0, 9000000000000000000]"), (int, "[1, 1000000]")
_SHARE, _AMOUNT, _FINITE = (float, "[0, 1]"), (float, "[0, inf]"), (float, "(-inf, inf)")

_IDENTITY: Form = {"sources": {"*": str}}  # `fingerprint.identity`
_CONFIG: Form = {
    "config": {"hidden_sizes": list},
    "hparams": dict,
    "physics": str,
    "env_kwargs": list,
    "sources": {"*": str},
    "digest": _DIGEST,
    "earlier?": [_DIGEST],
    "jax_flags?": dict,
    **dict.fromkeys(("lanes?", "devices?", "final_episodes?"), _LANES),
    "interface?": dict,
    "versions?": {"*": str},
}
RESULT: Form = {
    "status": f"{run_folder.FINISHED}|{run_folder.FAILED}",
    "reason": str,
    "digest": _DIGEST,
    "lanes": _LANES,
    "epochs": (int, "[1, 9000000000000000000]"),
    "env_steps": _COUNT,
    "wall_seconds": _AMOUNT,
}
_RATES: Form = dict.fromkeys(("success_rate", "success_low", "success_high", "reset_success_rate"), _SHARE)
RESULT_FINISHED: Form = {**RESULT, **_RATES, "episodes": _COUNT, "discarded_episodes?": _COUNT, "return_mean?": _FINITE}
ROW: Form = {  # of metrics.csv; other metrics of learners can be any number
    **dict.fromkeys(("epoch", "env_steps", "updates"), _COUNT),
    "wall_seconds": _AMOUNT,
    "success_rate": _SHARE,
    **dict.fromkeys(("reset_success_rate?", "train_success_rate?", "relabelled_share?", "no_goal_share?"), _SHARE),
    **dict.fromkeys(("bad_rewards?", "bad_success?"), _SHARE),
    **dict.fromkeys(("discarded_episodes?", "steps_per_second?", "updates_per_second?", "memory_bytes?"), _AMOUNT),
}
_MANIFEST: Form = {
    "epoch": _COUNT,
    "wall_seconds": _AMOUNT,
    "runs": [_IDENTITY],
    "failed": {"*": list},
    "leaves": [list],
    "files": {"*": str},
}


def check_form(content: Any, form: Form, name: str = "content") -> None:
    """Raises ValueError, TypeError or KeyError, naming the entry, unless `content` has the form `form`."""
    if isinstance(form, type):
        if not isinstance(content, form):
            raise TypeError(f"{name} must be a {form.__name__}")
    elif isinstance(form, str):
        if not isinstance(content, str) or not re.fullmatch(form, content):
            raise ValueError(f"{name} must be like {form}; got {content!r}")
    elif isinstance(form, tuple):
        check_number(name, content, form[1], form[0])
    elif isinstance(form, list):
        check_form(content, list, name)
        for entry in content:
            check_form(entry, form[0], name)
    else:
        check_form(content, dict, name)
        prefix = "" if name == "content" else f"{name}."
        for key, entry in form.items():
            for field in content if key == "*" else (key.removesuffix("?"),):
                if field in content or not key.endswith("?"):
                    check_form(content[field], entry, f"{prefix}{field}")


def changed_versions(content: Mapping[str, Any]) -> list[str]:
    """Sentences about versions of this program and its dependencies that differ from config.json."""
    before, now = content.get("versions", {}), run_folder.versions()
    return [f"{name} was {before[name]} and is {now[name]}" for name in now if before.get(name, now[name]) != now[name]]


def read_versioned(file: Path, schema: int) -> dict[str, Any]:
    """Reads a JSON object whose key "schema" is `schema`. Raises FileNotFoundError if there is none, and FolderError if it
    cannot be read, or has another schema.
    """
    content = files.read_json(file)
    written = content.get("schema") if isinstance(content, dict) else None
    if written != schema:
        raise FolderError(f"{file} must have schema {schema}; got {written!r}")
    return content


def read_config(path: Path) -> dict[str, Any]:
    """Reads config.json of the run in `path`. Raises FolderError if it is not a run folder, or has another schema."""
    if not path.is_dir():
        raise FolderError(f"{path} is not a run folder: {'it is a file' if path.exists() else 'no such folder'}")
    try:
        return read_config_file(path / run_folder.CONFIG_FILE)
    except FileNotFoundError:
        raise FolderError(f"{path} is not a run folder: it has no {run_folder.CONFIG_FILE}") from None


def read_config_file(file: Path) -> dict[str, Any]:
    """Reads a run's config.json from any path. Raises FileNotFoundError if there is none, and FolderError if it does not
    describe a run, or has another schema.
    """
    content = read_versioned(file, run_folder.SCHEMA)
    with checked(file, "does not describe a run"):
        check_form(content, _CONFIG)
        for flag in content.get("jax_flags", ()):
            lookup.check_name("jax_flags", flag, fingerprint.JAX_FLAGS)
    return content


@contextlib.contextmanager
def checked(file: Path, problem: str = "is damaged") -> Iterator[None]:
    """Converts errors of a block that reads the content of `file` to a FolderError."""
    try:
        yield
    except FolderError:
        raise
    except KeyError as error:
        raise FolderError(f"{file} {problem} ({error} is missing)") from error
    except (OSError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise FolderError(f"{file} {problem} ({error})") from error


def read_spec(path: Path, trusted: bool = False) -> RunSpec:
    """Reads the description of the run in `path`. Raises FolderError like `read_run`."""
    return read_run(path, trusted)[1]


def read_run(path: Path, trusted: bool = False) -> tuple[dict[str, Any], RunSpec]:
    """Reads config.json of the run in `path`: its content, and the run's description.

    Code that it names is imported only if `trusted`, or if the user has trained with it (`trust`). Raises FolderError if it is
    not a run folder, has another schema, or config.json was edited.
    """
    content = read_config(path)
    spec = to_spec(path, content, trusted)
    if edits := edited(path, content, spec):
        raise FolderError(f"{path / run_folder.CONFIG_FILE} was edited: {'; '.join(edits.values())}")
    check_written(path, content, spec)
    return content, spec


def identity_of(content: dict[str, Any], spec: RunSpec) -> dict[str, Any]:
    """`identity` of the run that config.json describes."""
    own = fingerprint.identity(spec, content["physics"], content["sources"], content.get("jax_flags"))
    return {**own, **{name: content["config"].get(name, value) for name, value in fingerprint.REMOVED.items()}}


def digests(content: Mapping[str, Any]) -> list[str] | None:
    """Digests that a run has had, in order, or None if its version did not keep them."""
    return [*content["earlier"], content["digest"]] if "earlier" in content else None


def foreign(content: dict[str, Any], spec: RunSpec, written: Mapping[str, Any]) -> str | None:
    """Differences between a file's settings and all settings that the run has had, or None if the file belongs to the run."""
    changed, known = fingerprint.differences(written, identity_of(content, spec)), digests(content)
    if known is None:  # then a resumed run is indistinguishable from another one that differs in these
        changed = {name: text for name, text in changed.items() if name not in fingerprint.MAY_CHANGE}
    elif fingerprint.digest(written) in known:
        return None
    return "; ".join(changed.values()) or None


def check_written(path: Path, content: dict[str, Any], spec: RunSpec) -> None:
    """Raises FolderError if the newest checkpoint, or else the policy, belongs to a run with other settings."""
    file, written = written_identity(path)
    if written is not None and (other := foreign(content, spec, written)):
        raise FolderError(f"{file} is of a run with other settings: {other}")


def edited(path: Path, content: dict[str, Any], spec: RunSpec) -> dict[str, str]:
    """Settings in config.json that differ from the trained ones, one sentence per name."""
    file = content["sources"].get("demonstrations")  # the identity has its digest in place of the name
    if (file is None) != (spec.demonstrations is None):
        return {"demonstrations": f"demonstrations is {spec.demonstrations!r}, and the file of its training is {file!r}"}
    now = identity_of(content, spec)
    if content["digest"] == fingerprint.digest(now):
        return {}
    _, written = written_identity(path)
    changed = {} if written is None else fingerprint.differences(written, now)
    return changed or {"digest": f"its digest is {content['digest']}, but its settings have {fingerprint.digest(now)}"}


def changed_code(content: dict[str, Any], spec: RunSpec) -> list[str]:
    """Sentences about custom source files and JAX flags that changed since the run was trained."""
    own = {**content["sources"], **fingerprint.sources(spec)}
    now = fingerprint.identity(spec, content["physics"], own, fingerprint.jax_flags())
    return list(fingerprint.differences(identity_of(content, spec), now).values())


def check_same(path: Path, spec: RunSpec, may_change: Sequence[str] = fingerprint.MAY_CHANGE) -> None:
    """Raises FolderError, naming the differences, if the folder holds a run that differs in more than `may_change`."""
    content = read_config(path)
    before = identity_of(content, to_spec(path, content))
    now = fingerprint.identity(spec, content["physics"], content["sources"], fingerprint.jax_flags())
    changed = fingerprint.differences(before, now)
    if refused := [text for name, text in changed.items() if name not in may_change]:
        raise FolderError(f"{path} holds a run with other settings: {'; '.join(refused)}")


def read_manifest(checkpoint: Path) -> dict[str, Any]:
    """Reads the manifest of a checkpoint. Raises FolderError if it is missing or damaged."""
    with checked(checkpoint):
        content = read_versioned(checkpoint / run_folder.MANIFEST, run_folder.SCHEMA)
        if content.pop("sha256", None) != fingerprint.sha256_of(content):
            raise ValueError(f"{run_folder.MANIFEST} has changed: SHA-256 differs")
        check_form(content, _MANIFEST)
        return content


def read_policy_settings(path: Path) -> dict[str, Any]:
    """Reads the `identity` in policy.npz of the run in `path`. Raises FolderError if it is missing or damaged."""
    file = path / run_folder.POLICY_FILE
    with checked(file, "is damaged or not a policy of this program"):
        return policy_settings(npz.read(file, ("settings",), POLICY_RATIO))


def policy_settings(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """`identity` among the arrays of a policy.npz. Raises ValueError, KeyError or TypeError if there is none."""
    if "settings" not in arrays:
        raise ValueError("it has no settings, unlike the policies of runs")
    settings = json.loads(arrays["settings"].tobytes())
    check_form(settings, _IDENTITY, "settings")
    return dict(settings)


def written_identity(path: Path) -> tuple[Path, dict[str, Any] | None]:
    """The run's newest checkpoint, or else its policy, and the `identity` in it, or None without either."""
    for checkpoint in run_folder.checkpoints(path):
        with contextlib.suppress(FolderError, ValueError):  # damaged, or of several runs
            (content,) = read_manifest(checkpoint)["runs"]
            return checkpoint, dict(content)
    with contextlib.suppress(FolderError):  # `load_policy` reports a damaged one
        return path / run_folder.POLICY_FILE, read_policy_settings(path)
    return path, None


def to_spec(path: Path, content: dict[str, Any], trusted: bool = False) -> RunSpec:
    """Description of a run from the content of its config.json, at `path` or in the folder `path`.

    Names of code and of demonstrations are marked as coming from a file, unless `trusted`. Raises FolderError if an entry is
    missing or invalid.
    """
    file = path / run_folder.CONFIG_FILE if path.is_dir() else path
    with checked(file, "does not describe a run"):
        fields = {f.name for f in dataclasses.fields(RunSpec)} - {"config", "hparams"}
        config = {**content["config"], "hidden_sizes": tuple(content["config"]["hidden_sizes"])}
        if missing := fingerprint.ALWAYS - {*content, *config, *content["hparams"]}:  # a default could be wrong
            raise ValueError(f"it lacks {', '.join(sorted(missing))}")
        for part, known in (("config", [field.name for field in dataclasses.fields(Config)]), ("hparams", HParams._fields)):
            if unknown := sorted(content[part].keys() - known - fingerprint.REMOVED.keys()):
                raise ValueError(f"{part} has no setting {unknown[0]!r}{lookup.hint(unknown[0], known)}")
        spec = RunSpec(
            config=Config(**{name: value for name, value in config.items() if name not in fingerprint.REMOVED}),
            hparams=HParams(**{name: math.inf if x == run_folder.INFINITE else x for name, x in content["hparams"].items()}),
            **{name: content[name] for name in fields - {"env_kwargs"} if name in content},
            env_kwargs=tuple(content["env_kwargs"]),
        )
        spec_lib.validate_values(spec)
    names = {**spec_lib.custom_components(spec), **({"demonstrations": spec.demonstrations} if spec.demonstrations else {})}
    if trusted or not names:
        return spec
    from mjx_dher.trust import FromFile

    marked: dict[str, Any] = {
        field: FromFile.of(name, file, spec.env_kwargs if field == "env" else ()) for field, name in names.items()
    }
    return dataclasses.replace(spec, **marked)
