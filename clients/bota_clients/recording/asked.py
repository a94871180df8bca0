"""How a recording is read: a part of it, and what is in force where it does not say it."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

from bota_clients.arguments import add_imu_units, duration
from bota_ethercat.program.arguments import number, typed
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import SettingValue, parse_assignment, sampling_rate_hz
from bota_ethercat.text.json_text import JsonObject

if TYPE_CHECKING:  # command lines are read without the extra
    from bota_clients.recording.columns import Bools, Ints

_NO_TIME: Final = -(1 << 63)  # NaT
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


class Moment(NamedTuple):
    text: str  # as it was written
    ns: int  # since 1970, or since the start of a recording
    is_stamp: bool  # by CLOCK_REALTIME

    @classmethod
    def parse(cls, text: str) -> Self:
        """Of a duration, or of a time in ISO 8601, UTC if it does not say; ValueError."""
        with contextlib.suppress(ValueError):
            return cls(text, round(duration(text) * 1e9), is_stamp=False)
        at = datetime.fromisoformat(text)
        passed = (at if at.tzinfo else at.replace(tzinfo=UTC)) - _EPOCH
        return cls(text, passed // timedelta(microseconds=1) * 1000, is_stamp=True)


class Asked(NamedTuple):
    """The rows from `begin` on until before `end`, None: all; `rate_hz` 0: not given."""

    begin: Moment | None = None
    end: Moment | None = None
    rate_hz: float = 0.0
    settings: Mapping[str, SettingValue] = {}

    @classmethod
    def of(cls, options: argparse.Namespace) -> Self:
        """Of `add_reading`."""
        return cls(options.begin, options.end, options.rate, dict(options.assignments))

    @property
    def part(self) -> str:
        """In words; empty: it is everything."""
        ends = {"from": self.begin, "to": self.end}
        return " ".join(f"{word} {at.text}" for word, at in ends.items() if at)

    def holds(self, stamp_ns: Ints, passed_ns: Ints) -> Bools:
        """(n,) which rows are of the part, by CLOCK_REALTIME and by the time since the first."""
        times, found = (passed_ns, stamp_ns), passed_ns > _NO_TIME
        if self.begin:
            found &= times[self.begin.is_stamp] >= self.begin.ns
        if self.end:
            until = times[self.end.is_stamp]
            found &= (until > _NO_TIME) & (until < self.end.ns)
        return found

    def description(self, sensors: Iterable[int]) -> JsonObject:
        """A description with what is given of each of these; {} if nothing is."""
        if not self.rate_hz and not self.settings:
            return {}
        settings: dict[str, Any] = dict(self.settings)
        rate_hz = self.rate_hz or (sampling_rate_hz(n) if (n := settings.get("sinc_length")) else 0.0)
        row = {"settings": settings, "rate_hz": rate_hz, "delay_ms": delays_ms(settings, rate_hz)}
        return {"sensors": [{"sensor": sensor, **row} for sensor in sensors]}


class _Ends(argparse.Action):
    def __call__(
        self, parser: argparse.ArgumentParser, options: argparse.Namespace, at: Any, *_: object
    ) -> None:
        setattr(options, self.dest, at)
        begin, end = options.begin, options.end
        if begin and end and begin.is_stamp == end.is_stamp and begin.ns >= end.ns:
            parser.error(f"--from {begin.text} is not before --to {end.text}")


def add_reading(parser: argparse.ArgumentParser) -> None:
    """How a recording is read: its units, a part of it, what it does not say; see `Asked.of`."""
    add_imu_units(parser)
    add = parser.add_argument
    what = "seconds from the start (30, 5min), or a time (2026-11-29T12:00:05Z)"
    when: dict[str, Any] = {"action": _Ends, "type": typed(Moment.parse, what), "metavar": "TIME"}
    add("--from", dest="begin", help=f"from there on: {what}", **when)
    add("--to", dest="end", help="until before it", **when)
    add("--rate", type=number(1e-3, 1e6), default=0.0, metavar="HZ",
        help="the sampling rate, if another program has left it out of the recording")  # fmt: skip
    add("--set", type=typed(parse_assignment), action="append", default=[], metavar="NAME=VALUE",
        dest="assignments", help="as --rate a setting; sinc_length tells the rate; repeatable")  # fmt: skip
