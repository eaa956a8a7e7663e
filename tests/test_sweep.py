import csv
import dataclasses
import gc
import json
import re
import shutil
import signal
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_trainer import SMALL

import mjx_dher
from mjx_dher import HParams, cli, config, envs, trainer
from mjx_dher.cli import sweep as cli_sweep
from mjx_dher.host import files, memory
from mjx_dher.host.files import FolderError
from mjx_dher.sweeps import sweep
from mjx_dher.sweeps.sweep import Cell
from probes import PointMass

CONFIG = dataclasses.replace(SMALL, num_envs=8, updates_per_cycle=8, hidden_sizes=(16,))  # an epoch of 240 steps
LONGER = dataclasses.replace(CONFIG, total_steps=5 * CONFIG.total_steps)


DEFAULT = HParams()


def grid(samplers=("future", "weighted"), seeds=(0, 1), points=(DEFAULT,), static=CONFIG):
    statics = [dataclasses.replace(static, sampler=sampler) for sampler in samplers]
    return sweep.cells(statics, [points] * len(statics), seeds)


def run(folder, cells, **options):
    sweep.run(folder, cells, lambda static: PointMass(), final_episodes=15, **options)


def test_cells_are_all_combinations_seed_by_seed():
    found = grid(points=(HParams(her_k=2.0), HParams(her_k=4.0)))
    assert [(c.seed, c.config.sampler, c.hparams.her_k) for c in found] == [
        (seed, sampler, k) for seed in (0, 1) for sampler in ("future", "weighted") for k in (2.0, 4.0)
    ]
    assert len({c.name for c in found}) == 8
    assert found[0].name == Cell(found[0].config, found[0].hparams, 0).name
    assert found[0].name.startswith("point_mass-future-s0-")
    assert found[0].name != Cell(dataclasses.replace(found[0].config, batch_size=33), found[0].hparams, 0).name


def test_what_a_sampler_does_not_read_makes_no_cells_of_its_own():
    """future once, closest once, epsilon_closest for each epsilon, weighted for each kernel and temperature."""
    statics = [
        dataclasses.replace(CONFIG, sampler=sampler, weight_kernel=kernel)
        for sampler in ("future", "closest", "epsilon_closest", "weighted")
        for kernel in ("linear", "softmax")
    ]
    points = [HParams(temperature=t, epsilon=e) for t in (0.5, 1.0) for e in (0.1, 0.2, 0.3)]
    found = sweep.cells(statics, [points] * len(statics), [0])
    count = lambda sampler: sum(c.config.sampler == sampler for c in found)  # noqa: E731
    assert {name: count(name) for name in ("future", "closest", "epsilon_closest", "weighted")} == {
        "future": 1,
        "closest": 1,
        "epsilon_closest": 3,
        "weighted": 4,
    }


def test_environments_stay_together():
    statics = [dataclasses.replace(CONFIG, env=env) for env in ("reach", "push")]
    found = sweep.cells(statics, [[HParams()]] * 2, [0, 1, 2])
    assert [c.config.env for c in found] == ["reach"] * 3 + ["push"] * 3


@pytest.mark.parametrize("of", [1, 2, 3, 7])
def test_shares_have_all_runs_between_them_and_whole_seeds_where_they_can(of):
    tasks = [dataclasses.replace(CONFIG, env=env) for env in ("push", "slide")]
    cells = [cell for task in tasks for cell in grid(seeds=(0, 1, 2, 3), static=task)]
    shares = [sweep.share(cells, number, of) for number in range(1, of + 1)]
    assert sorted(cell.name for share in shares for cell in share) == sorted(cell.name for cell in cells)
    for task in tasks:
        sizes = [sum(cell.config.env == task.env for cell in share) for share in shares]
        assert max(sizes) - min(sizes) <= 1
    if of == 2:
        assert [[(c.config.env, c.config.sampler, c.seed) for c in share] for share in shares] == [
            [(env, sampler, seed) for env in ("push", "slide") for seed in seeds for sampler in ("future", "weighted")]
            for seeds in ((0, 1), (2, 3))
        ]


