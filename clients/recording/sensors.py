"""Who the sensors of a recording are and how they are set, from the notes in it, in the order of the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from clients.recording.file_format import RECORDER
from protocol.errors import SettingError
from protocol.json_text import JsonObject
from protocol.settings import SETTINGS, sampling_rate_hz
from protocol.text import visible
from protocol.untrusted import rows


class Description(NamedTuple):
    """What the server said of itself and its sensors, a reply to `describe`."""

    stamp_ns: int
    """When it was received, ns since 1970."""
    reply: JsonObject


class Event(NamedTuple):
    """Something that happened: to the server, or to the recorder (`by_recorder`)."""

    stamp_ns: int
    """When it was received, ns since 1970."""
    event: JsonObject

    @property
    def name(self) -> str:
        """Which event."""
        return str(self.event.get("event", "?"))

    @property
    def by_recorder(self) -> bool:
        """Whether the recorder itself notes it: connected, disconnected, lost."""
        return self.event.get("source") == RECORDER


class Identity(NamedTuple):
    """Which sensor it is."""

    name: str = "?"
    serial: int = 0
    hardware: str = "?"
    firmware: str = "?"
    pdo_size: int = 0


class Settings(NamedTuple):
    """A sensor's settings and sampling rate from a moment on, and which sensor it is then."""

    stamp_ns: int
    values: Mapping[str, Any]
    rate_hz: float
    """Hz; 0 if it is not known."""
    identity: Identity


class RecordedSensor(NamedTuple):
    """A sensor of the recording, as it was described first."""

    sensor: int
    """Place on the bus, from 0."""
    name: str
    serial: int
    hardware: str
    firmware: str
    pdo_size: int
    rate_hz: float
    """Hz, nominal; 0 if it is not known."""
    settings: Mapping[str, Any]
    history: tuple[Settings, ...]
    """Settings and identity over time, oldest first; the first are those here."""
    frames: int
    """How many frames of it the recording holds."""


class Histories:
    """The histories of all sensors, while the notes are read."""

    def __init__(self) -> None:
        self._of: dict[int, list[Settings]] = {}

    def take(self, note: Description | Event) -> None:
        """Learn what `note`, the next in the file, says."""
        described = isinstance(note, Description)
        for row in rows(note.reply.get("sensors")) if isinstance(note, Description) else [note.event]:
            place, values = row.get("sensor"), row.get("settings")
            if isinstance(place, int) and not isinstance(place, bool) and isinstance(values, dict):
                self._learn(place, note.stamp_ns, row, values, described=described)

    def of(self, place: int) -> Sequence[Settings]:
        """What is known of the sensor at this place so far."""
        return self._of.get(place, ())

    def sensors(self, frames: Mapping[int, int]) -> tuple[RecordedSensor, ...]:
        """All sensors that were described or that have `frames`, which are counts by place."""
        return tuple(
            _sensor(place, self.of(place), frames.get(place, 0))
            for place in sorted(self._of.keys() | frames.keys())
        )

    def _learn(
        self, place: int, stamp_ns: int, row: JsonObject, values: dict[str, Any], *, described: bool
    ) -> None:
        known = self._of.setdefault(place, [])
        last = known[-1] if known else Settings(stamp_ns, {}, 0.0, Identity())
        identity = _identity(row) if described else last.identity
        rate = _number(row.get("rate_hz"))
        if known and last.values == values and last.identity in (identity, Identity()):
            # An event tells the settings, the description after it the rest of the same.
            known[-1] = last._replace(rate_hz=rate or last.rate_hz, identity=identity)
        else:
            known.append(Settings(stamp_ns, values, rate or _rate(values, last), identity))


def _rate(values: Mapping[str, Any], last: Settings) -> float:
    """The rate that follows from settings that come without one."""
    try:
        length = SETTINGS["sinc_length"].check(values.get("sinc_length"))
    except SettingError:
        return last.rate_hz
    return last.rate_hz if length == last.values.get("sinc_length") else float(sampling_rate_hz(length))


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 < value < 2**32 else 0.0


def _text(value: object) -> str:
    """Text from a file as it may appear in a line: no control characters, not endless."""
    return visible(str(value)[:80]) if value is not None else "?"


def _identity(row: JsonObject) -> Identity:
    return Identity(
        _text(row.get("name")), int(_number(row.get("serial"))), _text(row.get("hardware")),
        _text(row.get("firmware")), int(_number(row.get("pdo_size"))),
    )  # fmt: skip


def _sensor(place: int, history: Sequence[Settings], frames: int) -> RecordedSensor:
    first = history[0] if history else Settings(0, {}, 0.0, Identity())
    return RecordedSensor(place, *first.identity, first.rate_hz, first.values, tuple(history), frames)
