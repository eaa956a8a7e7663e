"""Writes docs/images/design.svg, the picture in docs/design.md: `python docs/make_design_figure.py`."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

WIDTH, HEIGHT = 1240, 904
SANS = "Helvetica Neue, Helvetica, Arial, DejaVu Sans, sans-serif"
MONO = "SFMono-Regular, Menlo, Consolas, DejaVu Sans Mono, monospace"
# Stroke and fill by place: host, device, user's values, disk.
HOST, DEVICE, VALUE, FILE = ("#5b6470", "#ffffff"), ("#2563a8", "#ffffff"), ("#b4530a", "#fff6ea"), ("#3f7d4a", "#f0f8f0")
INK, SOFT = "#1c232b", "#4d5763"


def text(x: float, y: float, words: str, size: int = 14, **style: str) -> str:
    """Line of text centred at `x`. `style` has anchor, color, font, weight and turn (degrees)."""
    turn = f' transform="rotate({style["turn"]} {x} {y})"' if "turn" in style else ""
    return (
        f'<text x="{x}" y="{y}" font-size="{size}" font-family="{style.get("font", SANS)}"'
        f' font-weight="{style.get("weight", "normal")}" fill="{style.get("color", INK)}"'
        f' text-anchor="{style.get("anchor", "middle")}"{turn}>{escape(words)}</text>'
    )


def rectangle(x: float, y: float, width: float, height: float, stroke: str, fill: str, dash: str = "none") -> str:
    """Rectangle with round corners. `dash` is its line style."""
    place = f'x="{x}" y="{y}" width="{width}" height="{height}" rx="8"'
    return f'<rect {place} fill="{fill}" stroke="{stroke}" stroke-width="1.5" stroke-dasharray="{dash}"/>'


def box(
    x: float, y: float, width: float, height: float, kind: tuple[str, str], title: str, *lines: str, font: str = SANS
) -> str:
    """Rectangle with a title and lines below it, centred as one block."""
    top = y + height / 2 - 9.5 * len(lines) + 5
    parts = [rectangle(x, y, width, height, *kind)]
    parts.append(text(x + width / 2, top, title, 15, weight="bold", color=kind[0], font=font))
    parts += [text(x + width / 2, top + 19 * number, line, 13) for number, line in enumerate(lines, 1)]
    return "\n".join(parts)


def arrow(*points: tuple[float, float], color: str = SOFT) -> str:
    """Line through `points` with a head at its end."""
    path = " L ".join(f"{x} {y}" for x, y in points)
    return f'<path d="M {path}" fill="none" stroke="{color}" stroke-width="1.8" marker-end="url(#head-{color[1:]})"/>'


def heads(*colors: str) -> str:
    """Definitions of arrow heads."""
    return "\n".join(
        f'<marker id="head-{color[1:]}" viewBox="0 0 10 10" refX="9.5" refY="5" markerWidth="7" markerHeight="7"'
        f' orient="auto"><path d="M 0 0 L 10 5 L 0 10 z" fill="{color}"/></marker>'
        for color in colors
    )


def commands() -> list[str]:
    """Draws the commands and the driver, across the top."""
    parts = [text(40, 46, "on the host", 17, weight="bold", anchor="start", color=HOST[0])]
    for number, name in enumerate(("train", "resume", "sweep")):
        x = 390 + 170 * number
        parts += [box(x, 24, 130, 34, HOST, name, font=MONO), arrow((x + 65, 58), (x + 65, 96))]
    parts.append(text(895, 46, "thin callers, with a RunSpec for each run", 13, anchor="start", color=SOFT))
    driver = ("one run, or L side by side: claims the folders, compiles once, calls epoch by epoch, ends lanes that diverge",)
    parts.append(box(250, 96, 950, 58, HOST, "runs/driver: train_runs(env, specs, folders)", *driver))
    return parts


def values() -> list[str]:
    """Draws the user's values on the left, and `make_train`, which takes them."""
    parts = [text(115, 200, "what a user hands in", 15, weight="bold", color=VALUE[0])]
    for number, (title, line) in enumerate(
        (
            ("env", "reset, step, reward"),
            ("sampler", "log weights of goals"),
            ("priority", "weight of an episode"),
            ("learner", "init, act, update, ..."),
            ("networks", "actor and critic"),
        )
    ):
        y = 214 + 84 * number
        parts.append(box(30, y, 170, 58, VALUE, title, line, font=MONO))
        parts.append(
            arrow((200, y + 29), (250, y + 29), color=VALUE[0])
            if title != "networks"
            else arrow((115, y), (115, y - 26), color=VALUE[0])
        )
    parts.append(text(115, 630, "each a name, a value,", 13, color=SOFT))
    parts.append(text(115, 648, "or module:attribute", 13, color=SOFT))
    parts += [rectangle(250, 200, 40, 340, *VALUE), text(276, 370, "make_train", 15, font=MONO, weight="bold", turn="-90")]
    parts += [arrow((290, 370), (326, 370), color=VALUE[0]), arrow((270, 154), (270, 200)), arrow((628, 154), (628, 200))]
    return parts


