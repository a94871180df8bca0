# SPDX-License-Identifier: Apache-2.0
"""The sensor's filters: rate, cut-off and delay of each setting, from Bota's manual.

Bota's publications differ in the cut-off frequencies: use these to compare settings, not as a specification.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple


class ForceTorqueFilter(NamedTuple):
    """A SINC length of the force/torque filter."""

    sinc_length: int
    rate_hz: int
    """As object 0x8011 gives it, whether FIR is on or off."""
    cutoff_fir_off_hz: float
    cutoff_fir_on_hz: float

    def cutoff_hz(self, fir: bool) -> float:
        """The cut-off frequency with FIR on or off."""
        return self.cutoff_fir_on_hz if fir else self.cutoff_fir_off_hz


class ImuFilter(NamedTuple):
    """A filter profile of the gyroscope or the accelerometer."""

    profile: int
    bandwidth_hz: int
    delay_ms: float
    rate_khz: int
    noise_density_ug_rthz: int | None = None
    """None for the gyroscope."""

    def __str__(self) -> str:
        text = f"bandwidth {self.bandwidth_hz} Hz, delay {self.delay_ms:g} ms, rate {self.rate_khz} kHz"
        if self.noise_density_ug_rthz is not None:
            text += f", noise density {self.noise_density_ug_rthz} µg/√Hz"
        return text


FORCE_TORQUE_FILTERS: Final[Mapping[int, ForceTorqueFilter]] = {
    row.sinc_length: row
    for row in (
        ForceTorqueFilter(32, 1600, 418.5, 62.5),
        ForceTorqueFilter(51, 1003, 265.5, 39.5),
        ForceTorqueFilter(64, 800, 209.5, 31.5),
        ForceTorqueFilter(128, 400, 105.0, 16.0),
        ForceTorqueFilter(205, 250, 65.5, 10.0),
        ForceTorqueFilter(256, 200, 52.5, 8.0),
        ForceTorqueFilter(341, 150, 39.5, 6.0),
    )
}
"""By SINC length."""

ANGULAR_RATE_FILTERS: Final[Mapping[int, ImuFilter]] = {
    row.profile: row
    for row in (
        ImuFilter(3, 184, 2.9, 1),
        ImuFilter(4, 92, 3.9, 1),
        ImuFilter(5, 41, 5.9, 1),
        ImuFilter(6, 20, 9.9, 1),
        ImuFilter(7, 10, 17.85, 1),
        ImuFilter(8, 5, 33.48, 1),
        ImuFilter(9, 3600, 0.17, 8),
    )
}
"""Gyroscope, by filter profile."""

ACCELERATION_FILTERS: Final[Mapping[int, ImuFilter]] = {
    row.profile: row
    for row in (
        ImuFilter(1, 460, 1.94, 1, 250),
        ImuFilter(2, 184, 5.80, 1, 250),
        ImuFilter(3, 92, 7.80, 1, 250),
        ImuFilter(4, 41, 11.80, 1, 250),
        ImuFilter(5, 20, 19.80, 1, 250),
        ImuFilter(6, 10, 35.70, 1, 250),
        ImuFilter(7, 5, 66.96, 1, 250),
        ImuFilter(8, 460, 1.94, 1, 250),
    )
}
"""Accelerometer, by filter profile."""

SHORT_SINC, LONG_SINC = 51, 1024  # for which Bota gives limits of the noise of a healthy sensor


def noise_limit(short: float, long: float, sinc_length: int) -> float:
    """The limit at another SINC length, by the limits at `SHORT_SINC` and `LONG_SINC`.

    Noise falls with a power of the averaging length: a straight line in a log-log plot, also beyond the two.
    """
    power = math.log(long / short) / math.log(LONG_SINC / SHORT_SINC)
    return float(short * (sinc_length / SHORT_SINC) ** power)
