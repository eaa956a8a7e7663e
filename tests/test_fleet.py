"""A fleet without Ray: how large tasks are, what is refused, own code, the screen."""

import dataclasses
import json
import re
from pathlib import Path

import pytest
from sweep_helpers import CONFIG, make_grid

import mjx_dher
from mjx_dher import Options, cli, lookup
from mjx_dher.cli import fleet
from mjx_dher.cli.fleet_options import FleetArgs, request_of
from mjx_dher.cli.fleet_screen import FleetScreen
from mjx_dher.fleet import chunks, driver, own_code, plan
from mjx_dher.fleet.chunks import Told
from mjx_dher.fleet.plan import Kind, Node, Request
from mjx_dher.spec import RunSpec
from mjx_dher.sweeps import grid

GPU, CPU = Kind("gpu", 1, 1), Kind("cpu", 0, 2)


@pytest.mark.parametrize(
    ("runs", "speeds", "most", "size"),
    [
        (40, [1.0] * 4, None, 10),  # each slot one task
        (40, [1.0] * 4, 8, 5),  # memory holds 8: two rounds of 5, not of 8 and 2
        (80, [2.0] * 4 + [1.0] * 4, None, 7),  # a slow slot takes 80 / 12 in the time in which a fast one takes two of them
        (3, [1.0] * 8, None, 1),
        (1, [1.0], 8, 1),
        (10, [1.0] * 3, None, 4),
        (10_000, [1.0] * 4, 8, 8),
    ],
)
def test_all_slots_have_work_until_the_end(runs, speeds, most, size):
    assert plan.chunk_size(runs, speeds, most) == size


def test_a_task_is_as_large_as_memory_allows():
    nodes = [node(gpu_bytes=80 << 30), node(gpu_bytes=24 << 30)]
    assert plan.lanes_that_fit(nodes, 1 << 30) == 12  # half of 24
    assert plan.lanes_that_fit(nodes, 100 << 30) == 1
    assert plan.lanes_that_fit([node()], 1 << 30) is None
    assert plan.most_of(GPU, Request("auto"), None, 12) == 12
    assert plan.most_of(GPU, Request("auto"), 5, 12) == 5
    assert plan.most_of(GPU, Request("auto"), None, None) is None
    assert plan.most_of(CPU, Request("auto"), None, None) == plan.TURNS
    assert plan.most_of(CPU, Request("auto"), 2, None) == 2 * plan.TURNS


def test_a_task_on_a_gpu_has_as_many_lanes_as_rings_fit(tmp_path):
    """Of a sweep that is trained with warp, on a machine that has no GPU; 30 runs on two GPUs, and memory for 6 rings."""
    push = mjx_dher.preset("gpu", "push", engine="warp")
    trials = grid.trials([push], range(30))
    ring = fleet._ring_bytes(push)
    assert ring > 4 * push.config.replay_size * 25  # observations of 25 float32 alone
    order = fleet.Order(Request("auto"), tmp_path, "warp", None, Options(), list, list)
    size = fleet._Sizes(order, [GPU], [node(gpu_bytes=2 * 6 * ring)], trials)
    assert size(GPU, trials[0]) == 5  # 15 for each, in three rounds
    limited = fleet._Sizes(dataclasses.replace(order, lanes=4), [GPU], [node()], trials)
    assert limited(GPU, trials[0]) == 4


def node(host="a", **changes):
    fields = {"versions": {"mjx_dher": "1", "files": "f", "jax": "1"}, "sources": {}, "hardware": "h", "gpu_bytes": None}
    return Node(host, host, **{**fields, "storage": None, "resources": {"CPU": 4.0, "GPU": 2.0}, **changes})


