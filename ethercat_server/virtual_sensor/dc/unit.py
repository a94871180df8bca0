"""The distributed clock of a controller: the times at which frames arrive, and the system time.

Sources: ETG.1000.4 and Beckhoff's ESC data sheets, registers 0x0900 to 0x0935 and 0x09F0 to 0x09FF. There are
no SYNC and LATCH signals.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final

from ethercat_server.virtual_sensor.dc.control_loop import ControlLoop
from ethercat_server.virtual_sensor.dc.events import EventTimes
from ethercat_server.virtual_sensor.dc.local_clock import LocalClock
from ethercat_server.virtual_sensor.esc import registers as reg

HOP_NS: Final = 700
"""From slave to slave, cable included."""
_U64 = 2**64 - 1
_U32 = 2**32 - 1
_offset_and_delay = struct.Struct("<QI").unpack_from
_DC_OFFSET: Final = reg.DC_OFFSET
_TIME = struct.Struct("<Q")


class DistributedClock:
    """A view of the controller's clock registers. `clock` gives the time in ns.

    Attributes:
        way_ns: a frame's way from the first slave to it.
        behind_ns: a frame's way through the slaves behind it and back.
        frame_start: when the frame that is being processed reached the first slave.
        time_mask: the bits of the system time that it has.
    """

    def __init__(self, memory: bytearray, clock: Callable[[], int]) -> None:
        self._memory = memory
        self._clock = clock
        self.way_ns = self.behind_ns = 0
        self.frame_start = clock()
        self.time_mask = _U64
        self.local = LocalClock(self.frame_start)
        self.loop = ControlLoop(memory, self.local)
        self.events = EventTimes(memory, self.local)
        self._stuck_at: int | None = None

    def place(self, before: int, behind: int) -> None:
        """Tell it how many slaves are before and behind it."""
        self.way_ns, self.behind_ns = before * HOP_NS, 2 * behind * HOP_NS

    @property
    def _arrival(self) -> int:
        """When the frame that is being processed reached this slave."""
        return self.frame_start + self.way_ns

    def _system(self) -> int:
        """The system time when this frame passed the reference clock, as this clock has it."""
        offset, delay = _offset_and_delay(self._memory, _DC_OFFSET)
        arrival = self.frame_start + self.way_ns  # in line: it is read in every frame
        return int(self.local.at(arrival) + offset - delay) & self.time_mask

    def latch(self) -> None:
        """The master wrote to the receive times: keep when its frame came, and came back."""
        out = self.local.at(self._arrival)
        back = self.local.at(self._arrival + self.behind_ns) if self.behind_ns else 0
        struct.pack_into("<II", self._memory, reg.DC_RECEIVE_TIMES, out & _U32, back & _U32)
        _TIME.pack_into(self._memory, reg.DC_RECEIVE_TIME, out & self.time_mask)

    def compare(self) -> None:
        """The master wrote the system time of another clock: follow it."""
        (written,) = struct.unpack_from("<I", self._memory, reg.DC_SYSTEM_TIME)
        ahead = (self._system() - written + 2**31) % 2**32 - 2**31
        self.settle()
        self.loop.compare(self._clock(), ahead)

    def reset_loop(self) -> None:
        """The master wrote the speed counter start."""
        self.settle()
        self.loop.reset(self._clock())

    def show_system_time(self) -> None:
        """The system time is about to be read."""
        shown = self._system() if self._stuck_at is None else self._stuck_at
        _TIME.pack_into(self._memory, reg.DC_SYSTEM_TIME, shown)

    def show_events(self) -> None:
        """The event times are about to be read."""
        self.events.update(self._clock() + self.way_ns)

    def exchanged(self) -> None:
        """This frame has exchanged a buffer whose sync manager latches that."""
        self.events.exchanged(self._arrival)

    def settle(self) -> int:
        """Something is about to change: keep what has happened. Returns the time."""
        now = self._clock()
        self.events.update(now)
        return now

    def stick_system_time(self, stuck: bool) -> None:
        """Let the system time stand still in its register, or end that."""
        self._stuck_at = self._system() if stuck else None
