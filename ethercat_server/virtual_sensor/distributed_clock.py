"""The distributed clock (DC) of a slave controller, and what may be wrong with it.

Local clock, system time and its control loop, event times: registers 0x0900 to 0x0935 and 0x09F0 to 0x09FF of
ETG.1000.4 and of Beckhoff's ESC data sheets. There are no SYNC and LATCH signals. All times are in ns.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Final

from bota_ethercat.program.arguments import number
from ethercat_server.virtual_sensor import registers as reg
from ethercat_server.virtual_sensor.options import Command, UsageError

RATE_SCALE: Final = 10**12  # rates are in parts of this
HOP_NS: Final = 700  # from slave to slave, cable included
WRITE_NS: Final = 12_000  # of a sample by the firmware: about what 61 bytes take over SPI at 40 MHz
_U64 = 2**64 - 1
_MASK: Final = 2**32 - 1
_U16, _I16, _U32, _TIME = (struct.Struct(f"<{code}") for code in "HhIQ")
_offset_and_delay = struct.Struct("<QI").unpack_from
_DC_OFFSET: Final = reg.DC_OFFSET


class LocalClock:
    """The local clock: ns since power-on, of a crystal of its own that may be steered.

    It tells local time at any instant of the machine's clock since the latest change. Whatever changes, the
    time goes on from what it is, but for `set`; rounding errors do not accumulate.
    """

    def __init__(self, now: int) -> None:
        self._anchor = now
        self._local = 0  # at the anchor, times the scale
        self._rate = 0  # deviation of the crystal, and what steers it
        self._steered = 0

    def at(self, instant: int) -> int:
        """Local time at an instant."""
        return self._scaled(instant) // RATE_SCALE

    def _scaled(self, instant: int) -> int:
        return self._local + (instant - self._anchor) * (RATE_SCALE + self._rate)

    def _go_on_from(self, now: int) -> None:
        self._local, self._anchor = self._scaled(now), now

    def set_ppm(self, now: int, ppm: float) -> None:
        """Set the error of its crystal, positive for a fast one."""
        self._go_on_from(now)
        self._rate = round(ppm * 1e6) + self._steered

    def steer(self, now: int, rate: int) -> None:
        """Run at this rate in addition to the crystal's."""
        self._go_on_from(now)
        self._rate += rate - self._steered
        self._steered = rate

    def set(self, now: int, ns: int) -> None:
        """Set local time."""
        self._anchor, self._local = now, ns * RATE_SCALE


_LOCAL_IS_NOT_LESS: Final = 1 << 31
_SPEED_START, _DEPTH, _SPEED_DEPTH = 0x1000, 4, 12  # power-on values
_LOWEST_START, _HIGHEST_START, _BELOW_START = 0x80, 0x3FFF, 0x7F
_DEEPEST: Final = 12
_TIME_CONSTANT_NS: Final = 100e6  # with the power-on values
_FRAMES_PER_FILTER: Final = 4  # the time constant is at least this many times that of the differences' filter
_LONGEST_NS: Final = 10**9


def _deviation(counter: int, start: int) -> float:
    """What this speed counter difference adds to the rate: 1 ns more in one 10 ns step of so many."""
    return counter / (5 * (start + counter + 2) * (start - counter + 2))


def _counter(rate: float, start: int) -> int:
    """The speed counter difference that adds `rate`."""
    if not rate:
        return 0
    return round((math.sqrt(1 + 100 * rate * rate * (start + 2) ** 2) - 1) / (10 * rate))