def test_two_programs_share_a_sweep_and_the_last_one_s_tables_have_it_all(tmp_path, point_mass, capsys):
    out = ["--lanes", "2", "--out", str(tmp_path / "shared")]
    assert cli.main([*COMMAND, *out, "--share", "2/2"]) == 0
    assert "2 runs, share 2/2 of the sweep; writing to" in capsys.readouterr().out
    assert {row["seed"] for row in table(tmp_path / "shared", sweep.FINALS)} == {"1"}
    assert cli.main([*COMMAND, *out, "--share", "1/2"]) == 0
    written = {name: (tmp_path / "shared" / name).read_bytes() for name in ("results.csv", "finals.csv", "comparison.csv")}
    assert len(table(tmp_path / "shared", sweep.FINALS)) == 4
    assert cli.main([*COMMAND, *out]) == 0
    assert "4 runs; 4 of them are done already" in capsys.readouterr().out
    assert written == {name: (tmp_path / "shared" / name).read_bytes() for name in written}


def test_a_run_that_another_program_trains_is_refused(tmp_path, monkeypatch):
    cells = grid(seeds=(0, 1))
    path = tmp_path / "cells" / cells[3].name
    path.mkdir(parents=True)
    with files.lock(path, "lock"), pytest.raises(FolderError, match=f"{cells[3].name} is being trained by another"):
        run(tmp_path, cells, lanes=2)
    assert [sweep.is_done(tmp_path, cell) for cell in cells] == [True, True, False, False]
    held, end = [], sweep._end

    def look(chunk, *rest):
        for cell in chunk:
            with pytest.raises(FolderError), files.lock(tmp_path / "cells" / cell.name, "lock"):
                pass
            held.append(cell)
        end(chunk, *rest)

    monkeypatch.setattr(sweep, "_end", look)
    run(tmp_path, cells[2:], lanes=2)
    assert held == cells[2:]  # until their results are written
    assert not list(tmp_path.glob("cells/*/lock"))


def test_another_program_s_checkpoints_stay(tmp_path):
    first, second = grid(("future",), (0, 1), static=LONGER)
    cut_short(tmp_path, [first], 2)
    run(tmp_path, [second])
    assert len(list((tmp_path / "unfinished").iterdir())) == 1
    run(tmp_path, [first])
    assert not (tmp_path / "unfinished").exists()


def test_a_lane_is_that_run_alone(tmp_path):
    """The same first parameters, to the bit, and the same draws; afterwards rounding, because XLA sums products of another
    shape in another order, which 24 updates let grow to less than 1e-4 here."""
    cells = grid(("future", "random", "weighted"), (3, 4))
    curves, learned = {}, {}

    def note(chunk, progress):
        for lane, cell in enumerate(chunk):
            curves[cell] = {name: values[lane] for name, values in progress.metrics.items()}
            learned[cell] = jax.tree.map(lambda x, lane=lane: np.asarray(x[lane]), progress.state.learner.params)

    run(tmp_path, cells, lanes=6, on_epoch=note)
    assert len({jax.tree.leaves(params)[0].tobytes() for params in learned.values()}) == len(cells)
    for sampler in ("future", "random", "weighted"):
        own = [cell for cell in cells if cell.config.sampler == sampler]
        program = trainer.make_train(PointMass(), own[0].config)
        compiled = trainer.compile_program(program, jax.random.key(0), HParams())
        for cell in own:
            start = trainer.Start(compiled.init(jax.random.key(cell.seed), cell.hparams))
            (alone,) = trainer.run(PointMass(), cell.config, compiled, start)
            for name, value in alone.metrics.items():
                assert curves[cell][name] == pytest.approx(value, rel=1e-3, abs=1e-4), (cell.name, name)
            for a, b in zip(jax.tree.leaves(learned[cell]), jax.tree.leaves(alone.state.learner.params), strict=True):
                np.testing.assert_allclose(a, b, atol=1e-4)
    keys, hparams = jnp.stack([jax.random.key(3), jax.random.key(4)]), HParams(*(jnp.full(2, x) for x in HParams()))
    together = jax.jit(jax.vmap(program.init))(keys, hparams)
    for lane, key in enumerate(keys):
        alone = jax.jit(program.init)(key, HParams())
        for a, b in zip(jax.tree.leaves(together.learner), jax.tree.leaves(alone.learner), strict=True):
            np.testing.assert_array_equal(a[lane], b)


