"""Custom components as "module:attribute": finds, checks and imports them. Loads neither JAX nor MuJoCo by itself."""

import functools
import importlib
import importlib.util
import inspect
import pkgutil
import sys
import traceback
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from mjx_dher import lookup, trust
from mjx_dher.lookup import hint

# Modules without components: the standard library, and the libraries that this one uses.
_LIBRARIES = "etils filelock flax jax jaxlib ml_dtypes mujoco numpy optax orbax ray rich scipy setuptools tyro viser warp"
NO_COMPONENTS = {*sys.stdlib_module_names, *_LIBRARIES.split()}


def check(field: str, value: str) -> None:
    """Raises ValueError unless "module:attribute" is a valid name and its top-level module exists. Imports nothing."""
    name, _, attribute = value.partition(":")
    if not all(part.isidentifier() for part in (*name.split("."), attribute)):
        raise ValueError(f"{field} must be module:attribute, with the module's name as in `import`; got {value!r}")
    _check_origin(field, value, name)
    top = name.partition(".")[0]
    if top not in sys.modules and find_module(top) is None:
        raise _no_module(field, value, top)
    if name.endswith(".py") and module_file(value) is None:
        raise ValueError(f"{field} {value!r}: a module's name has no .py (did you mean {name[:-3] + ':' + attribute!r}?)")


def load(field: str, value: str) -> Any:
    """Imports "module:attribute". Raises ValueError if the module or attribute does not exist (the message suggests the
    nearest) or belongs to another library, the name comes from a file that is not trusted, or the import raises an error.
    """
    check(field, value)
    trust.check(field, value, module_file(value))
    name, attribute = value.split(":")
    top = name.partition(".")[0]
    if top not in sys.modules and importlib.util.find_spec(top) is None:  # then it is in the current folder
        sys.path.append("")
    try:
        module = importlib.import_module(name)
    except (Exception, SystemExit) as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and f"{name}.".startswith(f"{missing}."):  # else the module itself imports a missing one
            raise _no_module(field, value, missing) from None
        reason = f"{type(error).__name__}: {error}".removesuffix(": ") + _place(error)
        raise ValueError(f"{field} {value!r}: importing it failed: {reason}") from error
    if not hasattr(module, attribute):
        nearest = hint(attribute, [name for name in dir(module) if not name.startswith("_")])
        raise ValueError(f"{field} {value!r}: module {name} ({module_file(value)}) has no {attribute!r}{nearest}")
    component = getattr(module, attribute)
    made_by = component.func if isinstance(component, functools.partial) else component
    if inspect.isclass(made_by) or inspect.isroutine(made_by):  # and not an instance of a library's class
        _check_origin(field, value, str(inspect.unwrap(made_by).__module__))
    return component


def find_module(top: str) -> ModuleSpec | None:
    """Finds a top-level module on Python's path, or in the current folder, without importing it.

    The current folder joins the path only after the user has used a component from it. Otherwise JAX would import plugins, and
    this library optional packages, from a folder that someone else may have made.
    """
    spec = importlib.util.find_spec(top)
    return PathFinder.find_spec(top, [""]) if spec is None and lookup.current_folder else spec


def module_file(value: str) -> Path | None:
    """File of the module in "module:attribute", or None if it does not exist. Imports neither it nor its packages."""
    top, *rest = value.partition(":")[0].split(".")
    try:
        spec = find_module(top)
        for name in rest:
            spec = PathFinder.find_spec(name, list(spec.submodule_search_locations or ())) if spec else None
    except (ValueError, ImportError):  # __main__ has no spec, for example
        return None
    return Path(spec.origin) if spec is not None and spec.origin and Path(spec.origin).is_file() else None


def _check_origin(field: str, value: str, module: str) -> None:
    if module.partition(".")[0] in NO_COMPONENTS:
        raise ValueError(
            f"{field} must be a component; {value!r} is from {module}, a module of Python or of a library, which has none;"
            " give a file of your own another name"
        )


def _place(error: BaseException) -> str:
    """Place of an error in the user's code. The text of a syntax error has it already, and its last frame is Python's."""
    frames = traceback.extract_tb(error.__traceback__)
    return f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames and not isinstance(error, SyntaxError) else ""


def _no_module(field: str, value: str, missing: str) -> ValueError:
    """Error for `missing`, the shortest prefix of a module's name that does not exist."""
    parent = missing.rpartition(".")[0]
    paths = getattr(sys.modules[parent], "__path__", ()) if parent else [".", *sys.path]
    modules = [parent, *(f"{parent}.{module.name}".lstrip(".") for module in pkgutil.iter_modules(paths))]
    place = f"in {parent}" if parent else "in the current folder or on Python's path"
    return ValueError(f"{field} {value!r}: there is no module {missing!r} {place}{hint(missing, modules, cutoff=0.75)}")
