"""For how long a vector has been steady."""

from __future__ import annotations

import math
from typing import Final

from ft_compensation.quantities import ZERO
from protocol.pdo import Vector3

_MEAN_S: Final = 0.3
"""Time constant of the mean that a vector is compared with: what changes slower than that is steady."""
_NOISES: Final = 4.0
"""Standard deviations of a component: 2.3 of all three, which chance rarely exceeds."""


class Steadiness:
    """Watches one vector. `mean` is its recent mean."""

    def __init__(self, limit: float) -> None:
        """A vector further than `limit` from the mean is another one."""
        self.mean: Vector3 = ZERO
        self.lasted_s = -1.0
        """Seconds; 0 of the first one, negative before it."""
        self._limit = limit

    def forget(self) -> None:
        """The next one is the first."""
        self.lasted_s = -1.0

    def watch(self, vector: Vector3, passed_s: float, noise: float) -> bool:
        """`noise` is the standard deviation of its components. False: it is another one now."""
        last = self.mean
        if self.lasted_s < 0.0 or math.dist(vector, last) > self._limit + _NOISES * noise:
            self.mean, self.lasted_s = vector, 0.0
            return False
        share = 1.0 - math.exp(-passed_s / _MEAN_S)
        x, y, z = last
        self.mean = x + share * (vector[0] - x), y + share * (vector[1] - y), z + share * (vector[2] - z)
        self.lasted_s += passed_s
        return True
