"""HTML report of a run or a sweep, in one file that opens without a server: curves, tables, settings and videos.

The page has no external files, scripts, fonts or addresses.
"""

import base64
import html
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mjx_dher import __version__, lookup
from mjx_dher.runs.folder import fingerprint, run_folder
from mjx_dher.runs.folder.fingerprint import text
from mjx_dher.runs.folder.results import Record
from mjx_dher.runs.folder.run_folder import FAILED
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import comparison, plotting
from mjx_dher.system import files
from mjx_dher.tools import curves, figures

REPORT = "report.html"
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


def of_run(folder: Path, report: Callable[[str], None] = lambda text: None) -> str:
    """HTML report of a run, which may still be training. `report` is called with a line about each video that is left out.
    Raises FolderError if it is not a run folder, or it is damaged.
    """
    curve = curves.read_curve(folder, allow_empty=True)
    spec = curve.spec
    body = [_element("p", curves.title(curve), "failed" if curve.status == FAILED else ""), _facts(curve)]
    body += _videos(folder, report)
    if curve.rows:
        body += [_element("h2", "Curves"), _figure(figures.to_svg(curves.draw_curve(curve), 0))]
        columns = [name for name in curve.rows[0] if name != "digest"]
        rows = [[_number(row.get(name)) for name in columns] for row in curve.rows]
        body.append(_details(f"every epoch ({len(rows)})", _table(columns, rows)))
    else:
        body.append(_element("p", "No epoch of the run has ended."))
    body += [_element("h2", "Settings"), *_settings(spec, curve.content)]
    body += [_element("code", f"mjx-dher --config {folder / run_folder.CONFIG_FILE}"), _footer(curve.content.get("versions"))]
    return _page(f"{spec.env}: {spec.sampler}, seed {spec.seed}", body)


def _facts(curve: Record) -> str:
    """Named numbers of a run in a row."""
    parts = (f"<div>{_element('b', value)}{_escaped(name)}</div>" for name, value in _numbers(curve))
    return '<div class="facts">' + "".join(parts) + "</div>"


def _numbers(curve: Record) -> Iterator[tuple[str, str]]:
    result, last = curve.result, curve.rows[-1] if curve.rows else {}
    yield "status", curve.status
    if "success_rate" in result:
        interval = f"{result['success_low']:.3f} to {result['success_high']:.3f}"
        yield f"success of {result['episodes']} episodes (95 % interval {interval})", f"{result['success_rate']:.3f}"
        yield "already at the reset", f"{result['reset_success_rate']:.3f}"
    elif last:
        yield f"success of the last evaluation ({curve.eval_episodes} episodes)", f"{last['success_rate']:.3f}"
    if last:
        yield "environment steps", f"{last['env_steps']:,}"
        yield "updates", f"{last['updates']:,}"
        yield "seconds of training", f"{last['wall_seconds']:,.1f}"


def _settings(spec: RunSpec, content: dict[str, Any]) -> Iterator[str]:
    """Settings that a run reads, next to the library's defaults if they differ."""
    defaults = fingerprint.settings(RunSpec())
    for title, values in fingerprint.groups(spec).items():
        rows = [[n, text(x), text(defaults[n]) if n in defaults and defaults[n] != x else ""] for n, x in values.items()]
        if title == "run":
            rows.append(["physics", content["physics"], ""])
        yield _details(title, _table((title, "value", "default, if different"), rows))


def _videos(folder: Path, report: Callable[[str], None]) -> Iterator[str]:
    for path in files.inside(folder, folder.iterdir()):
        if path.suffix.lower() not in VIDEOS or not path.is_file():
            continue
        if path.stat().st_size > LARGEST:
            report(f"{path} is left out because it is larger than {LARGEST / 1e6:.0f} MB")
            continue
        kind = VIDEOS[path.suffix.lower()]
        source = f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
        if kind.startswith("image"):
            yield _figure(f'<img src="{source}" alt="{_escaped(path.name)}">', path.name)
        else:
            yield _figure(f'<video controls loop muted autoplay playsinline src="{source}"></video>', path.name)


