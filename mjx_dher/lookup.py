"""Checks of names that users give, with suggestions, import paths `module:attribute`, and packages of optional extras.

Loads neither JAX nor MuJoCo.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
import os
import pkgutil
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any


def check_name(field: str, value: str, allowed: Iterable[str], own: bool = False) -> None:
    """Raises unless `value` is one of `allowed`.

    With `own`, an import path "module:attribute" is allowed, too, if such a module exists. The module is not imported.

    Raises:
      ValueError: the message lists the allowed names and suggests the nearest.
    """
    allowed = tuple(allowed)
    if value in allowed:
        return
    if own and is_import_path(value):
        _check_own(field, value)
        return
    rest = ", or module:attribute" if own else ""
    raise ValueError(f"{field} must be one of {', '.join(allowed)}{rest}; got {value!r}{_hint(str(value), allowed)}")


def command_name() -> str:
    """Name of the command that the user started: mjx-dher if it is installed, else train.py."""
    return "mjx-dher" if Path(sys.argv[0]).stem == "mjx-dher" else "train.py"


def is_import_path(name: str) -> bool:
    """Returns whether a name is an import path "module:attribute", not a name that this library registers."""
    return ":" in str(name)


def load_import_path(field: str, value: str) -> Any:
    """Imports the module of "module:attribute" and returns the attribute.

    Raises:
      ValueError: the module or the attribute does not exist (the message suggests the nearest), or the module raises an error
        when it is imported, which is the cause.
    """
    _check_own(field, value)
    name, attribute = value.split(":")
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{name}.".startswith(f"{error.name}."):
            raise _no_module(field, value, error.name) from None
        raise _failed_import(field, value, error) from error  # the module exists, but imports one that does not
    except Exception as error:
        raise _failed_import(field, value, error) from error
    if not hasattr(module, attribute):
        hint = _hint(attribute, [name for name in dir(module) if not name.startswith("_")])
        raise ValueError(f"{field} {value!r}: module {name} has no {attribute!r}{hint}")
    return getattr(module, attribute)


def module_file(value: str) -> Path | None:
    """Returns the file of the module that "module:attribute" names, without importing it; None where it has none."""
    try:
        spec = importlib.util.find_spec(value.partition(":")[0])
    except Exception:  # a package above it cannot be imported, as whoever imports the module will be told
        return None
    return Path(spec.origin) if spec is not None and spec.origin and Path(spec.origin).is_file() else None


def check_function(field: str, function: Any, parameters: Sequence[str]) -> Callable[..., Any]:
    """Returns `function`, refusing what cannot be called with as many arguments as `parameters` names.

    Raises:
      ValueError: names the field, the parameters and what it is.
    """
    try:
        inspect.signature(function).bind(*parameters)
    except TypeError:
        raise ValueError(f"{field} must be a function ({', '.join(parameters)}); it is {function!r}") from None
    return function


def require_extra(feature: str, package: str, extra: str) -> None:
    """Raises unless the package of an optional extra is installed. The package is not imported.

    Raises:
      ValueError: names the feature, the package and the extra to install.
    """
    if importlib.util.find_spec(package) is None:
        raise ValueError(missing_extra(feature, package, extra))


def missing_extra(feature: str, package: str, extra: str) -> str:
    """Returns the message for a package of an optional extra that is not installed."""
    return f'{feature} needs {package}, which the extra "{extra}" installs: pip install -e ".[{extra}]"'


def _check_own(field: str, value: str) -> None:
    name, _, attribute = value.partition(":")
    if not all(part.isidentifier() for part in (*name.split("."), attribute)):
        raise ValueError(f"{field} must be module:attribute, the module's name as `import` takes it; got {value!r}")
    top = name.partition(".")[0]
    if top not in sys.modules and importlib.util.find_spec(top) is None:
        raise _no_module(field, value, top)


def _failed_import(field: str, value: str, error: Exception) -> ValueError:
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return ValueError(f"{field} {value!r}: importing it failed: {type(error).__name__}: {error}{where}")


def _no_module(field: str, value: str, missing: str) -> ValueError:
    """Returns the error for `missing`, the shortest prefix of a module's name that does not exist."""
    parent = missing.rpartition(".")[0]
    if not parent:
        modules = [module.name for module in pkgutil.iter_modules([path or os.getcwd() for path in sys.path])]
    elif hasattr(sys.modules[parent], "__path__"):
        modules = [f"{parent}.{module.name}" for module in pkgutil.iter_modules(sys.modules[parent].__path__)]
    else:
        modules = [parent]
    place = f"in {parent}" if parent else "in the current folder or on Python's path"
    return ValueError(f"{field} {value!r}: there is no module {missing!r} {place}{_hint(missing, modules, cutoff=0.75)}")


def _hint(value: str, allowed: Iterable[str], cutoff: float = 0.5) -> str:
    nearest = difflib.get_close_matches(value, allowed, n=2, cutoff=cutoff)
    return f" (did you mean {' or '.join(map(repr, nearest))}?)" if nearest else ""
