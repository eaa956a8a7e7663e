"""Pictures of single runs, and pages about runs and sweeps: made from folders as runs leave them, without training."""

import base64
import dataclasses
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from conftest import refuses, save_policy
from test_plotting import texts

from mjx_dher import Config, RunSpec, cli
from mjx_dher.runs.folder import fingerprint, loggers, reading, run_folder
from mjx_dher.sweeps import grid, report
from mjx_dher.system import files
from mjx_dher.system.files import FolderError
from mjx_dher.tools import curves, figures

SPEC = RunSpec(env="reach", config=Config(eval_episodes=20, total_steps=12_000))
PNG = b"\x89PNG"


def write_run(folder, spec=SPEC, epochs=12, status="finished", reason="", columns=("q_mean", "critic_loss")):
    """A run folder as `train` leaves it after so many epochs; status None: it has not ended."""
    run_folder.write_config(folder, spec, "native", {"lanes": 1})
    digest = reading.read_config(folder)["digest"]
    sink = loggers.CsvSink(folder / "metrics.csv", digest=digest)
    for epoch in range(1, epochs + 1):
        rate = min(1.0, epoch / 10)
        metrics = {"success_rate": rate, "return_mean": -50 + 40 * rate, "reset_success_rate": 0.05}
        metrics |= {"train_success_rate": 0.8 * rate, "train_return_mean": -50 + 30 * rate, **dict.fromkeys(columns, 0.5)}
        sink.write({"epoch": epoch, "env_steps": 1000 * epoch, "updates": 10 * epoch, "wall_seconds": 2.0 * epoch, **metrics})
    sink.close()
    if status is None:
        return folder
    save_policy(folder)
    content = {"status": status, "reason": reason, "epochs": epochs + (status == "failed"), "env_steps": 1000 * epochs}
    content |= {"wall_seconds": 2.0 * epochs, "lanes": 1, "digest": digest}
    if status == "finished":
        content |= {"episodes": 500, "success_rate": 0.97, "success_low": 0.951, "success_high": 0.982}
        content |= {"reset_success_rate": 0.05, "return_mean": -9.5}
    files.write_json(folder / "result.json", content)
    return folder


# Reading


@pytest.mark.parametrize(
    ("made", "status"),
    [
        ({}, "finished"),
        ({"status": None}, "not ended"),
        ({"status": "failed", "reason": "the learner is not finite"}, "failed"),
    ],
)
def test_a_run_is_read_however_it_ended(made, status, tmp_path):
    curve = curves.read_curve(write_run(tmp_path / "run", **made))
    assert (curve.status, len(curve.rows), curve.result.get("reason", "")) == (status, 12, made.get("reason", ""))
    np.testing.assert_allclose(curve.column("success_rate")[:3], [0.1, 0.2, 0.3])
    assert np.isnan(curve.column("nothing")).all()
    assert "12,000 steps in 24 s" in curves.title(curve)
    assert status in curves.title(curve)
    if status != "finished":  # which others draw
        assert figures.to_svg(curves.draw_curve(curve), 0).startswith("<svg")


def test_runs_without_an_epoch_have_no_curve(tmp_path):
    with refuses("begun", error=FolderError):
        curves.read_curve(write_run(tmp_path / "begun", epochs=0, status=None))
    failed = write_run(tmp_path / "failed", epochs=0, status="failed", reason="no episode can be learned from")
    with refuses("failed", "no episode can be learned from", error=FolderError):
        curves.read_curve(failed)
    assert "No epoch of the run has ended." in report.of_run(failed)


def test_a_run_of_one_epoch_and_a_learner_of_ones_own_is_drawn(tmp_path):
    curve = curves.read_curve(write_run(tmp_path / "run", epochs=1, columns=()))
    figure = curves.draw_curve(curve)
    assert [axis.get_title() for axis in figure.axes] == ["success rate", "mean return"]