def device() -> list[str]:
    """Draws the compiled program: cycles, and the evaluation."""
    blue = DEVICE[0]
    parts = [rectangle(x, y, 600, 500, blue, "#dbe8f6") for x, y in ((344, 216), (336, 208))]
    parts.append(rectangle(328, 200, 600, 500, blue, "#eaf2fb"))
    parts.append(text(640, 182, "state, epoch after epoch", 13, anchor="start", color=SOFT))
    parts.append(text(348, 228, "on the device: one compiled, pure function", 16, anchor="start", weight="bold", color=blue))
    parts.append(text(908, 228, "epoch(state)", 14, anchor="end", font=MONO, color=blue))
    # The cycle.
    parts.append(rectangle(346, 244, 564, 344, blue, "#f6faff", dash="6 4"))
    parts.append(text(362, 267, "scan over the cycles of an epoch", 14, anchor="start", color=blue))
    parts.append(box(362, 282, 160, 104, DEVICE, "roll out", "N whole episodes,", "exploring; engine", "native, jax or warp"))
    parts.append(box(548, 282, 160, 104, DEVICE, "add to the ring", "valid episodes,", "each with its", "priority"))
    parts.append(box(734, 282, 160, 104, DEVICE, "normalizers", "take in the new", "observations", "and goals"))
    learn = ("gradient steps, a scan;", "targets move every", "target_period of them")
    parts.append(box(362, 468, 190, 104, DEVICE, "learner's updates", *learn))
    draw = ("rows by priority or uniformly,", "goals by the sampler,", "rewards anew")
    parts.append(box(628, 468, 266, 104, DEVICE, "draw batches", *draw))
    parts.append(arrow((522, 334), (548, 334), color=blue))
    parts.append(arrow((708, 334), (734, 334), color=blue))
    parts.append(arrow((814, 386), (814, 468), color=blue))
    parts.append(arrow((666, 386), (666, 468), color=blue))
    parts.append(text(656, 424, "episodes of all", 13, anchor="end", color=SOFT))
    parts.append(text(656, 442, "cycles so far", 13, anchor="end", color=SOFT))
    parts.append(arrow((628, 520), (552, 520), color=blue))
    parts.append(text(590, 510, "batches", 13, color=SOFT))
    parts.append(arrow((442, 468), (442, 386), color=blue))
    parts.append(text(452, 424, "the next cycle", 13, anchor="start", color=SOFT))
    # The evaluation.
    parts.append(arrow((628, 588), (628, 612), color=blue))
    parts.append(
        box(428, 612, 400, 72, DEVICE, "evaluate", "whole episodes of the deterministic policy,", "at the end of each epoch")
    )
    lanes = "lanes: vmap over seeds, samplers and numbers"
    parts.append(text(644, 742, lanes, 15, weight="bold", color=blue))
    return parts


def host_loop() -> list[str]:
    """Draws the host's work after each epoch, on the right."""
    parts = [text(1102, 196, "after every epoch", 15, weight="bold", color=HOST[0])]
    rows = (
        (212, HOST, "should_stop()", "ends it, with a checkpoint"),
        (302, HOST, "finite?", "a lane that is not", "has diverged and ends"),
        (412, FILE, "sinks", "metrics.csv; jsonl,", "tensorboard, wandb"),
        (522, FILE, "checkpoints", "in the run's own folder;", "of L runs: in unfinished/"),
    )
    for y, kind, title, *lines in rows:
        height = 46 + 20 * len(lines)
        parts.append(box(1004, y, 196, height, kind, title, *lines))
        parts.append(arrow((976, 450), (976, y + height / 2), (1004, y + height / 2)))
    parts.append(f'<path d="M 944 450 L 976 450" stroke="{SOFT}" stroke-width="1.8" fill="none"/>')
    parts.append(text(965, 345, "state and metrics", 13, color=SOFT, turn="-90"))
    return parts


def folders() -> list[str]:
    """Draws the files on disk and their readers, across the bottom."""
    parts = [
        box(250, 800, 300, 72, FILE, "run folder, one each", "config.json, metrics.csv,", "policy.npz, result.json"),
        box(30, 800, 180, 72, HOST, "load_policy", "and eval, render,", "transfer, export"),
        box(620, 800, 170, 72, HOST, "tables", "results.csv,", "finals.csv"),
        box(830, 800, 170, 72, HOST, "comparison", "statistics,", "comparison.csv"),
        box(1040, 800, 160, 72, HOST, "plots", "curves, thresholds,", "intervals"),
        arrow((1102, 608), (1102, 768), (400, 768), (400, 800), color=FILE[0]),
        arrow((250, 836), (210, 836)),
        arrow((550, 836), (620, 836)),
        arrow((790, 836), (830, 836)),
        arrow((1000, 836), (1040, 836)),
        text(585, 827, "of all", 12, color=SOFT),
    ]
    return parts


def make() -> str:
    """The picture as SVG."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" role="img">',
        "<title>mjx-dher: the compiled training loop on the device, and the host around it</title>",
        f"<defs>{heads(SOFT, DEVICE[0], VALUE[0], FILE[0])}</defs>",
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="12" fill="#f7f6f2"/>',
        *commands(),
        *values(),
        *device(),
        *host_loop(),
        *folders(),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def main() -> str:
    """Writes the picture and returns it."""
    svg = make()
    (Path(__file__).parent / "images" / "design.svg").write_text(svg)
    return svg


if __name__ == "__main__":
    main()
