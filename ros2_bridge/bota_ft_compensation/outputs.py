# SPDX-License-Identifier: Apache-2.0
"""The compensated wrench filtered, and in another frame. Plain floats.

`wrench_filtered`: a second-order Butterworth low-pass in direct form I. Its state is past inputs and outputs,
which mean the same whatever the coefficients, so a new cut-off makes no step. At the first sample, and after
a pause longer than the filter's memory, the state is what a constant load would have left: no transient.

Another frame: rotated, and its torque about the other frame's origin (docs/ros2.md), whether it moves or not.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from bota_ethercat.pdo import Vector3
from bota_ft_compensation.quantities import (
    CompensationError,
    Quaternion,
    Wrench,
    unit_quaternion,
)

LEAST_CUTOFF_HZ: Final = 0.05
Six = tuple[float, ...]  # Fx Fy Fz (N) Mx My Mz (Nm)
_SHORTEST_PAUSE: Final = 3.5  # sample periods: fewer are a few lost samples, which the state outlives


def cutoff_problem(cutoff_hz: float, rate_hz: float) -> str:
    """Why samples of this rate are too few for a low-pass, a sentence; empty if they are not."""
    half = rate_hz / 2.0
    if cutoff_hz < half:
        return ""
    return (
        f"filter.cutoff is {cutoff_hz:g} Hz, but must be below half of the sampling rate, {half:g} Hz: "
        "lower it"
    )


class Coefficients(NamedTuple):
    """y[n] = b (x[n] + 2 x[n-1] + x[n-2]) - a1 y[n-1] - a2 y[n-2]"""

    b: float
    a1: float
    a2: float
    delay: float  # group delay at DC, in samples


def low_pass(cutoff_hz: float, rate_hz: float) -> Coefficients:
    """Second-order Butterworth by the bilinear transform, exact at the cut-off."""
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    damping = math.sqrt(2.0) * k
    scale = 1.0 / (1.0 + damping + k * k)
    return Coefficients(
        k * k * scale, 2.0 * (k * k - 1.0) * scale, (1.0 - damping + k * k) * scale, 1.0 / damping
    )


class WrenchFilter:
    """Filters every sample of a stream. `step` is for one thread; another may `design` meanwhile."""

    def __init__(self) -> None:
        self.delay_s = 0.0  # group delay at DC, without the sensor's own filters
        self._coefficients = Coefficients(1.0, 0.0, 0.0, 0.0)
        none: Six = ()
        self._x1 = self._x2 = self._y1 = self._y2 = none
        self._longest_pause_ns = 0.0
        self._last_ns = math.inf

    def design(self, cutoff_hz: float, rate_hz: float) -> None:
        """For samples of this rate, from the next one on. CompensationError if they are too few for it."""
        if problem := cutoff_problem(cutoff_hz, rate_hz):
            raise CompensationError(problem)
        self._coefficients = low_pass(cutoff_hz, rate_hz)
        self.delay_s = self._coefficients.delay / rate_hz
        memory_s = 1.0 / (2.0 * math.pi * cutoff_hz)
        self._longest_pause_ns = 1e9 * max(_SHORTEST_PAUSE / rate_hz, memory_s)

    def step(self, force: Vector3, torque: Vector3, time_ns: int) -> Wrench:
        values: Six = force + torque
        passed_ns, self._last_ns = time_ns - self._last_ns, time_ns
        if not 0 <= passed_ns <= self._longest_pause_ns:
            self._x1 = self._x2 = self._y1 = self._y2 = values  # as if they had always been
        b, a1, a2, _ = self._coefficients
        fx, fy, fz, mx, my, mz = result = tuple([
            b * (x + 2.0 * p + q) - a1 * u - a2 * v
            for x, p, q, u, v in zip(values, self._x1, self._x2, self._y1, self._y2, strict=True)
        ])  # fmt: skip
        self._x2, self._x1, self._y2, self._y1 = self._x1, values, self._y1, result
        return Wrench((fx, fy, fz), (mx, my, mz))


Rotation = tuple[Vector3, Vector3, Vector3]  # a rotation matrix, row by row


class WrenchTransform(NamedTuple):
    """From a source frame to a target frame."""

    rotation: Rotation  # takes vectors of the source frame to the target frame
    translation: Vector3  # the origin of the source frame in the target frame, m

    @classmethod
    def of(cls, translation: Vector3, quaternion: Quaternion) -> WrenchTransform:
        """From the pose of the source frame in the target frame, as TF gives it. ValueError if it is none."""
        x, y, z, w = unit_quaternion(quaternion)
        if not math.isfinite(sum(translation)):
            raise ValueError("a translation is three finite numbers")
        rotation = (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
            (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
            (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
        )
        return cls(rotation, translation)

    def inverse(self) -> WrenchTransform:
        (a, b, c), (d, e, f), (g, h, i) = self.rotation
        x, y, z = self.translation
        back = (a, d, g), (b, e, h), (c, f, i)
        return type(self)(
            back, (-a * x - d * y - g * z, -b * x - e * y - h * z, -c * x - f * y - i * z)
        )  # fmt: skip

    def apply(self, force: Vector3, torque: Vector3) -> Wrench:
        """The wrench in the target frame, its torque about that frame's origin."""
        (a, b, c), (d, e, f), (g, h, i) = self.rotation
        x, y, z = self.translation
        fx, fy, fz = force
        mx, my, mz = torque
        px, py, pz = a * fx + b * fy + c * fz, d * fx + e * fy + f * fz, g * fx + h * fy + i * fz
        return Wrench(
            (px, py, pz),
            (
                a * mx + b * my + c * mz + y * pz - z * py,
                d * mx + e * my + f * mz + z * px - x * pz,
                g * mx + h * my + i * mz + x * py - y * px,
            ),
        )
