"""Writes docs/api.md: every public module, class and function, with signature and docstring, as the source has them.

    python docs/make_api.py

The source is read and not imported, so the page depends neither on the version of Python nor on what is installed.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "api.md"
MODULES = {
    "Environments": ("envs", "envs.base", "types", "testing"),
    "Parts of the algorithm": (
        "replay",
        "samplers",
        "relabel",
        "normalizer",
        "networks",
        "ddpg",
        "fused",
        "rollout",
        "evaluate",
    ),
    "Runs": ("config", "trainer", "checkpoint", "policy", "sweep", "comparison", "stats"),
}
HEAD = """# API

Made from the source by `python docs/make_api.py`; not to be edited. Shapes are in brackets, and [types](#types) says what
their letters mean.
"""


def page() -> str:
    """All of docs/api.md.

    Raises:
      ValueError: a public name has no docstring.
    """
    links = []
    for title, names in MODULES.items():
        links.append(f"- {title}: " + ",\n  ".join(f"[{name}](#{name.replace('.', '')})" for name in names))
    sections = [part for names in MODULES.values() for name in names for part in _module(name)]
    return "\n\n".join([HEAD.rstrip(), "\n".join(links), *sections]) + "\n"


def _module(name: str) -> Iterator[str]:
    path = (ROOT if name.startswith("envs") else ROOT / "mjx_dher") / name.replace(".", "/")
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    lines, body = path.read_text().splitlines(), ast.parse(path.read_text())
    yield f"## {name}"
    yield f"`mjx_dher.{name}`: {_markdown(name, body)}"
    constants = [node for node in body.body if isinstance(node, (ast.Assign, ast.AnnAssign)) and _is_public(_target(node))]
    if constants:
        yield _fenced([line for node in constants for line in _with_comment(lines, node)])
    for node in body.body:
        if isinstance(node, ast.FunctionDef) and _is_public(node.name):
            yield from _function(f"{name}.{node.name}", node, lines, "###")
        elif isinstance(node, ast.ClassDef) and _is_public(node.name):
            yield from _class(f"{name}.{node.name}", node, lines)


def _is_public(name: str) -> bool:
    return not name.startswith("_")


def _target(node: ast.Assign | ast.AnnAssign) -> str:
    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
    return target.id if isinstance(target, ast.Name) else "_"


def _with_comment(lines: list[str], node: ast.stmt) -> list[str]:
    """The statement, and the comment above it."""
    first = node.lineno - 1
    while lines[first - 1].startswith("#"):
        first -= 1
    return lines[first : node.end_lineno]


def _class(name: str, node: ast.ClassDef, lines: list[str]) -> Iterator[str]:
    """Its fields, what makes one, and methods that only have a signature; then its docstring, and other methods."""
    fields = [i for i, statement in enumerate(node.body) if isinstance(statement, ast.AnnAssign)]
    inside = []
    if fields:  # with what is said beside each, and below the last
        end = node.body[fields[-1] + 1 : fields[-1] + 2]
        last = end[0] if end and isinstance(end[0], ast.Expr) else node.body[fields[-1]]
        inside = lines[node.body[fields[0]].lineno - 1 : last.end_lineno]
    methods = [statement for statement in node.body if isinstance(statement, ast.FunctionDef)]
    methods = [method for method in methods if _is_public(method.name) or method.name in ("__init__", "__call__")]
    told = [method for method in methods if ast.get_docstring(method)]
    bare = [line for method in methods if method not in told for line in _signature(method, lines)]
    yield f"### `{name}`"
    yield _fenced([*_signature(node, lines), *inside, *bare])
    yield _markdown(name, node)
    for method in told:
        yield from _function(f"{name}.{method.name}", method, lines, "####")


def _function(name: str, node: ast.FunctionDef, lines: list[str], heading: str) -> Iterator[str]:
    yield f"{heading} `{name}`"
    yield _fenced(inspect.cleandoc("\n".join(_signature(node, lines))).splitlines())
    yield _markdown(name, node)


def _signature(node: ast.FunctionDef | ast.ClassDef, lines: list[str]) -> list[str]:
    """From its decorators to the colon."""
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
    return lines[first - 1 : max(node.lineno, node.body[0].lineno - 1)]


def _fenced(lines: list[str]) -> str:
    code = "\n".join(re.sub(r"  # (noqa|type: ignore)\b.*", "", line) for line in lines)
    return f"```python\n{code}\n```"


def _markdown(name: str, node: ast.Module | ast.ClassDef | ast.FunctionDef) -> str:
    """The docstring, with what is listed in its sections as lists."""
    docstring = ast.get_docstring(node)
    if docstring is None:
        raise ValueError(f"{name} has no docstring")
    section, text = "", []
    for line in docstring.splitlines():
        if line in ("Args:", "Returns:", "Raises:"):
            section = line
            text += [f"**{line[:-1]}**", ""]
        elif line and not line.startswith(" "):
            section = ""
            text.append(line)
        else:
            text.append(_listed(line[2:]) if section in ("Args:", "Raises:") else line[2:] if section else line)
    return "\n".join(text)


def _listed(line: str) -> str:
    """`name: what it is` as an entry; the lines after it stay indented."""
    return re.sub(r"^(\S[^:]*): ", r"- `\1`: ", line)


if __name__ == "__main__":
    PAGE.write_text(page())
