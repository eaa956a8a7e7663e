import csv
import json
import math
import struct
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import pytest
from configs import SMALL
from conftest import refuses

from mjx_dher import HParams, Options, RunSpec, spec, trainer
from mjx_dher.context import Context
from mjx_dher.runs import loop
from mjx_dher.runs.folder import loggers, results, run_folder, services
from mjx_dher.system import machine
from mjx_dher.system.files import FolderError
from point_mass import PointMass


def row(epoch, **more):
    counts = {"epoch": epoch, "env_steps": 100 * epoch, "updates": 2 * epoch, "wall_seconds": 0.5 * epoch}
    return {**counts, "success_rate": epoch / 10, "return_mean": -50.0 + epoch, "q_mean": math.nan, **more}


def write(sink, epochs):
    for epoch in epochs:
        sink.write(row(epoch))
    sink.close()


def test_csv_goes_on_after_the_epochs_that_had_ended(tmp_path):
    path = tmp_path / "metrics.csv"
    write(loggers.CsvSink(path), [1, 2, 3, 4])
    in_one_go = path.read_bytes()
    write(loggers.CsvSink(path, epochs=2), [3, 4])
    assert path.read_bytes() == in_one_go
    with path.open() as file:
        assert [r["epoch"] for r in csv.DictReader(file)] == ["1", "2", "3", "4"]


def test_csv_has_every_metric_of_a_learner_that_was_changed(tmp_path):
    path = tmp_path / "metrics.csv"
    sink = loggers.CsvSink(path, digest="before")
    for epoch in (1, 2):
        sink.write(row(epoch, old_loss=0.5))
    sink.close()
    for _ in range(2):  # it goes on from the first epoch twice
        sink = loggers.CsvSink(path, epochs=1, digest="after")
        sink.write(row(2, new_loss=0.25))
        sink.close()
        first, second = results.read_rows(path)
        assert (first["old_loss"], first["digest"], second["new_loss"], second["digest"]) == (0.5, "before", 0.25, "after")
        assert math.isnan(first["new_loss"])
        assert math.isnan(second["old_loss"])
        assert list(first)[-1] == "digest"


@pytest.mark.parametrize("damage", [lambda b: b[:-20], lambda b: b.replace(b"\n2,", b"\n7,"), lambda b: b""])
def test_csv_without_the_epochs_that_had_ended_is_refused(tmp_path, damage):
    path = tmp_path / "metrics.csv"
    write(loggers.CsvSink(path), [1, 2, 3])
    path.write_bytes(damaged := damage(path.read_bytes()))
    with refuses("metrics.csv", error=FolderError):
        loggers.CsvSink(path, epochs=3)
    assert path.read_bytes() == damaged


def test_jsonl_has_an_object_a_line_and_goes_on(tmp_path):
    path = tmp_path / "metrics.jsonl"
    write(loggers.JsonlSink(path), [1, 2, 3])
    write(loggers.JsonlSink(path, epochs=2), [3, 4])
    found = [json.loads(line) for line in path.read_text().splitlines()]
    assert found == [row(epoch, q_mean=None) for epoch in (1, 2, 3, 4)]


