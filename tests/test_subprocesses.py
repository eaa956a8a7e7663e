import os
import sys
import time

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


def test_a_program_whose_output_nobody_reads_goes_on():
    """As the viewer beside a run, whose errors are of use only when it has ended."""
    code = "import sys; [print('x' * 1000, file=stream) for stream in (sys.stdout, sys.stderr) for _ in range(1000)]"
    with subprocesses.started([sys.executable, "-S", "-c", code]) as process:
        assert process.wait(30) == 0
        assert len(subprocesses.answer(process).err) == 1_001_000


def test_the_package_is_the_one_that_runs():
    """A child process finds it by this path, whatever is installed."""
    assert os.path.samefile(subprocesses.PACKAGE, os.path.dirname(sys.modules["mjx_dher"].__file__))
