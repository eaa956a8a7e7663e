"""A fleet without Ray: parcels, copies in the storage, and the driver on a cluster that is this process."""

import dataclasses
import re
import tarfile
import threading
import time
import zipfile

import pytest
from sweep_helpers import CONFIG, compile_once, make_grid, run, table  # noqa: F401

from mjx_dher import Options
from mjx_dher.cli import fleet
from mjx_dher.fleet import chunks, driver, parcels
from mjx_dher.fleet.chunks import Chunk
from mjx_dher.fleet.cluster import Flying, Outcome
from mjx_dher.fleet.ledger import Ledger
from mjx_dher.fleet.plan import Kind
from mjx_dher.runs.folder import results
from mjx_dher.sweeps import grid, tables
from mjx_dher.system.files import BusyError, FolderError
from probes import PointMass, held

OPTIONS = Options(final_episodes=15, checkpoint_every=1)
LONG = dataclasses.replace(CONFIG, total_steps=4 * CONFIG.total_steps)  # four epochs


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Two runs that have ended, without Ray."""
    folder = tmp_path_factory.mktemp("trained")
    trials = make_grid(("future",), (0, 1))
    run(folder, trials)
    return folder, trials


def test_a_run_comes_back_whole_and_once(trained, tmp_path):
    folder, trials = trained
    parcel = parcels.pack(grid.folder_of(folder, trials[0]))
    target = grid.folder_of(tmp_path, trials[0])
    (target / "checkpoints" / "epoch-000001").mkdir(parents=True)  # of an attempt without Ray
    (target / "metrics.csv").write_text("cut")
    assert parcels.deliver(target, parcel)
    assert results.is_whole(target)
    assert not (target / "checkpoints").exists()
    assert parcels.pack(target) == parcel
    written = (target / "result.json").stat().st_mtime_ns
    assert not parcels.deliver(target, parcel)
    assert (target / "result.json").stat().st_mtime_ns == written
    assert len(tables.read(tmp_path)) == 1


def test_what_comes_back_is_not_believed_unseen(trained, tmp_path):
    folder, trials = trained
    parcel = parcels.pack(grid.folder_of(folder, trials[0]))
    kept = tmp_path / "a" / "checkpoints" / "epoch-000001"
    kept.mkdir(parents=True)
    for damaged in (b"", b"nonsense", parcel[:-40], parcel[:200] + b"\0" * 50 + parcel[250:]):
        with pytest.raises(FolderError, match="is damaged"):
            parcels.deliver(tmp_path / "a", damaged)
        assert kept.exists()
        assert not (tmp_path / "a" / "result.json").exists()
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as archive:
        archive.writestr("../outside", "x")
    with pytest.raises(FolderError, match="outside of its folder"):
        parcels.deliver(tmp_path / "a", (tmp_path / "evil.zip").read_bytes())
    assert not (tmp_path / "outside").exists()
    with zipfile.ZipFile(tmp_path / "short.zip", "w") as archive:
        archive.writestr("result.json", "{}")
    with pytest.raises(FolderError, match="what came back of a run is not whole"):
        parcels.deliver(tmp_path / "a", (tmp_path / "short.zip").read_bytes())
    (tmp_path / "b").mkdir()
    with held(tmp_path / "b"), pytest.raises(FolderError, match="is being trained by another program"):
        in_a_thread(lambda: parcels.deliver(tmp_path / "b", parcel))


def in_a_thread(call):
    """Calls in another thread, which has none of this one's locks, and raises what that raises."""
    errors = []

    def run():
        try:
            call()
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    for error in errors:
        raise error


def test_the_newest_copy_that_is_whole_is_used(tmp_path):
    storage, scratch = parcels.Storage(str(tmp_path / "storage"), "s", "c"), tmp_path / "scratch"
    scratch.mkdir()

    def restored():
        target = tmp_path / "scratch" / "restored"
        target.mkdir(exist_ok=True)
        told = storage.restore(target)
        content = (target / "file").read_text() if (target / "file").exists() else None
        for path in target.iterdir():
            path.unlink()
        return content, told

    assert restored() == (None, [])
    for text in "abc":
        (scratch / "own").mkdir(exist_ok=True)
        (scratch / "own" / "file").write_text(text)
        storage.save(scratch / "own")
    assert restored() == ("c", [])
    copies = sorted((tmp_path / "storage" / "fleet-s" / "c").glob("*.tar"))
    assert [path.name[:6] for path in copies] == ["000002", "000003"]  # the oldest has gone
    content = bytearray(copies[1].read_bytes())
    content[600] ^= 1
    copies[1].write_bytes(content)
    text, told = restored()
    assert text == "b"
    assert re.search("the copy 000003-.* of these runs is damaged .SHA-256 differs", told[0])
    copies[0].unlink()
    assert restored()[0] is None
    storage.clear()
    assert not (tmp_path / "storage" / "fleet-s").exists()


