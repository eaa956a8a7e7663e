"""A measurement in a program of its own, so that no earlier one has left anything behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

MEASURE = "measure"


def measured(script: str, args: Sequence[str], environ: Mapping[str, str] | None = None, python: str = sys.executable) -> Any:
    """What the function that `script` gave to `main` returns for `args`, called in a new Python.

    Args:
      script: path of the program to start.
      args: of the function.
      environ: added to this program's environment variables.
      python: interpreter that runs it.
    """
    command = [python, script, MEASURE, *args]
    done = subprocess.run(command, env={**os.environ, **(environ or {})}, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed; see above")
    return json.loads(done.stdout.splitlines()[-1])


def main(measure: Callable[..., Any], otherwise: Callable[[], int | None]) -> None:
    """Runs a script: as `measured` starts it, `measure`, and `otherwise` what a user starts."""
    if sys.argv[1:2] == [MEASURE]:
        print(json.dumps(measure(*sys.argv[2:])))
    else:
        sys.exit(otherwise())
