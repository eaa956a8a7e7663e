"""Types and ranges of the content of a run's files, which are checked whenever they are read."""

from __future__ import annotations

import re
from typing import Any

from mjx_dher.runs.folder.run_folder import FAILED, FINISHED
from mjx_dher.validation import check_number

# A form is a type, a pattern for a string, (kind, interval) of a number, [form] for a list, or a dict of forms by key. The key
# "*" means all keys, and a key that ends in "?" may be missing.
Form = Any


_DIGEST = "[0-9a-f]{10}"
_COUNT, _LANES = (int, "[0, 9000000000000000000]"), (int, "[1, 1000000]")
_SHARE, _AMOUNT = (float, "[0, 1]"), (float, "[0, inf]")

IDENTITY: Form = {"sources": {"*": str}}  # `fingerprint.identity`
CONFIG: Form = {
    "config": {"hidden_sizes": list},
    "hparams": dict,
    "physics": str,
    "env_kwargs": list,
    "sources": {"*": str},
    "digest": _DIGEST,
    "earlier?": [_DIGEST],
    "jax_flags?": dict,
    "lanes?": _LANES,
    "devices?": _LANES,
    "interface?": dict,
    "versions?": {"*": str},
}
RESULT: Form = {
    "status": f"{FINISHED}|{FAILED}",
    "reason": str,
    "digest": _DIGEST,
    "lanes": _LANES,
    "epochs": _COUNT,
    "env_steps": _COUNT,
    "wall_seconds": _AMOUNT,
}
_RATES: Form = dict.fromkeys(("success_rate", "success_low", "success_high", "reset_success_rate"), _SHARE)
RESULT_FINISHED: Form = {**RESULT, **_RATES, "episodes": _COUNT, "return_mean?": (float, "(-inf, inf)")}
ROW: Form = {  # of metrics.csv; other metrics of learners can be any number
    **dict.fromkeys(("epoch", "env_steps", "updates"), _COUNT),
    "wall_seconds": _AMOUNT,
    "success_rate": _SHARE,
    **dict.fromkeys(("reset_success_rate?", "train_success_rate?", "relabelled_share?", "no_goal_share?"), _SHARE),
    **dict.fromkeys(("bad_rewards?", "bad_success?"), _SHARE),
    **dict.fromkeys(("discarded_episodes?", "steps_per_second?", "updates_per_second?", "memory_bytes?"), _AMOUNT),
}
MANIFEST: Form = {
    "epoch": _COUNT,
    "wall_seconds": _AMOUNT,
    "runs": [IDENTITY],
    "failed": {"*": list},
    "leaves": [list],
    "files": {"*": str},
}


def check(content: Any, form: Form, name: str = "content") -> None:
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
        check(content, list, name)
        for entry in content:
            check(entry, form[0], name)
    else:
        check(content, dict, name)
        prefix = "" if name == "content" else f"{name}."
        for key, entry in form.items():
            for field in content if key == "*" else (key.removesuffix("?"),):
                if field in content or not key.endswith("?"):
                    check(content[field], entry, f"{prefix}{field}")