def test_what_tasks_take_is_what_nodes_have():
    mixed = [{"CPU": 8.0, "GPU": 2.0}, {"CPU": 4.0}, {"CPU": 0.0}]
    kinds = lambda engine="auto", nodes=mixed, **wishes: plan.kinds_of(Request("auto", **wishes), nodes, engine)  # noqa: E731
    assert kinds() == [Kind("gpu", 1, 1)]
    assert kinds(on="cpu") == [Kind("cpu", 0, 4)]
    assert kinds(cpus=2) == [Kind("cpu", 0, 2)]
    assert kinds(on="both", cpus=2, engine="native") == [Kind("gpu", 1, 1), Kind("cpu", 0, 2)]
    assert kinds(nodes=mixed[1:]) == [Kind("cpu", 0, 4)]
    assert [[kind.slots(own) for own in mixed] for kind in (GPU, CPU)] == [[2, 0, 0], [4, 2, 0]]
    with pytest.raises(ValueError, match=r"ray_on both: .*name one, --engine native or jax"):
        kinds(on="both")
    with pytest.raises(ValueError, match="no node of the cluster has a GPU for a task; its nodes have 4 CPUs, 0 GPUs"):
        kinds(on="gpu", nodes=mixed[1:2])
    with pytest.raises(ValueError, match=r"no node of the cluster has 9 CPUs \(ray_cpus\)"):
        kinds(on="cpu", cpus=9)
    with pytest.raises(ValueError, match="its nodes have nothing"):
        kinds(nodes=[])


def test_slower_nodes_count_for_less():
    assert plan.speeds([node(speed=2.0), node(speed=1.0, resources={"CPU": 2.0})], CPU) == [2.0, 2.0, 1.0]
    assert plan.describe([node()], [GPU, CPU]) == "1 node: 2 tasks at once with a GPU each, 2 tasks at once with 2 CPUs each"


def test_nodes_that_cannot_take_part_are_named():
    own = {"mjx_dher": "1", "files": "f", "jax": "1"}
    assert plan.problems([node(), node("b")], own, {}) == []
    told = plan.problems(
        [
            node("b", versions={**own, "mjx_dher": "2", "files": "g"}),
            node("c", versions={**own, "files": "g"}),
            node("d", storage="/x cannot be written to"),
            node("e", sources={"env m:E": "m.py 2"}),
            node("f"),
        ],
        own,
        {"env m:E": "m.py 1"},
    )
    assert [line for line in told if "where this machine" not in line] == [
        "ray: node b has mjx-dher 2, and this machine 1: install the same version on every node",
        "ray: node c has files of mjx-dher with the digest g, and this machine f: install the same version on every node",
        "storage: node d: /x cannot be written to",
    ]
    assert "env m:E: node e has m.py 2 where this machine has m.py 1" in told
    assert "env m:E: node f has no such module where this machine has m.py 1" in told
    assert plan.other_libraries([node(), node("b", versions={**own, "jax": "2"})], own) == [
        "jax is 1 here and 2 on other nodes"
    ]


WRONG = [
    (["--ray", ""], "ray must be local .*, auto .*, or HOST:PORT"),
    (["--ray", "nonsense"], "ray must be local .*; got 'nonsense'"),
    (["--ray", "ray://head:10001"], "ray must be local .*; got 'ray://head:10001'"),
    (["--ray", "head:0"], "ray must be local .*; got 'head:0'"),
    (["--ray", "head:99999999999999999999"], "ray must be local"),
    (["--ray", "local", "--ray-cpus", "0"], r"ray_cpus must lie in \[1, .*; got 0"),
    (["--ray", "local", "--ray-chunk", "-1"], r"ray_chunk must lie in \[1, .*; got -1"),
    (["--ray", "local", "--ray-chunk", "100000000000000000000"], "ray_chunk must lie in"),
    (["--ray", "local", "--ray-on", "gpu", "--ray-cpus", "2"], "ray_cpus is for tasks on CPUs"),
    (["--ray", "local", "--dry-run"], "dry_run does not go with --ray"),
    (["--ray", "local", "--storage", ""], "storage must be a folder, or begin with gs://"),
    (["--ray", "local", "--storage", "ftp://host/x"], "storage must be a folder, or begin with gs://"),
    (["--ray", "local", "--storage", "gs://"], "storage must name a bucket"),
    (["--ray", "local", "--storage", __file__], "storage: .*test_fleet.py is there already and is no folder"),
    (["--ray", "127.0.0.1:1"], "ray: nobody answers at 127.0.0.1:1 .*ray start --head"),
    (["--ray-cpus", "2"], "ray_cpus is for --ray local, auto or HOST:PORT, which is not given; got 2"),
    (["--storage", "/tmp/x"], "storage is for --ray"),
    (["--ray-on", "cpu"], "ray_on is for --ray"),
]


