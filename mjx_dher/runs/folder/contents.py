"""Types and ranges of what a run's files hold. Every reader of these files calls the checks here, and none checks anew."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from mjx_dher.lookup import check_name
from mjx_dher.runs.folder import fingerprint
from mjx_dher.validation import check_devices, check_number

# Statuses in result.json.
FINISHED = "finished"
FAILED = "failed"

_SHARES = (
    *("success_rate", "reset_success_rate", "train_success_rate", "success_low", "success_high"),
    *("relabelled_share", "no_goal_share", "bad_rewards", "bad_success"),
)
_COUNTS = ("epoch", "epochs", "env_steps", "updates", "episodes")
_AMOUNTS = ("wall_seconds", "discarded_episodes", "steps_per_second", "updates_per_second", "memory_bytes")
_MAY_BE_NAN = ("relabelled_share", "steps_per_second", "updates_per_second", "memory_bytes")
_LARGEST = 9 * 10**18


def check_config(content: Mapping[str, Any]) -> None:
    """Raises ValueError, TypeError or KeyError for an entry of config.json that is missing or invalid.

    `run_folder.to_spec` checks the settings themselves, and `Options` the options.
    """
    kinds = {"config": dict, "hparams": dict, "physics": str, "env_kwargs": list, "sources": dict, "digest": str}
    for name, kind in kinds.items():
        _check_kind(name, content[name], kind)
    _check_kind("config.hidden_sizes", content["config"]["hidden_sizes"], list)
    for group in ("sources", "versions"):
        _check_kind(group, content.get(group, {}), dict)
        for name, text in content.get(group, {}).items():
            _check_kind(f"{group}.{name}", text, str)
    _check_kind("earlier", content.get("earlier", []), list)
    _check_digest("digest", content["digest"])
    for digest in content.get("earlier", ()):
        _check_digest("earlier", digest)
    for flag in content.get("jax_flags", {}):
        check_name("jax_flags", flag, fingerprint.JAX_FLAGS)
    check_devices(content.get("devices", 1))
    check_number("lanes", content.get("lanes", 1), "[1, 1000000]")


def check_result(content: Mapping[str, Any]) -> None:
    """Raises ValueError, TypeError or KeyError for an entry of result.json that is missing or invalid."""
    check_name("status", content["status"], (FINISHED, FAILED))
    _check_digest("digest", content["digest"])
    _check_kind("reason", content["reason"], str)
    check_number("lanes", content["lanes"], "[1, 1000000]")
    needed = ["epochs", "env_steps", "wall_seconds"]
    if content["status"] == FINISHED:
        needed += ["episodes", "success_rate", "success_low", "success_high", "reset_success_rate"]
        if content["return_mean"] is not None:
            check_number("return_mean", content["return_mean"], "(-inf, inf)", float)
    for name in needed:
        _check_metric(name, content[name])


def check_row(row: Mapping[str, Any]) -> None:
    """Raises ValueError for a value in a line of metrics.csv that is invalid. A custom learner's metrics can be any number."""
    for name, value in row.items():
        if name not in _MAY_BE_NAN or not math.isnan(value):
            _check_metric(name, value)


def check_manifest(content: Mapping[str, Any]) -> None:
    """Raises ValueError, TypeError or KeyError for an entry of a checkpoint's manifest that is missing or invalid."""
    _check_metric("epoch", content["epoch"])
    _check_metric("wall_seconds", content["wall_seconds"])
    for run in content["runs"]:
        check_identity(run)
    for lane, (epoch, reason) in content["failed"].items():
        check_number("failed", int(lane), "[0, 1000000]")
        _check_metric("epoch", epoch)
        _check_kind("failed", reason, str)
    for name, shape, dtype in content["leaves"]:
        for text in (name, dtype):
            _check_kind("leaves", text, str)
        for size in shape:
            check_number(name, size, f"[0, {_LARGEST}]")
    for name, digest in content["files"].items():
        _check_kind(f"files.{name}", digest, str)


def check_identity(content: Any) -> None:
    """Raises ValueError, TypeError or KeyError unless `content` may be a `fingerprint.identity`."""
    _check_kind("settings", content, dict)
    _check_kind("settings.sources", content["sources"], dict)
    for name, text in content["sources"].items():
        _check_kind(f"settings.sources.{name}", text, str)


def _check_digest(name: str, digest: Any) -> None:
    if not isinstance(digest, str) or not re.fullmatch("[0-9a-f]{10}", digest):
        raise ValueError(f"{name} must be ten hexadecimal digits; got {digest!r}")


def _check_metric(name: str, value: Any) -> None:
    if name in _COUNTS:
        check_number(name, value, f"[0, {_LARGEST}]")
    elif name in _SHARES:
        check_number(name, value, "[0, 1]", float)
    elif name in _AMOUNTS:
        check_number(name, value, "[0, inf]", float)


def _check_kind(name: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a {kind.__name__}")
