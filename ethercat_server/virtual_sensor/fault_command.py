"""What a fault on command is: a row of the table, the call that it gets, and how its numbers are read."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ethercat_server.virtual_sensor.bus import Bus
from ethercat_server.virtual_sensor.firmware import Firmware
from ethercat_server.virtual_sensor.sensor import VirtualSensor


class CommandError(Exception):
    """A command that cannot be done; its text is a sentence."""


Action = Callable[[], str | None]
"""Does a command and returns what is to be said after `ok`; CommandError if it cannot."""


@dataclass(frozen=True, slots=True)
class Call:
    """One command as it was given."""

    bus: Bus
    sensor: VirtualSensor
    """The one it is for."""
    arguments: list[str]
    parse: Callable[[str], Action]
    """What another command would do to the same sensor; CommandError if it is none."""

    @property
    def life(self) -> Firmware:
        """The sensor's firmware; CommandError if it has no power."""
        if self.sensor.life is None:
            raise CommandError("that sensor has no power: switch it on first with `power on`")
        return self.sensor.life


@dataclass(frozen=True, slots=True)
class FaultCommand:
    """One command."""

    name: str
    usage: str
    counts: Sequence[int]
    """Numbers of arguments that it takes."""
    meaning: str
    run: Callable[[Call], str | None]


def whole(text: str, lowest: int, highest: int) -> int:
    """A whole number, decimal or 0x...; CommandError if it is none or out of range."""
    try:
        value = int(text, 0)
    except ValueError:
        raise CommandError(f"{text!r} is no whole number: write it as 27 or 0x1B") from None
    if not lowest <= value <= highest:
        raise CommandError(f"{text} is out of range: it must be from {lowest} to {highest}")
    return value


def real(text: str, lowest: float, highest: float) -> float:
    """A finite number; CommandError if it is none or out of range."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not lowest <= value <= highest:
        raise CommandError(f"{text!r} must be a number from {lowest:g} to {highest:g}")
    return value