def table(folder, name=sweep.RESULTS, without=("wall_seconds",)):
    sweep.write_tables(folder, sweep.read(folder))
    with (folder / name).open() as file:
        return [{k: v for k, v in row.items() if k not in without} for row in csv.DictReader(file)]


def test_a_sweep_that_was_cut_short_trains_what_is_missing_and_ends_as_if_it_had_not_been(tmp_path):
    cells, cut, whole = grid(seeds=(0, 1, 2)), tmp_path / "cut", tmp_path / "whole"
    trained = []

    def stop_after_the_second_chunk(chunk, progress):
        trained.extend(c.name for c in chunk)
        if len(trained) > 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(cut, cells, lanes=2, on_epoch=stop_after_the_second_chunk)
    assert [sweep.is_done(cut, cell) for cell in cells] == [True] * 4 + [False] * 2
    curves = [cut / "cells" / cell.name / "metrics.csv" for cell in cells]
    assert [path.exists() and len(path.read_text().splitlines()) for path in curves] == [2, 2, 2, 2, False, False]
    assert len(table(cut)) == 4
    run(cut, [cell for cell in cells if not sweep.is_done(cut, cell)], lanes=2)
    run(whole, cells, lanes=2)
    assert table(cut) == table(whole)
    assert table(cut, sweep.FINALS) == table(whole, sweep.FINALS)


def cut_short(folder, cells, epoch, **options):
    """Trains until KeyboardInterrupt after `epoch`."""

    def interrupt(chunk, progress):
        if progress.epoch == epoch:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(folder, cells, on_epoch=interrupt, **options)


def test_what_ran_side_by_side_goes_on_from_its_checkpoint_to_the_same_tables(tmp_path):
    cells, cut, whole, seen, said = grid(static=LONGER), tmp_path / "cut", tmp_path / "whole", [], []
    cut_short(cut, cells, 3, lanes=4)
    assert len(list((cut / "unfinished").glob("*/checkpoints/epoch-000003"))) == 1

    def look(chunk, progress):
        gc.collect()
        seen.append((progress.epoch, sum(array.nbytes for array in jax.live_arrays())))

    run(cut, cells, lanes=4, on_epoch=look, on_program=said.append)
    run(whole, cells, lanes=4, on_epoch=look)
    assert [epoch for epoch, _ in seen] == [4, 5, 1, 2, 3, 4, 5]
    assert seen[1][1] <= seen[-1][1]  # one state in memory, as from the start
    assert "going on after epoch 3" in said
    assert not (cut / "unfinished").exists()
    assert table(cut) == table(whole)
    assert table(cut, sweep.FINALS) == table(whole, sweep.FINALS)
    seconds = [float(row["wall_seconds"]) for row in csv.DictReader((cut / "results.csv").open())][:5]
    assert seconds == sorted(set(seconds))


def test_a_checkpoint_is_made_every_so_many_epochs_and_one_is_kept(tmp_path):
    found = []

    def look(chunk, progress):
        found.append([path.name for path in tmp_path.glob("unfinished/*/checkpoints/*")])

    run(tmp_path, grid(("future",), (0,), static=LONGER), checkpoint_every=2, on_epoch=look)
    assert found == [[], [], ["epoch-000002"], ["epoch-000002"], []]  # none when the results are written
    found.clear()
    run(tmp_path, grid(("future",), (1,), static=LONGER), on_epoch=look)
    assert found == [[]] * 5


def test_another_lane_s_sampler_is_its_own_when_fewer_are_left(tmp_path):
    """`closest` is the first of two samplers, and was the second of three when it was cut short."""
    cells = grid(("future", "closest", "weighted"), (0,), static=LONGER)
    ended = []

    def interrupt(chunk, progress):
        ended.append(progress.epoch)
        if len(ended) == 5 + 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "cut", cells, lanes=1, on_epoch=interrupt)
    assert [sweep.is_done(tmp_path / "cut", cell) for cell in cells] == [True, False, False]
    run(tmp_path / "cut", cells[1:], lanes=1, on_epoch=lambda chunk, progress: ended.append(progress.epoch))
    assert ended[8:] == [4, 5, 1, 2, 3, 4, 5]
    run(tmp_path / "whole", cells[1:2], lanes=1)
    ours, alone = table(tmp_path / "cut"), table(tmp_path / "whole")
    ours = [row for row in ours if row["sampler"] == "closest"]
    for a, b in zip(ours, alone, strict=True):
        assert {name: float(a[name]) for name in NUMBERS} == pytest.approx({name: float(b[name]) for name in NUMBERS}, rel=1e-2)


