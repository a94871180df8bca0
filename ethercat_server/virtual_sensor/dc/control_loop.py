"""The time control loop of a distributed clock: it steers the local clock to a reference clock's system time.

Source: Beckhoff's ESC data sheets, registers 0x092C to 0x0935. What the speed counter does to the rate is
theirs; how the counter follows from the differences they do not say: a PI controller stands for it.
"""

from __future__ import annotations

import math
import struct
from typing import Final

from ethercat_server.virtual_sensor.dc.local_clock import RATE_SCALE, LocalClock
from ethercat_server.virtual_sensor.esc import registers as reg

_U16, _I16, _U32 = struct.Struct("<H"), struct.Struct("<h"), struct.Struct("<I")
_LOCAL_IS_NOT_LESS: Final = 1 << 31
_START, _DEPTH, _SPEED_DEPTH = 0x1000, 4, 12
"""Power-on values."""
_LOWEST_START, _HIGHEST_START = 0x80, 0x3FFF
_BELOW_START: Final = 0x7F
_DEEPEST: Final = 12
_TIME_CONSTANT_NS: Final = 100e6
"""With the power-on values."""
_FRAMES_PER_FILTER: Final = 4
"""The time constant is at least so many times what the filter of the differences takes."""
_LONGEST_NS: Final = 10**9


class ControlLoop:
    """Works on the registers in `memory`."""

    def __init__(self, memory: bytearray, local: LocalClock) -> None:
        self._memory = memory
        self._local = local
        _U16.pack_into(memory, reg.DC_SPEED_START, _START)
        memory[reg.DC_FILTERS : reg.DC_FILTERS + 2] = bytes((_DEPTH, _SPEED_DEPTH))
        self._mean = self._integral = 0.0
        self._count = 0
        self._latest: int | None = None

    def reset(self, now: int) -> None:
        """The master wrote the speed counter start: the filters begin again."""
        self._mean = self._integral = 0.0
        self._count, self._latest = 0, None
        _U32.pack_into(self._memory, reg.DC_DIFFERENCE, 0)
        _I16.pack_into(self._memory, reg.DC_SPEED_DIFFERENCE, 0)
        self._local.steer(now, 0)

    def compare(self, now: int, ahead: int) -> None:
        """The local copy of the system time was so many ns ahead of the one received."""
        memory = self._memory
        start = min(max(_U16.unpack_from(memory, reg.DC_SPEED_START)[0], _LOWEST_START), _HIGHEST_START)
        depth, speed_depth = (min(d, _DEEPEST) for d in memory[reg.DC_FILTERS : reg.DC_FILTERS + 2])
        self._count = min(self._count + 1, 1 << depth)
        self._mean += (ahead - self._mean) / self._count
        size = min(round(abs(self._mean)), _LOCAL_IS_NOT_LESS - 1)
        _U32.pack_into(memory, reg.DC_DIFFERENCE, size | (_LOCAL_IS_NOT_LESS if self._mean >= 0 else 0))
        if self._latest is not None:
            elapsed = min(now - self._latest, _LONGEST_NS)
            constant = max(
                _TIME_CONSTANT_NS * start / _START * 2 ** ((speed_depth - _SPEED_DEPTH) / 2),
                (_FRAMES_PER_FILTER << depth) * elapsed,
            )
            most = start - _BELOW_START
            fastest = _deviation(most, start)
            integral = self._integral - self._mean * elapsed / (2 * constant) ** 2
            self._integral = min(max(integral, -fastest), fastest)
            counter = _counter(self._integral - self._mean / constant, start)
            counter = min(max(counter, -most), most)
            _I16.pack_into(memory, reg.DC_SPEED_DIFFERENCE, counter)
            self._local.steer(now, round(_deviation(counter, start) * RATE_SCALE))
        self._latest = now


def _deviation(counter: int, start: int) -> float:
    """What this speed counter difference adds to the rate: 1 ns more in one 10 ns step of so many."""
    return counter / (5 * (start + counter + 2) * (start - counter + 2))


def _counter(rate: float, start: int) -> int:
    """The speed counter difference that adds `rate`."""
    if not rate:
        return 0
    return round((math.sqrt(1 + 100 * rate * rate * (start + 2) ** 2) - 1) / (10 * rate))
