"""A simulated machine: its clock, how late it wakes, when it stalls, and what it does to frames on the wire.

Everything is drawn from one seed, so a run can be repeated to the nanosecond.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Final

START_NS: Final = 3_600 * 10**9
REALTIME_START_NS: Final = 1_767_225_600 * 10**9  # 2026-01-01 00:00:00 UTC
# Time that passes when a program asks for the time: programs take time, and no loop is endless.
_CALL_NS: Final = 150


@dataclass(frozen=True, slots=True)
class Machine:
    """What the machine and its wire do to a program. Times in ns, chances per frame from 0 to 1."""

    seed: int = 0
    wake_ns: float = 15_000.0  # mean lateness of a wake-up; exponentially distributed
    # Mean time between two moments in which the machine runs something else; 0 for never.
    stall_every_s: float = 0.0
    stall_ns: float = 0.0  # how long each takes
    frame_ns: float = 40_000.0  # round trip of a frame at least
    frame_jitter_ns: float = 10_000.0  # mean of what comes on top; exponentially distributed
    even_jitter_ns: float = 0.0  # up to so much comes on top, too; evenly distributed
    lost: float = 0.0  # chance that a frame does not come back
    late: float = 0.0  # chance that a frame comes back `late_ns` later; the next may overtake it
    late_ns: float = 2_000_000.0
    slew: float = 0.0  # CLOCK_MONOTONIC runs by so much of its rate faster than CLOCK_MONOTONIC_RAW


class SimulatedClock:
    """Time that passes only when somebody waits; see `ethercat.clock.Clock`. `now_ns` is the raw one."""

    def __init__(self, machine: Machine, start_ns: int = START_NS) -> None:
        self.now_ns = start_ns
        self._machine = machine
        self._chance = random.Random(machine.seed)
        self._ahead_ns = REALTIME_START_NS - start_ns
        self._agenda: list[tuple[int, int, Callable[[], object]]] = []
        self._order = count()
        self._stall_at_ns = self._next_stall()
        # Since when CLOCK_MONOTONIC has been slewed by how much, and how far it was ahead then.
        self._slews = [(0, machine.slew, -machine.slew * start_ns)]

    def raw_ns(self) -> int:
        self.now_ns += _CALL_NS
        return self.now_ns

    def monotonic_ns(self) -> int:
        return self.monotonic_at(self.raw_ns())

    def monotonic_at(self, raw_ns: int) -> int:
        since_ns, slew, ahead_ns = next(row for row in reversed(self._slews) if row[0] <= raw_ns)
        return raw_ns + round(ahead_ns + slew * (raw_ns - since_ns))

    def time_ns(self) -> int:
        return self.monotonic_at(self.now_ns) + self._ahead_ns

    def sleep(self, seconds: float) -> None:
        self.wake_at(self.after(seconds))

    def after(self, seconds: float) -> int:
        """When this time has passed, as the kernel waits: by CLOCK_MONOTONIC."""
        return self.now_ns + round(seconds * 1e9 / (1 + self._machine.slew))

    def wake_at(self, due_ns: int) -> None:
        """Wait until `due_ns`, as late as this machine wakes."""
        self.advance(max(due_ns, self.now_ns) + round(self._chance.expovariate(1) * self._machine.wake_ns))
        if self.now_ns >= self._stall_at_ns:
            self.stall(self._machine.stall_ns)
            self._stall_at_ns = self._next_stall()

    def stall(self, duration_ns: float) -> None:
        self.advance(self.now_ns + round(duration_ns))

    def become(self, machine: Machine) -> None:
        self._machine = machine
        self._stall_at_ns = self._next_stall()
        ahead_ns = self.monotonic_at(self.now_ns) - self.now_ns
        self._slews.append((self.now_ns, machine.slew, ahead_ns))

    def set_realtime_back(self, seconds: float) -> None:
        self._ahead_ns -= round(seconds * 1e9)

    def at(self, due_ns: int, action: Callable[[], object]) -> None:
        """Have `action` called when the clock reaches `due_ns`."""
        heapq.heappush(self._agenda, (due_ns, next(self._order), action))

    def advance(self, now_ns: int) -> None:
        """Let time pass until `now_ns`, with what is due on the way."""
        while self._agenda and self._agenda[0][0] <= now_ns:
            due_ns, _, action = heapq.heappop(self._agenda)
            self.now_ns = max(self.now_ns, due_ns)
            action()
        self.now_ns = max(self.now_ns, now_ns)

    def _next_stall(self) -> float:
        every_s = self._machine.stall_every_s
        return self.now_ns + self._chance.expovariate(1 / every_s) * 1e9 if every_s else float("inf")
