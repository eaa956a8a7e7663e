"""Measurements in separate processes, so that earlier ones leave nothing behind."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

MEASURE = "measure"


def measured(script: str, args: Sequence[str], environ: Mapping[str, str] | None = None, python: str = sys.executable) -> Any:
    """Calls, in a new Python, the function that `script` passes to `main`, and returns its result.

    Args:
      script: path of the program to start.
      args: arguments of the function.
      environ: variables to add to this process's environment.
      python: interpreter that runs the script. It does not need this library.
    """
    from mjx_dher.system import subprocesses

    answer = subprocesses.ask([python, script, MEASURE, *args], environ)
    if answer.failure:
        sys.exit(f"{python} {script} {MEASURE} {' '.join(args)} failed:\n{answer.err.strip() or answer.failure}")
    return answer.last_json()


def main(measure: Callable[..., Any], otherwise: Callable[[], int | None]) -> None:
    """Runs `measure` if `measured` started the script, and `otherwise` if a user did."""
    if sys.argv[1:2] == [MEASURE]:
        print(json.dumps(measure(*sys.argv[2:])))
    else:
        sys.exit(otherwise())
