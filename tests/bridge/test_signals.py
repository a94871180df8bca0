"""Stop signals: the first is a call, one right behind it is the same, a later one ends the process."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys, types
from bridge import signals

def monotonic():
    seen = now  # the test sets it on as soon as it reads the line
    print("looked at the time", flush=True)
    return seen

now = 100.0
signals.time = types.SimpleNamespace(monotonic=monotonic)
signals.block_stop_signals()
signals.call_on_stop_signal(lambda number: print("called", int(number), flush=True))
print("ready", flush=True)
for line in sys.stdin:
    now = float(line)
    print("time passes", flush=True)
"""


def test_a_second_signal_counts_only_when_it_is_meant() -> None:
    """With a clock of its own, so that the machine may be busy."""
    command = [sys.executable, "-c", PROGRAM]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, bufsize=1) as program:
        assert program.stdin is not None
        assert program.stdout is not None

        def says(words: str) -> None:
            assert program.stdout is not None
            assert program.stdout.readline() == f"{words}\n"

        says("ready")
        program.send_signal(2)
        says("called 2")
        says("looked at the time")
        for number, now in ((2, 100.9), (15, 101.0)):  # a terminal and a launcher may each send theirs
            program.send_signal(number)
            says("looked at the time")
            program.stdin.write(f"{now}\n")
            says("time passes")
        program.send_signal(15)
        assert program.wait(timeout=30) == 128 + 15
