#!/usr/bin/env python3
"""Check the form of code and prose. Prints every violation as `file:line: text` and exits with status 1 if there is one.

ruff checks style, mypy types, and lint-imports the layers. This script checks the rest:

- that each module has a layer
- lengths of files and functions
- names that say nothing
- public functions and constants of the algorithm that only their own module uses, and the index of public names
- prose that is hard to read, by prose.py (lower the limits as the tree improves)
"""

import argparse
import ast
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import prose

ROOT = Path(__file__).resolve().parents[1]
FILE_LINES = 350
FUNCTION_LINES, FUNCTION_LINES_P95 = 60, 30
EMPTY_NAMES = {"found", "said", "there", "thing", "stuff", "tmp"}
NAMES_PAGE = ROOT / "docs" / "api" / "names.md"
NAMES_HEAD = """# API: index of names

Every public name of the algorithm's modules. The module's link leads to its docstrings, with shapes and errors. The package
itself has the names in `mjx_dher.__all__`, such as `Config`, `HParams`, `RunSpec`, `preset`, `train_runs`, `make_train` and
`load_policy`. [Environments](environments.md) lists `mjx_dher.envs`. `python .ci/lint.py --write-names` writes it.

| name | module | description |
|---|---|---|
"""
MAX_VALUE = 60  # characters of a constant's value in the table
HABITS_PER_1000_WORDS = {"pages": 2.5, "docstrings": 1.5}
LONG_SENTENCES = {"pages": 0.05, "docstrings": 0.05}  # share
CORE = {
    *("types", "config", "validation", "spec", "context", "replay", "samplers", "relabel", "normalizer", "networks"),
    *("contract", "rollout", "evaluate", "trainer", "mirror", "learners", "contrib", "by_distance", "priorities"),
    "demonstrations",
}
Add = Callable[[Path, int, str], None]


def python_files(*folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]  # links are not followed


def pages() -> list[Path]:
    files = [path for pattern in ("*.md", ".github/*.md", "docs/**/*.md", "bench/*.md") for path in sorted(ROOT.glob(pattern))]
    return [path for path in files if path.name not in ("CHANGELOG.md", "history.md")]  # they report what there was


def check_lengths(trees: dict[Path, ast.Module], add: Add) -> str:
    files = {path: len(path.read_text().splitlines()) for path in python_files("mjx_dher", "envs", "tests", "bench", "docs")}
    for path, length in files.items():
        if length > FILE_LINES:
            add(path, FILE_LINES + 1, f"the file has {length} lines; at most {FILE_LINES} are allowed")
    lengths = []
    for path, node in definitions(trees):
        lengths.append((node.end_lineno or node.lineno) - node.lineno + 1)
        if lengths[-1] > FUNCTION_LINES:
            add(path, node.lineno, f"{node.name} has {lengths[-1]} lines; at most {FUNCTION_LINES} are allowed")
    lengths.sort()
    p95 = lengths[math.ceil(0.95 * len(lengths)) - 1]
    if p95 > FUNCTION_LINES_P95:
        add(ROOT / "mjx_dher", 1, f"5 % of the functions have more than {FUNCTION_LINES_P95} lines (p95: {p95})")
    lines = sum(files[path] for path in trees)
    return f"{len(trees)} modules, {lines} lines; {len(lengths)} functions, p95 {p95} lines, longest {lengths[-1]}"


def check_layers(add: Add) -> None:
    layers = (ROOT / "pyproject.toml").read_text()
    for path in sorted((ROOT / "mjx_dher").iterdir()):
        is_module = path.suffix == ".py" or (path / "__init__.py").is_file()
        if is_module and path.stem != "__init__" and not re.search(rf"mjx_dher\.{path.stem}\b", layers):
            add(path, 1, "this module is in no layer of [tool.importlinter] in pyproject.toml")