def of_sweep(
    folder: Path,
    trials: list[dict[str, Any]],
    baseline: str,
    threshold: float,
    report: Callable[[str], None] = lambda text: None,
) -> str:
    """HTML report of a sweep with the `trials` of `tables.read`. For the others see `of_run` and `comparison.compare`."""
    failed = [trial for trial in trials if trial["status"] == FAILED]
    body = [_element("p", f"{len(trials)} runs have ended, of which {len(failed)} failed. Intervals are 95 %, over seeds.")]
    body += _videos(folder, report)
    for number, (env, groups) in enumerate(comparison.groups(trials).items()):
        rows = comparison.compare(groups, baseline, threshold)
        body += [_element("h2", env), _table(*comparison.table(rows))]
        against = "P(better) and p: against" if any(row.better == row.better for row in rows) else "there is no baseline"
        body.append(_element("p", f"epochs to a success rate of {threshold:g}; {against} {baseline}"))
        for place, (name, figure) in enumerate(plotting.draw(groups, rows, threshold).items()):
            body.append(_figure(figures.to_svg(figure, 10 * number + place), name))
    body += [_element("h2", "Runs"), _details(f"all {len(trials)} runs", _runs(trials))]
    body += [_element("h2", "Settings"), *_shared_settings(trials)]
    body.append(_footer(None))
    return _page(f"Sweep {folder.absolute().name}", body)


def _runs(trials: Sequence[dict[str, Any]]) -> str:
    varying = fingerprint.varying([trial["settings"] for trial in trials])
    head = ["run", *varying, "seed", "status", "success", "at the reset", "seconds", "reason"]
    rows = []
    for trial in trials:
        final, seconds = trial["final"], [None, *trial["curve"].get("wall_seconds", ())][-1]
        values = [text(trial["settings"][name]) for name in varying]
        numbers = map(_number, (final.get("success_rate"), final.get("reset_success_rate"), seconds))
        rows.append([trial["folder"].name, *values, trial["seed"], trial["status"], *numbers, trial["reason"]])
    return _table(head, rows)


def _shared_settings(trials: Sequence[dict[str, Any]]) -> Iterable[str]:
    varying, first = fingerprint.varying([trial["settings"] for trial in trials]), trials[0]["settings"]
    if varying:
        yield _element("p", f"Runs differ in {', '.join(varying)}.")
    rows = [(name, text(value)) for name, value in first.items() if name not in varying]
    yield _details("the same in all runs", _table(("setting", "value"), rows))


def _footer(versions: dict[str, str] | None) -> str:
    told = ", ".join(f"{name} {version}" for name, version in (versions or {}).items())
    return _element("p", f"Written by mjx-dher {__version__}." + (f" The run: {told}." if told else ""))


def _number(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _page(title: str, body: Iterable[str]) -> str:
    """A whole page with a heading."""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{_escaped(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{_escaped(title)}</h1>\n" + "\n".join(body) + "\n</body>\n</html>\n"
    )


def _escaped(value: object) -> str:
    """Escaped text of a value, also bytes of file names that are not valid UTF-8."""
    return html.escape(lookup.escaped(str(value)))


def _element(name: str, words: object, kind: str = "") -> str:
    """An element such as h2, p or code with a text and, if given, a class."""
    return f"<{name}{f' class={kind}' if kind else ''}>{_escaped(words)}</{name}>"


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table."""
    lines = ["".join(_element("th", name) for name in head), *("".join(_element("td", cell) for cell in row) for row in rows)]
    return '<div class="wide"><table>\n' + "\n".join(f"<tr>{line}</tr>" for line in lines) + "\n</table></div>"


def _details(summary: str, inside: str) -> str:
    """Content that a click opens."""
    return f"<details>{_element('summary', summary)}\n{inside}\n</details>"


def _figure(content: str, caption: str = "") -> str:
    """A picture in HTML, with a caption."""
    return f"<figure>{content}" + (_element("figcaption", caption) if caption else "") + "</figure>"
