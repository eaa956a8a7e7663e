"""Shared parts of all pictures: line styles, and figures without a screen. Matplotlib is loaded with the first figure."""

import functools
import importlib
import importlib.util
import io
import re
import textwrap
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjx_dher import lookup
from mjx_dher.system import files

# Okabe and Ito's palette for colour-blind readers, from dark to light, each colour with its own line and marker.
_STYLES: tuple[tuple[str, Any, str], ...] = (
    ("#000000", "-", "o"),
    ("#0072B2", "--", "s"),
    ("#D55E00", "-.", "^"),
    ("#009E73", ":", "D"),
    ("#CC79A7", (0, (5, 1, 1, 1, 1, 1)), "v"),
    ("#E69F00", (0, (8, 2)), "P"),
    ("#56B4E9", (0, (1, 1)), "X"),
)
FORMATS = ("png", "svg", "pdf")
DPI = 130


def check(formats: Sequence[str], feature: str = "plot") -> None:
    """Raises ValueError if Matplotlib is not installed or a format is not in FORMATS."""
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise ValueError(f"formats must be among {', '.join(FORMATS)}; got {', '.join(unknown) or 'none'}")
    lookup.require_extra(feature, "matplotlib", "plot")


def is_there() -> bool:
    """Whether Matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


@functools.cache
def preload() -> None:
    """Loads Matplotlib in a thread, if installed, for a program that draws later."""
    if is_there():
        threading.Thread(target=importlib.import_module, args=("matplotlib.backends.backend_agg",), daemon=True).start()


def styles(number: int) -> list[tuple[Any, Any, str]]:
    """Colour, line and marker of each of `number` curves. The first 49 differ in colour or line."""
    chosen = []
    for i in range(number):
        rounds = i // len(_STYLES)  # lines are shifted by one in each round of colours, and markers by two
        colour, line, marker = (_STYLES[(i + shift * rounds) % len(_STYLES)] for shift in (0, 1, 2))
        chosen.append((colour[0], line[1], marker[2]))
    return chosen


def subplots(rows: int, columns: int, width: float, height: float, **options: Any) -> tuple[Any, list[Any]]:
    """Makes a figure of a size in inches. Returns it with its axes, row by row. `options` are Matplotlib's."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False, **options).flat)


def label_success(
    figure: Any, axes: Sequence[Any], units: Sequence[str], names: Sequence[str], columns: int, title: str
) -> None:
    """Labels axes of success rates over several units, and adds one common legend."""
    for axis, unit in zip(axes, units):
        axis.set_xlabel(unit)
        axis.set_xlim(left=0)
        axis.set_ylim(-0.02, 1.02)
        axis.grid(alpha=0.2)
    axes[0].set_ylabel("success rate")
    figure.suptitle(folded(title, figure.get_figwidth()), fontsize=11)
    lines = axes[0].get_lines()[: len(names)]  # Matplotlib's own list lacks names that begin with _
    figure.legend(lines, list(map(plain, names)), loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def write(figure: Any, path: Path) -> None:
    """Writes a figure atomically, in the format of the path's suffix.

    Without dates and with fixed ids, so that equal figures give equal files.
    """
    import matplotlib

    ending = path.suffix[1:]
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with files.atomic_write(path) as partial, matplotlib.rc_context({"svg.hashsalt": "mjx-dher"}):
        figure.savefig(partial, format=ending, dpi=DPI, metadata=dates.get(ending))


def to_svg(figure: Any, number: int) -> str:
    """A figure as a self-contained SVG element for an HTML page. `number` makes its ids unique."""
    import matplotlib

    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "mjx-dher"}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    element = text.getvalue()[text.getvalue().index("<svg") :]
    element = re.sub(r"<metadata>.*?</metadata>", "", element, flags=re.S)
    return re.sub(r'(\bid="|href="#|url\(#)', rf"\1f{number}-", element)


def folded(title: str, width: float) -> str:
    """Title folded to the width of a figure, in inches."""
    return plain(textwrap.fill(title, int(11.5 * width)))


def plain(text: str) -> str:
    """Text that Matplotlib draws as it is: without formulas, and with escaped bytes of file names that are not valid UTF-8."""
    return lookup.escaped(text).replace("$", r"\$")
