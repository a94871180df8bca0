"""A fault command: its row of the table, its call, and the parsing of its numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ethercat_server.virtual_sensor.bus import Bus, Slave
from ethercat_server.virtual_sensor.firmware.firmware import Firmware
from ethercat_server.virtual_sensor.sensor import VirtualSensor
from ethercat_server.virtual_sensor.slave.application import Application


class CommandError(Exception):
    """A command that cannot be executed."""


Action = Callable[[], str | None]
"""Executes a command; returns the text after `ok`. CommandError if it cannot be executed."""


@dataclass(frozen=True, slots=True)
class Call:
    """One command with its arguments."""

    bus: Bus
    slave: Slave
    """The slave it is for."""
    arguments: list[str]
    parse: Callable[[str], Action]
    """Parses another command for the same slave; CommandError if it is invalid."""

    @property
    def sensor(self) -> VirtualSensor:
        """The sensor it is for; CommandError if it is for a foreign slave."""
        if not isinstance(self.slave, VirtualSensor):
            raise CommandError("that slave is no sensor: choose one with `@N`")
        return self.slave

    @property
    def application(self) -> Application:
        """What runs in the slave; CommandError if it has no power."""
        if self.slave.life is None:
            raise CommandError("it has no power: use `power on` first")
        return self.slave.life

    @property
    def life(self) -> Firmware:
        """The sensor's firmware; CommandError if it has no power."""
        if self.sensor.life is None:
            raise CommandError("the sensor has no power: use `power on` first")
        return self.sensor.life


@dataclass(frozen=True, slots=True)
class FaultCommand:
    """One command."""

    name: str
    usage: str
    counts: Sequence[int]
    """Permitted numbers of arguments."""
    meaning: str
    run: Callable[[Call], str | None]


def whole(text: str, lowest: int, highest: int) -> int:
    """A whole number, decimal or 0x...; CommandError if it is invalid or out of range."""
    try:
        value = int(text, 0)
    except ValueError:
        raise CommandError(f"{text!r} is not a whole number such as 27 or 0x1B") from None
    if not lowest <= value <= highest:
        raise CommandError(f"{text} is out of range: it must be from {lowest} to {highest}")
    return value


def real(text: str, lowest: float, highest: float) -> float:
    """A finite number; CommandError if it is invalid or out of range."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not lowest <= value <= highest:
        raise CommandError(f"{text!r} must be a number from {lowest:g} to {highest:g}")
    return value
