"""What a report is about: one sensor, its settings and its frames, from a recording or from a live stream.

Everything here comes from a file or the network. Texts are cut to one printable line; settings that are
unknown or impossible are left out and said so.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from clients.recording.columns import Columns
from protocol.errors import SettingError
from protocol.settings import BASE_SAMPLING_RATE_HZ, SETTINGS, SettingValue
from protocol.text import printable

_LONGEST_TEXT: Final = 80
_MOST_REMARKS: Final = 20
_HIGHEST_RATE_HZ: Final = 100_000.0


@dataclass(frozen=True)
class Subject:
    """One sensor and what was received of it."""

    place: int
    name: str
    serial: str
    hardware: str
    firmware: str
    rate_hz: float
    """Nominal, as it was described; 0 if it is not known."""
    settings: Mapping[str, SettingValue]
    """Those that are known and have a value that exists."""
    columns: Columns
    source: str
    """Where it comes from: a file's name, or a server's address."""
    remarks: tuple[str, ...] = ()
    """Sentences about the recording that a reader of the report should know."""

    @property
    def sinc_length(self) -> int | None:
        """None if it is not known."""
        return self.settings.get("sinc_length")

    @property
    def nominal_period_s(self) -> float | None:
        """What the settings say; None if they do not."""
        if self.sinc_length is not None:
            return self.sinc_length / BASE_SAMPLING_RATE_HZ
        return 1 / self.rate_hz if 0 < self.rate_hz <= _HIGHEST_RATE_HZ else None

    def with_remarks(self, remarks: Iterable[str]) -> Subject:
        """The same with more remarks; what is too much is left out."""
        every = [*self.remarks, *(printable(remark, 300) for remark in remarks)]
        if len(every) > _MOST_REMARKS:
            left_out = len(every) - _MOST_REMARKS
            every = [*every[:_MOST_REMARKS], f"{left_out} more remarks are left out."]
        return replace(self, remarks=tuple(every))


def known_settings(values: object) -> tuple[dict[str, SettingValue], list[str]]:
    """The settings in `values` that exist, and a remark for each that does not."""
    known: dict[str, SettingValue] = {}
    remarks = []
    if not isinstance(values, Mapping):
        return {}, ["The settings are not known."]
    for name, value in values.items():
        setting = SETTINGS.get(name) if isinstance(name, str) else None
        if setting is None:
            remarks.append(f"A setting that is not known, {printable(name, 40)!r}, was left out.")
            continue
        try:
            known[setting.name] = setting.check(value)
        except SettingError as error:
            remarks.append(f"A setting was left out: {printable(error)}.")
    return known, remarks


def subject(
    description: Mapping[str, Any], settings: object, columns: Columns, source: str, place: int
) -> Subject:
    """The sensor that one row of a reply to `describe` describes."""
    known, remarks = known_settings(settings)
    return Subject(
        place=place,
        name=_text(description.get("name")),
        serial=_text(description.get("serial")),
        hardware=_text(description.get("hardware")),
        firmware=_text(description.get("firmware")),
        rate_hz=_rate(description.get("rate_hz")),
        settings=known,
        columns=columns,
        source=printable(source),
    ).with_remarks(remarks)


def _rate(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 < value <= _HIGHEST_RATE_HZ else 0.0


def _text(value: object) -> str:
    return "not known" if value is None or value == "" else printable(value, _LONGEST_TEXT)


def no_frames() -> Columns:
    """Of a sensor that nothing was received of."""
    whole = np.zeros(0, np.int64)
    fields: dict[str, Any] = dict.fromkeys(Columns.__slots__, whole)
    for name in ("force", "torque", "acceleration", "angular_rate"):
        fields[name] = np.zeros((0, 3))
    return Columns(**{**fields, "orientation": np.zeros((0, 4)), "temperature": np.zeros(0)})