class EventTimes:
    """When frames and firmware exchanged the buffers of sync managers, in local time.

    Those of the inputs are computed from the instants of the samples when somebody looks, or something
    changes. The firmware's accesses to mailboxes are left out.
    """

    def __init__(self, memory: bytearray, local: LocalClock) -> None:
        self._memory = memory
        self._local = local
        self._newest_at: Callable[[int], int] | None = None
        self._since: int | None = None
        self._begun = self._completed = -1
        self._any_shown = False
        self.none = False  # there are no such registers
        self.repair()

    def repair(self) -> None:
        """End all that is wrong with the times of writes."""
        self.stuck = False  # no further end of a write is shown
        self.shift = 0  # added to the times of writes

    def take_away(self) -> None:
        """Be a controller without these registers."""
        self.none = True
        self._memory[reg.DC_ECAT_EVENT : reg.DC_END] = bytes(reg.DC_END - reg.DC_ECAT_EVENT)

    def follow(self, newest_at: Callable[[int], int], end_of: Callable[[int], int]) -> None:
        """Show the firmware's writes of inputs.

        They are numbered: the newest that is complete at an instant, and when one is complete.
        """
        self._newest_at, self._end_of = newest_at, end_of

    def latch(self, wanted: bool, now: int) -> None:
        """Latch the writes from now on, or no longer."""
        if wanted != (self._since is not None):
            self.update(now)
            self._since = now if wanted else None

    def update(self, now: int, *, starts: bool = True) -> None:
        """Latch the ends of writes up to now, and their starts."""
        newest_at, since = self._newest_at, self._since
        if since is None or newest_at is None or self.none:
            return
        number = newest_at(now)
        if number != self._completed and not (self.stuck and self._any_shown):
            self._completed = number
            end = self._end_of(number)
            if end >= since:
                self._any_shown = True
                self._show(reg.DC_PDI_CHANGE_EVENT, end)
        if starts and (begun := newest_at(now + WRITE_NS)) != self._begun:
            self._begun = begun
            start = self._end_of(begun) - WRITE_NS
            if start >= since:
                self._show(reg.DC_PDI_START_EVENT, start)

    def _show(self, register: int, instant: int) -> None:
        _U32.pack_into(self._memory, register, self._local.at(instant) + self.shift & _MASK)

    def taken(self, now: int, *registers: int) -> None:
        """Show this time, of a frame that exchanged a buffer or of the firmware that has read the outputs."""
        for register in registers if not self.none else ():
            _U32.pack_into(self._memory, register, self._local.at(now) & _MASK)


class DistributedClock:
    """A view of the controller's clock registers. `clock` gives the time in ns."""

    def __init__(self, memory: bytearray, write_mask: bytearray, clock: Callable[[], int]) -> None:
        self._memory, self._write_mask = memory, write_mask
        self._clock = clock
        self.present = True  # the controller has a distributed clock
        self.way_ns = 0  # a frame's way from the first slave to it
        self.behind_ns = 0  # a frame's way through the slaves behind it and back
        self.frame_start = clock()  # when the frame that is being processed reached the first slave
        self.time_mask = _U64  # the bits of the system time that it has
        self.local = LocalClock(self.frame_start)
        _U16.pack_into(memory, reg.DC_SPEED_START, _SPEED_START)
        memory[reg.DC_FILTERS : reg.DC_FILTERS + 2] = bytes((_DEPTH, _SPEED_DEPTH))
        self._reset_loop()
        self.events = EventTimes(memory, self.local)

    def take_away(self) -> None:
        """Be a controller without a distributed clock."""
        self.present = False
        self.events.take_away()
        self._miss(reg.DC_AVAILABLE | reg.DC_64_BIT, range(reg.DC_RECEIVE_TIMES, reg.DC_END))

    def narrow(self) -> None:
        """Be a distributed clock of 32 bits."""
        self.time_mask = _MASK
        for time in (reg.DC_SYSTEM_TIME, reg.DC_RECEIVE_TIME, reg.DC_OFFSET):
            self._miss(reg.DC_64_BIT, range(time + 4, time + 8))

    def _miss(self, feature: int, registers: range) -> None:
        self._memory[reg.FEATURES] &= ~feature
        for memory in (self._memory, self._write_mask):
            memory[registers.start : registers.stop] = bytes(len(registers))

    def system_time(self) -> int:
        """The system time when this frame passed the reference clock, as this clock has it."""
        offset, delay = _offset_and_delay(self._memory, _DC_OFFSET)
        return int(self.local.at(self.frame_start + self.way_ns) + offset - delay) & self.time_mask

    def latch(self) -> None:
        """The master wrote to the receive times: keep when its frame came, and came back."""
        arrival = self.frame_start + self.way_ns
        out = self.local.at(arrival)
        back = self.local.at(arrival + self.behind_ns) if self.behind_ns else 0
        struct.pack_into("<II", self._memory, reg.DC_RECEIVE_TIMES, out & _MASK, back & _MASK)
        _TIME.pack_into(self._memory, reg.DC_RECEIVE_TIME, out & self.time_mask)

    def _reset_loop(self) -> None:
        self._mean = self._integral = 0.0
        self._count = 0
        self._latest: int | None = None

    def reset(self) -> None:
        """The master wrote the speed counter start: the filters of the control loop begin again."""
        self._reset_loop()
        _U32.pack_into(self._memory, reg.DC_DIFFERENCE, 0)
        _I16.pack_into(self._memory, reg.DC_SPEED_DIFFERENCE, 0)
        self.local.steer(self.settle(), 0)

    def compare(self) -> None:
        """The master wrote the system time of another clock: steer the local clock to it.

        What the speed counter does to the rate is the data sheets'; how the counter follows from the
        differences they do not say: a PI controller stands for it.
        """
        now, (written,) = self.settle(), _U32.unpack_from(self._memory, reg.DC_SYSTEM_TIME)
        ahead = (self.system_time() - written + 2**31) % 2**32 - 2**31
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
                _TIME_CONSTANT_NS * start / _SPEED_START * 2 ** ((speed_depth - _SPEED_DEPTH) / 2),
                (_FRAMES_PER_FILTER << depth) * elapsed,
            )
            most = start - _BELOW_START
            fastest = _deviation(most, start)
            integral = self._integral - self._mean * elapsed / (2 * constant) ** 2
            self._integral = min(max(integral, -fastest), fastest)
            counter = _counter(self._integral - self._mean / constant, start)
            counter = min(max(counter, -most), most)
            _I16.pack_into(memory, reg.DC_SPEED_DIFFERENCE, counter)
            self.local.steer(now, round(_deviation(counter, start) * RATE_SCALE))
        self._latest = now

    def show_system_time(self) -> None:
        """The system time is about to be read."""
        _TIME.pack_into(self._memory, reg.DC_SYSTEM_TIME, self.system_time())

    def settle(self) -> int:
        """Something is about to change: keep what has happened. Returns the time."""
        now = self._clock()
        self.events.update(now)
        return now


