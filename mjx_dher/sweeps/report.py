"""HTML report of a run or a sweep, in one file that opens without a server: curves, tables, settings and videos."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mjx_dher import __version__
from mjx_dher.runs.folder import fingerprint, run_folder
from mjx_dher.runs.folder.fingerprint import text
from mjx_dher.runs.folder.run_folder import FAILED
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import comparison, plotting, tables
from mjx_dher.system import files
from mjx_dher.tools import curves, figures, html
from mjx_dher.tools.curves import Curve

REPORT = "report.html"


def of_run(folder: Path, report: Callable[[str], None] = lambda text: None) -> str:
    """HTML report of a run, which may still be training. `report` is called with a line about each video that is left out.
    Raises FolderError if it is not a run folder, or it is damaged.
    """
    curve = curves.read_curve(folder, allow_empty=True)
    spec = curve.spec
    body = [html.element("p", curves.title(curve), "failed" if curve.status == FAILED else ""), html.facts(_facts(curve))]
    body += _videos(folder, report)
    if curve.rows:
        body += [html.element("h2", "Curves"), html.figure(figures.to_svg(curves.draw_curve(curve), 0))]
        columns = [name for name in curve.rows[0] if name != "digest"]
        rows = [[_number(row.get(name)) for name in columns] for row in curve.rows]
        body.append(html.details(f"every epoch ({len(rows)})", html.table(columns, rows)))
    else:
        body.append(html.element("p", "No epoch of the run has ended."))
    body += [html.element("h2", "Settings"), *_settings(spec, curve.content)]
    body += [
        html.element("code", f"mjx-dher --config {folder / run_folder.CONFIG_FILE}"),
        _footer(curve.content.get("versions")),
    ]
    return html.page(f"{spec.env}: {spec.sampler}, seed {spec.seed}", body)


def _facts(curve: Curve) -> Iterator[tuple[str, str]]:
    result, last = curve.result, curve.rows[-1] if curve.rows else {}
    yield "status", curve.status
    if "success_rate" in result:
        interval = f"{result['success_low']:.3f} to {result['success_high']:.3f}"
        yield f"success of {result['episodes']} episodes (95 % interval {interval})", f"{result['success_rate']:.3f}"
        yield "already at the reset", f"{result['reset_success_rate']:.3f}"
    elif last:
        yield f"success of the last evaluation ({curve.spec.config.eval_episodes} episodes)", f"{last['success_rate']:.3f}"
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
        yield html.details(title, html.table((title, "value", "default, if different"), rows))


def _videos(folder: Path, report: Callable[[str], None]) -> Iterator[str]:
    for path in files.inside(folder, folder.iterdir()):
        if path.suffix.lower() not in html.VIDEOS or not path.is_file():
            continue
        if path.stat().st_size > html.LARGEST:
            report(f"{path} is left out because it is larger than {html.LARGEST / 1e6:.0f} MB")
            continue
        yield html.video(path)


def of_sweep(folder: Path, baseline: str, threshold: float, report: Callable[[str], None] = lambda text: None) -> str:
    """HTML report of all finished runs of a sweep. Arguments are as in `of_run` and `comparison.compare`. Raises FolderError if
    it is not a sweep, it is damaged, or none of its runs has ended.
    """
    trials = tables.read(folder)
    failed = [trial for trial in trials if trial["status"] == FAILED]
    body = [html.element("p", f"{len(trials)} runs have ended, of which {len(failed)} failed. Intervals are 95 %, over seeds.")]
    body += _videos(folder, report)
    for number, (env, groups) in enumerate(comparison.groups(trials).items()):
        rows = comparison.compare(groups, baseline, threshold)
        body += [html.element("h2", env), html.table(*comparison.table(rows))]
        compared = f"P(better) and p: against {baseline}" if any(row.better == row.better for row in rows) else "no baseline"
        body.append(html.element("p", f"epochs to a success rate of {threshold:g}; {compared}"))
        for place, (name, figure) in enumerate(plotting.draw(groups, rows, threshold).items()):
            body.append(html.figure(figures.to_svg(figure, 10 * number + place), name))
    body += [html.element("h2", "Runs"), html.details(f"all {len(trials)} runs", _runs(trials))]
    body += [html.element("h2", "Settings"), *_shared_settings(trials)]
    body.append(_footer(None))
    return html.page(f"Sweep {folder.absolute().name}", body)


def _runs(trials: Sequence[dict[str, Any]]) -> str:
    varying = _varying(trials)
    head = ["run", *varying, "seed", "status", "success", "at the reset", "seconds", "reason"]
    rows = []
    for trial in trials:
        final, seconds = trial["final"], [None, *trial["curve"].get("wall_seconds", ())][-1]
        values = [text(trial["settings"][name]) for name in varying]
        numbers = map(_number, (final.get("success_rate"), final.get("reset_success_rate"), seconds))
        rows.append([trial["folder"].name, *values, trial["seed"], trial["status"], *numbers, trial["reason"]])
    return html.table(head, rows)


def _varying(trials: Sequence[dict[str, Any]]) -> list[str]:
    settings = [trial["settings"] for trial in trials]
    return [name for name in settings[0] if len({str(each.get(name)) for each in settings}) > 1]


def _shared_settings(trials: Sequence[dict[str, Any]]) -> Iterable[str]:
    varying, first = _varying(trials), trials[0]["settings"]
    if varying:
        yield html.element("p", f"Runs differ in {', '.join(varying)}.")
    rows = [(name, text(value)) for name, value in first.items() if name not in varying]
    yield html.details("the same in all runs", html.table(("setting", "value"), rows))


def _footer(versions: dict[str, str] | None) -> str:
    told = ", ".join(f"{name} {version}" for name, version in (versions or {}).items())
    return html.element("p", f"Written by mjx-dher {__version__}." + (f" The run: {told}." if told else ""))


def _number(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
