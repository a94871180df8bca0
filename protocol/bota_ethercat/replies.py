# SPDX-License-Identifier: Apache-2.0
"""What replies to `describe` and `status` say, decoded and checked once: the rows that every program uses.

The server is not trusted: a value that is missing, or of another type than its field, is the field's "not
known", as are all fields of a row that is no object. `SensorInfo` and `Description` are in the C++ header,
too.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

from bota_ethercat.control import known_six
from bota_ethercat.sensor_choice import MAX_SENSORS
from bota_ethercat.settings import SettingValue, known_settings
from bota_ethercat.text.untrusted import mapping, number, rows, text, whole

MAX_DELAY_MS: Final = 1000  # a longer delay is no filter's
_MAX_HZ: Final = 1e6  # a higher rate is no sensor's
Six = tuple[float, ...]  # a wrench, N and Nm
Row = TypeVar("Row", bound=tuple[Any, ...])


class Delays(NamedTuple):
    """Group delay of each channel's filters, ns; None: unknown."""

    force_torque: int | None = None
    acceleration: int | None = None
    angular_rate: int | None = None

    @classmethod
    def parse(cls, delay_ms: object) -> Delays:
        """From `delay_ms` in a message."""
        values = (number(mapping(delay_ms).get(channel)) for channel in cls._fields)
        return cls(
            *(round(ms * 1e6) if ms is not None and 0 <= ms <= MAX_DELAY_MS else None for ms in values)
        )


class SensorInfo(NamedTuple):
    """A sensor as the server describes it."""

    sensor: int = 0  # position on the bus
    name: str = ""
    serial: int | None = None
    hardware: str = ""
    firmware: str = ""
    pdo_size: int | None = None  # bytes of process data
    state: str = ""
    settling: bool = False  # whether its data has not settled
    rate_hz: float = 0.0  # samples a second that are to be expected; 0: not known
    settings: Mapping[str, SettingValue] = {}
    delay_ns: Delays = Delays()  # of the filters
    # The sensor's own force/torque offset, part of every sample, N and Nm; None if it is not known.
    offset: Six | None = None

    @classmethod
    def parse(cls, row: Mapping[str, Any]) -> SensorInfo | None:
        """From its row of a description; None if that does not say which sensor it is."""
        if (position := position_of(row)) is None:
            return None
        name, hardware, firmware, state = (
            text(row.get(key)) for key in ("name", "hardware", "firmware", "state")
        )
        serial, size, settling = whole(row.get("serial")), whole(row.get("pdo_size")), row.get("settling")
        found = cls(position, name, serial, hardware, firmware, size, state, settling is True)
        return found.changed_by(row)

    @property
    def identity(self) -> tuple[object, ...]:
        """Of the sensor and its firmware."""
        return self.name, self.serial, self.hardware, self.firmware

    def as_message(self) -> dict[str, Any]:
        """The same as a description or an event carries it, without what is not known."""
        delays = {name: None if ns is None else ns * 1e-6 for name, ns in self.delay_ns._asdict().items()}
        known: dict[str, Any] = {"settings": dict(self.settings), "rate_hz": self.rate_hz}
        known |= {"offset": self.offset and list(self.offset), "delay_ms": any(self.delay_ns) and delays}
        return {key: value for key, value in known.items() if value}

    def changed_by(self, message: Mapping[str, Any]) -> SensorInfo:
        """The same with what a description or an event says to be in force; the rest stays as it was."""
        rate_hz, delay_ms = number(message.get("rate_hz")), message.get("delay_ms")
        return self._replace(
            rate_hz=rate_hz if rate_hz is not None and 0 < rate_hz <= _MAX_HZ else self.rate_hz,
            settings=known_settings(message.get("settings")) or self.settings,
            delay_ns=Delays.parse(delay_ms) if isinstance(delay_ms, dict) else self.delay_ns,
            offset=known_six(message["offset"]) if "offset" in message else self.offset,
        )

    def __str__(self) -> str:
        serial = "?" if self.serial is None else self.serial
        rate = f"{self.rate_hz:g}" if self.rate_hz else "?"
        return f"sensor {self.sensor} ({self.name or '?'}, serial {serial}, {rate} Hz, {self.state or '?'})"


class Description(NamedTuple):
    """A reply to `describe` or `subscribe`."""

    version: str  # the server's
    sensors: tuple[SensorInfo, ...]

    @classmethod
    def parse(cls, reply: Mapping[str, Any]) -> Description:
        """From the reply; of two rows of one sensor the first counts."""
        found = [info for row in rows(reply.get("sensors")) if (info := SensorInfo.parse(row)) is not None]
        unique = {info.sensor: info for info in reversed(found)}
        return cls(text(reply.get("version")), tuple(unique[position] for position in sorted(unique)))

    def find(self, sensor: int) -> SensorInfo | None:
        """The sensor at this position."""
        return next((info for info in self.sensors if info.sensor == sensor), None)


