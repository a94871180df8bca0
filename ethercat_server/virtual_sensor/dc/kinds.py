"""What a distributed clock is like, and what may be wrong with it: one table, for options and commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from ethercat_server.virtual_sensor.esc.controller import Esc

Limits = tuple[float, float]
_PPM: Final = (-100_000.0, 100_000.0)
_US: Final = (0.0, 1e6)
_SECONDS: Final = (0.0, 1e6)


class ClockWordError(ValueError):
    """No such word, or wrong values for it."""


@dataclass(frozen=True, slots=True)
class ClockWord:
    """One row of the table."""

    name: str
    values: str
    """Their names."""
    limits: tuple[Limits, ...]
    meaning: str
    apply: Callable[..., None]
    """Takes the controller and the values."""
    from_power_on: bool = False
    """Whether it cannot come about while the controller runs."""


def _ok(esc: Esc) -> None:
    now = esc.clock.settle()
    esc.clock.local.stop(now, False)
    esc.clock.stick_system_time(False)
    esc.clock.events.repair()


def _no_events(esc: Esc) -> None:
    esc.clock.events.take_away()


def _stuck(esc: Esc) -> None:
    esc.clock.settle()
    esc.clock.events.stuck = True


def _start(esc: Esc) -> None:
    esc.clock.events.shows_start = True


def _previous(esc: Esc) -> None:
    esc.clock.events.previous = True


def _late(esc: Esc, us: float) -> None:
    esc.clock.events.shift = round(us * 1000)


def _early(esc: Esc, us: float) -> None:
    _late(esc, -us)


def _jitter(esc: Esc, us: float) -> None:
    esc.clock.events.jitter = round(us * 1000)


def _time_stuck(esc: Esc) -> None:
    esc.clock.stick_system_time(True)


def _stopped(esc: Esc) -> None:
    esc.clock.local.stop(esc.clock.settle(), True)


def _jump(esc: Esc, ns: float) -> None:
    esc.clock.local.jump(esc.clock.settle(), round(ns))


def _at(esc: Esc, ns: float) -> None:
    now = esc.clock.settle()
    esc.clock.local.jump(now, round(ns) - esc.clock.local.at(now))


def _ppm(esc: Esc, ppm: float, seconds: float = 0.0) -> None:
    esc.clock.local.set_ppm(esc.clock.settle(), ppm, round(seconds * 1e9))


CLOCK_WORDS: Final = (
    ClockWord("ok", "", (), "nothing is wrong; rate and time stay", _ok),
    ClockWord("none", "", (), "no DC: no feature bit, registers read zero", Esc.take_dc_away, True),
    ClockWord("32-bit", "", (), "system and local time have 32 bits", Esc.narrow_dc, True),
    ClockWord("no-events", "", (), "no 0x09F0, 0x09F8, 0x09FC: they read zero", _no_events),
    ClockWord("stuck", "", (), "0x09FC stands still", _stuck),
    ClockWord("start", "", (), "0x09FC has the start of the write, as 0x09F8", _start),
    ClockWord("previous", "", (), "0x09F8 and 0x09FC lag by one sample", _previous),
    ClockWord("late", "US", (_US,), "0x09F8 and 0x09FC are too late by this", _late),
    ClockWord("early", "US", (_US,), "they are too early by this", _early),
    ClockWord("jitter", "US", (_US,), "they are off by up to this, at random", _jitter),
    ClockWord("time-stuck", "", (), "0x0910 stands still, event times do not", _time_stuck),
    ClockWord("stopped", "", (), "the local clock stands still", _stopped),
    ClockWord("jump", "NS", ((-(2.0**62), 2.0**62),), "the local clock jumps, once", _jump),
    ClockWord("at", "NS", ((0.0, 2.0**62),), "the local clock jumps to this time", _at),
    ClockWord("ppm", "X", (_PPM,), "rate of the local clock, without a jump of the time", _ppm),
    ClockWord("ramp", "X S", (_PPM, _SECONDS), "the same, linearly within S seconds", _ppm),
)

_BY_NAME: Final = {word.name: word for word in CLOCK_WORDS}


def parse_word(name: str, values: list[str], *, running: bool) -> Callable[[Esc], None]:
    """What one word does to a controller, one that is `running`; ClockWordError if it is wrong."""
    word = _BY_NAME.get(name.lower())
    if word is None or (running and word.from_power_on):
        known = ", ".join(w.name for w in CLOCK_WORDS if not (running and w.from_power_on))
        raise ClockWordError(f"no {name[:40]!r} of a distributed clock: available: {known}")
    if len(values) != len(word.limits):
        raise ClockWordError(f"{word.name} takes {word.values or 'no value'}")
    numbers = []
    for text, (lowest, highest) in zip(values, word.limits, strict=True):
        try:
            number = float(text)
        except ValueError:
            number = float("nan")
        if not lowest <= number <= highest:
            raise ClockWordError(f"{text!r} must be a number from {lowest:g} to {highest:g}")
        numbers.append(number)
    return lambda esc: word.apply(esc, *numbers)


def parse_clock(text: str) -> list[Callable[[Esc], None]]:
    """What an option such as `32-bit+late=50` does to a controller at power-on, in this order."""
    parsed = []
    for item in text.split("+") if text else ():
        name, _, values = item.partition("=")
        parsed.append(parse_word(name, values.split("/") if values else [], running=False))
    return parsed
