"""Distributed clock of a controller: the times at which frames arrive, and the system time.

Source: ETG.1000.4, registers 0x0900 to 0x092F. All local clocks have the same rate, so nothing is controlled;
there are no SYNC signals.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final

from ethercat_server.virtual_sensor.esc import registers as reg

HOP_NS: Final = 700
"""From slave to slave, cable included."""
_U64 = 2**64 - 1
_OFFSET_AND_DELAY = struct.Struct("<QI")
_TIME = struct.Struct("<Q")
_LOCAL_IS_GREATER = 1 << 31


class DistributedClock:
    """A view of the controller's clock registers. `clock` gives the time in ns."""

    def __init__(self, memory: bytearray, clock: Callable[[], int]) -> None:
        self._memory = memory
        self._clock = clock
        self._started = clock()
        self.before = self.behind = 0
        """Slaves before and behind it."""

    def _local(self) -> int:
        return self._clock() - self._started + self.before * HOP_NS

    def _system(self) -> int:
        offset, delay = _OFFSET_AND_DELAY.unpack_from(self._memory, reg.DC_OFFSET)
        return (self._local() + int(offset) + int(delay)) & _U64

    def latch(self) -> None:
        """The master wrote to the receive times: keep when its frame came, and came back."""
        out = self._local()
        back = out + 2 * self.behind * HOP_NS if self.behind else 0
        struct.pack_into("<II", self._memory, reg.DC_RECEIVE_TIMES, out & 0xFFFFFFFF, back & 0xFFFFFFFF)
        _TIME.pack_into(self._memory, reg.DC_RECEIVE_TIME, out & _U64)

    def compare(self) -> None:
        """The master wrote the system time of another clock: keep the difference."""
        (written,) = struct.unpack_from("<I", self._memory, reg.DC_SYSTEM_TIME)
        ahead = (self._system() - written + 2**31) % 2**32 - 2**31
        sign = _LOCAL_IS_GREATER if ahead > 0 else 0
        struct.pack_into("<I", self._memory, reg.DC_DIFFERENCE, sign | min(abs(ahead), _LOCAL_IS_GREATER - 1))

    def show(self) -> None:
        """The system time is about to be read."""
        _TIME.pack_into(self._memory, reg.DC_SYSTEM_TIME, self._system())