def test_everything_written_is_inside(tmp_path):
    long = dataclasses.replace(SPEC, sampler="a_package_of_mine.samplers_of_mine:prefer_goals_that_are_near")
    runs = [curves.read_curve(write_run(tmp_path / str(i), dataclasses.replace(long, seed=i))) for i in range(9)]
    for figure in (curves.draw_curve(runs[0]), curves.draw_together(runs), curves.draw_together(runs[:1])):
        width, height = figure.canvas.get_width_height()
        for text, box in texts(figure):
            assert box.x0 >= -1, text.get_text()
            assert box.x1 <= width + 1, text.get_text()
            assert box.y0 >= -1, text.get_text()
            assert box.y1 <= height + 1, text.get_text()


def test_a_bound_that_rounding_has_moved_beyond_the_rate_is_drawn(tmp_path):
    folder = write_run(tmp_path / "run")
    content = json.loads((folder / "result.json").read_text())
    content |= {"success_rate": 0.0, "success_low": 4e-19, "success_high": 0.0076}
    files.write_json(folder / "result.json", content)
    assert "end, 500 episodes: 0.000" in curves.draw_curve(curves.read_curve(folder)).axes[0].get_legend_handles_labels()[1]


def test_the_interval_of_success_is_wilson_s(tmp_path):
    figure = curves.draw_curve(curves.read_curve(write_run(tmp_path / "run")))
    band = figure.axes[0].collections[0].get_paths()[0].get_extents()
    # Of 20 episodes: none too few at 2 of 20, whose interval is 0.028 to 0.301 (Wilson 1927), up to 20 of 20, 0.839 to 1.
    np.testing.assert_allclose((band.y0, band.y1), (0.0279, 1.0), atol=1e-3)


def test_runs_are_called_by_what_differs(tmp_path):
    make = lambda name, **changes: curves.read_curve(write_run(tmp_path / name, dataclasses.replace(SPEC, **changes)))  # noqa: E731
    runs = [make("a"), make("b", seed=3), make("c", env_kwargs=("reward_type=dense",))]
    assert curves.labels(runs) == ["env_kwargs none, seed 0", "env_kwargs none, seed 3", "env_kwargs reward_type=dense, seed 0"]
    same = [make("d"), make("e"), make("f", seed=1)]
    assert curves.labels(same) == [f"seed 0: {tmp_path / 'd'}", f"seed 0: {tmp_path / 'e'}", "seed 1"]
    assert curves.labels(same[:2]) == [str(tmp_path / "d"), str(tmp_path / "e")]
    unfinished = curves.read_curve(write_run(tmp_path / "g", dataclasses.replace(SPEC, seed=7), status=None))
    assert curves.labels([same[0], unfinished]) == ["seed 0", "seed 7 (not ended)"]
    others = [
        make("h", learner="ddpg", seed=2),
        make("i", learner="td3", seed=2, config=dataclasses.replace(SPEC.config, policy_delay=2)),
    ]
    assert curves.labels(others) == ["ddpg", "td3, policy_delay 2"]
    head, cells = curves.curves_table([same[0], unfinished])
    assert dict(zip(head, cells[0]))["final success (95 % interval)"] == "0.970 (0.951 to 0.982)"
    assert dict(zip(head, cells[1]))["last evaluation"] == "1.00"


# The command `plot`


