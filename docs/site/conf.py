"""Settings of Sphinx for the site, which `.ci/run --docs` builds. Its source is the repository, so links work as on GitHub.

Pages are Markdown that is readable without Sphinx. This file builds the table of contents from docs/index.md, inserts
docstrings in place of the API pages' module lines, and converts docstrings from Markdown.
"""

import ast
import functools
import importlib
import inspect
import os
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

from sphinx.pycode import ModuleAnalyzer

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]
import citations  # noqa: E402

import mjx_dher  # noqa: E402

project = "mjx-dher"
release = mjx_dher.__version__
author = "The mjx-dher authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "hosting"]
root_doc = "docs/index"
include_patterns = [
    "*.md",
    "docs/*.md",
    "docs/*.ipynb",
    "docs/api/*.md",
    "docs/experiments/*.md",
    "docs/joss/*.md",
    "bench/*.md",
    "mjx_dher/policy/bundled/*/*.md",
]
html_theme = "furo"
html_title = f"mjx-dher {release}"
html_extra_path = ["index.html"]  # the front page's address: it leads to docs/index.html
html_copy_source = False
html_static_path, html_css_files, html_js_files = ["static"], ["site.css"], ["versions.js"]
html_favicon = "static/icon.svg"
ADDRESSES = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"].get("urls", {})
html_baseurl = os.environ.get("SITE", ADDRESSES.get("Documentation", "")).rstrip("/")
html_baseurl += "/" if html_baseurl else ""
if html_baseurl and not html_baseurl.startswith(("https://", "http://")):
    raise ValueError(f"SITE or Documentation must begin with https:// or http://; got {html_baseurl!r}")
if ADDRESSES.get("Repository"):  # each page gets a link to its source
    html_theme_options = {"source_repository": ADDRESSES["Repository"], "source_branch": "main", "source_directory": ""}
myst_heading_anchors = 4
nb_execution_mode = "off"  # a test runs the notebook
viewcode_follow_imported_members = False  # else the links back from a module's source name another module
default_role = "py:obj"  # for text in backticks in a docstring
autodoc_default_options = {
    "members": True,
    "undoc-members": True,
    "member-order": "bysource",
    "ignore-module-all": True,
    "exclude-members": "replace",
}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
napoleon_google_docstring, napoleon_numpy_docstring = True, False
suppress_warnings = ["ref.python"]  # a name in backticks that several modules have

SECTION = re.compile(r"(Args|Returns|Raises|Yields|Attributes|Note|Example|Examples):$")
MODULE = re.compile(r"^- \[`(mjx_dher[\w.]*)`\]\([^)]*\)(.*)$", re.M)
AUTOMODULE = "## `{0}`\n\n```{{eval-rst}}\n.. automodule:: {0}\n```\n"


def expand(app: Any, docname: str, source: list[str]) -> None:
    """Builds the table of contents from the index's links, and docstrings from the API pages' lists."""
    del app
    if docname == root_doc:
        source[0] += contents(source[0])
    elif docname == citations.PAPER:
        source[0] = citations.page(source[0], (ROOT / citations.PAPER).with_suffix(".bib").read_text(encoding="utf-8"))
    elif docname.startswith("docs/api/"):
        for line in MODULE.finditer(source[0]):
            add_comments(line[1])
        source[0] = MODULE.sub(lambda line: AUTOMODULE.format(line[1]), source[0])


def contents(text: str) -> str:
    """The index's sections as hidden tables of contents, each with the pages that its section links to."""
    parts = []
    for section in text.split("\n## ")[1:]:
        title, _, body = section.partition("\n")
        pages = re.findall(r"\]\(([^)#:]+\.(?:md|ipynb))\)", body)
        entries = "\n".join(dict.fromkeys(path.rpartition(".")[0] for path in pages))
        parts.append(f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n{entries}\n```\n")
    return "".join(parts)


def to_rst(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Rewrites a docstring before napoleon reads it. An indented block after a paragraph becomes a literal block."""
    del app, what, name, obj, options
    if lines and lines[0].startswith("Alias for field number"):  # Python's own text for a field of a NamedTuple
        lines.clear()
    written: list[str] = []
    in_section = in_block = False
    for line in lines:
        if line and not line.startswith(" "):
            in_section, in_block = bool(SECTION.match(line)), False
        if line.startswith("    ") and not in_section and not in_block and written and not written[-1]:
            written += ["::", ""]
            in_block = True
        written.append(line if in_block else escaped(line))
    lines[:] = written


def escaped(line: str) -> str:
    """A line with the special characters of reStructuredText escaped, unless they are Markdown."""
    if re.match(r"\s*\*\*\w+:", line):  # an argument's name
        return line
    parts = line.split("`")
    for i in range(0, len(parts), 2):  # not within backticks
        text = re.sub(r"(?<!\w)\*(?=\w[^*]*\w\*)|(?<=\w)\*(?!\w)", "\0", parts[i])  # emphasis stays
        text = re.sub(r"(?<=\w)_(?!\w)", r"\\_", re.sub(r"([*|])", r"\\\1", text)).replace("\0", "*")
        parts[i] = f"\\ {text}" if i and text[:1].isalnum() else text  # `Array`s
    return "`".join(parts)


def field_text(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Restores a field's text: napoleon takes the part before a colon for its type."""
    del app, obj, options
    owner, _, field = name.rpartition(".")
    if what == "attribute" and (text := texts_of(*owner.rpartition(".")[::2]).get(field)):
        lines[:] = [escaped(line) for line in text.split("\n")]


def add_comments(module: str) -> None:
    """Makes autodoc use the comment next to a field, which has its shape, if the field has no docstring."""
    importlib.import_module(module)
    documented = ModuleAnalyzer.for_module(module).find_attr_docs()
    for owner in classes(module):
        for field, text in texts_of(module, owner).items():
            documented.setdefault((owner, field), [text, ""])


def classes(module: str) -> dict[str, ast.ClassDef]:
    """Classes of an imported module, with their names."""
    origin = getattr(sys.modules.get(module), "__file__", None)
    tree = ast.parse(Path(origin).read_text(encoding="utf-8")) if origin else ast.Module([], [])
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


@functools.cache
def texts_of(module: str, owner: str) -> dict[str, str]:
    """Docstrings of a class's fields, or else the comments next to and above them. Empty if there is no such class."""
    if (node := classes(module).get(owner)) is None:
        return {}
    rows, texts = Path(sys.modules[module].__file__ or "").read_text(encoding="utf-8").splitlines(), {}
    for field, following in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and field.end_lineno:
            text = docstring(following) or comment(rows, field.lineno - 1, field.end_lineno - 1)
            texts.update({field.target.id: text} if text else {})
    return texts


def docstring(node: ast.stmt | None) -> str:
    """Text of a statement that is only a string, as below a field, or else ""."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return inspect.cleandoc(node.value.value)
    return ""


def comment(rows: list[str], first: int, last: int) -> str:
    """The comment above row `first`, and the one at the end of row `last`."""
    above: list[str] = []
    while rows[first - 1].strip().startswith("# "):
        first -= 1
        above.insert(0, rows[first].strip()[2:])
    beside = rows[last].partition("  # ")[2].partition("  # noqa")[0]
    return " ".join([*above, beside]).strip()


def setup(app: Any) -> None:
    """Registers the conversions of pages and docstrings."""
    app.connect("source-read", expand)
    app.connect("autodoc-process-docstring", to_rst, priority=400)  # before napoleon's
    app.connect("autodoc-process-docstring", field_text, priority=600)