CLOCK_WORDS: Final = (
    Command("ok", "nothing is wrong; rate and time stay", lambda c, _: c.events.repair()),
    Command("none", "no DC: no feature bit, registers read zero", lambda c, _: c.take_away()),
    Command("32-bit", "system and local time have 32 bits", lambda c, _: c.narrow()),
    Command("no-events", "no 0x09F0, 0x09F8, 0x09FC: they read zero", lambda c, _: c.events.take_away()),
    Command("stuck", "0x09FC stands still", lambda c, _: setattr(c.events, "stuck", True)),
    Command("late US", "0x09F8 and 0x09FC are too late by this, too early if negative",
            lambda c, _, us: setattr(c.events, "shift", round(us * 1000)), (number(-1e6, 1e6),)),
    Command("at NS", "the local clock jumps to this time",
            lambda c, now, ns: c.local.set(now, round(ns)), (number(0, 2.0**62),)),
    Command("ppm X", "rate of the local clock, without a jump of the time",
            lambda c, now, ppm: c.local.set_ppm(now, ppm), (number(-100_000, 100_000),)),
)  # fmt: skip
_FROM_POWER_ON: Final = ("none", "32-bit")  # which cannot come about while the controller runs


def parse_word(name: str, values: Sequence[str], *, running: bool) -> Callable[[DistributedClock], None]:
    """What one word does to a clock, one that is `running`; UsageError if it is wrong."""
    known = {word.name: word for word in CLOCK_WORDS if not (running and word.name in _FROM_POWER_ON)}
    word = known.get(name.lower())
    if word is None:
        raise UsageError(f"no {name[:40]!r} of a distributed clock: available: {', '.join(known)}")
    numbers = word.parse(values)
    return lambda clock: word.run(clock, clock.settle(), *numbers)


def parse_clock(text: str) -> list[Callable[[DistributedClock], None]]:
    """What an option such as `32-bit+late=50` does to a clock at power-on, in this order."""
    parsed = []
    for item in text.split("+") if text else ():
        name, _, values = item.partition("=")
        parsed.append(parse_word(name, values.split("/") if values else [], running=False))
    return parsed
