# SPDX-License-Identifier: Apache-2.0
"""What the parts of compensation hand to each other: wrench, payload, limits, and the error with a sentence.

Without NumPy, for command lines.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from bota_ethercat.pdo import AXES, STANDARD_GRAVITY, Vector3

Quaternion = tuple[float, float, float, float]  # x, y, z, w
ZERO: Final[Vector3] = (0.0, 0.0, 0.0)
# Gravity in the base frame (z up), m/s². The sensor's g is 9.80665 m/s², not 9.81.
DEFAULT_GRAVITY: Final[Vector3] = (0.0, 0.0, -STANDARD_GRAVITY)
NORM_TOLERANCE: Final = 0.01


class CompensationError(Exception):
    """Something cannot be estimated or identified; the text is one sentence for people."""


# Angular rate, rad/s, and angular acceleration, rad/s²; behind a filter that passes products of rates
# otherwise also these, (rad/s)²: xx yy zz, and xy xz yz.
Turning = tuple[Vector3, ...]
STILL: Final[Turning] = (ZERO, ZERO)
UPRIGHT: Final[Vector3] = (0.0, 0.0, STANDARD_GRAVITY)  # specific force at rest


class Wrench(NamedTuple):
    """A load that acts on the sensor, at the sensor's wrench origin and in its frame."""

    force: Vector3  # N
    torque: Vector3  # Nm, about the wrench origin

    @classmethod
    def of(cls, values: object) -> Wrench:
        """From six numbers: Fx Fy Fz (N) Mx My Mz (Nm). ValueError if they are not six finite numbers."""
        fx, fy, fz, mx, my, mz = _finite(values, 6, "a wrench")
        return cls((fx, fy, fz), (mx, my, mz))

    @property
    def values(self) -> tuple[float, float, float, float, float, float]:
        return *self.force, *self.torque

    def plus(self, other: Wrench, times: float = 1.0) -> Wrench:
        """The sum of this and `times` the other."""
        return Wrench.of([a + times * b for a, b in zip(self.values, other.values, strict=True)])


NO_WRENCH: Final = Wrench(ZERO, ZERO)


class Payload(NamedTuple):
    """What hangs on the sensor's tool side."""

    mass: float = 0.0  # kg
    center: Vector3 = ZERO  # center of gravity in the sensor's frame, m from the wrench origin
    # Ixx Iyy Izz Ixy Ixz Iyz about the center of gravity, in axes parallel to the sensor's, kg m²: diagonal
    # and off-diagonal elements of the tensor (Ixy is minus the integral of xy), as in URDF. A point mass: 0.
    inertia: tuple[float, ...] = (0.0,) * 6
    # Half the width of the 95 % intervals; of what is typical, or zeros, unless it was identified.
    center_interval: Vector3 = (0.002,) * 3
    inertia_interval: tuple[float, ...] = (0.0,) * 6

    def __str__(self) -> str:
        return f"a tool of {self.mass:.3g} kg" if self.mass else "no tool_mass"


def wrench_text(wrench: Wrench) -> str:
    numbers = " ".join(f"{axis} {value:.4f}" for axis, value in zip(AXES, wrench.values, strict=True))
    return f"{numbers} (N, Nm)"


NO_PAYLOAD: Final = Payload()
_REACH: Final = 0.1  # m: how far the mass of a tool is likely to be from a center of gravity at the origin
_LIKELY, _ABOUT = 0.2, 0.45
# m/s²: standard deviation of the offset of an axis of a MEMS accelerometer, once soldered.
OFFSET_PRIOR: Final = 0.4
# Likewise of an axis' sensitivity, relative (local gravity is within it), and of what it has of another axis.
SCALE_PRIOR: Final = 0.005
NORMAL_95: Final = 1.96  # half of a 95 % interval, in standard deviations
_SCALE_95: Final = NORMAL_95 * SCALE_PRIOR
CROSS_AXES: Final = ("xy", "xz", "yx", "yz", "zx", "zy")  # reading's axis, true axis
ELEMENTS: Final = ("xx", "yy", "zz", "xy", "xz", "yz")  # of a tensor
Six = tuple[float, float, float, float, float, float]


class Accelerometer(NamedTuple):
    """What an accelerometer reads: `scale` times the truth, axis by axis, plus `offset`.

    The axes are not quite orthogonal, nor quite parallel to those of the wrench: of each axis, parts of the
    others are subtracted. Every `..._interval` is half the width of the 95 % interval; of what is typical,
    unless it was identified.
    """

    offset: Vector3 = ZERO  # m/s²
    scale: Vector3 = (1.0, 1.0, 1.0)
    offset_interval: Vector3 = (NORMAL_95 * OFFSET_PRIOR,) * 3  # m/s²
    scale_interval: Vector3 = (_SCALE_95,) * 3
    cross_axis: Six = (0.0,) * 6  # in the order of CROSS_AXES
    cross_axis_interval: Six = (_SCALE_95,) * 6

    def correct(self, acceleration: Vector3) -> Vector3:
        """The truth, m/s², of what was read."""
        (x, y, z), (ox, oy, oz), (sx, sy, sz) = acceleration, self.offset, self.scale
        x, y, z = (x - ox) / sx, (y - oy) / sy, (z - oz) / sz
        xy, xz, yx, yz, zx, zy = self.cross_axis
        return x - xy * y - xz * z, y - yx * x - yz * z, z - zx * x - zy * y


EXACT: Final = Accelerometer()
Matrix = tuple[float, ...]  # nine numbers, row by row
IDENTITY: Final[Matrix] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Accuracy(NamedTuple):
    """What an identification knows of the errors of compensation: standard deviations on each axis.

    Zeros: not known. `left` is what a tool and an IMU that motion identified together leave, where their
    intervals, one by one, would say too much: N in any pose, N for each m/s² by which the specific force is
    another than in a tare, N for each rad/s²; and Nm likewise.
    """

    noise: Six = (0.0,) * 6  # of a sample's force, N, and torque, Nm, as it would be at SINC 51 with FIR off
    left: Six = (0.0,) * 6


UNKNOWN_ACCURACY: Final = Accuracy()


def likely_inertia(payload: Payload) -> tuple[Six, Six]:
    """The tensor about the center of gravity by mass and center alone, and half of its 95 % intervals, kg m².

    Of tools that begin at the sensor: they reach about as far beyond their center of gravity as it is away.
    """
    largest = payload.mass * (_REACH**2 + length(payload.center) ** 2)
    moment, half = _LIKELY * largest, _ABOUT * largest
    return (moment, moment, moment, 0.0, 0.0, 0.0), (half, half, half, *(_LIKELY * largest,) * 3)


def length(a: Vector3) -> float:
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def unit_quaternion(q: Quaternion) -> Quaternion:
    """`q` made exactly one long; ValueError, a sentence, if it is not nearly so."""
    x, y, z, w = q
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) <= NORM_TOLERANCE:  # a NaN is not either
        raise ValueError(f"a rotation is a quaternion of length 1, this one's is {norm:g}")
    return x / norm, y / norm, z / norm, w / norm


def vector(values: object, name: str) -> Vector3:
    """Three numbers. ValueError, a sentence with their `name`, if they are not three finite ones."""
    x, y, z = _finite(values, 3, name)
    return x, y, z


def _finite(values: object, count: int, name: str) -> list[float]:
    try:
        numbers = [float(value) for value in values]  # type: ignore[attr-defined]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} is {count} finite numbers, not {values!r:.80}")
    return numbers
