"""The sensor's own clock: the instants of its samples, independent of the master.

The instant of sample k is the anchor plus (k - k0) * T, with T = SINC / 51200 s / (1 + ppm * 1e-6).
In whole nanoseconds, without accumulating rounding errors.
"""

from __future__ import annotations

from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ

_PPM_SCALE = 10**12  # ppm in steps of one millionth


class SampleClock:
    """Sample numbers and their instants, from the moment of power-on."""

    def __init__(self, now: int, sinc_length: int, ppm: float = 0.0) -> None:
        self._anchor = now
        self._anchor_number = 0
        self.sinc_length = sinc_length
        self.ppm = ppm
        self._set_period()

    def _set_period(self) -> None:
        # T in ns as a fraction.
        self._numerator = self.sinc_length * 10**9 * _PPM_SCALE
        self._denominator = BASE_SAMPLING_RATE_HZ * (_PPM_SCALE + round(self.ppm * 1e6))

    def number_at(self, now: int) -> int:
        """Number of the newest sample at the time `now`, ns."""
        elapsed = now - self._anchor
        if elapsed < 0:
            return self._anchor_number
        return self._anchor_number + ((elapsed + 1) * self._denominator - 1) // self._numerator

    def instant(self, number: int) -> int:
        """Instant of sample `number`, ns."""
        return self._anchor + (number - self._anchor_number) * self._numerator // self._denominator

    def change(self, now: int, *, sinc_length: int | None = None, ppm: float | None = None) -> None:
        """Change the rate from the newest sample on, without skipping or repeating one."""
        newest = self.number_at(now)
        self._anchor, self._anchor_number = self.instant(newest), newest
        self.sinc_length = self.sinc_length if sinc_length is None else sinc_length
        self.ppm = self.ppm if ppm is None else ppm
        self._set_period()