NUMBERS = ("actor_norm", "critic_norm", "q_mean", "relabel_distance")


@pytest.mark.parametrize("harm", ["damaged", "other lanes"])
def test_without_a_checkpoint_that_fits_runs_begin_anew(tmp_path, harm):
    cells, seen, said = grid(static=LONGER), [], []
    cut_short(tmp_path, cells, 2, lanes=4)
    if harm == "damaged":
        (manifest,) = tmp_path.glob("unfinished/*/checkpoints/*/manifest.json")
        manifest.write_text(manifest.read_text().replace('"epoch": 2', '"epoch": 1'))
    on_epoch = lambda chunk, progress: seen.append(progress.epoch)  # noqa: E731
    run(tmp_path, cells, lanes=4 if harm == "damaged" else 2, on_epoch=on_epoch, on_program=said.append)
    assert seen == [1, 2, 3, 4, 5] * (1 if harm == "damaged" else 2)
    assert any("manifest.json is not as it was written" in line for line in said) == (harm == "damaged")
    assert [len(cell["curve"]["epoch"]) for cell in sweep.read(tmp_path)] == [5] * 4
    assert not (tmp_path / "unfinished").exists()


def test_a_checkpoint_that_cannot_be_written_does_not_end_the_sweep(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    said = []
    run(tmp_path, grid(("future",), (0,), static=LONGER), checkpoint_every=2, on_program=said.append)
    assert sum("1.0 kB of the disk are free" in line for line in said) == 2
    assert len(sweep.read(tmp_path)) == 1


def test_the_tables_hold_every_epoch_and_every_setting(tmp_path):
    static = dataclasses.replace(CONFIG, total_steps=480)
    run(tmp_path, grid(("weighted",), (5,), (HParams(her_k=2.0), HParams(her_k=8.0)), static), lanes=2)
    rows = table(tmp_path, without=())
    assert [(row["her_k"], row["seed"], row["epoch"], row["env_steps"], row["updates"]) for row in rows] == [
        (k, "5", epoch, steps, updates)
        for k in ("2.0", "8.0")
        for epoch, steps, updates in (("1", "240", "24"), ("2", "480", "48"))
    ]
    names = ("env", "sampler", "engine", "lanes", "wall_seconds", "success_rate", "return_mean")
    assert {*HParams._fields, *names} <= set(rows[0])
    assert 0 < float(rows[0]["wall_seconds"]) < float(rows[1]["wall_seconds"])
    arrays = np.load(tmp_path / "results.npz")
    np.testing.assert_array_equal(arrays["success_rate"], [float(row["success_rate"]) for row in rows])
    assert arrays["epoch"].dtype.kind == "i"
    finals = table(tmp_path, sweep.FINALS)
    assert [row["episodes"] for row in finals] == ["15"] * 2
    assert all(len(row[name]) <= 8 for row in finals for name in ("success_rate", "reset_success_rate", "return_mean"))
    assert all(row["env_steps"] == "480" for row in finals)
    for cell in (tmp_path / sweep.CELLS).iterdir():
        learned = mjx_dher.load_policy(cell)
        assert learned({"observation": np.zeros(2), "achieved_goal": np.zeros(2), "desired_goal": np.zeros(2)}).shape == (2,)


def test_lanes_are_as_many_as_memory_holds_as_the_compiler_counts_it(tmp_path, monkeypatch):
    """Three rings alone would fit; three whole programs do not."""
    cells = grid(seeds=range(4))
    available = int(3.5 * trainer.make_train(PointMass(), CONFIG).replay_bytes)
    monkeypatch.setattr(memory, "available_bytes", lambda: available)
    told, sizes = [], []
    run(tmp_path, cells, lanes=8, on_program=told.append, on_epoch=lambda chunk, _: sizes.append(len(chunk)))
    assert "compiling for 3 runs side by side, of 8" in told[0]
    assert "compiling for 3 runs" not in told[2]
    assert sum(sizes) == 8
    assert max(sizes) < 3
    assert len(sweep.read(tmp_path)) == 8


def test_what_is_no_sweep_is_named(tmp_path):
    with pytest.raises(FolderError, match="holds no finished run of a sweep"):
        sweep.read(tmp_path)
    cells = grid(("future",), (0,))
    run(tmp_path, cells)
    cell = tmp_path / sweep.CELLS / cells[0].name
    for name, content, message in (
        ("metrics.csv", "epoch,success_rate\n", "is not a finished run of a sweep"),
        ("result.json", "{", "is not a finished run of a sweep"),
        ("config.json", json.dumps({"schema": 0}), "is not of this program's schema 1"),
    ):
        (cell / name).write_text(content)
        with pytest.raises(FolderError, match=message):
            sweep.read(tmp_path)
    (cell / "result.json").unlink()  # as if the write had been cut short
    assert not sweep.is_done(tmp_path, cells[0])


@pytest.fixture
def point_mass(monkeypatch):
    monkeypatch.setitem(envs._REGISTRY, "point_mass", lambda engine, **options: PointMass())


COMMAND = [
    *(
        "sweep",
        "--preset",
        "cpu",
        "--env",
        "point_mass",
        "--sampler",
        "future",
        "weighted",
        "--seeds",
        "2",
        "--final-episodes",
        "20",
    ),
    *("--num-envs", "8", "--cycles-per-epoch", "3", "--updates-per-cycle", "4", "--batch-size", "32", "--total-steps", "800"),
    *("--replay-size", "400", "--hidden-sizes", "16", "--eval-episodes", "20", "--lanes", "4", "--threshold", "0.2"),
]


def test_the_command_line_sweeps_and_goes_on_and_plots(tmp_path, point_mass, capsys):
    out = ["--out", str(tmp_path / "sweep")]
    assert cli.main([*COMMAND, *out]) == 0
    first = capsys.readouterr().out
    assert "4 runs; writing to" in first
    assert "100%  point_mass, 4 runs: epoch 4/4" in first
    assert cli.main([*COMMAND, *out, "--sweep.her-k", "4", "8"]) == 0
    # The preset's k is 16; two samplers, two numbers, two seeds are new.
    assert "8 runs; writing to" in capsys.readouterr().out
    assert cli.main([*COMMAND, *out]) == 0
    assert "4 runs; 4 of them are done already" in capsys.readouterr().out
    assert len(table(tmp_path / "sweep", sweep.FINALS)) == 12
    assert cli.main(["plot", str(tmp_path / "sweep"), "--out", str(tmp_path / "pictures"), "--threshold", "0.2"]) == 0
    written = {path.name: path.stat().st_size for path in (tmp_path / "pictures").iterdir()}
    names = [f"point_mass_{name}.{end}" for name in ("curves", "thresholds", "comparison") for end in ("png", "svg")]
    assert sorted(written) == sorted(names)
    assert min(written.values()) > 5000


def interrupting(monkeypatch, after, number):
    """The epochs that are shown; in the one after which `after` are, the signal comes."""
    show, seen = cli_sweep._Screen.show, []

    def interrupt(screen, cells, progress):
        seen.append(progress.epoch)
        if len(seen) == after:
            signal.raise_signal(number)
        show(screen, cells, progress)

    monkeypatch.setattr(cli_sweep._Screen, "show", interrupt)
    return seen


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_sweep_after_the_epoch_and_keeps_what_is_done(tmp_path, point_mass, monkeypatch, capsys, number):
    """In the first epoch of the second of two programs."""
    seen = interrupting(monkeypatch, 5, number)
    handler = signal.getsignal(number)
    command = [*COMMAND, "--lanes", "2", "--out", str(tmp_path)]
    assert cli.main(command) == 128 + number
    said = capsys.readouterr().out
    assert "stopping when this epoch has ended" in said
    assert "stopped; 2 runs are done, and the same command goes on with the other 2" in said
    assert seen == [1, 2, 3, 4, 1]
    assert signal.getsignal(number) == handler
    assert len(table(tmp_path, sweep.FINALS)) == 2
    assert cli.main(command) == 0
    assert seen[5:] == [2, 3, 4]
    said = capsys.readouterr().out
    assert "going on after epoch 1" in said
    assert "100%  point_mass, 2 runs: epoch 4/4" in said


@pytest.mark.parametrize(("lanes", "done", "status"), [(2, 2, 128 + signal.SIGINT), (4, 4, 0)])
def test_a_signal_in_the_last_epoch_loses_nothing(tmp_path, point_mass, monkeypatch, capsys, lanes, done, status):
    """Of the first of two programs, which has results by then, or of the only one, after which there is nothing to stop."""
    seen = interrupting(monkeypatch, 4, signal.SIGINT)
    assert cli.main([*COMMAND, "--lanes", str(lanes), "--out", str(tmp_path)]) == status
    assert seen == [1, 2, 3, 4]
    assert len(list(tmp_path.glob("cells/*/result.json"))) == done
    assert (tmp_path / sweep.FINALS).exists() == (status == 0)
    assert not (tmp_path / "unfinished").exists()
    assert ("the same command goes on with the other 2" in capsys.readouterr().out) == (done == 2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--env", "pusj"], "env must be one of .*; got 'pusj' .did you mean 'push'"),
        (["--sampler", "future", "weihgted"], "sampler must be one of .*did you mean 'weighted'"),
        (["--sampler"], "sampler must be one of"),
        (["--weight-kernel", "cubic"], "weight_kernel must be one of linear, inverse, softmax; got 'cubic'"),
        (["--metric", "speed"], "metric must be one of position; got 'speed'"),
        (["--preset", "tpu"], "preset must be one of"),
        (["--seeds", "0"], "seeds must be an integer of at least 1; got 0"),
        (["--first-seed", "-1"], "first_seed must be an integer of at least 0; got -1"),
        (["--checkpoint-every", "-1"], "checkpoint_every must be a number of epochs, or 0; got -1"),
        (["--share", "3/2"], "share must be N/M, 1 to M, such as 2/4; got '3/2'"),
        (["--share", "half"], "share must be N/M, 1 to M, such as 2/4; got 'half'"),
        (["--share", "1/9", "--seeds", "2", "--sampler", "future"], "share 1/9 is empty: there are 2 runs in all"),
        (["--lanes", "0"], "lanes must be an integer of at least 1; got 0"),
        (["--threshold", "2"], r"threshold must lie in \(0, 1\]; got 2"),
        (["--sweep.gamma", "0.9", "1.5"], r"gamma must lie in \[0, 1\); got 1.5"),
        (["--batch-size", "0"], "batch_size must be an integer of at least 1; got 0"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_written(tmp_path, arguments, said, capsys):
    assert cli.main(["sweep", "--out", str(tmp_path / "new"), *arguments]) == 2
    assert not (tmp_path / "new").exists()
    assert re.search(said, capsys.readouterr().err)


def test_a_folder_that_holds_something_else_is_refused(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("")
    assert cli.main(["sweep", "--out", str(tmp_path)]) == 2
    assert "holds something else than a sweep" in capsys.readouterr().err
    assert cli.main(["plot", str(tmp_path)]) == 2
    assert "holds no finished run" in capsys.readouterr().err
    assert cli.main(["plot", str(tmp_path), "--formats", "jpg"]) == 2
    assert "formats must be among png, svg, pdf; got jpg" in capsys.readouterr().err


OTHERS = ("--learner-dtype", "bfloat16", "--engine", "jax")


def test_every_number_and_every_shape_can_be_set():
    args, cells = cli_args("--sweep.her-k", "2", "4", "--num-envs", "4", "--hidden-sizes", "8", "8", "--seeds", "3", *OTHERS)
    assert {c.hparams.her_k for c in cells} == {2.0, 4.0}
    assert {c.config.num_envs for c in cells} == {4}
    assert {c.config.hidden_sizes for c in cells} == {(8, 8)}
    assert {(c.config.learner_dtype, c.config.engine) for c in cells} == {("bfloat16", "jax")}
    assert len(cells) == 4 * 2 * 3
    assert {*vars(args.sweep)} == set(HParams._fields)
    assert {*vars(args.changes)} == {f.name for f in dataclasses.fields(config.Config)} - {
        "env",
        "sampler",
        "weight_kernel",
        "metric",
    }


def cli_args(*argv):
    return cli_sweep.parse_sweep_args(["--out", "nowhere", "--preset", "cpu", *argv])
