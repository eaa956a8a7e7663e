"""Names of parts: what is allowed, what is nearest, and `module:attribute`. Loads neither JAX nor MuJoCo."""

from __future__ import annotations

import difflib
import importlib.util
import pkgutil
import sys
from collections.abc import Iterable
from typing import Any


def check_name(field: str, value: str, allowed: Iterable[str], own: bool = False) -> None:
    """Refuses what is not one of `allowed`.

    With `own`, "module:attribute" is allowed, too, where a module of that name can be found. It is not imported.

    Raises:
      ValueError: says what is allowed, and names the nearest.
    """
    allowed = tuple(allowed)
    if value in allowed:
        return
    if own and is_own(value):
        _check_own(field, value)
        return
    rest = ", or module:attribute" if own else ""
    raise ValueError(f"{field} must be one of {', '.join(allowed)}{rest}; got {value!r}{_hint(str(value), allowed)}")


def is_own(name: str) -> bool:
    """Whether a name is "module:attribute", and not one that this library knows."""
    return ":" in str(name)


def load_own(field: str, value: str) -> Any:
    """What "module:attribute" names. What the module itself raises when it is imported is raised as it is.

    Raises:
      ValueError: there is no such module, or no such attribute in it; the message names the nearest.
    """
    _check_own(field, value)
    name, attribute = value.split(":")
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise  # the module is there, and lacks another
        raise _no_module(field, value, error.name) from None
    if not hasattr(module, attribute):
        hint = _hint(attribute, [name for name in dir(module) if not name.startswith("_")])
        raise ValueError(f"{field} {value!r}: module {name} has no {attribute!r}{hint}")
    return getattr(module, attribute)


def _check_own(field: str, value: str) -> None:
    name, _, attribute = value.partition(":")
    if not all(part.isidentifier() for part in (*name.split("."), attribute)):
        raise ValueError(f"{field} must be module:attribute, the module's name as `import` takes it; got {value!r}")
    top = name.partition(".")[0]
    if top not in sys.modules and importlib.util.find_spec(top) is None:
        raise _no_module(field, value, top)


def _no_module(field: str, value: str, missing: str) -> ValueError:
    """`missing` is the first part of the module's name that cannot be found; what it would be in has been imported."""
    parent = missing.rpartition(".")[0]
    if not parent:
        there = [module.name for module in pkgutil.iter_modules()]
    elif hasattr(sys.modules[parent], "__path__"):
        there = [f"{parent}.{module.name}" for module in pkgutil.iter_modules(sys.modules[parent].__path__)]
    else:
        there = [parent]
    where = f"in {parent}" if parent else "in the current folder or on Python's path"
    return ValueError(f"{field} {value!r}: there is no module {missing!r} {where}{_hint(missing, there, cutoff=0.75)}")


def _hint(value: str, there: Iterable[str], cutoff: float = 0.5) -> str:
    nearest = difflib.get_close_matches(value, there, n=2, cutoff=cutoff)
    return f" (did you mean {' or '.join(map(repr, nearest))}?)" if nearest else ""
