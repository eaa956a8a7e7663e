import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mjx_dher.system import subprocesses


def ask(code, **options):
    return subprocesses.ask([sys.executable, "-S", "-c", code], **options)


def test_a_program_that_succeeds():
    answer = ask("import json, os; print('noise'); print(json.dumps(os.environ['MINE']))", variables={"MINE": "x"})
    assert (answer.out, answer.err, answer.failure) == ('noise\n"x"\n', "", None)
    assert answer.last_json() == "x"


@pytest.mark.parametrize(
    ("end", "err", "failure"),
    [
        ("sys.exit('no\\nluck')", "no\nluck\n", "exit status 1: luck"),
        ("os.kill(os.getpid(), 9)", "", "exit status -9: "),
        ("sys.stderr.buffer.write(b'\\xff'); sys.exit(3)", "\ufffd", "exit status 3: \ufffd"),
        ("time.sleep(60)", "", "did not end within 1 s"),
    ],
)
def test_the_output_before_a_failure_is_kept(end, err, failure):
    answer = ask(f"import os, sys, time; print(1, flush=True); {end}", seconds=1)
    assert answer == subprocesses.Answer("1\n", err, failure)


def test_a_program_that_does_not_exist():
    answer = subprocesses.ask(["/no/such/program"])
    assert "/no/such/program" in answer.failure


def test_a_program_is_killed_at_the_end_of_its_block():
    start = time.monotonic()
    with pytest.raises(RuntimeError), subprocesses.started([sys.executable, "-c", "import time; time.sleep(60)"]) as process:
        raise RuntimeError
    assert process.poll() is not None
    assert time.monotonic() - start < 30


CHILD = "import subprocess, sys, time; subprocess.Popen([sys.executable, '-S', '-c', 'import time; time.sleep(60)']); {then}"


@pytest.mark.parametrize("then", ["time.sleep(60)", "sys.exit()"])
def test_a_program_that_is_killed_leaves_no_programs_of_its_own(then):
    with subprocesses.started([sys.executable, "-S", "-c", CHILD.format(then=then)]) as process:
        group = process.pid
        time.sleep(0.3)
    ends = time.monotonic() + 10
    while any(_group_of(path) == group for path in Path("/proc").glob("[0-9]*")):
        assert time.monotonic() < ends
        time.sleep(0.05)


def _group_of(path):
    """Its process group, if it has not ended."""
    try:
        state, _, group = (path / "stat").read_text().rpartition(")")[2].split()[:3]
    except OSError:
        return None
    return int(group) if state != "Z" else None


def test_sessions_of_children_are_killed_whole():
    """As Ray's node, whose workers have groups of their own."""
    inner = "import os, time; os.setpgid(0, 0); time.sleep(60)"
    code = f"import subprocess, sys, time; print(subprocess.Popen([sys.executable, '-S', '-c', {inner!r}]).pid); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-S", "-u", "-c", code], stdout=subprocess.PIPE, start_new_session=True) as process:
        inner = Path("/proc", process.stdout.readline().decode().strip())
        subprocesses.kill_sessions()
        ends = time.monotonic() + 10
        while _group_of(inner) is not None:
            assert time.monotonic() < ends
            time.sleep(0.05)
        assert process.wait(10) == -signal.SIGKILL


def test_a_program_whose_output_nobody_reads_goes_on():
    """As the viewer beside a run, whose errors are of use only when it has ended."""
    code = "import sys; [print('x' * 1000, file=stream) for stream in (sys.stdout, sys.stderr) for _ in range(1000)]"
    with subprocesses.started([sys.executable, "-S", "-c", code]) as process:
        assert process.wait(30) == 0
        assert len(subprocesses.answer(process).err) == 1_001_000


def test_the_package_is_the_one_that_runs():
    """A child process finds it by this path, whatever is installed."""
    assert os.path.samefile(subprocesses.PACKAGE, os.path.dirname(sys.modules["mjx_dher"].__file__))