def definitions(trees: dict[Path, ast.Module]) -> Iterator[tuple[Path, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for path, tree in trees.items():
        yield from ((path, node) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def check_local_names(trees: dict[Path, ast.Module], add: Add) -> None:
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.arg) and node.arg in EMPTY_NAMES:
                add(path, node.lineno, f"the name {node.arg!r} says nothing")
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in EMPTY_NAMES:
                add(path, node.lineno, f"the name {node.id!r} says nothing")


def public_names(trees: dict[Path, ast.Module]) -> Iterator[tuple[Path, ast.stmt, str]]:
    """Functions, classes and constants that the core's modules define at their top level."""
    for path, tree in trees.items():
        if path.relative_to(ROOT).with_suffix("").parts[1] not in CORE or path.parts[-2] == "bundled":
            continue
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names = [node.name]
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = [target.id for target in targets if isinstance(target, ast.Name)]
            else:
                continue
            yield from ((path, node, name) for name in names if not name.startswith("_"))


def check_public_names(trees: dict[Path, ast.Module], add: Add) -> str:
    """A function or constant that only its own module uses is private. All public names are in the table of NAMES_PAGE."""
    files = [*ROOT.glob("**/*.md"), *python_files("mjx_dher", "envs", "tests", "bench", "docs")]
    words = {path: set(re.findall(r"\w+", path.read_text())) for path in files if path != NAMES_PAGE}
    names = list(public_names(trees))
    for path, node, name in names:
        is_type = name != name.upper() and name[0].isupper()  # part of a signature
        if not is_type and not any(name in used for other, used in words.items() if other != path):
            add(path, node.lineno, f"no other file uses the public name {name}: make it private")
    if NAMES_PAGE.read_text() != names_page(names):
        add(NAMES_PAGE, 1, "it differs from the code: run `python .ci/lint.py --write-names`")
    return f"{len(names)} public names in the core"


def names_page(names: list[tuple[Path, ast.stmt, str]]) -> str:
    """The table of public names, with the first sentence of each docstring, or the value of a constant."""
    lines = []
    for path, node, name in sorted(names, key=lambda entry: (entry[2].lower(), entry[0])):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            text = (ast.get_docstring(node) or "").split("\n\n")[0].replace("\n", " ")
            text = re.split(r"(?<=\.)(?<!al\.)\s", text)[0]
        else:
            value = ast.unparse(node).split(" = ", 1)[-1]
            text = f"`{value if len(value) <= MAX_VALUE else value[:MAX_VALUE] + '...'}`"
        link = f"[`{module}`](../../{path.relative_to(ROOT)})"
        lines.append(f"| `{name}` | {link} | {text} |".replace("\\", "\\\\"))
    return NAMES_HEAD + "\n".join(re.sub(r"(?<=\w) *\|(?= *\w)", " or ", line) for line in lines) + "\n"


def check_prose(trees: dict[Path, ast.Module], add: Add, listing: bool) -> Iterator[str]:
    for kind, paths in {"pages": pages(), "docstrings": list(trees)}.items():
        found = prose.count(paths)
        rate, share = 1000 * len(found.habits) / found.words, len(found.long) / found.sentences
        if rate > HABITS_PER_1000_WORDS[kind] or share > LONG_SENTENCES[kind]:
            limits = f"{HABITS_PER_1000_WORDS[kind]} habits and {100 * LONG_SENTENCES[kind]:.0f} % are allowed"
            add(paths[0], 1, f"{kind} are hard to read: {found}; {limits} (--list)")
        yield f"{kind}: {found}"
        if listing:
            yield from found.habits + found.long


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="print each habit and each long sentence")
    parser.add_argument("--write-names", action="store_true", help=f"write {NAMES_PAGE.relative_to(ROOT)}")
    arguments = parser.parse_args()
    violations = []

    def add(path: Path, line: int, text: str) -> None:
        violations.append(path)
        print(f"{path.relative_to(ROOT)}:{line}: {text}")

    trees = {path: ast.parse(path.read_text()) for path in python_files("mjx_dher", "envs")}
    if arguments.write_names:
        NAMES_PAGE.write_text(names_page(list(public_names(trees))))
    check_layers(add)
    check_local_names(trees, add)
    summary = [check_lengths(trees, add), check_public_names(trees, add), *check_prose(trees, add, arguments.list)]
    print("\n".join(summary))
    return bool(violations) and not arguments.list


if __name__ == "__main__":
    raise SystemExit(main())