def test_plot_draws_a_run_into_its_folder_and_several_together(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    one, other = write_run(tmp_path / "one"), write_run(tmp_path / "other", dataclasses.replace(SPEC, seed=1), status=None)
    assert cli.main(["plot", str(one)]) == 0
    assert (one / "curve.png").read_bytes().startswith(PNG)
    first = (one / "curve.svg").read_bytes()
    assert cli.main(["plot", str(one), "--formats", "svg"]) == 0
    assert (one / "curve.svg").read_bytes() == first
    assert cli.main(["plot", str(one), str(other), "--formats", "png"]) == 0
    assert (tmp_path / "curves.png").read_bytes().startswith(PNG)
    assert "seed 1 (not ended)" in capsys.readouterr().out
    assert cli.main(["plot", str(one), str(other), "--formats", "pdf", "--out", "new/folder"]) == 0
    pdf = (tmp_path / "new/folder/curves.pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert b"Date" not in pdf  # equal figures give equal files


def test_every_name_of_a_run_is_drawn_as_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = ["_old", "$_$", "q\udcff", "new"]
    drawn = [curves.read_curve(write_run(Path(name), epochs=5 + number)) for number, name in enumerate(names)]
    (legend,) = curves.draw_together(drawn).legends
    assert [text.get_text() for text in legend.get_texts()] == ["_old", r"\$_\$", r"q\xff", "new"]
    assert [line.get_color() for line in legend.get_lines()] == [color for color, *_ in figures.styles(4)]
    assert cli.main(["plot", *names]) == 0
    assert cli.main(["report", names[2]]) == 0
    assert r"mjx-dher --config q\xff/config.json" in Path(names[2], "report.html").read_text()


def test_what_is_no_run_is_named(tmp_path, capsys):
    run = write_run(tmp_path / "run")
    (tmp_path / "sweep" / "cells").mkdir(parents=True)
    (tmp_path / "file").write_text("")
    for folders, message in (
        ([tmp_path / "none"], "none is neither a run folder nor a sweep: no such folder"),
        ([tmp_path / "file"], "file is neither a run folder nor a sweep: it is a file"),
        ([tmp_path], "it has neither config.json nor cells/"),
        ([run, tmp_path / "sweep"], "sweep is a sweep: pass it alone, without other folders"),
        ([tmp_path / "sweep"], "sweep has no finished run of a sweep"),
        ([], "pass one or more run folders"),
        ([run, "--out", tmp_path / "file" / "x"], "file"),
        ([run, "--formats", "gif"], "formats must be among png, svg, pdf; got gif"),
        ([run, "--threshold", "nan"], "threshold must lie in (0, 1]; got nan"),
    ):
        assert cli.main(["plot", *map(str, folders)]) == 2, folders
        assert message in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["config.json", "metrics.csv", "policy.npz", "result.json"]


def test_files_that_were_changed_are_not_drawn(tmp_path, capsys):
    run = write_run(tmp_path / "run")
    lines = (run / "metrics.csv").read_text().splitlines(keepends=True)
    (run / "metrics.csv").write_text("".join(lines[:-3]))
    for command in ("plot", "report"):
        assert cli.main([command, str(run)]) == 2
        assert "metrics.csv has complete lines of 9 of 12 epochs" in capsys.readouterr().err


# The command `report`


class Page(HTMLParser):
    """What a page refers to, and whether its elements are closed in order."""

    VOID = ("meta", "img", "br")

    def __init__(self, text):
        super().__init__()
        self.open, self.addresses, self.ids = [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        named = dict(attrs)
        self.addresses += [named[name] for name in ("src", "href", "xlink:href", "data") if name in named]
        self.addresses += re.findall(r"url\((.*?)\)", " ".join(value or "" for value in named.values()))
        self.ids += [named["id"]] if "id" in named else []

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def read_page(path):
    text = path.read_text()
    found = Page(text)
    assert all(address.startswith(("#", "data:")) for address in found.addresses)
    assert {address[1:] for address in found.addresses if address[0] == "#"} <= set(found.ids)
    assert len(found.ids) == len(set(found.ids))
    assert "<script" not in text
    assert "@import" not in text
    return text, found


def test_a_page_about_a_run_holds_all_that_it_shows(tmp_path, capsys):
    run = write_run(tmp_path / "run")
    (run / "video.mp4").write_bytes(b"film")
    assert cli.main(["report", str(run)]) == 0
    assert capsys.readouterr().out == f"wrote {run / 'report.html'}\n"
    text, found = read_page(run / "report.html")
    assert [a for a in found.addresses if a.startswith("data:")] == [
        f"data:video/mp4;base64,{base64.b64encode(b'film').decode()}"
    ]
    for told in ("0.970", "95 % interval 0.951 to 0.982", "12,000", "every epoch (12)", "total_steps", "1000000", "mujoco"):
        assert told in text
    assert cli.main(["report", str(run), "--out", str(tmp_path / "page.html")]) == 0
    assert cli.main(["report", str(run), "--out", str(tmp_path / "page.html")]) == 2
    assert "exists; pass another file" in capsys.readouterr().err
    assert cli.main(["report", str(run), "--out", str(tmp_path / "page.txt")]) == 2
    assert cli.main(["report", str(run), "--out", "/proc/page.html", "--video"]) == 2  # before the video
    assert "out: /proc cannot be written to" in capsys.readouterr().err


def test_a_page_with_a_new_video_leaves_the_video_as_it_was_drawn(tmp_path, monkeypatch, capsys):
    run = write_run(tmp_path / "run")
    real = cli.run

    def draw(command, argv, console):
        film = command == "render" and Path(argv[argv.index("--out") + 1])
        return film.write_bytes(b"film") if film else real(command, argv, console)

    monkeypatch.setattr(cli, "run", draw)
    assert cli.main(["report", str(run), "--video"]) == 0
    assert (run / "video.mp4").read_bytes() == b"film"
    assert capsys.readouterr().out == f"wrote {run / 'report.html'}\n"
    assert base64.b64encode(b"film").decode() in (run / "report.html").read_text()


def test_a_page_about_a_run_that_failed_says_why_without_markup_of_its_own(tmp_path):
    spec = dataclasses.replace(SPEC, env="<b>:x")
    run = write_run(tmp_path / "run", status="failed", reason="<script>alert('x')</script> & more")
    curve = curves.read_curve(run)
    text = report.of_run(run)
    Page(text)
    assert "&lt;script&gt;" in text
    assert "<script" not in text
    assert curve.status == "failed"
    assert report._escaped(spec.env) == "&lt;b&gt;:x"


def test_a_film_that_is_too_large_is_left_out_and_named(tmp_path, monkeypatch):
    run = write_run(tmp_path / "run")
    (run / "large.gif").write_bytes(b"12345")
    monkeypatch.setattr(report, "LARGEST", 4)
    told = []
    assert "data:" not in report.of_run(run, told.append)
    assert told == [f"{run / 'large.gif'} is left out because it is larger than 0 MB"]


@pytest.fixture
def sweep(tmp_path):
    for sampler in ("future", "weighted"):
        for seed in (0, 1):
            spec = dataclasses.replace(SPEC, sampler=sampler, seed=seed)
            bad = sampler == "weighted" and seed == 1
            made = {"status": "failed", "reason": "the learner is not finite", "epochs": 5} if bad else {}
            write_run(tmp_path / "sweep" / grid.CELLS / fingerprint.trial_name(spec), spec, **made)
    return tmp_path / "sweep"


def test_a_page_about_a_sweep_compares_and_names_its_runs(sweep, capsys):
    assert cli.main(["report", str(sweep), "--threshold", "0.5"]) == 0
    text, _ = read_page(sweep / "report.html")
    assert text.count("<svg") == 3
    for told in (
        "4 runs have ended, of which 1 failed",
        "2 (1 failed)",
        "the learner is not finite",
        "epochs to a success rate of 0.5",
    ):
        assert told in text
    assert "Runs differ in sampler." in text
    assert not (sweep / "comparison.csv").exists()


def test_a_picture_that_cannot_be_drawn_costs_a_run_nothing(tmp_path, monkeypatch, capsys):
    from mjx_dher.cli import train as cli_train

    run = write_run(tmp_path / "run")
    told = []
    console = type("Console", (), {"print": lambda self, text, **kwargs: told.append(text)})()
    monkeypatch.setattr(curves, "draw_curve", lambda curve: 1 / 0)
    cli_train._draw(run, True, console)
    assert told == ["the learning curve could not be drawn (ZeroDivisionError: division by zero)"]
    monkeypatch.setattr(figures, "is_there", lambda: False)
    cli_train._draw(run, True, console)
    assert len(told) == 1
    assert not math.isnan(curves.read_curve(run).column("success_rate")[0])
