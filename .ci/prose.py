"""Report how hard prose is to read: `python .ci/prose.py [--list] [PATH ...]`, of pages (.md) and docstrings (.py).

It counts habits of wording and sentences of more than 30 words, without code, tables and addresses. A heading, a list item, an
argument of a docstring and a paragraph each end a sentence.
"""

import argparse
import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

HABITS = re.compile(
    r"\b(?:of|with|in|by|from|to|for|on|and|says?|than|as|is|are|has|have|gives?|returns?|takes?|sees?)\s+what\b"  # no noun
    r"|(?:^|[.;:] )what\b(?![^.?!]*\?)|\breturns? (?:whether|how|by what|which)\b|\bwhat(?:so)?ever\b"
    r"|[;,] (?:None|nothing|all|none|0|1) where\b|\bwhere (?:there (?:is|are)|it (?:is|has|was|does)|one (?:is|has)|none|no )\b"
    r"|\b(?:of|with) (?:one's|your|its|their|his|a user's|our) own\b|\bone's own\b"
    r"|\b(?:that|those) of\b|\bof which\b|\bof (?:it|them|these|those)\b[,.;]"
    r"|\b(?:anew|likewise|hence|so many|as such|but for|save for|all but|by name|besides?|lest|whence|told|mend(?:s|ed)?)\b"
    r"|\brefuse[sd]?\b|\b(?:go(?:es)?|went) on\b",
    re.IGNORECASE,
)
STARTS = re.compile(r"\s*(?:[-*+] |\d+\. |#+ |\*{0,2}\w+(?: \([^)]*\))?: )")  # of an item, a heading, an argument


class Count(NamedTuple):
    """The prose of some files."""

    words: int
    sentences: int
    long: list[str]
    habits: list[str]

    def __str__(self) -> str:
        rate, share = 1000 * len(self.habits) / max(1, self.words), 100 * len(self.long) / max(1, self.sentences)
        return f"{self.words} words, {rate:.2f} habits per 1,000, {share:.0f} % of the sentences are long"


def pieces(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each paragraph, item and heading of a page, or of a module's docstrings."""
    text = path.read_text(encoding="utf-8")
    wholes = [(1, re.sub(r"```.*?```|<!--.*?-->", lambda code: re.sub(r"[^\n]", "", code[0]), text, flags=re.DOTALL))]
    if path.suffix == ".py":
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, kinds) and ast.get_docstring(node)]
        wholes = [(node.body[0].lineno, ast.get_docstring(node) or "") for node in nodes]
    for first, whole in wholes:
        piece, start = "", first
        for number, line in enumerate([*whole.splitlines(), ""], first):
            ends = not line.strip() or line.lstrip().startswith(("|", "!["))
            if piece and (ends or STARTS.match(line) or piece.startswith("#")):
                yield start, piece
                piece = ""
            if not ends:
                piece, start = (f"{piece} {line.strip()}", start) if piece else (line.strip(), number)


def count(paths: Iterable[Path], words: int = 0, sentences: int = 0) -> Count:
    long, habits = [], []
    for name, line, piece in ((path, *piece) for path in paths for piece in pieces(path)):
        plain = re.sub(r"`[^`]*`", "Code", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", piece))
        words += len(re.findall(r"[A-Za-z][A-Za-z'-]*", plain))
        habits += [f"{name}:{line}: {match[0].strip()!r} is hard to read" for match in HABITS.finditer(plain)]
        found = re.split(r"(?<=[.!?])\s+(?=[A-Z`*\[\"(])", plain)
        sentences += len(found)
        long += [f"{name}:{line}: {sentence}" for sentence in found if len(re.findall(r"\w\S*", sentence)) > 30]
    return Count(words, sentences, long, habits)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path, default=[Path("README.md"), Path("docs"), Path("mjx_dher")])
    parser.add_argument("--list", action="store_true", help="print each habit and each long sentence")
    arguments = parser.parse_args()
    if missing := [str(path) for path in arguments.paths if not path.exists()]:
        parser.error(f"no such file or folder: {', '.join(missing)}")
    files = [path for given in arguments.paths for path in ([given] if given.is_file() else sorted(given.rglob("*")))]
    for path, found in ((path, count([path])) for path in files if path.suffix in (".md", ".py")):
        print(f"{path}: {found}", *(found.habits + found.long if arguments.list else []), sep="\n  ")
