"""The arm's own acceleration in the state of `TiltFilter`: how far it may tilt the measured direction.

While the acceleration is steady it is one number for each horizontal axis: unknown at first, and the longer
it lasts the less likely to be anything but zero.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ft_compensation.attitude.covariance import Array

ANY_ARM: Final = 1.0
"""rad²: nothing is known of it."""
_ARM: Final = 0.064**2
"""rad²: an acceleration across gravity, 0.6 m/s², that makes f longer by no more than `_LENGTH_NOISE`."""
_LENGTH_NOISE: Final = 0.02
"""m/s²: of |f|."""
_UNEVEN: Final = 3 * 2.0
"""rad² per relative error of |f|: an acceleration across gravity, a, makes f longer by a²/2g. Three times
that, because it may also point down a little."""


class ArmAcceleration:
    """`tilt` is the estimate; its covariance is in rows and columns 5 and 6 of the filter's."""

    def __init__(self, magnitude: float, time_constant_s: float) -> None:
        """`magnitude` of gravity is in m/s²."""
        self.tilt = 0.0, 0.0
        """About x and y of the still frame, rad"""
        self._magnitude, self._time_constant_s = magnitude, time_constant_s
        self._first, self._likely_s = _ARM, 0.0

    @property
    def error(self) -> Array:
        """The filter's error state, (7,), of which only this is not zero."""
        return np.array((0.0, 0.0, 0.0, 0.0, 0.0, *self.tilt))

    def is_new(self, covariance: Array, variance: float = _ARM, lasted_s: float = 0.0) -> None:
        """It is another one, known to `variance` (rad²), and has been steady for `lasted_s`."""
        self.tilt, self._first = (0.0, 0.0), variance
        self._likely_s = min(lasted_s, 5.0 * self._time_constant_s)
        covariance[5:] = covariance[:, 5:] = 0.0
        now = variance * math.exp(-2.0 * self._likely_s / self._time_constant_s)
        covariance[5, 5] = covariance[6, 6] = now

    def by_length(self, size: float, noise: float) -> float:
        """Variance, rad², of one that makes f as long as `size` (m/s², with the noise of its components)."""
        longer = max(0.0, abs(size - self._magnitude) - _LENGTH_NOISE - noise)
        return _ARM + _UNEVEN * longer / self._magnitude

    def less_likely(self, passed_s: float) -> float:
        """Variance, rad², of measuring it to be 0, which a block more of steadiness amounts to.

        All of them together leave a standard deviation that falls exponentially.
        """
        past, more = 2.0 * self._likely_s / self._time_constant_s, 2.0 * passed_s / self._time_constant_s
        self._likely_s = min(self._likely_s + passed_s, 5.0 * self._time_constant_s)
        return self._first / (math.exp(past) * math.expm1(min(more, 10.0)))
