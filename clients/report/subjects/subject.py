"""What a report is about: one sensor, its settings and its frames, from a recording or from a live stream.

Everything here comes from a file or the network. Texts are cut to one printable line; settings that are
unknown or invalid are omitted, with a remark.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from clients.recording.columns import Columns
from protocol.errors import SettingError
from protocol.settings import BASE_SAMPLING_RATE_HZ, SETTINGS, SettingValue, rate_divisor
from protocol.text.untrusted import whole
from protocol.text.visible import printable

_LONGEST_TEXT: Final = 80
_MOST_REMARKS: Final = 20
_HIGHEST_RATE_HZ: Final = 100_000.0


@dataclass(frozen=True)
class Subject:
    """One sensor and its frames."""

    position: int
    name: str
    serial: int | None
    hardware: str
    firmware: str
    rate_hz: float
    """Nominal, as described; 0 if unknown."""
    settings: Mapping[str, SettingValue]
    """Those that exist and have a valid value."""
    columns: Columns
    source: str
    """A file name or a server's address."""
    age_p99_us: float | None = None
    """Of the samples on arrival; None from a recording, or another machine."""
    remarks: tuple[str, ...] = ()
    """Sentences about the recording for the reader of the report."""

    @property
    def who(self) -> str:
        """Name and serial number."""
        return f"{self.name}, serial {_text(self.serial)}"

    @property
    def sinc_length(self) -> int | None:
        """None if unknown."""
        return self.settings.get("sinc_length")

    @property
    def nominal_period_s(self) -> float | None:
        """From the settings; None if unknown."""
        if self.sinc_length is not None:
            divisor = rate_divisor(self.sinc_length, round(self.rate_hz), self.settings.get("chop"))
            return self.sinc_length * (divisor or 1) / BASE_SAMPLING_RATE_HZ
        return 1 / self.rate_hz if 0 < self.rate_hz <= _HIGHEST_RATE_HZ else None

    def with_remarks(self, remarks: Iterable[str]) -> Subject:
        """The same with more remarks, up to a limit."""
        every = [*self.remarks, *(printable(remark, 300) for remark in remarks)]
        if len(every) > _MOST_REMARKS:
            left_out = len(every) - _MOST_REMARKS
            every = [*every[:_MOST_REMARKS], f"{left_out} more remarks are omitted."]
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
            remarks.append(f"The unknown setting {printable(name, 40)!r} was ignored.")
            continue
        try:
            known[setting.name] = setting.check(value)
        except SettingError as error:
            remarks.append(f"A setting was ignored: {printable(error)}.")
    return known, remarks


def subject(
    description: Mapping[str, Any], settings: object, columns: Columns, source: str, position: int
) -> Subject:
    """The sensor that one row of a reply to `describe` describes."""
    known, remarks = known_settings(settings)
    return Subject(
        position=position,
        name=_text(description.get("name")),
        serial=whole(description.get("serial")),
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
