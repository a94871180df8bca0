#!/usr/bin/env bash
# CPython's select.poll: a deadline that passed by a fraction of a millisecond makes poll wait for ever.
#
# One would guess: `poll((deadline - now) * 1000)` with -0.2 left returns at once, as threading.Event.wait does, or
# raises ValueError, as select.select does.
# What happens: the fraction is rounded away from zero to -1 ms, and poll(2) takes any negative number as "no time-out".
# A client that computes what is left of its time-out hangs, rarely, when the deadline falls between two lines. Where it
# is met: robots' clients whose host does not answer. Seen with CPython 3.11.7, Linux.
set -euo pipefail
python3 - <<'END'
import os, select, sys, threading, time

reading, writing = os.pipe()
poll = select.poll()
poll.register(reading, select.POLLIN)

def took(left_ms: float) -> float:
    """Seconds until it returns; what wakes it comes after half a second."""
    timer = threading.Timer(0.5, os.write, (writing, b"x"))
    timer.start()
    began = time.monotonic()
    woken = poll.poll(left_ms)
    seconds = time.monotonic() - began
    timer.join()
    os.read(reading, 1)
    return seconds if woken else 0.0

seen = {left_ms: took(left_ms) for left_ms in (0.0, -0.2)}
try:
    select.select([reading], [], [], -0.0002)
    of_select = "returns"
except ValueError as error:
    of_select = f"raises ValueError ({error})"
print(f"Python {sys.version.split()[0]}: poll(0.0) returns at once, poll(-0.2) when somebody writes,",
      f"{seen[-0.2]:.1f} s later; select {of_select}")
assert seen[0.0] == 0.0 and seen[-0.2] > 0.4, "the behavior has changed"
END
