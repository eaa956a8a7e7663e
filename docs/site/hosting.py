"""Sphinx extension for web servers and search engines.

Each page gets a description and the tags of a link preview. The site gets a page for wrong addresses, `robots.txt` and, if its
address is known (`html_baseurl`), `sitemap.xml`.
"""

from html import escape
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
LONGEST = 200  # characters of a description
CARD = "_static/card.png"  # by make_card.py


def description(doctree: Any) -> str:
    """A page's first paragraph outside of tables and lists, cut at a word. Empty without one."""
    paragraphs = doctree.findall(lambda node: node.tagname == "paragraph" and node.parent.tagname in ("section", "document"))
    text = " ".join(next((node.astext() for node in paragraphs), "").split())
    return text if len(text) <= LONGEST else text[: LONGEST - 4].rpartition(" ")[0] + " ..."


def tags(title: str, text: str, base: str, path: str) -> str:
    """Tags of a page's head. Addresses need `base`: previews follow no relative ones."""
    values = {"og:type": "website", "og:site_name": "mjx-dher", "og:title": title, "og:description": text}
    if base:
        values |= {"og:url": base + path, "og:image": base + CARD, "twitter:card": "summary_large_image"}
    values["description"] = text
    kinds = {name: "property" if name.startswith("og:") else "name" for name in values}
    return "\n".join(f'<meta {kinds[name]}="{name}" content="{escape(value)}">' for name, value in values.items() if value)


def sitemap(base: str, paths: list[str]) -> str:
    """The addresses of all pages, for search engines."""
    entries = "".join(f"  <url><loc>{escape(base + path)}</loc></url>\n" for path in sorted(paths))
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<urlset xmlns="http://www.sitemaps.org/schemas/sitemap/0.9">\n'
    return f"{head}{entries}</urlset>\n"


def add_tags(app: Any, page: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Adds the tags to a page that is written here. The index and the search have none."""
    del template
    if doctree is not None:
        path = app.builder.get_target_uri(page)
        title = app.env.titles[page].astext()
        context["metatags"] += tags(title, description(doctree), app.config.html_baseurl, path)


def write_files(app: Any, error: Exception | None) -> None:
    """Writes the files that are no pages."""
    if error is not None or app.builder.format != "html":
        return
    base, out = app.config.html_baseurl, Path(app.outdir)
    (out / "404.html").write_text((HERE / "404.html").read_text().replace("{base}", escape(base or "/")))
    robots = "User-agent: *\nAllow: /\n"
    if base:
        pages = [app.builder.get_target_uri(page) for page in app.env.found_docs]
        (out / "sitemap.xml").write_text(sitemap(base, pages))
        robots += f"Sitemap: {base}sitemap.xml\n"
    (out / "robots.txt").write_text(robots)


def setup(app: Any) -> dict[str, bool]:
    """Registers the two steps."""
    app.connect("html-page-context", add_tags)
    app.connect("build-finished", write_files)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
