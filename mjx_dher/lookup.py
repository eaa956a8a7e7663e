"""Names from users: checks with suggestions, and packages of optional extras. `import_paths` has "module:attribute".

Loads neither JAX nor MuJoCo.
"""

import difflib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

# Of the command that runs.
current_folder = False  # whether to search the current folder for components
trusts_files = False  # --trust (`trust`)
_BYTES = re.compile("[\udc80-\udcff]+")  # as Python decodes them


def escaped(text: str) -> str:
    """Text with escaped bytes of file names that are not valid UTF-8, which cannot be written."""
    return _BYTES.sub(lambda match: match[0].encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace"), text)


def command_name() -> str:
    """The command that the user started: mjx-dher if it is installed, else as a module or file."""
    name = Path(sys.argv[0]).stem
    return {"mjx-dher": name, "__main__": "python -m mjx_dher"}.get(name, "python train.py")


def check_name(field: str, value: str, allowed: Iterable[str], custom: bool = False) -> None:
    """Raises ValueError unless a name is allowed. The message lists the allowed names and suggests the nearest.

    Args:
      field: setting that the message names.
      custom: whether "module:attribute" is allowed too. The module must exist; it is not imported.
    """
    allowed = tuple(allowed)
    if value in allowed:
        return
    if custom and is_import_path(value):
        from mjx_dher import import_paths

        import_paths.check(field, value)
        return
    rest = ", or module:attribute" if custom else ""
    raise ValueError(
        f"{field} must be one of {', '.join(allowed) or '(there is none)'}{rest}; got {value!r}{hint(str(value), allowed)}"
    )


def is_import_path(name: str) -> bool:
    """Whether a name is "module:attribute" and not a built-in name."""
    return ":" in str(name)


def check_function(field: str, function: Any, parameters: Sequence[str]) -> Callable[..., Any]:
    """Returns `function`. Raises ValueError unless it can be called with `parameters`."""
    try:
        inspect.signature(function).bind(*parameters)
    except TypeError:
        raise ValueError(f"{field} must be a function ({', '.join(parameters)}); it is {function!r}") from None
    return function


def require_extra(feature: str, package: str, extra: str) -> None:
    """Raises ValueError that names the extra unless `package` is installed. Does not import it."""
    if importlib.util.find_spec(package) is None:
        raise ValueError(missing_extra(feature, package, extra))


def missing_extra(feature: str, package: str, extra: str) -> str:
    """Message for a missing package of an optional extra, with the command that installs it here."""
    checkout = (Path(__file__).parents[1] / "pyproject.toml").is_file()
    command = f'pip install -e ".[{extra}]"' if checkout else f'pip install "mjx-dher[{extra}]"'
    return f'{feature} needs {package}, which the extra "{extra}" installs: {command}'


def hint(value: str, allowed: Iterable[str], cutoff: float = 0.5) -> str:
    """Text that suggests the nearest allowed names, "" if none is near."""
    nearest = difflib.get_close_matches(value, allowed, n=2, cutoff=cutoff)
    return f" (did you mean {' or '.join(map(repr, nearest))}?)" if nearest else ""
