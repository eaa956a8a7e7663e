"""Several processes that train together: who they are, how they find each other, and what happens when one is gone."""

import contextlib
import socket
import threading
import time

import numpy as np
import pytest
from conftest import free_port

from mjx_dher.cli import main
from mjx_dher.cli.processes import Hosts, first_node
from mjx_dher.parallel import processes
from mjx_dher.system import line

JAX = {"JAX_COORDINATOR_ADDRESS": "gpu1:8000", "JAX_NUM_PROCESSES": "4", "JAX_PROCESS_ID": "3"}
SLURM = {
    "SLURM_JOB_ID": "4242",
    "SLURM_STEP_NODELIST": "gpu[007-009,12],cpu3",
    "SLURM_STEP_NUM_TASKS": "4",
    "SLURM_PROCID": "2",
}


def test_the_place_comes_of_options_of_variables_or_of_slurm():
    assert Hosts().place({}) is None
    assert Hosts("a:1", 2, 0).place({}) == ("a:1", 2, 0)
    assert Hosts().place(JAX) == ("gpu1:8000", 4, 3)
    assert Hosts(process_id=0).place(JAX) == ("gpu1:8000", 4, 0)
    assert Hosts("slurm").place(SLURM) == ("gpu007:61586", 4, 2)  # 61440 + 4242 - 4096
    assert Hosts("slurm").place(SLURM | {"SLURM_STEP_NUM_TASKS": "1", "SLURM_PROCID": "0"}) is None
    assert Hosts("[::1]:99", 2, 1).place({}) == ("[::1]:99", 2, 1)


@pytest.mark.parametrize(
    ("nodes", "first"),
    [("gpu1", "gpu1"), ("gpu[3,5]", "gpu3"), ("gpu[003-005]", "gpu003"), ("a1,b[2-3]", "a1"), ("n-0-[10-12]", "n-0-10")],
)
def test_the_first_of_slurm_s_nodes(nodes, first):
    assert first_node(nodes) == first


@pytest.mark.parametrize(
    ("hosts", "variables", "match"),
    [
        (Hosts("a:1"), {}, "several processes need num_processes .*process_id .*, too: only coordinator is given"),
        (Hosts(process_id=1), {}, "several processes need coordinator"),
        (Hosts("nowhere", 2, 0), {}, r"coordinator must be HOST:PORT, with a port in \[1, 65535\], or slurm; got 'nowhere'"),
        (Hosts("a:0", 2, 0), {}, "coordinator must be"),
        (Hosts("a:99999999999999999999", 2, 0), {}, "coordinator must be"),
        (Hosts(":80", 2, 0), {}, "coordinator must be"),
        (Hosts("", 2, 0), {}, "coordinator must be"),
        (Hosts("a:1", 1, 0), {}, r"num_processes must lie in \[2, 10000\]; got 1"),
        (Hosts("a:1", 10**20, 0), {}, "num_processes must lie in"),
        (Hosts("a:1", 2, 2), {}, r"process_id must lie in \[0, 1\]; got 2"),
        (Hosts("a:1", 2, -1), {}, "process_id must"),
        (Hosts(), JAX | {"JAX_NUM_PROCESSES": "nan"}, "num_processes must be an integer"),
        (Hosts("slurm"), {}, "coordinator slurm needs the variables that srun sets; there is no SLURM_JOB_ID, SLURM_STEP"),
        (Hosts("slurm"), SLURM | {"SLURM_STEP_NODELIST": "["}, "SLURM_STEP_NODELIST must be a list of nodes"),
    ],
)
def test_a_place_that_cannot_be_is_refused(hosts, variables, match):
    with pytest.raises(ValueError, match=match):
        hosts.place(variables)


def test_the_command_line_names_what_is_wrong(tmp_path, capsys):
    """Before JAX is started, and with status 2."""
    out = ["--out", str(tmp_path / "run")]
    assert main(["train", "--coordinator", "a:1", *out]) == 2
    assert "several processes need num_processes" in capsys.readouterr().err
    assert main(["train", "--coordinator", "a:1", "--num-processes", "2", "--process-id", "0"]) == 2
    assert "out: several processes need the name of the run folder" in capsys.readouterr().err
    assert main(["train", "--devices", "0", *out]) == 2
    assert "devices must be an integer in [1, 1000000], or all; got 0" in capsys.readouterr().err
    assert main(["sweep", "--coordinator", "x", "--num-processes", "2", "--process-id", "0", *out]) == 2
    assert "coordinator must be HOST:PORT" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_an_address_at_which_nobody_answers_is_refused():
    port = free_port()
    with pytest.raises(
        ValueError, match=f"coordinator: nobody answers at 127.0.0.1:{port} .*for 0.5 s; it must be the address"
    ):
        processes.connect(f"127.0.0.1:{port}", 2, 1, {}, wait=0.5)
    with pytest.raises(ValueError, match=r"coordinator: there is no host 'no-such-host\.invalid'"):
        processes.connect("no-such-host.invalid:80", 2, 1, {}, wait=0.5)
    with pytest.raises(ValueError, match=r"num_processes is 3, and of these processes 1, 2 did not come within 0\.3 s"):
        processes.connect(f"127.0.0.1:{port}", 3, 0, {}, wait=0.3)


