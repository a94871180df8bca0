"""How far the carried attitude is tilted, by an arm that never rests: its velocity stays small.

The acceleration of an arm adds up to nothing over time, and an error of the tilt, which makes gravity look
like an acceleration, adds up to more and more. A Kalman filter beside `TiltFilter`, with 7 numbers:

    tilt     (2)  as there, rad
    offset   (3)  as there, rad/s
    velocity (2)  of the arm, as a tilt times seconds: (vy, -vx) / g

    d velocity/dt = (fy, -fx)/g - tilt    f: mean acceleration in the still frame
    0             = velocity + noise      of an arm that is as fast as `_FAST`

It needs about 13 s to know the direction to 4°, whatever the arm does meanwhile. What is much faster than an
arm, such as a vehicle, contradicts, and everything here begins anew; but a vehicle's steady acceleration
looks like a tilt. So `TiltFilter` takes it only where it is at a loss itself.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ft_compensation.attitude.block import Block
from ft_compensation.attitude.covariance import Array, inverse

_FAST: Final = 1.0
"""m/s, standard deviation of a component."""
_KEPT_S: Final = 0.5
"""Time constant with which an arm's velocity changes."""
_LOOKS_S: Final = 0.25
"""From one measurement of the velocity to the next."""
_FORCE: Final = 0.03
"""m/s²: what else is wrong with the mean acceleration of a block."""
_CONTRADICTS: Final = 4.0**2
_VERTICAL_S: Final = 3.0
_VERTICAL: Final = 5.0
"""m/s: an arm's vertical accelerations, added up and forgotten with that time constant, are below it."""
_LONGEST_S: Final = 0.1
"""A gap between samples beyond it may hide any velocity."""
_VELOCITY: Final = np.eye(2, 7, 5)


class MotionTilt:
    """One step, `follow`, for each block; `corrected` tells it what was done to attitude and offset."""

    def __init__(self, magnitude: float) -> None:
        """`magnitude` of gravity, m/s²."""
        self._magnitude = magnitude
        self._since_s = self._vertical = 0.0
        self.forget(1.0, np.eye(3))

    def forget(self, start: float, offset: Array) -> None:
        """`start` is the variance of the tilt, rad², `offset` the covariance of the offset, (rad/s)²."""
        self._error: Array = np.zeros(7)
        self._start = start, offset
        p: Array = np.zeros((7, 7))
        self.covariance = p
        p[0, 0] = p[1, 1] = start
        p[2:5, 2:5] = offset
        self._lose_velocity()

    def _lose_velocity(self) -> None:
        p = self.covariance
        p[5:] = p[:, 5:] = 0.0
        p[5, 5] = p[6, 6] = (_FAST / self._magnitude) ** 2
        self._error[5:] = 0.0
        self._since_s = self._vertical = 0.0

    def follow(self, block: Block, grows: float, drift: float) -> None:
        """Take a block; tilt and offset have become less certain by so much variance."""
        passed_s, mean = block.passed_s, block.acceleration
        f = np.eye(7)
        f[:2, 2:5] = -passed_s * block.attitude[:2]
        f[5, 0] = f[6, 1] = -passed_s
        error, p = f @ self._error, f @ self.covariance @ f.T
        lost = (_FORCE / self._magnitude * passed_s) ** 2
        for axis, more in enumerate((grows, grows, drift, drift, drift, lost, lost)):
            p[axis, axis] += more
        self._error, self.covariance = error, p
        if mean is None or block.longest_s > _LONGEST_S:
            self._lose_velocity()
            return
        self._vertical *= math.exp(-passed_s / _VERTICAL_S)
        self._vertical += passed_s * (mean[2] - self._magnitude)
        if abs(self._vertical) > _VERTICAL:  # wrong units, or no arm
            self.forget(*self._start)
            return
        error[5] += passed_s * mean[1] / self._magnitude
        error[6] -= passed_s * mean[0] / self._magnitude
        self._since_s += passed_s
        if self._since_s >= _LOOKS_S:
            self._look()

    def _look(self) -> None:
        """Take it that the velocity is an arm's."""
        # White noise that says as much as the correlated velocity does.
        noise = (_FAST / self._magnitude) ** 2 * 2.0 * _KEPT_S / self._since_s
        self._since_s = 0.0
        p, h = self.covariance, _VELOCITY
        weight = inverse(p[5:, 5:] + np.eye(2) * noise)
        velocity = self._error[5:]
        if velocity @ weight @ velocity > _CONTRADICTS:
            self.forget(*self._start)
            return
        gain = p[:, 5:] @ weight
        m = np.eye(7) - gain @ h
        p = m @ p @ m.T + noise * gain @ gain.T
        self.covariance = 0.5 * (p + p.T)
        self._error = self._error - gain @ velocity

    def corrected(self, tilt: tuple[float, float], offset: Array) -> None:
        """The attitude was turned by `tilt`, rad, and the offset changed by `offset`, rad/s."""
        self._error[:2] -= tilt
        self._error[2:5] -= offset

    @property
    def error(self) -> Array:
        """The estimate of tilt and offset, (5,)."""
        return self._error[:5]
