"""Signals while something trains, in a program of its own."""

import signal
import subprocess
import sys

import pytest
from conftest import ROOT

PROGRAM = """
import signal, sys
from pathlib import Path
from rich.console import Console
from mjx_dher.runs.signals import Stop
before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
stop = Stop(Console(), Path("runs/here"))
with stop:
    print(stop.asked)
    for number in {signals}:
        signal.raise_signal(number)
        print(int(stop.asked))
print([signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before)
"""


def program(*signals):
    code = PROGRAM.format(signals=[int(number) for number in signals])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    return done.returncode, done.stdout


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks(number):
    status, said = program(number)
    assert status == 0
    assert said.split("\n")[0] == "None"
    assert "stopping when this epoch has ended, with a checkpoint" in said
    assert said.endswith(f"{number:d}\nTrue\n")


def test_the_second_one_ends_the_program_at_once():
    status, said = program(signal.SIGINT, signal.SIGTERM)
    assert status == 128 + signal.SIGTERM
    assert said.endswith(f"{signal.SIGINT:d}\nstopped at once; what was saved is in runs/here\n")
