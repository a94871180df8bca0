"""The distributed clock (DC) of a slave controller, and what may be wrong with it.

Local clock, system time, event times: registers 0x0900 to 0x092B and 0x09FC of ETG.1000.4 and of Beckhoff's
ESC data sheets. No master steers it, and there are no SYNC and LATCH signals. All times are in ns.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from bota_ethercat.option_types import choice
from bota_ethercat.program.arguments import number, of_type
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.virtual_sensor.fault import PPM_LIMIT, Fault

RATE_SCALE: Final = 10**12  # rates are in parts of this
HOP_NS: Final = 700  # from slave to slave, cable included
_U64 = 2**64 - 1
_MASK: Final = 2**32 - 1
_U32, _TIME = struct.Struct("<I"), struct.Struct("<Q")
_offset_and_delay = struct.Struct("<QI").unpack_from
_DC_OFFSET: Final = reg.DC_OFFSET


class CrystalClock:
    """The local clock: ns since power-on, by a crystal of its own, at any instant since its latest change.

    Whatever changes, the time goes on from what it is, but for `set`; rounding errors do not accumulate.
    """

    def __init__(self, now: int) -> None:
        self._anchor = now
        self._local = 0  # at the anchor, times the scale
        self._rate = 0  # deviation of the crystal

    def at(self, instant: int) -> int:
        return self._scaled(instant) // RATE_SCALE

    def _scaled(self, instant: int) -> int:
        return self._local + (instant - self._anchor) * (RATE_SCALE + self._rate)

    def set_ppm(self, now: int, ppm: float) -> None:
        self._local, self._anchor, self._rate = self._scaled(now), now, round(ppm * 1e6)

    def set(self, now: int, ns: int) -> None:
        self._anchor, self._local = now, ns * RATE_SCALE


class InputEvents:
    """When the firmware wrote the inputs, in local time.

    Computed from the instants of the samples when a master reads it, or something changes.
    """

    def __init__(self, memory: bytearray, local: CrystalClock) -> None:
        self._memory = memory
        self._local = local
        self._newest_at: Callable[[int], int] | None = None
        self._since: int | None = None
        self._shown = -1
        self.none = False  # there is no such register
        self.repair()

    def repair(self) -> None:
        """End all that is wrong with the times."""
        self.stuck = False  # no further one is shown
        self.shift = 0  # added to them

    def remove(self) -> None:
        """Be a controller without this register."""
        self.none = True
        _U32.pack_into(self._memory, reg.DC_PDI_CHANGE_EVENT, 0)

    def follow(self, newest_at: Callable[[int], int], end_of: Callable[[int], int]) -> None:
        """Show writes, by number: which is the newest complete one at an instant, and when one is."""
        self._newest_at, self._end_of = newest_at, end_of

    def latch(self, wanted: bool, now: int) -> None:
        if wanted != (self._since is not None):
            self.update(now)
            self._since = now if wanted else None

    def update(self, now: int) -> None:
        if self._since is None or self._newest_at is None or self.none or (self.stuck and self._shown >= 0):
            return
        number = self._newest_at(now)
        if number != self._shown and (end := self._end_of(number)) >= self._since:
            self._shown = number
            time = self._local.at(end) + self.shift & _MASK
            _U32.pack_into(self._memory, reg.DC_PDI_CHANGE_EVENT, time)


class DcUnit:
    """A view of the controller's clock registers. `clock` gives the time in ns."""

    def __init__(self, memory: bytearray, write_mask: bytearray, clock: Callable[[], int]) -> None:
        self._memory, self._write_mask = memory, write_mask
        self._clock = clock
        self.present = True  # the controller has a distributed clock
        self.propagation_delay_ns = 0  # from the first slave to this one
        self.loop_delay_ns = 0  # through the slaves behind this one and back
        self.frame_start = clock()  # when the frame that is being processed reached the first slave
        self.time_mask = _U64  # the bits of the system time that it has
        self.local = CrystalClock(self.frame_start)
        self.events = InputEvents(memory, self.local)

    def remove(self) -> None:
        """Be a controller without a distributed clock."""
        self.present = False
        self.events.remove()
        self._remove(reg.DC_AVAILABLE | reg.DC_64_BIT, range(reg.DC_RECEIVE_TIMES, reg.DC_END))

    def narrow(self) -> None:
        self.time_mask = _MASK
        for time in (reg.DC_SYSTEM_TIME, reg.DC_RECEIVE_TIME, reg.DC_OFFSET):
            self._remove(reg.DC_64_BIT, range(time + 4, time + 8))

    def _remove(self, feature: int, registers: range) -> None:
        self._memory[reg.FEATURES] &= ~feature
        for memory in (self._memory, self._write_mask):
            memory[registers.start : registers.stop] = bytes(len(registers))

    def latch(self) -> None:
        """The master wrote to the receive times: keep when its frame came, and came back."""
        arrival = self.frame_start + self.propagation_delay_ns
        out = self.local.at(arrival)
        back = self.local.at(arrival + self.loop_delay_ns) if self.loop_delay_ns else 0
        struct.pack_into("<II", self._memory, reg.DC_RECEIVE_TIMES, out & _MASK, back & _MASK)
        _TIME.pack_into(self._memory, reg.DC_RECEIVE_TIME, out & self.time_mask)

    def show_system_time(self) -> None:
        """About to be read: the time when this frame passed the reference clock, as this clock has it."""
        offset, delay = _offset_and_delay(self._memory, _DC_OFFSET)
        time = (
            int(self.local.at(self.frame_start + self.propagation_delay_ns) + offset - delay) & self.time_mask
        )
        _TIME.pack_into(self._memory, reg.DC_SYSTEM_TIME, time)

    def settle(self) -> int:
        """Something is about to change: keep what has happened. Returns the time."""
        now = self._clock()
        self.events.update(now)
        return now

    def apply(self, word: Fault, numbers: Sequence[float]) -> None:
        """Do what a word of `CLOCK_WORDS` says."""
        word.effect(self, self.settle(), *numbers)