@pytest.mark.parametrize(("arguments", "said"), WRONG)
def test_wishes_that_cannot_be_met_are_refused_at_once(tmp_path, arguments, said, capsys):
    assert cli.main(["sweep", "--out", str(tmp_path / "new"), *arguments]) == 2
    assert not (tmp_path / "new").exists()
    assert re.search(said, capsys.readouterr().err)


def test_without_the_extra_the_refusal_names_it(monkeypatch):
    find = lookup.importlib.util.find_spec
    monkeypatch.setattr(lookup.importlib.util, "find_spec", lambda name: None if name == "ray" else find(name))
    with pytest.raises(ValueError, match=r'--ray needs ray, which the extra "ray" installs: pip install -e ".\[ray\]"'):
        request_of(FleetArgs(ray="local"))


def test_checkpoints_of_one_machine_are_kept_beside_its_sweep():
    assert plan.storage_of(Request("local"), Path("/s")) == "/s/unfinished"
    assert plan.storage_of(Request("auto"), Path("/s")) is None
    assert plan.storage_of(Request("auto", storage="gs://b/x"), Path("/s")) == "gs://b/x"
    assert plan.storage_of(Request("auto", storage="/a/../b"), Path("/s")) == "/b"


def test_own_code_lies_in_one_folder(tmp_path, monkeypatch):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"fleet_{name}.py").write_text("")
        monkeypatch.syspath_prepend(tmp_path / name)
    specs = [RunSpec(env="fleet_one:E"), RunSpec(env="fleet_one:E", seed=1), RunSpec()]
    assert own_code.folder_of(specs) == tmp_path / "one"
    assert own_code.folder_of([RunSpec(), RunSpec(sampler="numpy:add")]) is None  # installed
    assert len(own_code.with_own_parts(specs)) == 1
    with pytest.raises(ValueError, match=r"must lie in one folder.*env fleet_one:E in .*one; sampler fleet_two:s in .*two"):
        own_code.folder_of([*specs, RunSpec(sampler="fleet_two:s")])


def test_the_screen_shows_all_nodes(capsys):
    from rich.console import Console

    trials = make_grid(("future",), (0, 1, 2, 3))
    screen = FleetScreen(Console(width=200), trials)
    one = Told("c", "node1", "push", 2, 1, 2, CONFIG.total_steps * 1.0, 500.0, {"future": 0.25}, ())
    other = one._replace(chunk="d", host="node2", success={"future": 0.75})
    screen._printed -= 100
    screen.show(driver.State(1, 0, frozenset("cd"), 2, [one, other]))
    line = capsys.readouterr().out
    assert "75%  1 of 4 runs have ended; 2 of 2 tasks train on 2 hosts  1,000 steps/s  future 0.50  ETA not known yet" in line
    screen.show(driver.State(4, 0, frozenset(), 2, []))
    assert "100%  4 of 4 runs have ended" in capsys.readouterr().out
    table = screen._table("title")
    assert [*table.columns[0].cells] == ["node1", "node2"]
    screen.close()


def test_the_package_is_known_by_its_files():
    versions = chunks.versions()
    assert versions["mjx_dher"] == chunks.__version__
    assert re.fullmatch("[0-9a-f]{10}", versions["files"])
    assert json.dumps(versions)
