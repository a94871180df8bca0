"""For how long a vector has been steady, and whether the sensor is at rest."""

from __future__ import annotations

import math
from typing import Final

from ft_compensation.attitude.block import Block
from ft_compensation.quantities import ZERO
from protocol.pdo import Vector3

_MEAN_S: Final = 0.3
"""Time constant of the mean that a vector is compared with: what changes slower than that is steady."""
_NOISES: Final = 4.0
"""Standard deviations of a component: 2.3 of all three, which chance rarely exceeds."""
_AT_REST: Final = 0.08
"""m/s², besides the noise: change of the acceleration in the sensor's frame."""
_STILL: Final = 0.006
"""rad/s: change of the rate."""
_RESTS_S: Final = 0.275
"""Seconds of both that are rest: at its turning points slow motion looks like it."""


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


class Rest:
    """Acceleration and rate are steady in the sensor's frame: it rests, or turns slowly."""

    def __init__(self) -> None:
        self._acceleration, self._rate = Steadiness(_AT_REST), Steadiness(_STILL)

    def forget(self) -> None:
        """Nothing is known of the past."""
        self._acceleration.forget()
        self._rate.forget()

    def watch(self, block: Block, mean: Vector3) -> None:
        """Take a block; `mean` is its acceleration, m/s² in the still frame."""
        x, y, z = (block.attitude.T @ mean).tolist()
        self._acceleration.watch((x, y, z), block.passed_s, block.noise)
        self._rate.watch(block.rate, block.passed_s, block.rate_noise)

    @property
    def is_rest(self) -> bool:
        """Whether both have been steady for long enough."""
        return min(self._acceleration.lasted_s, self._rate.lasted_s) > _RESTS_S
