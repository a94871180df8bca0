"""Identity and settings of the sensors of a recording over time, from its descriptions and events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bota_clients.recording.file_format import RECORDER
from bota_ethercat.errors import SettingError
from bota_ethercat.settings import SETTINGS, sampling_rate_hz
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import rows, visible


class Description(NamedTuple):
    """A reply to `describe`."""

    stamp_ns: int
    """When it was received, ns since 1970."""
    reply: JsonObject


class Event(NamedTuple):
    """An event of the server, or of the recorder (`by_recorder`)."""

    stamp_ns: int
    """When it was received, ns since 1970."""
    event: JsonObject

    @property
    def name(self) -> str:
        """Name of the event."""
        return str(self.event.get("event", "?"))

    @property
    def by_recorder(self) -> bool:
        """Whether it is the recorder's own: connected, disconnected, lost."""
        return self.event.get("source") == RECORDER


class Identity(NamedTuple):
    """Identity of a sensor."""

    name: str = "?"
    serial: int = 0
    hardware: str = "?"
    firmware: str = "?"
    pdo_size: int = 0


class Settings(NamedTuple):
    """Settings, sampling rate and identity of a sensor from a time on."""

    stamp_ns: int
    values: Mapping[str, Any]
    rate_hz: float
    """Hz; 0 if unknown."""
    identity: Identity


class RecordedSensor(NamedTuple):
    """A sensor of the recording, as first described."""

    sensor: int
    """Place on the bus, from 0."""
    name: str
    serial: int
    hardware: str
    firmware: str
    pdo_size: int
    rate_hz: float
    """Hz, nominal; 0 if unknown."""
    settings: Mapping[str, Any]
    history: tuple[Settings, ...]
    """Settings and identity over time, oldest first; the first are the ones here."""
    frames: int
    """Number of its frames in the recording."""


class Histories:
    """The histories of all sensors, built from descriptions and events in file order."""

    def __init__(self) -> None:
        self._of: dict[int, list[Settings]] = {}

    def take(self, note: Description | Event) -> None:
        """Take the next description or event of the file."""
        described = isinstance(note, Description)
        for row in rows(note.reply.get("sensors")) if isinstance(note, Description) else [note.event]:
            position, values = row.get("sensor"), row.get("settings")
            if isinstance(position, int) and not isinstance(position, bool) and isinstance(values, dict):
                self._learn(position, note.stamp_ns, row, values, described=described)

    def of(self, position: int) -> Sequence[Settings]:
        """The history so far of the sensor at this position."""
        return self._of.get(position, ())

    def sensors(self, frames: Mapping[int, int]) -> tuple[RecordedSensor, ...]:
        """All sensors that were described or that have `frames`, which are counts by position."""
        return tuple(
            _sensor(position, self.of(position), frames.get(position, 0))
            for position in sorted(self._of.keys() | frames.keys())
        )

    def _learn(
        self, position: int, stamp_ns: int, row: JsonObject, values: dict[str, Any], *, described: bool
    ) -> None:
        known = self._of.setdefault(position, [])
        last = known[-1] if known else Settings(stamp_ns, {}, 0.0, Identity())
        identity = _identity(row) if described else last.identity
        rate = _number(row.get("rate_hz"))
        if known and last.values == values and last.identity in (identity, Identity()):
            # The description that follows an event completes the same entry.
            known[-1] = last._replace(rate_hz=rate or last.rate_hz, identity=identity)
        else:
            known.append(Settings(stamp_ns, values, rate or _rate(values, last), identity))


def _rate(values: Mapping[str, Any], last: Settings) -> float:
    """The rate that the settings imply where it is not given."""
    try:
        length = SETTINGS["sinc_length"].check(values.get("sinc_length"))
    except SettingError:
        return last.rate_hz
    return last.rate_hz if length == last.values.get("sinc_length") else float(sampling_rate_hz(length))


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 < value < 2**32 else 0.0


def _text(value: object) -> str:
    """Text from a file, safe to print: no control characters, limited length."""
    return visible(str(value)[:80]) if value is not None else "?"


def _identity(row: JsonObject) -> Identity:
    return Identity(
        _text(row.get("name")), int(_number(row.get("serial"))), _text(row.get("hardware")),
        _text(row.get("firmware")), int(_number(row.get("pdo_size"))),
    )  # fmt: skip


def _sensor(position: int, history: Sequence[Settings], frames: int) -> RecordedSensor:
    first = history[0] if history else Settings(0, {}, 0.0, Identity())
    return RecordedSensor(position, *first.identity, first.rate_hz, first.values, tuple(history), frames)
