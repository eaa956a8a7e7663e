"""A sweep on a cluster without Ray: options, chunks, runs as bytes, and the driver on a cluster that is this process."""

import dataclasses
import re
import shutil
import threading
import zipfile
from pathlib import Path

import pytest
from conftest import refuses
from rich.console import Console
from sweep_helpers import CONFIG, compile_once, make_grid, run, table  # noqa: F401

from mjx_dher import Options, cli, lookup
from mjx_dher.cli import fleet, sweep
from mjx_dher.fleet import chunks, cluster, worker
from mjx_dher.fleet.chunks import FleetOptions, Task
from mjx_dher.fleet.cluster import LostError, Running
from mjx_dher.runs.folder import results
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid, tables
from mjx_dher.system.files import FolderError
from probes import PointMass, held

OPTIONS = Options(final_episodes=15, checkpoint_every=1)
LONG = dataclasses.replace(CONFIG, total_steps=4 * CONFIG.total_steps)  # four epochs
GPU, CPU = Task(1, 1), Task(0, 2)

WRONG = [
    (["--ray", ""], "ray must be"),
    (["--ray", "ray://head:10001"], "ray must be .*; got 'ray://head:10001'"),
    (["--ray", "head:0"], "ray must be"),
    (["--ray", "local", "--ray-cpus", "0"], r"ray_cpus must lie in \[1, .*; got 0"),
    (["--ray", "local", "--ray-chunk", "100000000000000000000"], "ray_chunk must lie in"),
    (["--ray", "local", "--dry-run"], "dry_run"),
    (["--ray", "local", "--devices", "2"], "devices"),
    (["--ray", "local", "--storage", "gs://bucket"], "storage must be a folder"),
    (["--ray", "local", "--storage", __file__], "storage must be a folder"),
    (["--ray", "127.0.0.1:1"], "ray: no cluster answers at 127.0.0.1:1 .*ray start --head"),
    (["--ray-cpus", "2"], "ray_cpus needs --ray"),
    (["--storage", "/tmp/x"], "storage needs --ray"),
]


@pytest.mark.parametrize(("arguments", "said"), WRONG)
def test_options_that_cannot_be_used_are_rejected_before_anything_is_written(tmp_path, arguments, said, capsys):
    assert cli.main(["sweep", "--out", str(tmp_path / "new"), *arguments]) == 2
    assert not (tmp_path / "new").exists()
    assert re.search(said, capsys.readouterr().err)


def test_without_the_extra_the_error_names_it(monkeypatch):
    find = lookup.importlib.util.find_spec
    monkeypatch.setattr(lookup.importlib.util, "find_spec", lambda name: None if name == "ray" else find(name))
    with refuses("[ray]"):
        FleetOptions(ray="local").check()


def test_a_task_takes_what_nodes_have():
    mixed = [{"CPU": 8.0, "GPU": 2.0}, {"CPU": 4.0}, {"CPU": 0.0}]
    assert chunks.task_of(None, mixed) == Task(1, 1)
    assert chunks.task_of(2, mixed) == Task(0, 2)
    assert chunks.task_of(None, mixed[1:]) == Task(0, 4)
    assert [[task.slots(own) for own in mixed] for task in (GPU, CPU)] == [[2, 0, 0], [4, 2, 0]]
    for cpus, nodes in ((9, mixed), (None, [])):
        with refuses("0 GPUs", f"{cpus or 1} CPUs"):
            chunks.task_of(cpus, nodes)


@pytest.mark.parametrize(
    ("runs", "task", "slots", "lanes", "size", "sizes"),
    [
        (40, GPU, 4, None, None, [10] * 4),  # each slot one task
        (40, GPU, 4, 8, None, [5] * 8),  # two rounds of 5, not of 8 and 2
        (10, GPU, 3, None, None, [4, 4, 2]),
        (3, GPU, 8, None, None, [1] * 3),
        (40, CPU, 1, None, None, [8] * 5),
        (40, CPU, 1, 2, None, [14, 14, 12]),  # at most 16
        (6, CPU, 1, None, 4, [4, 2]),
    ],
)
def test_chunks_keep_all_slots_busy_until_the_end(runs, task, slots, lanes, size, sizes):
    trials = make_grid(("future",), range(runs))
    found = chunks.split(trials, task, slots, lanes, size)
    assert [len(chunk) for chunk in found] == sizes
    assert [one for chunk in found for one in chunk] == trials


