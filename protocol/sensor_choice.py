"""How one sensor of a chain is named: by its place on the bus, its serial number or its name."""

from __future__ import annotations

from typing import Final, NamedTuple

MOST_PLACES: Final = 256
_SERIAL: Final = "serial:"

MEANING: Final = 'a place such as 0, "serial:1234", or a name such as "BFT-SENS-ECAT-M8"'


class SensorChoice(NamedTuple):
    """One of the three is given."""

    place: int | None = None
    serial: int | None = None
    name: str | None = None

    @classmethod
    def parse(cls, value: object) -> SensorChoice:
        """From a number or a text; ValueError says what it must be."""
        if isinstance(value, str) and value.isdecimal():
            value = int(value)
        if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < MOST_PLACES:
            return cls(place=value)
        if isinstance(value, str) and value.startswith(_SERIAL):
            number = value.removeprefix(_SERIAL)
            if number.isdecimal() and int(number) < 1 << 32:
                return cls(serial=int(number))
        elif isinstance(value, str) and value and value.isprintable() and len(value) <= 64:
            return cls(name=value)
        raise ValueError(MEANING)

    def matches(self, place: int, name: str, serial: int) -> bool:
        """Whether the sensor at `place` with this name and serial number is meant."""
        if self.place is not None:
            return self.place == place
        if self.serial is not None:
            return self.serial == serial
        return self.name == name

    @property
    def precedence(self) -> int:
        """What is said of a place wins over what is said of a serial number, and that over a name."""
        return 2 if self.place is not None else 1 if self.serial is not None else 0

    def __str__(self) -> str:
        """As it is written."""
        if self.place is not None:
            return str(self.place)
        return f"{_SERIAL}{self.serial}" if self.serial is not None else str(self.name)
