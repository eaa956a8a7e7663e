"""Parts of a self-contained HTML page, without external files, scripts, fonts or addresses."""

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from mjx_dher import lookup

VIDEOS = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}
LARGEST = 50_000_000  # bytes of an embedded video

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff }
body { max-width: 1100px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.5em } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #ddd }
.wide { overflow-x: auto } svg { max-width: 100%; height: auto }
table { border-collapse: collapse; font-size: 13px } th, td { text-align: left; padding: 2px 12px 2px 0; vertical-align: top }
tr { border-bottom: 1px solid #eee } td { font-variant-numeric: tabular-nums } summary { cursor: pointer; margin: 1em 0 }
.facts { display: flex; flex-wrap: wrap; gap: 2em } .facts b { display: block; font-size: 1.5em }
.failed { color: #a00 } figure { margin: 1em 0 } figcaption { color: #555; font-size: 13px } video, img { max-width: 100% }
code { background: #f4f4f4; padding: 0 3px }
"""


def page(title: str, body: Iterable[str]) -> str:
    """A whole page with a heading."""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{text(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{text(title)}</h1>\n" + "\n".join(body) + "\n</body>\n</html>\n"
    )


def text(value: object) -> str:
    """Escaped text of a value, also bytes of file names that are not valid UTF-8."""
    return html.escape(lookup.escaped(str(value)))


def element(name: str, words: object, kind: str = "") -> str:
    """An element such as h2, p or code with a text and, if given, a class."""
    return f"<{name}{f' class={kind}' if kind else ''}>{text(words)}</{name}>"


def facts(values: Iterable[tuple[str, str]]) -> str:
    """Named numbers in a row."""
    return '<div class="facts">' + "".join(f"<div>{element('b', v)}{text(name)}</div>" for name, v in values) + "</div>"


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table."""
    lines = ["".join(element("th", name) for name in head), *("".join(element("td", cell) for cell in row) for row in rows)]
    return '<div class="wide"><table>\n' + "\n".join(f"<tr>{line}</tr>" for line in lines) + "\n</table></div>"


def details(summary: str, inside: str) -> str:
    """Content that a click opens."""
    return f"<details>{element('summary', summary)}\n{inside}\n</details>"


def figure(content: str, caption: str = "") -> str:
    """A picture in HTML, with a caption."""
    return f"<figure>{content}" + (element("figcaption", caption) if caption else "") + "</figure>"


def video(path: Path) -> str:
    """An embedded video with a suffix in VIDEOS."""
    kind = VIDEOS[path.suffix.lower()]
    source = f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
    if kind.startswith("image"):
        return figure(f'<img src="{source}" alt="{text(path.name)}">', path.name)
    return figure(f'<video controls loop muted autoplay playsinline src="{source}"></video>', path.name)