class DistributionStatus(NamedTuple):
    """A distribution, µs."""

    p50: float | None = None
    p99: float | None = None
    p999: float | None = None
    max: float | None = None


class ClockStatus(NamedTuple):
    """How the server follows a sensor's sampling clock."""

    mode: str = ""  # `locked` or `oversampling`
    stamps: str = ""  # `hardware` or `polling`
    period_us: float | None = None
    offset_ppm: float | None = None
    uncertainty_us: float | None = None


class EmergencyStatus(NamedTuple):
    """The newest emergency of a sensor."""

    code: int | None = None
    text: str = ""
    ago_s: float | None = None


class DriftStatus(NamedTuple):
    """How far the zero has drifted."""

    since: str = ""  # `tare`, `change`, `return` or the start
    ago_s: float | None = None
    kelvin: float | None = None  # by which it is warmer
    wrench: Six | None = None


class OverloadStatus(NamedTuple):
    """The largest loads of a sensor's past; times in seconds of the Unix epoch."""

    since: float | None = None
    peak: Six | None = None
    saturations: int | None = None
    saturated_at: float | None = None


class SensorStatus(NamedTuple):
    """A sensor's row of `status`; counts are those since the server's start."""

    sensor: int | None = None
    fresh: int | None = None
    repeated: int | None = None
    invalid: int | None = None
    lost_samples: int | None = None
    not_finite: int | None = None
    recoveries: int | None = None
    emergencies: int | None = None
    emergency: EmergencyStatus = EmergencyStatus()
    drift: DriftStatus = DriftStatus()
    history: OverloadStatus = OverloadStatus()
    clock: ClockStatus = ClockStatus()
    age_us: DistributionStatus = DistributionStatus()  # of the samples when they are sent


class Recent(NamedTuple):
    """The distributions of the last ten seconds; `age_us` by sensor."""

    wake_us: DistributionStatus = DistributionStatus()
    exchange_us: DistributionStatus = DistributionStatus()
    age_us: tuple[DistributionStatus, ...] = ()


class ClientStatus(NamedTuple):
    """A client of the server: frames sent to it, and those that it did not read."""

    peer: str = ""
    sent: int | None = None
    withheld: int | None = None


class Status(NamedTuple):
    """A reply to `status`."""

    cycles: int | None = None
    missed_deadlines: int | None = None
    lost_frames: int | None = None
    uptime_s: float | None = None
    wake_us: DistributionStatus = DistributionStatus()
    exchange_us: DistributionStatus = DistributionStatus()
    last_10s: Recent = Recent()
    sensors: tuple[SensorStatus, ...] = ()
    clients: tuple[ClientStatus, ...] = ()

    @classmethod
    def parse(cls, reply: object) -> Status:
        """From the reply; a row that does not say which sensor it is of is by its place."""
        found = decode(cls, reply)
        said = {row.sensor for row in found.sensors}
        places = (
            row if row.sensor is not None or place in said else row._replace(sensor=place)
            for place, row in enumerate(found.sensors)
        )  # fmt: skip
        return found._replace(sensors=tuple(places))

    def find(self, sensor: int) -> SensorStatus:
        """The row of the sensor at this position."""
        return next((row for row in self.sensors if row.sensor == sensor), SensorStatus())

    def recent_age_us(self, sensor: int | None) -> DistributionStatus:
        """Of the last ten seconds."""
        ages = (
            age for row, age in zip(self.sensors, self.last_10s.age_us, strict=False) if row.sensor == sensor
        )
        return next(ages, DistributionStatus())


def decode(row: type[Row], value: object) -> Row:
    """The object `value` as a row, by the types of its fields."""
    found = mapping(value)
    return row(*(check(found.get(name)) for name, check in _checks(row)))


@functools.cache
def _checks(row: type[Row]) -> tuple[tuple[str, Callable[[object], Any]], ...]:
    return tuple((name, _check(hint)) for name, hint in get_type_hints(row).items())


_OF_TYPE: Final[Mapping[object, Callable[[object], Any]]] = {
    str: text,
    int | None: whole,
    float | None: number,
    Six | None: known_six,
}


def _check(hint: Any) -> Callable[[object], Any]:
    """What makes a value of this type of whatever a field may have."""
    if hint in _OF_TYPE:
        return _OF_TYPE[hint]
    if get_origin(hint) is tuple:
        row = get_args(hint)[0]
        return lambda value: tuple(decode(row, each) for each in (value if isinstance(value, list) else ()))
    return functools.partial(decode, hint)


def position_of(row: Mapping[str, Any]) -> int | None:
    """The sensor's position on the bus that a row or an event has; None if it is none."""
    position = row.get("sensor")
    return position if type(position) is int and 0 <= position < MAX_SENSORS else None
