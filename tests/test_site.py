"""The site's own files: tags, sitemap, versions, and the check of its links. `.ci/run --docs` builds it and runs the check."""

import json
import re
import sys
from types import SimpleNamespace

import pytest
import yaml
from conftest import ROOT

sys.path.insert(0, str(ROOT / "docs" / "site"))
import check
import citations
import hosting
import versions


def node(text, parent, tagname="paragraph"):
    return SimpleNamespace(tagname=tagname, parent=SimpleNamespace(tagname=parent), astext=lambda: text)


def test_a_description_is_the_first_paragraph_of_the_text():
    nodes = [
        node("Title", "section", "title"),
        node("cell", "entry"),
        node("Trains\nrobots.", "section"),
        node("More.", "section"),
    ]
    page = SimpleNamespace(findall=lambda wanted: filter(wanted, nodes))
    assert hosting.description(page) == "Trains robots."
    nodes[2] = node("word " * 100, "section")
    assert len(hosting.description(page)) <= hosting.LONGEST
    assert hosting.description(page).endswith("word ...")
    assert hosting.description(SimpleNamespace(findall=lambda wanted: [])) == ""


def test_tags_have_addresses_only_if_the_site_has_one():
    assert "http" not in hosting.tags("Tips", "Text", "", "docs/tips.html")
    tags = hosting.tags('"<Tips>"', "Text", "https://example.org/0.2.0/", "docs/tips.html")
    assert '<meta property="og:title" content="&quot;&lt;Tips&gt;&quot;">' in tags
    assert '<meta property="og:url" content="https://example.org/0.2.0/docs/tips.html">' in tags
    image = '<meta property="og:image" content="https://example.org/0.2.0/_static/'
    assert (ROOT / "docs" / "site" / "static" / tags.partition(image)[2].partition('"')[0]).is_file()


def built(app_folder, base):
    """The folder of a site with two pages after Sphinx's last step."""
    builder = SimpleNamespace(format="html", get_target_uri=lambda page: f"{page}.html")
    env, config = SimpleNamespace(found_docs={"a", "b/c&d"}), SimpleNamespace(html_baseurl=base)
    hosting.write_files(SimpleNamespace(builder=builder, outdir=app_folder, env=env, config=config), None)
    return {path.name: path.read_text() for path in app_folder.iterdir()}


def test_a_site_with_an_address_has_a_sitemap(tmp_path):
    files = built(tmp_path, "https://example.org/")
    assert "<loc>https://example.org/a.html</loc>" in files["sitemap.xml"]
    assert "<loc>https://example.org/b/c&amp;d.html</loc>" in files["sitemap.xml"]
    assert "Sitemap: https://example.org/sitemap.xml\n" in files["robots.txt"]
    assert 'href="https://example.org/search.html"' in files["404.html"]


def test_a_site_without_an_address_has_none(tmp_path):
    files = built(tmp_path, "")
    assert set(files) == {"404.html", "robots.txt"}
    assert 'href="/search.html"' in files["404.html"]


def test_versions_are_ordered_as_numbers(tmp_path):
    for name in ("0.2.0", "0.10.0", "main", "junk", "1.0"):
        (tmp_path / name).mkdir()
        for file in ("404.html", "robots.txt", "objects.inv"):
            (tmp_path / name / file).write_text(name)
        (tmp_path / name / "index.html").write_text((ROOT / "docs" / "site" / "index.html").read_text())
    (tmp_path / "1.0" / "objects.inv").unlink()  # no site
    versions.main([str(tmp_path)])
    assert json.loads((tmp_path / "versions.json").read_text()) == ["0.10.0", "0.2.0", "main"]
    assert (tmp_path / "404.html").read_text() == "0.10.0"
    assert 'href="0.10.0/docs/index.html"' in (tmp_path / "index.html").read_text()
    with pytest.raises(SystemExit, match="no folder"):
        versions.main([str(tmp_path / "junk")])


def test_links_that_lead_nowhere_are_listed(tmp_path):
    (tmp_path / "a.html").write_text(
        '<h1 id="top">A</h1><a href="b.html#x%20y">1</a><a href="#top">2</a><a href="https://example.org/none">3</a>'
        '<a href="none.html">4</a><a href="b.html#none">5</a><img src="none.png"><a href="#none">6</a><a href="http://[">7</a>'
    )
    (tmp_path / "b.html").write_text('<p id="x y"><a href="a.html">A</a></p>')
    found = sorted(line.removeprefix("a.html links to ") for line in check.broken_links(tmp_path))
    assert found == ["#none", "b.html#none", "http://[", "none.html", "none.png"]


def test_the_paper_has_the_journals_form():
    text, bib = (ROOT / f"{citations.PAPER}{suffix}" for suffix in (".md", ".bib"))
    _, front, body = text.read_text().split("---\n", 2)
    head = yaml.safe_load(front)
    assert {"title", "tags", "authors", "affiliations", "date", "bibliography"} <= set(head)
    assert (text.parent / head["bibliography"]) == bib
    titles = re.findall(r"^# (.*)$", body, re.M)
    assert titles == ["Summary", "Statement of need", "State of the field", "Software design", "References"]
    assert len(body.split()) <= 700
    cited = set(re.findall(r"@(\w+)", "".join(citations.CITATION.findall(body))))
    assert cited == set(citations.entries(bib.read_text()))
    pages = "".join((ROOT / name).read_text() for name in ("README.md", "docs/results.md", "docs/field.md"))
    figures = re.findall(r"\d[\d,]*\.\d+|\d+(?:,\d{3})+", body)
    assert len(figures) > 4
    assert [figure for figure in figures if figure not in pages] == []
    shown = citations.page(text.read_text(), bib.read_text())
    assert shown.startswith(f"# {head['title']}\n")
    assert "(Andrychowicz et al. 2017)" in shown
    assert "@" not in shown
    with pytest.raises(ValueError, match="nobody"):
        citations.page(text.read_text().replace("[@her]", "[@nobody]"), bib.read_text())
