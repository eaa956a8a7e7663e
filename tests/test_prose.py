"""How the pages read, by the rules of .ci/prose.py."""

import importlib.util

import pytest
from conftest import ROOT

_spec = importlib.util.spec_from_file_location("prose", ROOT / ".ci" / "prose.py")
prose = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(prose)

START = [ROOT / name for name in ("README.md", "docs/index.md", "docs/start.md")]
PAGES = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "bench").glob("*.md")]


def test_the_first_pages_are_easy_to_read():
    for page in START:
        found = prose.count([page])
        assert found.habits == []
        assert len(found.long) <= 0.1 * found.sentences
    assert prose.count(START[:1]).words <= 700


def test_all_pages_are_readable_and_short():
    found = prose.count(PAGES)
    assert len(found.habits) <= 1.5 * found.words / 1000, found.habits
    assert len(found.long) <= 0.1 * found.sentences, found.long
    lengths = {page.name: len(page.read_text().splitlines()) for page in PAGES if page.name != "names.md"}  # it is generated
    assert {name: length for name, length in lengths.items() if length > 250} == {}


LONG = " ".join(["word"] * 31)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# A head\n\nOne. Two `what is`.\nThree [what](what.md).\n", (7, 4, 0, 0)),
        (f"{LONG[:-5]}.\n\n{LONG}.\n", (61, 2, 1, 0)),
        (f"* {LONG[:149]}\n* {LONG[:149]}\n", (60, 2, 0, 0)),
        ("```\nof what\n```\n| of what |\n<!-- of what -->\nIt is told of what it is.\n", (7, 1, 0, 2)),
        ("What is it? It has no food but for us.\n", (10, 2, 0, 1)),
    ],
)
def test_counts_by_hand(tmp_path, text, expected):
    for name, content in (("page.md", text), ("module.py", f'"""{text}"""\n')):
        (tmp_path / name).write_text(content)
        if name == "page.md" or "```" not in text:
            found = prose.count([tmp_path / name])
            assert (found.words, found.sentences, len(found.long), len(found.habits)) == expected
