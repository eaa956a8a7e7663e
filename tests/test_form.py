"""The form of the code: sizes of functions and files, first words of docstrings, names that say nothing."""

import ast

import numpy as np
import pytest
from conftest import ROOT
from test_packaging import MODULES

TREES = {name: ast.parse(path.read_text()) for name, path in MODULES.items()}
FUNCTIONS = {
    f"{name}.{node.name}": node
    for name, tree in TREES.items()
    for node in ast.walk(tree)
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
}
REFUSED = {"what", "whether", "how", "where", "of", "for", "a", "an", "the", "all", "as", "to", "in", "no", "if", "when", "any"}
EMPTY_NAMES = {"found", "said", "there", "thing", "stuff", "tmp"}


def lines_of(node):
    return node.end_lineno - node.lineno + 1


def test_functions_and_files_stay_small(capsys):
    lengths = sorted(map(lines_of, FUNCTIONS.values()))
    longest = max(FUNCTIONS, key=lambda name: lines_of(FUNCTIONS[name]))
    files = {
        str(path.relative_to(ROOT)): len(path.read_text().splitlines())
        for root in ("mjx_dher", "envs", "tests", "bench", "docs")
        for path in (ROOT / root).rglob("*.py")
    }
    largest = max(files, key=files.get)
    p95 = float(np.percentile(lengths, 95))
    with capsys.disabled():
        print(
            f"\n{len(lengths)} functions: median {np.median(lengths):.0f} lines, p95 {p95:.0f},"
            f" longest {longest} {lengths[-1]}; {len(files)} files, largest {largest} {files[largest]}"
        )
    assert p95 <= 30
    assert lengths[-1] <= 60, longest
    assert files[largest] <= 350, largest


def docstrings():
    for name, node in FUNCTIONS.items():
        if text := ast.get_docstring(node):
            yield pytest.param(node, text, id=name)


def is_property(node):
    return any("property" in ast.unparse(decorator) for decorator in node.decorator_list)


@pytest.mark.parametrize(("node", "text"), list(docstrings()))
def test_a_function_s_docstring_begins_with_a_verb(node, text):
    """In the third person, such as Returns, Draws, Raises; a property's begins with a noun, as a field's does."""
    first = text.split()[0].strip(".,:;`").lower()
    assert first not in REFUSED
    if not is_property(node):
        assert first.endswith("s"), first


def local_names(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.arg):
            yield node.arg


@pytest.mark.parametrize("name", sorted(TREES))
def test_no_name_says_nothing(name):
    assert not EMPTY_NAMES & set(local_names(TREES[name]))