def test_a_port_that_is_taken_is_refused():
    with socket.create_server(("", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"coordinator: process 0 cannot listen at port {port}"):
            processes.connect(f"127.0.0.1:{port}", 2, 0, {}, wait=0.3)


@contextlib.contextmanager
def started(monkeypatch, *others, described=None, size=2):
    """Processes that connect, as threads, without JAX: yields the teams, or errors, the first process's first."""
    monkeypatch.setattr(processes, "_start_jax", lambda *arguments: None)
    address, results = f"127.0.0.1:{free_port()}", {}

    def connect(place, *arguments):
        try:
            results[place] = processes.connect(address, *arguments, wait=5.0)
        except ValueError as error:
            results[place] = str(error)

    first = (0, size, 0, described or {})
    threads = [threading.Thread(target=connect, args=a) for a in (first, *((n, *o) for n, o in enumerate(others, 1)))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    teams = [results[place] for place in sorted(results)]
    yield teams
    for made in teams:
        if isinstance(made, processes.Team):
            made.close()


@pytest.mark.parametrize(
    ("other", "match"),
    [
        (
            (2, 1, {"version": "0.1", "gamma": 0.98}),
            "all processes must be started alike: version is '0.2' in process 0, and",
        ),
        ((2, 1, {"version": "0.2", "gamma": 0.9}), "gamma is 0.98 in process 0, and 0.9 in process 1"),
        ((2, 1, {"version": "0.2"}), "gamma is 0.98 in process 0, and None in process 1"),
        ((3, 1, {"version": "0.2", "gamma": 0.98}), "num_processes must be the same in all: it is 2 in process 0, and 3 in"),
        (
            (2, 7, {"version": "0.2", "gamma": 0.98}),
            "process_id must be a different one of 0 to 1 in each process; 7 is",
        ),
    ],
)
def test_processes_that_are_not_alike_are_refused_in_all(monkeypatch, other, match):
    with started(monkeypatch, other, described={"version": "0.2", "gamma": 0.98}) as results:
        assert [match in str(result) for result in results] == [True, True], results


def in_all(teams, function):
    """What `function` of each team gives, all called at once."""
    results = {}
    threads = [threading.Thread(target=lambda t=t: results.update({t.number: function(t)})) for t in teams]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    return [results[t.number] for t in teams]


def test_what_the_first_process_decides_holds_in_all(monkeypatch):
    monkeypatch.setattr(line, "PIECE", 7)  # an array of 48 bytes is sent in seven calls
    with started(monkeypatch, (3, 1, {}), (3, 2, {}), size=3) as teams:
        assert [(t.number, t.leads) for t in teams] == [(0, True), (1, False), (2, False)]
        assert in_all(teams, lambda t: t.share(lambda: {"a": [1, "x"]})) == [{"a": [1, "x"]}] * 3
        assert in_all(teams, lambda t: t.any(t.number == 2)) == [True] * 3
        assert in_all(teams, lambda t: t.any(False)) == [False] * 3
        arrays = [np.arange(6.0).reshape(2, 3), np.zeros((0, 2), np.int32), np.array(True)]
        for shared in in_all(teams, lambda t: t.share_arrays(arrays if t.leads else None)):
            for array, expected in zip(shared, arrays):
                np.testing.assert_array_equal(array, expected)
                assert array.dtype == expected.dtype

        assert in_all(teams, lambda t: t.agree("lanes", 4)) == [None] * 3

        def differ(t):
            try:
                t.agree("lanes", 4 - t.number)
            except ValueError as error:
                return str(error)

        assert all(text.startswith("lanes: the first process has 4, this one") for text in in_all(teams, differ))

        def fails():
            raise ValueError("no")

        def attempt(t):
            try:
                return t.share(fails)
            except ValueError as error:
                return str(error)

        assert in_all(teams, attempt) == ["no", "process 0: no", "process 0: no"]


def test_one_alone_asks_nobody():
    assert processes.ALONE.share(lambda: 3) == 3
    assert processes.ALONE.any(True)
    assert not processes.ALONE.any(False)
    assert processes.ALONE.fetch([np.ones(1)])[0] == 1.0


@pytest.mark.parametrize("how", ["closed", "silent", "told"])
def test_who_is_gone_ends_the_others(monkeypatch, how):
    ended = []
    monkeypatch.setattr(line.Line, "_end", lambda self, what: ended.append((self.greeting["number"], what)))
    monkeypatch.setattr(line, "GRACE", 0.1)
    monkeypatch.setattr(line, "SILENCE", 1.0)
    monkeypatch.setattr(line, "BEAT", 100.0 if how == "silent" else 0.2)
    with started(monkeypatch, (2, 1, {})) as (first, second):
        if how == "closed":
            second.lines[0]._closed = True
            second.lines[0]._socket.shutdown(socket.SHUT_RDWR)
        elif how == "told":
            second.close("the disk is full")
        deadline = time.monotonic() + 10
        while not ended and time.monotonic() < deadline:
            time.sleep(0.05)
        number, what = ended[0]
        assert number == 1 or how == "silent"
        assert {
            "closed": "is gone (the line is closed)",
            "silent": "is gone (timed out)",
            "told": "has ended: the disk is full",
        }[how] in what
        assert first.size == 2


def test_who_calls_by_mistake_is_left_out(monkeypatch):
    """Somebody who speaks another language does not keep the others from meeting."""
    monkeypatch.setattr(processes, "_start_jax", lambda *arguments: None)
    port, results = free_port(), []
    first = threading.Thread(target=lambda: results.append(processes.connect(f"127.0.0.1:{port}", 2, 0, {}, wait=10.0)))
    first.start()
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=5) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n" * 10)
            break
    second = processes.connect(f"127.0.0.1:{port}", 2, 1, {}, wait=5.0)
    first.join(10)
    assert results[0].size == 2
    second.close()
    results[0].close()