def test_a_storage_that_cannot_be_used_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot be written to" in parcels.probe(str(tmp_path / "file" / "x"), "s", None)
    assert parcels.probe(str(tmp_path / "new"), "s", None) is None
    with parcels.shown(str(tmp_path / "fresh"), "s") as token:
        assert parcels.probe(str(tmp_path / "fresh"), "s", token) is None
        assert "is not where this machine sees it" in parcels.probe(str(tmp_path / "other"), "s", token)
    assert not (tmp_path / "fresh").exists()
    assert (tmp_path / "new").exists()  # it was there
    with pytest.raises(ValueError, match=r"storage: .*cannot be written to"), parcels.shown("/proc/nothing", "s"):
        pass


def test_tasks_that_had_not_ended_are_handed_out_first_as_they_were(tmp_path):
    trials = make_grid(("future", "weighted"), (0, 1, 2))
    ledger = Ledger(tmp_path, trials)
    handed = [ledger.take(lambda spec: 2) for _ in range(2)]
    assert [specs for _, specs in handed] == [tuple(trials[:2]), tuple(trials[2:4])]
    ledger.ended(handed[0][0])
    again = Ledger(tmp_path, trials[2:])
    assert again.sweep == ledger.sweep
    assert again.waits == 4
    assert again.take(lambda spec: 1) == handed[1]  # of two, whatever the size is now
    assert again.take(lambda spec: 9)[1] == tuple(trials[4:])
    assert again.waits == 0
    again.close()
    assert not (tmp_path / "fleet.json").exists()
    for damaged in ("", "{", "[]", '{"id": 1}', '{"id": "x", "chunks": 3}'):
        (tmp_path / "fleet.json").write_text(damaged)
        with pytest.raises(FolderError, match=r"fleet.json is damaged .*remove it"):
            Ledger(tmp_path, trials)


def test_a_task_of_which_runs_have_ended_keeps_the_digest_that_its_copies_have(tmp_path):
    trials = make_grid(("future", "weighted"), (0, 1))
    chunk, specs = Ledger(tmp_path, trials).take(lambda spec: 4)
    assert specs == tuple(trials)
    for left in (trials[1:], trials[2:]):  # two starts in which a run ended each
        again = Ledger(tmp_path, left)
        assert again.waits == len(left)
        assert again.take(lambda spec: 1) == (chunk, tuple(left))
    again.ended(chunk)
    assert Ledger(tmp_path, []).waits == 0


def test_a_run_that_another_program_trains_is_left_to_it(tmp_path, monkeypatch):
    def busy(folder, parcel):
        raise BusyError(f"{folder} is being trained by another program")

    (trial,) = make_grid(("future",), (0,))
    told = []
    job = dataclasses.replace(job_of(tmp_path, []), report=told.append)
    monkeypatch.setattr(parcels, "deliver", busy)
    assert not driver._deliver(job, trial, b"what came back")
    assert "was not written" in told[0]
    assert "another program" in told[0]


def test_a_folder_goes_again_only_where_nothing_is_left_to_go_on_with(tmp_path):
    with fleet.claimed(tmp_path / "a" / "sweep"):
        assert (tmp_path / "a" / "sweep" / "cells").is_dir()
        with pytest.raises(FolderError, match="is being trained by another program"):
            in_a_thread(lambda: fleet.claimed(tmp_path / "a" / "sweep").__enter__())
    assert not (tmp_path / "a").exists()
    with fleet.claimed(tmp_path / "b"):
        (tmp_path / "b" / "fleet.json").write_text("{}")
    assert (tmp_path / "b" / "cells").is_dir()


def test_runs_of_a_task_share_a_program(tmp_path):
    trials = [*make_grid(("future",), (0, 1)), *make_grid(("future",), (0, 1), static=LONG)]
    ledger = Ledger(tmp_path, trials)
    assert [ledger.take(lambda spec: 3)[1] for _ in range(2)] == [tuple(trials[:2]), tuple(trials[2:])]


def chunk_of(trials, storage=None):
    return Chunk("c", "s", tuple(trials), OPTIONS, 1, None, None if storage is None else str(storage), "")


def make_point_mass(run):
    return PointMass()


def test_a_stopped_task_goes_on_where_it_was_on_another_node(tmp_path):
    """Its runs end as if nothing had happened; the second run had not begun."""
    trials = make_grid(("future",), (0, 1), static=LONG)
    run(tmp_path / "plain", trials)
    told = []
    words = lambda one: told.append(one) or one.epoch == 4  # noqa: E731
    first = chunks.train(chunk_of(trials, tmp_path / "storage"), make_point_mass, words)
    assert [bool(parcel) for parcel in first] == [True, False]
    told.clear()
    second = chunks.train(chunk_of(trials, tmp_path / "storage"), make_point_mass, lambda one: told.append(one) or False)
    assert {one.epoch for one in told} <= {1, 2, 3, 4}
    assert told[-1].done == 4 * CONFIG.total_steps  # of the second run alone
    assert second[0] == first[0]
    for trial, parcel in zip(trials, second):
        parcels.deliver(grid.folder_of(tmp_path / "fleet", trial), parcel)
    assert table(tmp_path / "fleet") == table(tmp_path / "plain")
    assert table(tmp_path / "fleet", tables.FINALS) == table(tmp_path / "plain", tables.FINALS)