# Their effects get the clock, the time, numbers.
CLOCK_WORDS: Final = (
    Fault("ok", "end all faults; rate and time stay as they are", lambda c, _: c.events.repair()),
    Fault("none", "no distributed clock: no feature bit, its registers read zero", lambda c, _: c.remove()),
    Fault("32-bit", "system and local time have 32 bits", lambda c, _: c.narrow()),
    Fault("no-events", "no 0x09FC: it reads zero", lambda c, _: c.events.remove()),
    Fault("stuck", "0x09FC stands still", lambda c, _: setattr(c.events, "stuck", True)),
    Fault("late US", "0x09FC is late by this; negative is early",
          lambda c, _, us: setattr(c.events, "shift", round(us * 1000)), (number(-1e6, 1e6),)),
    Fault("at NS", "the local clock jumps to this time",
          lambda c, now, ns: c.local.set(now, round(ns)), (number(0, 2.0**62),)),
    Fault("ppm X", "rate of the local clock, without a jump of the time",
          lambda c, now, ppm: c.local.set_ppm(now, ppm), (number(-PPM_LIMIT, PPM_LIMIT),)),
)  # fmt: skip
_FROM_POWER_ON: Final = ("none", "32-bit")  # which cannot come about while the controller runs


def parse_clock_word(name: str, values: Sequence[str], *, running: bool) -> tuple[Fault, list[Any]]:
    """One of `CLOCK_WORDS`, for a clock that is `running`, and its numbers; UsageError if it is wrong."""
    known = {word.name: word for word in CLOCK_WORDS if not (running and word.name in _FROM_POWER_ON)}
    word = known[of_type(choice(*known))(name.lower())]
    return word, word.parse(values)


def parse_clock(text: str) -> Iterator[tuple[Fault, list[Any]]]:
    """Words and numbers of an option such as `32-bit+late=50`, for power-on; UsageError if one is wrong."""
    for item in text.split("+") if text else ():
        name, _, values = item.partition("=")
        yield parse_clock_word(name, values.split("/") if values else [], running=False)
