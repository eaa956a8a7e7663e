"""Wrong calls of the command line, several hundred: each must end with status 2 and a sentence, and write nothing."""

import os
import shutil
from pathlib import Path

from mjx_dher.config import Config, HParams, Number, metadata

TINY = [
    *(
        "--env",
        "reach",
        "--engine",
        "native",
        "--preset",
        "cpu",
        "--num-envs",
        "2",
        "--cycles-per-epoch",
        "1",
        "--batch-size",
        "16",
    ),
    *(
        "--updates-per-cycle",
        "2",
        "--target-period",
        "1",
        "--replay-size",
        "1000",
        "--hidden-sizes",
        "8",
        "--total-steps",
        "100",
    ),
]
NUMBERS = ("nan", "inf", "-1", "1e20", "100000000000000000000", "text", "", "0x10")
NAMES = ("psuh", "", "a:b:c", "no_such_module:x", "json:dumps", "json:nothing", ":", "os.path", "../x", "push ")


def paths(folder: Path) -> list[str]:
    """Makes places that are no run, no sweep, and no place to write to, and returns their paths."""
    folder.mkdir()
    (folder / "dangling").symlink_to(folder / "nowhere")
    (folder / "loop").symlink_to(folder / "loop")
    os.mkfifo(folder / "fifo")
    (folder / "file").write_text("hello")
    (folder / "used").mkdir()
    (folder / "used" / "mine").write_text("mine")
    (folder / "broken").mkdir()
    (folder / "broken" / "config.json").write_text("[" * 100_000)
    made = [str(folder / name) for name in ("dangling", "loop", "fifo", "file", "used", "broken", "file/below", "x" * 300)]
    return [*made, "/proc/x", "/dev/full", "a\0b", str(folder / ("long/" * 900))]


def damaged(run: Path, folder: Path) -> list[str]:
    """Makes copies of a finished run, each with one thing wrong, and returns their paths."""
    folder.mkdir()
    whole = {name: (run / name).read_bytes() for name in ("config.json", "policy.npz")}
    changes: list[tuple[str, bytes]] = [
        *((name, content[:n]) for name, content in whole.items() for n in (0, 10, len(content) // 2, len(content) - 3)),
        *((name, b"\x00" + content[1:]) for name, content in whole.items()),
        ("config.json", _flipped(whole["config.json"], len(whole["config.json"]) // 3)),
        # A byte of the first array: some bytes of the headers between arrays mean nothing.
        ("policy.npz", _flipped(whole["policy.npz"], 300)),
        ("config.json", b"null"),
        ("config.json", b"[" * 100_000),
        ("config.json", whole["config.json"].replace(b'"reach"', b'"push"')),
        ("config.json", whole["config.json"].replace(b'"schema": 2', b'"schema": 1')),
        ("config.json", whole["config.json"].replace(b'"schema": 2', b'"schema": 9')),
        ("policy.npz", whole["config.json"]),
    ]
    made = []
    for number, (name, content) in enumerate(changes):
        copy = folder / str(number)
        shutil.copytree(run, copy)
        (copy / name).write_bytes(content)
        made.append(str(copy))
    return made


def _flipped(content: bytes, place: int) -> bytes:
    """Returns the bytes with all bits of one turned over."""
    return content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :]


def calls(folder: Path, run: Path, stopped: Path, sweep: Path) -> list[list[str]]:
    """Returns the calls. `run` is a finished run of Reach, `stopped` one with a checkpoint, `sweep` a finished sweep.

    What they need is made in `folder`, and they may write to `folder/out` alone.
    """
    out, train = str(folder / "out"), ["train", *TINY]
    found: list[list[str]] = []
    for path in paths(folder / "paths"):
        found += [
            [*train, "--out", path],
            ["sweep", *TINY, "--seeds", "1", "--out", path],
            *([command, path] for command in ("resume", "eval", "transfer", "plot", "report")),
            ["export", path, "--format", "onnx"],
            ["render", path, "--out", out + ".png"],
            ["export", str(run), "--format", "onnx", "--out", path],
            ["export", str(run), "--format", "safetensors", "--out", path + "/none/policy.safetensors"],
            ["render", str(run), "--out", path],
        ]
    for path in damaged(run, folder / "damaged"):
        found += [["eval", path], ["export", path, "--format", "onnx", "--out", out + ".onnx"]]
    for flag in [*_flags(Config), *_flags(HParams), "--seed", "--final-episodes", "--checkpoint-every", "--keep"]:
        found += [[*train, "--out", out, flag, number] for number in NUMBERS[: 3 if flag in _flags(HParams) else None]]
    for flag in (
        "--env",
        "--sampler",
        "--weight-kernel",
        "--weight-normalization",
        "--metric",
        "--priority",
        "--generator",
        "--learner",
        "--networks",
        "--engine",
        "--log",
    ):
        found += [[*train, "--out", out, flag, name] for name in NAMES]
    for flag in ("--seeds", "--first-seed", "--lanes", "--devices", "--threshold", "--sweep.gamma", "--sweep.her-k"):
        found += [["sweep", *TINY, "--out", out, flag, number] for number in NUMBERS[:4]]
    for command in (["eval", str(run)], ["transfer", str(run)], ["render", str(run), "--out", out + ".png"]):
        found += [[*command, "--episodes", number] for number in NUMBERS[:5]]
    found += [["resume", str(stopped), "--total-steps", number] for number in NUMBERS[:5]]
    found += [
        *([flag, "1"] for flag in ("--learning-rate", "--tau", "--discount", "--no-such-flag")),
        ["resume", str(run)],
        ["plot", str(sweep), "--formats", "bmp"],
        ["export", str(run), "--format", "pickle"],
        ["render", "--out", out + ".png"],
        ["render", str(run), "--out", out + ".bmp"],
        ["render", str(run), "--out", out + ".png", "--width", "0"],
        ["sweep", *TINY, "--out", str(run)],
        [*train, "--out", str(sweep)],
        ["check"],
        ["check", "--env", "json:dumps"],
        ["trian"],
    ]
    # Of the flags that an earlier version refused or a reader may take for wrong, some are right.
    return [call for call in found if not _is_right(call)]


def _flags(owner: type) -> list[str]:
    return ["--" + name.replace("_", "-") for name in metadata(owner, Number)]


def _is_right(call: list[str]) -> bool:
    if len(call) < 2:
        return False
    flag, value = call[-2:]
    numbers = metadata(Config, Number) | metadata(HParams, Number)
    name = flag[2:].replace("-", "_").removeprefix("sweep.")
    if name in ("first_seed", "seed") or flag == "--checkpoint-every":
        return False
    if name in numbers and name in HParams._fields:
        try:
            return numbers[name].contains(float(value))
        except ValueError:
            return False
    return flag == "--sweep.her-k" and value == "1e20"
