"""Signals, in programs of their own."""

import signal
import subprocess
import sys
import time

import pytest
from conftest import ROOT

# The file is loaded alone: a program that imports nothing else starts in a tenth of the time.
PROGRAM = """
import importlib.util, os, signal, sys, time
spec = importlib.util.spec_from_file_location("signals", "mjx_dher/system/signals.py")
signals = importlib.util.module_from_spec(spec)
spec.loader.exec_module(signals)
said = []
send = signal.raise_signal
NUMBERS = signals.NUMBERS
"""
NUMBERS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def program(code, *prefix):
    """Exit status, output and errors of a program, and its seconds."""
    command = [*prefix, sys.executable, "-S", "-u", "-c", PROGRAM + code]
    started = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False)
    return done.returncode, done.stdout, done.stderr, time.monotonic() - started


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize(
    "busy",
    [
        "time.sleep(60)",
        # C code, which lets no handler of Python's run; the mask keeps the signal from ending the call.
        "signal.pthread_sigmask(signal.SIG_BLOCK, NUMBERS); __import__('ctypes').CDLL(None).sleep(60)",
        "while True: pass",
    ],
)
def test_a_signal_ends_a_program_that_is_not_held_at_once(number, busy):
    code = f"signals.take()\nimport threading\nthreading.Timer(0.1, os.kill, [os.getpid(), {number:d}]).start()\n{busy}"
    status, out, err, seconds = program(code)
    assert (status, out, err) == (128 + number, "", "stopped\n")
    assert seconds < 10


@pytest.mark.parametrize("number", NUMBERS)
def test_a_signal_while_the_interpreter_ends_does_not_replace_the_status(number):
    """A module's objects are freed late, after the interpreter has restored the signals' defaults."""
    code = f"""
class Late:
    def __del__(self, kill=os.kill, pid=os.getpid()):
        kill(pid, {number:d})
late = Late()
signals.take()
sys.exit(3)
"""
    status, _, err, _ = program(code)
    assert (status, err) == (3, "")


def test_an_exception_of_a_library_and_its_handler_change_nothing():
    """As Ray has a handler for SIGTERM that raises SystemExit."""
    code = """
signals.take()
signal.signal(signal.SIGTERM, lambda *_: sys.exit(15))
signals.take_back()
try:
    send(signal.SIGTERM)
    time.sleep(60)
except BaseException as error:
    print(error)
"""
    assert program(code)[:3] == (143, "", "stopped\n")


def test_a_handler_in_c_of_a_library_is_replaced():
    """As Ray's, which prints where each thread is and aborts."""
    code = """
import ctypes
signals.take()
libc = ctypes.CDLL(None)
libc.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
libc.signal(signal.SIGTERM, ctypes.cast(libc.abort, ctypes.c_void_p))
time.sleep(0.4)
send(signal.SIGTERM)
time.sleep(60)
"""
    assert program(code)[:3] == (143, "", "stopped\n")


@pytest.mark.parametrize("number", NUMBERS)
def test_a_held_block_is_asked_once_by_signals_within_half_a_second(number):
    code = f"""
with signals.taken():
    with signals.held(said.append, "runs/here"):
        print(signals.asked())
        for _ in range(2):
            send({number:d})
        print(signals.asked(), len(said))
    print(signals.asked())
print(signals.asked(), [signal.getsignal(number) for number in NUMBERS] == before)
"""
    code = f"before = [signal.getsignal(number) for number in NUMBERS]{code}"
    assert program(code)[:3] == (0, f"None\n{number:d} 1\n{number:d}\nNone True\n", "")


def test_a_second_signal_later_ends_a_held_block_and_cleans():
    code = """
signals.take()
with signals.held(said.append, "runs/here"), signals.cleaning(lambda: print("cleaned")):
    send(signal.SIGINT)
    time.sleep(0.7)
    send(signal.SIGTERM)
    time.sleep(60)
"""
    assert program(code)[:3] == (143, "cleaned\n", "stopped at once; saved work is in runs/here\n")


@pytest.mark.parametrize("block", ["signals.held(said.append, 'here', 0.5)", "signals.cleaning(list)"])
def test_what_hangs_after_a_signal_ends_within_ten_seconds(block):
    code = f"""
signals.take()
signals._signals.blocks[0].patience = 0.5
with signals.held(said.append, "there"):
    send(signal.SIGTERM)
    signals.asked()
with {block}:
    time.sleep(60)
"""
    status, _, err, seconds = program(code)
    assert status == 143
    assert err.startswith("stopped")
    assert err.count("\n") == 1
    assert seconds < 10


@pytest.mark.parametrize("block", ["signals.held(print, 'here')", "signals.cleaning(list)"])
def test_a_full_pipe_does_not_keep_a_program(block):
    """Nobody reads what it prints. A held block waits for the second signal."""
    code = f"""
import threading
signals.take()
for seconds in (0.2, 0.9):
    threading.Timer(seconds, os.kill, [os.getpid(), {signal.SIGTERM:d}]).start()
with {block}:
    print("x" * 1_000_000)
"""
    with subprocess.Popen([sys.executable, "-S", "-c", PROGRAM + code], cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.wait(20) == 143


def test_programs_that_a_library_has_started_end_silently():
    """As glfw does when it is imported; one that would complain that nobody reads."""
    code = """
import subprocess
signals.take()
inner = "import time; time.sleep(0.5); print(1, flush=True)"
with subprocess.Popen([sys.executable, "-S", "-c", inner], stdout=subprocess.PIPE):
    send(signal.SIGTERM)
    time.sleep(60)
"""
    assert program(code)[:3] == (143, "", "stopped\n")


def test_nohup_keeps_a_program(tmp_path):
    code = "signals.take(); send(signal.SIGHUP); time.sleep(0.2); print('here')"
    assert program(code, "nohup")[:2] == (0, "here\n")


def test_a_forked_child_has_the_handlers_of_before():
    """Its signals are not its parent's."""
    code = """
signals.take()
child = os.fork()
if child == 0:
    time.sleep(60)
os.kill(child, signal.SIGTERM)
print(os.WTERMSIG(os.waitpid(child, 0)[1]))
time.sleep(0.2)
print("here")
"""
    assert program(code)[:2] == (0, "15\nhere\n")
