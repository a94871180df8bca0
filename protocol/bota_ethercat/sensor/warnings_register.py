# SPDX-License-Identifier: Apache-2.0
"""The sensor's warnings register ("Warnings Errors Fatal"): what each bit means and what to do about it.

From the table of warnings and errors in Bota's manual.
"""

from __future__ import annotations

from enum import Enum, IntFlag
from typing import Final, NamedTuple


class Severity(Enum):
    """How bad a set bit is."""

    WARNING = "warning"
    ERROR = "error"
    FATAL = "fatal"


class WarningFlag(IntFlag):
    """The bits of the register that have a meaning; 7 to 31 are reserved."""

    FORCE_TORQUE_SATURATED = 1 << 0
    ACCELERATION_SATURATED = 1 << 1
    ANGULAR_RATE_SATURATED = 1 << 2
    ADC_OUT_OF_SYNC = 1 << 3
    FORCE_TORQUE_OUT_OF_RANGE = 1 << 4
    OVERTEMPERATURE = 1 << 5
    WRONG_SUPPLY_VOLTAGE = 1 << 6


class WarningMeaning(NamedTuple):
    """What one bit means, and what to do about it."""

    flag: int
    severity: Severity
    meaning: str
    remedy: str


WARNINGS: Final = tuple(
    WarningMeaning(*row)
    for row in (
        (WarningFlag.FORCE_TORQUE_SATURATED, Severity.ERROR,
         "Force/torque (ADC) saturated", "Reduce sensor loading"),
        (WarningFlag.ACCELERATION_SATURATED, Severity.ERROR,
         "Acceleration saturated", "Reduce acceleration or increase acceleration range"),
        (WarningFlag.ANGULAR_RATE_SATURATED, Severity.ERROR, "Angular velocities (gyro) saturated",
         "Reduce angular velocities or increase angular velocities range"),
        (WarningFlag.ADC_OUT_OF_SYNC, Severity.ERROR,
         "ADC out of sync", "Contact support (repair required)"),
        (WarningFlag.FORCE_TORQUE_OUT_OF_RANGE, Severity.ERROR,
         "Force/torque measurement exceeding the range", "Reduce sensor loading"),
        (WarningFlag.OVERTEMPERATURE, Severity.WARNING,
         "Overtemperature", "Power off the sensor and let it cool down"),
        (WarningFlag.WRONG_SUPPLY_VOLTAGE, Severity.FATAL,
         "Wrong supply voltage", "Remove sensor from power supply"),
    )
)  # fmt: skip


def explain(register: int) -> list[WarningMeaning]:
    """The meaning of every set bit, lowest first; reserved bits are listed too, as warnings."""
    remedy = "Check the firmware's manual: this bit has no published meaning"
    reserved = register & ~sum(row.flag for row in WARNINGS)
    return [row for row in WARNINGS if register & row.flag] + [
        WarningMeaning(1 << bit, Severity.WARNING, f"Reserved bit {bit} set", remedy)
        for bit in range(32)
        if reserved >> bit & 1
    ]