def test_a_task_that_is_killed_loses_what_follows_the_last_copy(tmp_path, monkeypatch):
    """Epoch 3 has ended, and its checkpoint has not been made; that of epoch 2 is in the storage."""
    monkeypatch.setattr(chunks, "SECONDS_BETWEEN_WORDS", -1.0)
    trials = make_grid(("future",), (0,), static=LONG)

    def copied(epoch):
        for path in sorted(tmp_path.glob("fleet-s/c/*.json")):
            with tarfile.open(path.with_suffix(".tar")) as archive:
                if any(name.endswith(f"epoch-{epoch:06d}/manifest.json") for name in archive.getnames()):
                    return True
        return False

    def dies(one):
        if one.epoch == 3:
            deadline = time.monotonic() + 60
            while not copied(2) and time.monotonic() < deadline:
                time.sleep(0.05)
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        chunks.train(chunk_of(trials, tmp_path), make_point_mass, dies)
    told = []
    (parcel,) = chunks.train(chunk_of(trials, tmp_path), make_point_mass, lambda one: told.append(one) or False)
    assert [one.epoch for one in told] == [3, 4]
    assert any("after epoch 2" in line for line in told[0].lines)
    assert parcel


class Here:
    """A cluster that is this process: chunks are trained when they are waited for; some of them are lost."""

    def __init__(self, slots=2, lost=(), error=None):
        self.slots, self.lost, self.error = slots, set(lost), error
        self.most, self.taken, self.told = 0, [], []

    def resources(self):
        return {"node": {"CPU": float(self.slots)}}

    def submit(self, chunk, kind, work):
        self.taken.append(chunk)
        return Flying(chunk, kind, [work])

    def wait(self, flying, seconds):
        self.most = max(self.most, len(flying))
        return flying[:1]

    def collect(self, flying):
        if self.error is not None:
            raise self.error
        if len(self.taken) in self.lost:
            return Outcome(iter(()), "lost: the node died")
        return Outcome(iter(flying.refs[0](flying.chunk, lambda one: self.told.append(one) or False)))

    def cancel(self, flying):
        flying.refs[0] = lambda chunk, tell: [b""] * len(chunk.specs)

    def look(self, stop):
        told, self.told = self.told, []
        return told


def job_of(folder, states, stop=lambda: False):
    return driver.Job(
        folder,
        OPTIONS,
        1,
        str(folder / "storage"),
        "",
        [Kind("cpu", 0, 1)],
        lambda kind, spec: 2,
        lambda chunk, tell: chunks.train(chunk, make_point_mass, tell),
        lambda text: None,
        states.append,
        stop,
    )


def test_every_run_is_there_in_the_end_and_none_twice(tmp_path):
    trials = make_grid(("future",), range(6))
    run(tmp_path / "plain", trials)
    states, here = [], Here()
    folder = tmp_path / "fleet"
    folder.mkdir()
    assert driver.run(here, job_of(folder, states), Ledger(folder, trials)) == []
    assert [chunk.specs for chunk in here.taken] == [tuple(trials[i : i + 2]) for i in (0, 2, 4)]
    assert states[-1][:2] == (6, 0)
    for name in (tables.RESULTS, tables.FINALS):
        assert table(folder, name) == table(tmp_path / "plain", name)
    assert not (folder / "storage").exists() or not list((folder / "storage").iterdir())


def test_a_stop_takes_back_what_has_not_begun(tmp_path):
    trials = make_grid(("future",), range(12))
    states, here = [], Here(slots=1)
    driver.run(here, job_of(tmp_path, states, lambda: True), Ledger(tmp_path, trials))
    assert here.most == 3  # a slot and two that wait
    assert len(list(tmp_path.glob("cells/*/result.json"))) == 2  # of the task that was under way
    ledger = Ledger(tmp_path, [trial for trial in trials if not grid.is_done(tmp_path, trial)])
    assert ledger.waits == 10
    assert ledger.take(lambda spec: 1)[1] == tuple(trials[2:4])


def test_a_lost_task_is_told_and_the_others_go_on(tmp_path):
    trials = make_grid(("future",), (0, 1, 2, 3))
    here = Here(slots=1, lost={2})
    told = driver.run(here, job_of(tmp_path, []), Ledger(tmp_path, trials))
    assert told
    assert set(told) == {"lost: the node died"}
    with pytest.raises(ValueError, match="what training raises"):
        driver.run(Here(error=ValueError("what training raises")), job_of(tmp_path, []), Ledger(tmp_path, trials))
