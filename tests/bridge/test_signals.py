"""Stop signals: the first is a call, one right behind it is the same, a later one ends the process."""

from __future__ import annotations

import subprocess
import sys
import time

PROGRAM = """
import time
from bridge.signals import block_stop_signals, call_on_stop_signal
block_stop_signals()
call_on_stop_signal(lambda number: print("called", int(number), flush=True))
print("ready", flush=True)
time.sleep(30)
"""


def test_a_second_signal_counts_only_when_it_is_meant() -> None:
    command = [sys.executable, "-c", PROGRAM]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "ready\n"
        program.send_signal(2)
        assert program.stdout.readline() == "called 2\n"
        program.send_signal(2)
        time.sleep(0.3)
        assert program.poll() is None, "a terminal and a launcher may each send theirs"
        time.sleep(1)
        program.send_signal(15)
        assert program.wait(timeout=10) == 128 + 15
