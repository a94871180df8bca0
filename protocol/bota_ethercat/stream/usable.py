# SPDX-License-Identifier: Apache-2.0
"""Which channels of a sample may be used: the one table for every program (for people: docs/protocol.md).

A REPEATED or INVALID frame brings no sample. Of a sample each channel is judged by its values, by its
saturation field and by the warnings register, either of which counts alone. A saturated channel reads less
than there is, with the right sign. Values of a faulty one mean nothing: the ADC that measures force and
torque is out of sync, or the supply voltage of the whole sensor is wrong. Overtemperature and reserved bits
forbid nothing. The C++ header has the same (`usability`); tests/corpus.py and
tests/protocol/golden/readings.json hold both to the table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Final, NamedTuple

from bota_ethercat.pdo import Sample
from bota_ethercat.sensor.warnings_register import WarningFlag

_SUPPLY: Final = int(WarningFlag.WRONG_SUPPLY_VOLTAGE)


class Usability(IntEnum):
    """What a channel of a sample is worth; the numbers are those of `Condition`."""

    USABLE = 0
    SATURATED = 1
    FAULTY = 2  # not finite, or the sensor reports a fault of what measures it

    @property
    def why_not(self) -> str:
        """A clause; empty if it may be used."""
        return ("", "saturated or out of range", "not finite, or of a sensor that reports a fault")[self]


class Channel(NamedTuple):
    """What is measured and judged together."""

    name: str
    values: tuple[str, ...]  # attributes of a `Sample`
    saturation: tuple[str, ...]  # its saturation fields: any bit
    saturating: int  # bits of the warnings register that say the same
    faulty: int = _SUPPLY  # bits with which its values mean nothing

    @property
    def title(self) -> str:
        """For people."""
        return self.name.replace("force_torque", "force or torque").replace("_", " ")

    def flagged(self, sample: Any) -> Any:
        """Not 0 if the sensor says that it must not be used; of n samples as arrays (n,)."""
        found = sample.warnings & (self.saturating | self.faulty)
        for name in self.saturation:
            found = found | getattr(sample, name)
        return found

    def judge(self, sample: Sample) -> Usability:
        """May it be used?"""
        if sample.warnings & self.faulty or not self.is_finite(sample):
            return Usability.FAULTY
        return Usability.SATURATED if self.flagged(sample) else Usability.USABLE

    def is_finite(self, sample: Sample) -> bool:
        """Whether its values are finite numbers."""
        return all(
            math.isfinite(value if isinstance(value, float) else sum(value or ()))
            for value in (getattr(sample, name) for name in self.values)
        )


def judge(sample: Sample, channels: Sequence[Channel]) -> tuple[Usability, str]:
    """The worst of these channels, and why it may not be used, a clause."""
    worst, why = Usability.USABLE, ""
    for channel in channels:
        if (found := channel.judge(sample)) > worst:
            worst, why = found, f"{channel.title} was {found.why_not}"
    return worst, why


_F, _A, _R = "force_torque_saturated", "acceleration_saturated", "angular_rate_saturated"
_FLAG = WarningFlag
FORCE_TORQUE: Final = Channel(
    "force_torque", ("force", "torque"), (_F,),
    int(_FLAG.FORCE_TORQUE_SATURATED | _FLAG.FORCE_TORQUE_OUT_OF_RANGE), int(_FLAG.ADC_OUT_OF_SYNC) | _SUPPLY,
)  # fmt: skip
ACCELERATION: Final = Channel("acceleration", ("acceleration",), (_A,), int(_FLAG.ACCELERATION_SATURATED))
ANGULAR_RATE: Final = Channel("angular_rate", ("angular_rate",), (_R,), int(_FLAG.ANGULAR_RATE_SATURATED))
TEMPERATURE: Final = Channel("temperature", ("temperature",), (), 0)
ORIENTATION: Final = Channel(  # the sensor's estimate by its IMU
    "orientation", ("orientation",), (_A, _R), ACCELERATION.saturating | ANGULAR_RATE.saturating
)
CHANNELS: Final = (FORCE_TORQUE, ACCELERATION, ANGULAR_RATE, TEMPERATURE, ORIENTATION)