def test_runs_of_a_chunk_share_a_program():
    trials = [*make_grid(("future",), (0, 1)), *make_grid(("future",), (0, 1), static=LONG)]
    assert chunks.split(trials, CPU, 1, None, 3) == [tuple(trials[:2]), tuple(trials[2:])]


def test_custom_code_lies_in_one_folder(tmp_path, monkeypatch):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"fleet_{name}.py").write_text("")
        monkeypatch.syspath_prepend(tmp_path / name)
    specs = [RunSpec(env="fleet_one:E"), RunSpec(env="fleet_one:E", seed=1), RunSpec()]
    assert chunks.custom_code(specs) == tmp_path / "one"
    assert chunks.custom_code([RunSpec(), RunSpec(sampler="numpy:add")]) is None  # installed
    with refuses("env fleet_one:E", "sampler fleet_two:s"):
        chunks.custom_code([*specs, RunSpec(sampler="fleet_two:s")])


def test_the_screen_shows_all_nodes(capsys):
    screen = fleet._Screen(Console(width=200), make_grid(("future",), (0, 1, 2, 3)))
    one = worker.News("c", "node1", CONFIG.total_steps * 1.0, 500.0, {"future": 0.25}, ())
    other = one._replace(chunk="d", host="node2", success={"future": 0.75})
    screen._printed -= 100
    screen.show(cluster.State(1, frozenset("cd"), 2, [one, other]))
    line = capsys.readouterr().out
    assert "75%  1 of 4 runs have ended; 2 of 2 tasks train on 2 hosts  1,000 steps/s  future 0.50  ETA" in line
    screen.show(cluster.State(4, frozenset(), 2, []))
    assert "100%  4 of 4 runs have ended" in capsys.readouterr().out


