"""Checks a built site: `python docs/site/check.py SITE`. It prints every problem, and ends with status 1 if there is one.

Each link, picture and anchor within the site must lead somewhere. In Chromium, if selenium and a driver are there, no page may
scroll sideways at the width of a phone, and the search must find pages without a server.
"""

import shutil
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

WIDTH = 390  # pixels of a phone
TERMS = {
    "weighted": "samplers",
    "make_train": "algorithm",
    "shadow hand": "environments",
    "onnx": "policies",
    "resume": "commands",
}
WIDE = """
const scrolls = (e) => e.tagName !== "ARTICLE" && (getComputedStyle(e).overflowX !== "visible" || scrolls(e.parentElement));
return [...document.querySelectorAll("article *")]
  .find((e) => e.getBoundingClientRect().right > innerWidth + 1 && !scrolls(e.parentElement))?.outerHTML.slice(0, 80);
"""


class Page(HTMLParser):
    """Addresses that a page leads to, and the names within it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.names: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name in ("href", "src") and value:
                self.links.append(value)
            elif name == "id" and value:
                self.names.add(value)


def leads(path: Path, link: str, pages: dict[Path, Page]) -> bool:
    """Whether a link of the page `path` leads to a file, and to a name in it. True for other sites' addresses."""
    try:
        target = urlsplit(link)
        if target.scheme or target.netloc or link.startswith("/"):
            return True
        end = (path.parent / unquote(target.path)).resolve() if target.path else path
        return end.is_file() and (not target.fragment or unquote(target.fragment) in getattr(pages.get(end), "names", ()))
    except ValueError:  # no address at all
        return False


def broken_links(site: Path) -> Iterator[str]:
    """Links of all pages that lead nowhere."""
    site = site.resolve()
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html") if path.parent.name != "demo"}
    for path, page in pages.items():
        yield from (f"{path.relative_to(site)} links to {link}" for link in page.links if not leads(path, link, pages))


def wide_pages(site: Path, driver: Any) -> Iterator[str]:
    """The first element of each page that is wider than a phone and does not scroll by itself."""
    size = {"width": WIDTH, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    for path in sorted(site.rglob("*.html")):
        if not {"_modules", "_static", "demo"} & set(path.relative_to(site).parts):
            driver.get(path.resolve().as_uri())
            if element := driver.execute_script(WIDE):
                yield f"{path.relative_to(site)} is too wide: {element}"


def lost_terms(site: Path, driver: Any) -> Iterator[str]:
    """Terms for which the search does not find the page about them."""
    from selenium.webdriver.support.wait import WebDriverWait

    for term, page in TERMS.items():
        driver.get(f"{(site / 'search.html').resolve().as_uri()}?q={term.replace(' ', '+')}")
        WebDriverWait(driver, 60).until(lambda there: there.execute_script("return Search.status?.innerText.includes('found')"))
        links = driver.execute_script("return [...document.querySelectorAll('#search-results li a')].map((a) => a.href)")
        if not any(f"/{page}.html" in link for link in links):
            yield f"the search for {term!r} does not find {page}.html among {len(links)} pages"


def in_browser(site: Path) -> Iterator[str]:
    """The problems that Chromium shows."""
    chromium, service = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    try:
        from selenium import webdriver
    except ImportError:
        service = None
    if not (chromium and service):
        print("not checked in a browser: that needs selenium, chromium and chromedriver")
        return
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in ("--headless", "--no-sandbox", "--disable-gpu"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(service))
    try:
        yield from wide_pages(site, driver)
        yield from lost_terms(site, driver)
    finally:
        driver.quit()


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1], "searchindex.js").is_file():
        raise SystemExit(__doc__)
    problems = [*broken_links(Path(sys.argv[1])), *in_browser(Path(sys.argv[1]))]
    print("\n".join([*problems, f"{len(problems)} problems"]))
    raise SystemExit(bool(problems))
