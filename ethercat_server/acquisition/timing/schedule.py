"""When the next exchange is due: each sensor has a clock of its own, an exchange reads all of them.

Polls that lie close together are merged: the earlier one waits for the later, by no more than the time that
four exchanges cost this machine, as measured. So three quarters of its time are left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming

_COST_GAIN: Final = 1 / 64
_FIRST_COST_NS: Final = 50_000.0
_BUDGET: Final = 1 / 4
"""Part of the time that exchanges may take."""
_LARGEST_WAIT: Final = 0.3
"""What a poll may wait for another, in shortest sample periods."""
_LONGEST_LEAD_NS: Final = 200_000.0
"""By how much polls are brought forward at most because this machine wakes late."""


class Schedule:
    """Of the streams of one bus."""

    def __init__(self, streams: Sequence[SensorStream], timing: ExchangeTiming) -> None:
        self._streams = streams
        self._timing = timing
        self._cost_ns = _FIRST_COST_NS
        self._spacing_ns = 0.0
        self.shortest_ns = 0.0
        """The shortest sample period; it changes with the rates."""
        self.one_by_one = True
        """Whether the answer to an exchange is usually back before the next one is due."""
        self.roll()

    def next_ns(self) -> float:
        """When the next exchange is due."""
        streams = self._streams
        if len(streams) == 1:
            due_ns = streams[0].clock.next_poll_ns()
        else:
            wanted = [stream.clock.next_poll_ns() for stream in streams]
            due_ns = min(wanted)
            latest_ns = due_ns + self._spacing_ns
            due_ns = max([each for each in wanted if each <= latest_ns])
        timing = self._timing
        due_ns -= timing.late_ns if timing.late_ns < _LONGEST_LEAD_NS else _LONGEST_LEAD_NS
        earliest_ns = timing.sent_ns + self._spacing_ns
        return due_ns if due_ns > earliest_ns else earliest_ns

    def cost(self, busy_ns: int) -> None:
        """An exchange has kept the loop busy for so long."""
        self._cost_ns += _COST_GAIN * (busy_ns - self._cost_ns)

    def roll(self) -> None:
        """Once a second."""
        self.shortest_ns = min(stream.clock.period_ns for stream in self._streams)
        self._spacing_ns = min(self._cost_ns / _BUDGET, _LARGEST_WAIT * self.shortest_ns)
        self.one_by_one = all(stream.clock.one_by_one for stream in self._streams)