def test_checkpoints_of_one_machine_lie_in_its_sweep(tmp_path):
    assert fleet.storage_of(FleetOptions(ray="local"), tmp_path).parent == tmp_path / "unfinished"
    assert fleet.storage_of(FleetOptions(ray="auto"), tmp_path) is None
    own = FleetOptions(ray="auto", storage=Path("/shared"))
    assert fleet.storage_of(own, tmp_path).parent == Path("/shared")
    assert fleet.storage_of(own, tmp_path / "other") != fleet.storage_of(own, tmp_path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run that has ended, without Ray."""
    folder, (trial,) = tmp_path_factory.mktemp("trained"), make_grid(("future",), (0,))
    run(folder, [trial])
    return trial, worker.pack(grid.folder_of(folder, trial))


def test_a_run_comes_back_whole_and_once(trained, tmp_path):
    trial, parcel = trained
    target = grid.folder_of(tmp_path, trial)
    (target / "checkpoints" / "epoch-000001").mkdir(parents=True)  # of a run without Ray
    (target / "metrics.csv").write_text("cut")
    assert worker.unpack(target, trial, parcel)
    assert results.is_done(target, trial)
    assert not (target / "checkpoints").exists()
    assert worker.pack(target) == parcel
    written = (target / "result.json").stat().st_mtime_ns
    assert not worker.unpack(target, trial, parcel)
    chunk = chunks.make((trial,), Options(), None, chunks.Task(0, 1), tmp_path / "storage", {})
    chunks.make_folder(chunk)
    assert cluster._deliver(tmp_path, chunk, [parcel], pytest.fail) == 0  # it had ended before
    assert not (tmp_path / "storage" / chunk.id).exists()
    assert (target / "result.json").stat().st_mtime_ns == written
    assert len(tables.read(tmp_path)) == 1


def test_a_damaged_run_is_rejected_and_nothing_is_lost(trained, tmp_path):
    trial, parcel = trained
    kept = tmp_path / "a" / "checkpoints" / "epoch-000001"
    kept.mkdir(parents=True)
    for damaged in (b"", b"nonsense", parcel[:-40], parcel[:200] + b"\0" * 50 + parcel[250:]):
        with refuses("damaged", error=FolderError):
            worker.unpack(tmp_path / "a", trial, damaged)
        assert kept.exists()
        assert not (tmp_path / "a" / "result.json").exists()
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("../outside", "x")
        archive.writestr("result.json", "{}")
    with refuses("damaged", error=FolderError):
        worker.unpack(tmp_path / "b" / "c", trial, (tmp_path / "other.zip").read_bytes())
    assert not (tmp_path / "b" / "outside").exists()
    with refuses("seed", error=FolderError):  # another trial
        worker.unpack(tmp_path / "c", dataclasses.replace(trial, seed=1), parcel)


def test_the_sweep_without_ray_removes_chunks_whose_runs_have_ended(tmp_path, monkeypatch):
    ended, waiting = make_grid(("future",), (0, 1))
    run(tmp_path, [ended])
    monkeypatch.setattr(sweep, "_write_tables", lambda args, console: None)
    args, _ = sweep.parse_sweep_args(["--out", str(tmp_path), "--preset", "cpu"], print)
    storage = fleet.storage_of(FleetOptions(ray="local"), tmp_path)
    both, one = (chunks.make(specs, OPTIONS, None, CPU, storage, {}) for specs in ((ended, waiting), (ended,)))
    for chunk in (both, one):
        chunks.make_folder(chunk)
        (chunk.storage / "cells").mkdir()
    assert sweep._end(args, [ended], [], 0, Console()) == 0
    assert [path.name for path in storage.iterdir()] == [both.id]  # a larger sweep needs it
    run(tmp_path, [waiting])
    assert sweep._end(args, [ended, waiting], [waiting], 0, Console()) == 0
    assert not (tmp_path / "unfinished").exists()
    storage.parent.mkdir()  # left empty by a driver that has cleared its own storage
    assert sweep._end(args, [ended, waiting], [], 0, Console()) == 0
    assert not (tmp_path / "unfinished").exists()


def test_chunks_that_had_not_ended_come_first_as_they_were(tmp_path):
    trials = make_grid(("future", "weighted"), (0, 1, 2))
    for chunk in (trials[2:4], trials[4:]):
        chunks.make_folder(chunks.make(tuple(chunk), OPTIONS, None, CPU, tmp_path, {}))
    assert set(chunks.unfinished(tmp_path, trials, trials)) == {tuple(trials[2:4]), tuple(trials[4:])}
    assert chunks.unfinished(tmp_path, trials, trials[:4]) == [tuple(trials[2:4])]
    assert chunks.unfinished(tmp_path, trials, trials[3:4]) == [tuple(trials[2:4])]  # one has ended: both, as they were
    assert chunks.unfinished(tmp_path, trials[:2], trials[:2]) == []  # of another sweep
    for path in tmp_path.glob("*/chunk.json"):
        path.write_text("{")
    assert chunks.unfinished(tmp_path, trials, trials) == chunks.unfinished(None, trials, trials) == []


def chunk_of(trials, storage=None, lanes=1):
    chunk = chunks.make(tuple(trials), OPTIONS, lanes, CPU, storage, chunks.code_of(trials))
    chunks.make_folder(chunk)
    return chunk


def make_point_mass(run):
    return PointMass()


@pytest.mark.parametrize("killed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_chunk_resumes_where_it_was_on_another_node(tmp_path, killed, monkeypatch):
    """Its runs end as if nothing had happened; two side by side, in the second of four epochs."""
    monkeypatch.setattr(worker, "SECONDS_BETWEEN_NEWS", -1.0)
    trials = make_grid(("future",), (0, 1), static=LONG)
    run(tmp_path / "plain", trials, lanes=2)

    def stops(news):
        if killed and news.steps == 2 * 2 * CONFIG.total_steps:
            raise KeyboardInterrupt
        return news.steps == 2 * 2 * CONFIG.total_steps

    chunk, told = chunk_of(trials, tmp_path / "storage", lanes=2), []
    if killed:
        with pytest.raises(KeyboardInterrupt):
            worker.train(chunk, make_point_mass, stops)
    else:
        assert worker.train(chunk, make_point_mass, stops) == [b"", b""]
    parcels = worker.train(chunk, make_point_mass, lambda news: told.append(news) or False)
    assert [news.steps / CONFIG.total_steps / 2 for news in told] == ([2, 3, 4] if killed else [3, 4])
    assert any("resuming from" in line for line in told[0].lines)
    for trial, parcel in zip(trials, parcels):
        worker.unpack(grid.folder_of(tmp_path / "fleet", trial), trial, parcel)
    for name in (tables.RESULTS, tables.FINALS):
        assert table(tmp_path / "fleet", name) == table(tmp_path / "plain", name)


def test_a_node_with_other_code_or_another_storage_is_rejected(tmp_path):
    chunk = chunk_of(make_grid(("future",), (0,)), tmp_path)
    other = chunk._replace(code={**chunk.code, "version of mjx_dher": "0"})
    with refuses("mjx_dher", 0):
        worker.train(other, make_point_mass, lambda news: False)
    shutil.rmtree(chunk.storage)
    with refuses("storage"):
        worker.train(chunk, make_point_mass, lambda news: False)


class Here:
    """A cluster that is this process: chunks are trained when they are waited for, unless they are lost."""

    def __init__(self, slots=2, lost=()):
        self.slots, self.lost = slots, set(lost)
        self.most, self.taken, self.cancelled, self.news = 0, [], [], []

    def resources(self):
        return [{"CPU": 2.0 * self.slots}]

    def submit(self, chunk, work):
        self.taken.append(chunk)
        return Running(chunk, work)

    def wait(self, running, seconds):
        self.most = max(self.most, len(running))
        return running[:1]

    def result(self, running):
        if running.chunk in self.cancelled:
            return []
        if self.taken.index(running.chunk) in self.lost:
            raise LostError("the node died")
        return running.ref(running.chunk, lambda news: self.news.append(news) or False)

    def cancel(self, running):
        self.cancelled.append(running.chunk)

    def look(self, stop):
        news, self.news = self.news, []
        return news


def drive(here, folder, trials, stop=lambda: False, size=2, work=None):
    """What `cluster.train` returns, and the states that it shows."""
    states, storage = [], folder / "storage"
    before = chunks.unfinished(storage, trials, trials)
    left = [trial for trial in trials if not any(trial in chunk for chunk in before)]
    parts = [*before, *chunks.split(left, CPU, here.slots, 1, size)]
    work = work or (lambda chunk, tell: worker.train(chunk, make_point_mass, tell))
    parts = [chunks.make(part, OPTIONS, 1, CPU, storage, chunks.code_of(trials)) for part in parts]
    return cluster.train(here, folder, parts, work, lambda text: None, states.append, stop), states


def test_every_run_is_there_in_the_end_and_none_twice(tmp_path):
    trials = make_grid(("future",), range(6))
    run(tmp_path / "plain", trials)
    here = Here()
    lost, states = drive(here, tmp_path / "fleet", trials)
    assert lost == []
    assert [chunk.specs for chunk in here.taken] == [tuple(trials[i : i + 2]) for i in (0, 2, 4)]
    assert states[-1].ended == 6
    for name in (tables.RESULTS, tables.FINALS):
        assert table(tmp_path / "fleet", name) == table(tmp_path / "plain", name)
    assert not any((tmp_path / "fleet" / "storage").iterdir())


def test_a_stop_takes_back_what_has_not_begun_and_a_lost_chunk_is_reported(tmp_path):
    trials = make_grid(("future",), range(12))
    here = Here(slots=1)
    assert drive(here, tmp_path, trials, lambda: True)[0] == []
    assert here.most == 3  # a slot and two that wait
    assert len(list(tmp_path.glob("cells/*/result.json"))) == 2  # of the chunk that was running
    left = [trial for trial in trials if not grid.is_done(tmp_path, trial)]
    assert left == trials[2:]
    here = Here(slots=1, lost={1})
    assert drive(here, tmp_path, left)[0] == ["the node died"]
    assert {chunk.specs for chunk in here.taken[:2]} == {tuple(trials[2:4]), tuple(trials[4:6])}  # taken back: first now
    assert [trial for trial in trials if not grid.is_done(tmp_path, trial)] == list(here.taken[1].specs)


def test_an_error_of_the_training_is_raised_and_a_run_of_another_program_is_left_to_it(trained, tmp_path):
    trial, parcel = trained

    def fails(chunk, tell):
        raise ValueError("raised by the training")

    with pytest.raises(ValueError, match="raised by the training"):
        drive(Here(), tmp_path / "a", [trial], work=fails)
    target = grid.folder_of(tmp_path / "b", trial)
    target.mkdir(parents=True)
    ended = []
    with held(target):
        thread = threading.Thread(
            target=lambda: ended.extend(drive(Here(), tmp_path / "b", [trial], work=lambda chunk, tell: [parcel])[1])
        )
        thread.start()
        thread.join()
    assert ended[-1].ended == 0
    assert not (target / "result.json").exists()
