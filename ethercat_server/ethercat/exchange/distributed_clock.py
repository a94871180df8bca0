"""Distributed clocks of the sensors' slave controllers, and what an exchange reads of them.

Source: ETG.1000.4 and the data sheets of slave controllers. The local time counts ns from power-on; the
system time is that and an offset, less a delay, which masters that synchronize slaves have written. Events
are latched in local time, for the sync managers that are asked to; nothing else is written here, and only to
sensors.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from ethercat_server.ethercat.datagrams import Datagrams
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import BYTE_NS, COUNTER_SIZE, DATAGRAM_HEADER, Command

_U64_U32: Final = struct.Struct("<QI")
_PORTS: Final = struct.Struct("<4I")
# Bit of the DL status that says whether port 0 has a link.
_LINKS: Final = 4
_MOST_BEHIND_NS: Final = 1_000_000
_WRAP: Final = 1 << 32
_TIME_SIZE: Final = 4
_SLACK_NS: Final = 10_000
# One lost frame is no reason to do without event times; many would hold up the loop.
_ATTEMPTS: Final = 3

# System time when the frame arrived, a working counter; local time of the event PDI buffer change, a working
# counter. Both times are modulo 2**32 ns.
Latched = tuple[int, int, int, int]
LATCHED: Final = struct.Struct(f"<IH{DATAGRAM_HEADER}xIH")
# Bytes in a frame, of two datagrams.
LATCHED_SIZE: Final = DATAGRAM_HEADER + LATCHED.size


class DistributedClock(NamedTuple):
    """Of one slave controller."""

    offset: int
    """System time less local time, modulo 2**32 ns."""
    behind_ns: int
    """Time from when a frame arrives at the slave until it is there again on its way back."""
    reading_ns: int
    """Time from when a frame arrives until it has read what is latched, at most."""


def latched_datagrams(station: int) -> tuple[tuple[int, int, int, bytes], ...]:
    """The datagrams that read `Latched`, for `wire.build`."""
    return (
        (Command.FPRD, station, reg.DC_SYSTEM_TIME, bytes(_TIME_SIZE)),
        (Command.FPRD, station, reg.DC_PDI_CHANGE_EVENT, bytes(_TIME_SIZE)),
    )


def switch_latched(frame: bytearray, at: int, *, reads: bool) -> None:
    """Have a frame read what is latched, to be found at `at`, or not (NOP)."""
    for data in (at, at + LATCHED.size - COUNTER_SIZE - _TIME_SIZE):
        frame[data - DATAGRAM_HEADER] = Command.FPRD if reads else Command.NOP


def read_clock(bus: Datagrams, number: int, at: int) -> DistributedClock | None:
    """What another master has left in a sensor's controller; None if it does not answer.

    `at` is where frames read what is latched.
    """
    tries = (bus.read_register(number, reg.DC_OFFSET, _U64_U32.size) for _ in range(_ATTEMPTS))
    if (data := next(filter(None, tries), None)) is None:
        return None
    offset, delay = _U64_U32.unpack(data)
    return DistributedClock((offset - delay) % _WRAP, _behind_ns(bus, number), at * BYTE_NS + _SLACK_NS)


def _behind_ns(bus: Datagrams, number: int) -> int:
    """A write to the receive times has the controller note when a frame arrives at each of its ports."""
    if not bus.write_register(number, reg.DC_RECEIVE_TIMES, bytes(4)):
        return 0
    data = bus.read_register(number, reg.DC_RECEIVE_TIMES, _PORTS.size)
    links = bus.read_register(number, reg.DL_STATUS, 2)
    if data is None or links is None:
        return 0
    status = int.from_bytes(links, "little")
    out, *back = _PORTS.unpack(data)
    times = [(time - out) % _WRAP for port, time in enumerate(back, 1) if status >> _LINKS + port & 1]
    return max((time for time in times if time < _MOST_BEHIND_NS), default=0)