def events(folder):
    """(step, name, value) of every scalar; a record is its length, a checksum, an Event and a checksum."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted(folder.iterdir()):
        content, at = path.read_bytes(), 0
        while at < len(content):
            (size,) = struct.unpack("<Q", content[at : at + 8])
            event = Event.FromString(content[at + 12 : at + 12 + size])
            found += [(event.step, value.tag, value.simple_value) for value in event.summary.value]
            at += 16 + size
    return found


def test_tensorboard_has_the_metrics_over_environment_steps(tmp_path):
    write(services.TensorBoardSink(tmp_path / "tb"), [1, 2])
    found = events(tmp_path / "tb")
    assert (200, "success_rate", pytest.approx(0.2)) in found
    assert (100, "return_mean", -49.0) in found
    assert {name for _, name, _ in found} == set(row(1)) - set(loggers.COUNTS)


def test_wandb_takes_the_metrics_offline_and_keeps_them_in_the_run_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    run_folder.write_config(tmp_path / "run", RunSpec(seed=3, sampler="closest"), "native", {})
    sink = loggers.open_sinks(tmp_path / "run", ["wandb"])[1]
    run = sink._run
    sink.write(row(1))
    sink.write(row(2))
    assert run.summary["success_rate"] == 0.2
    sink.close()
    expected = {"seed": 3, "gamma": HParams().gamma, "env": "push", "sampler": "closest", "engine": "native", "num_envs": 16}
    assert {name: run.config[name] for name in expected} == expected
    (kept,) = (tmp_path / "run" / "wandb").glob("offline-run-*")
    assert kept.name.endswith(run.id)
    assert any(kept.glob("*.wandb"))
    again = loggers.open_sinks(tmp_path / "run", ["wandb"])[1]
    assert again._run.id == run.id
    again.close()


@pytest.mark.parametrize("kind", ["UsageError", "CommError"])
def test_wandb_that_cannot_start_is_an_error_with_a_cure(kind, tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setattr(wandb, "init", Mock(side_effect=getattr(wandb.errors, kind)("No API key configured.")))
    run_folder.write_config(tmp_path / "run", RunSpec(), "native", {})
    with refuses("log", "wandb", "key", "WANDB_MODE=offline"):
        loggers.open_sinks(tmp_path / "run", ["wandb"])


def test_a_lost_process_of_wandb_is_an_error_that_names_it_and_not_the_run_folder(tmp_path, monkeypatch):
    wandb, lost = pytest.importorskip("wandb"), Mock(side_effect=ConnectionResetError("Connection lost"))
    monkeypatch.setattr(wandb, "init", Mock(return_value=Mock(log=lost, finish=lost)))
    run_folder.write_config(tmp_path / "run", RunSpec(), "native", {})
    sink = loggers.open_sinks(tmp_path / "run", ["wandb"])[1]
    for call in (lambda: sink.write(row(1)), sink.close):
        with refuses("log wandb", "Connection lost", "checkpoint", error=FolderError), run_folder.named(tmp_path / "run"):
            call()


def test_logs_are_refused_by_name_and_by_the_extra_that_is_missing(monkeypatch):
    with refuses("log", "tensorbord", "tensorboard"):
        Options(log=("jsonl", "tensorbord")).check()
    monkeypatch.setitem(spec.LOGS, "wandb", "no_such_package")
    with refuses("log", "wandb", "no_such_package", "[wandb]"):
        Options(log=("wandb",)).check()
    Options(log=("jsonl",)).check()


def test_open_sinks_writes_csv_always_and_each_log_once(tmp_path):
    opened = loggers.open_sinks(tmp_path, ["jsonl", "jsonl"])
    assert [type(sink) for sink in opened] == [loggers.CsvSink, loggers.JsonlSink]


def test_what_was_relabelled_by_hand():
    goal = jnp.zeros((4, 2))
    hindsight = jnp.array([[0.0, 0.0], [3.0, 4.0], [0.0, 1.0], [0.0, 0.0]])
    context = Context(PointMass().compute_reward, HParams())
    found = trainer._relabel_metrics(context, goal, hindsight)
    assert found == {"relabelled_share": 0.5, "relabel_distance": 3.0}
    assert trainer._relabel_metrics(context, goal, goal) == {"relabelled_share": 0.0, "relabel_distance": 0.0}


def test_memory_in_use_is_known_and_plausible():
    assert 10**7 < machine.used_bytes() < 10**12


def test_every_metric_is_documented():
    program = trainer.make_train(PointMass(), SMALL)
    found = jax.eval_shape(lambda state: program.epoch(state)[1], loop.state_template(program))
    text = (run_folder.Path(__file__).parent.parent / "docs" / "logs.md").read_text()
    for name in (*loggers.COUNTS, *found, "steps_per_second", "updates_per_second", "memory_bytes"):
        assert f"| `{name}` |" in text, name
