# SPDX-License-Identifier: Apache-2.0
"""Selects one sensor of a chain: by number, serial number or name."""

from __future__ import annotations

from typing import Final, NamedTuple

MAX_SENSORS: Final = 256
_SERIAL: Final = "serial:"

MEANING: Final = 'a number such as 0, "serial:1234", or a name such as "BFT-SENS-ECAT-M8"'


class SensorChoice(NamedTuple):
    """Exactly one field is set."""

    number: int | None = None
    serial: int | None = None
    name: str | None = None

    @classmethod
    def parse(cls, value: object) -> SensorChoice:
        """From a number or a text; the text of ValueError is what is allowed."""
        if isinstance(value, str) and value.isdecimal():
            value = int(value)
        if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < MAX_SENSORS:
            return cls(number=value)
        if isinstance(value, str) and value.startswith(_SERIAL):
            number = value.removeprefix(_SERIAL)
            if number.isdecimal() and int(number) < 1 << 32:
                return cls(serial=int(number))
        elif isinstance(value, str) and value and value.isprintable() and len(value) <= 64:
            return cls(name=value)
        raise ValueError(MEANING)

    def matches(self, number: int, name: str, serial: int) -> bool:
        """Whether it selects the sensor `number` with this name and serial number."""
        if self.number is not None:
            return self.number == number
        if self.serial is not None:
            return self.serial == serial
        return self.name == name

    @property
    def precedence(self) -> int:
        """Settings for a number override those for a serial number, and those override a name's."""
        return 2 if self.number is not None else 1 if self.serial is not None else 0

    def __str__(self) -> str:
        if self.number is not None:
            return str(self.number)
        return f"{_SERIAL}{self.serial}" if self.serial is not None else str(self.name)
