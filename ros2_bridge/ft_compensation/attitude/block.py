"""Blocks of samples: what `TiltFilter` goes by. `add` is for every sample, so in plain floats."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ft_compensation.attitude.carried import CarriedAttitude
from ft_compensation.quantities import ZERO
from protocol.pdo import Vector3

_INDEPENDENT: Final = 20
"""Samples of a block that count as independent, however many there are: a vibration of 20 to 60 Hz is not
white, and leaves up to a fifth of its rms in the mean of 50 ms."""


class Block(NamedTuple):
    """Means of some samples, and how well they are known."""

    attitude: NDArray[np.float64]
    """Mean of the matrix that turns the sensor's vectors into the still frame, (3, 3)."""
    acceleration: Vector3 | None
    """m/s² in the still frame; None if that of a sample could not be used"""
    rate: Vector3
    """Less the gyroscope's offset, rad/s in the sensor's frame"""
    passed_s: float
    longest_s: float
    """The longest time between two samples."""
    noise: float
    """Standard deviation of a component of `acceleration`, by the scatter of the samples, m/s²"""
    rate_noise: float
    """The same of `rate`, rad/s"""


class BlockSum:
    """Adds samples up, from `begin` to `end`."""

    __slots__ = ("_count", "_first", "_longest_s", "_rate_squares", "_spoiled", "_squares", "_sum", "_turned",
                 "began_s")  # fmt: skip

    def __init__(self) -> None:
        self.begin(0.0, CarriedAttitude())

    def begin(self, time_s: float, attitude: CarriedAttitude) -> None:
        """There are no samples yet."""
        self.began_s, self._first = time_s, attitude.matrix
        self._sum = self._turned = ZERO
        self._count, self._spoiled = 0, False
        self._longest_s = self._squares = self._rate_squares = 0.0

    def add(
        self,
        attitude: CarriedAttitude,
        acceleration: Vector3 | None,
        rate: Vector3,
        turn: Vector3,
        passed_s: float,
    ) -> bool:
        """Take a sample, and the turn since the previous one, rad. False: it spoils the block."""
        tx, ty, tz = turn
        sx, sy, sz = self._turned
        self._turned = sx + tx, sy + ty, sz + tz
        if passed_s > self._longest_s:  # noqa: PLR1730 - twice as fast as max()
            self._longest_s = passed_s
        self._count += 1
        if acceleration is None:
            self._spoiled = True
            return False
        ax, ay, az = acceleration
        wx, wy, wz = rate
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = attitude.matrix
        sx, sy, sz = self._sum
        self._sum = (
            sx + xx * ax + xy * ay + xz * az,
            sy + yx * ax + yy * ay + yz * az,
            sz + zx * ax + zy * ay + zz * az,
        )
        square = ax * ax + ay * ay + az * az
        self._squares += square
        self._rate_squares += wx * wx + wy * wy + wz * wz
        if square - square == 0.0:
            return True
        self._spoiled = True  # NaN or infinity
        return False

    def end(self, time_s: float, attitude: CarriedAttitude) -> Block:
        """Their means."""
        passed_s, count = time_s - self.began_s, self._count
        x, y, z = self._turned
        rate = x / passed_s, y / passed_s, z / passed_s
        middle = 0.5 * (np.array(self._first) + np.array(attitude.matrix))
        if self._spoiled:
            return Block(middle, None, rate, passed_s, self._longest_s, 0.0, 0.0)
        x, y, z = self._sum
        mean = x / count, y / count, z / count
        x, y, z = attitude.offset
        read = rate[0] + x, rate[1] + y, rate[2] + z
        return Block(
            middle, mean, rate, passed_s, self._longest_s,
            _noise(self._squares, mean, count), _noise(self._rate_squares, read, count),
        )  # fmt: skip


def _noise(squares: float, mean: Vector3, count: int) -> float:
    """Standard deviation of a component of the mean of `count` vectors, by the sum of their squares."""
    x, y, z = mean
    scatter = max(0.0, squares / count - x * x - y * y - z * z)  # of all three components
    return math.sqrt(scatter / (3.0 * min(count, _INDEPENDENT)))
