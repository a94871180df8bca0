# SPDX-License-Identifier: Apache-2.0
"""Contact: whether something touches the tool, and where on its surface. Plain floats; docs/compensation.md.

`contact.hpp` of the C++ client is its twin. Force and torque together (chi squared, 6 degrees of freedom) are
contact once they are beyond what noise and tool make so many times an hour, until they are within what these
make in 95 % of samples. In the plane that touches the surface m = p x f leaves a conic of points: exact for
Gaussian errors, however weak the force (Fieller's theorem).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from itertools import pairwise
from typing import Final, NamedTuple

from bota_ethercat.pdo import Vector3
from bota_ethercat.sensor.response import imu_noise, noise_taps
from bota_ethercat.settings import SettingValue
from bota_ft_compensation.bounds import Bounds
from bota_ft_compensation.quantities import (
    STILL,
    ZERO,
    CompensationError,
    Payload,
    Turning,
    length,
)

FARTHEST_M: Final = 10.0  # from the sensor: what a parameter may name
# Chi squared that 95 % keep to, with 6 and with 2 degrees of freedom, and the root of that with 3.
_RELEASE, _REGION, _CHI_3 = 12.592, 5.991, 2.795
_IMU_MOTION: Final = 0.08  # m/s² on each axis: deviation of what alignment leaves of motion, by its extremes


class Why(Enum):
    """Why there is no point."""

    POINT = "there is one"
    NO_CONTACT = "force and torque are within their uncertainty"
    FREE_MOMENT = "a free moment acts, so the line of action says nothing"
    TOO_WEAK = "the force across the surface is too small for its uncertainty"
    OFF_SURFACE = "the line of action does not meet the surface"


class Plane(NamedTuple):
    """A flat face of the tool: a disk, in the sensor's frame, m."""

    center: Vector3
    normal: Vector3  # of length 1, out of the tool
    radius: float


class Capsule(NamedTuple):
    """All within `radius` of a segment, in the sensor's frame, m; a sphere if its ends are the same.

    It is pressed, not pulled: a pull at the far side makes the same wrench.
    """

    start: Vector3
    end: Vector3
    radius: float


Surface = Plane | Capsule


class Uncertainty(NamedTuple):
    """Standard deviations of what is not contact in one compensated sample."""

    force: float  # N, of each axis
    torque: Vector3  # Nm, by axis
    tool: float = 0.0  # N on each axis, at `center`: of what is not known of the tool's weight
    center: Vector3 = ZERO  # m
    spin: float = 0.0  # Nm for each rad/s² of the sensor: inertia that is not known
    motion: float = 0.0  # N, as `tool`, for the decision only: the extremes of motion

    @classmethod
    def of(
        cls, noise: Sequence[float], force_95: float, torque_95: float, tool: Payload, spin_95: float = 0.0,
        imu: float = imu_noise({})[0],
    ) -> Uncertainty:  # fmt: skip
        """From deviations of the sensor's noise (6), 95 % bounds, N, Nm, and kg m² of inertia, and the
        deviation of the specific force by the `imu`, m/s² on each axis (`Alignment.noise`)."""
        weight, motion = (
            math.hypot(force_95 / _CHI_3, imu * tool.mass, each * tool.mass) for each in (0.0, _IMU_MOTION)
        )
        x, y, z = (math.hypot(each, torque_95 / _CHI_3) for each in noise[3:])
        force = math.hypot(*noise[:3]) / math.sqrt(3.0)
        return cls(force, (x, y, z), weight, tool.center, spin_95 / _CHI_3, motion)


def surface_of(text: str) -> Surface | None:
    """The surface of the parameter `contact.surface`, None of an empty one; CompensationError."""
    if not text.strip():
        return None
    kind, *words = text.split()
    try:
        *numbers, radius = map(float, words or ["nan"])
        if not (radius > 0.0 and all(abs(number) <= FARTHEST_M for number in (*numbers, radius))):
            raise ValueError("a number is out of range")
        x, y, z, *more = numbers
        a, b, c = more if kind in {"plane", "capsule"} else (x, y, z)
        size = math.hypot(a, b, c)
        if kind == "plane":
            return Plane((x, y, z), (a / size, b / size, c / size), radius)
        if kind == "capsule" or (kind == "sphere" and not more):
            return Capsule((x, y, z), (a, b, c), radius)
        raise ValueError(f"{kind!r} is no surface")
    except (ValueError, ZeroDivisionError) as error:
        raise CompensationError(
            f"parameter contact.surface is {text!r}: it must be plane X Y Z NX NY NZ RADIUS, sphere X Y Z "
            f"RADIUS or capsule X Y Z X Y Z RADIUS, in m ({error})"
        ) from None


def detector_of(
    surface: Surface, tool: Payload, bounds: Bounds, settings: Mapping[str, SettingValue], rate_hz: float,
    alarms_per_hour: float = 1.0,
) -> ContactDetector:  # fmt: skip
    """By the bounds of a sensor with these settings; CompensationError."""
    force, torque = (math.sqrt(each / 3.0) for each in bounds.imu)
    weight, at_center, spin = bounds.of_tool()
    noise = [*bounds.noise[:3], *(math.hypot(each, torque) for each in bounds.noise[3:])]
    imu = force / tool.mass if tool.mass else 0.0
    known = Uncertainty.of(noise, _CHI_3 * weight, _CHI_3 * at_center, tool, _CHI_3 * spin, imu)
    return ContactDetector(surface, known, rate_hz, correlation(settings), alarms_per_hour)


def correlation(settings: Mapping[str, SettingValue]) -> float:
    """Of the noise of one sample and the next, by the sensor's filters."""
    return sum(a * b for a, b in pairwise(noise_taps(settings)))


def _level(share: Callable[[float], float], alarms_per_sample: float, correlation: float) -> float:
    """The square of how many standard deviations noise exceeds so often, each excursion counted once.

    At most each sample beyond it begins one; where samples are alike Rice's formula tells how many do.
    """
    low, high = 0.0, 40.0
    for _ in range(60):
        u = 0.5 * (low + high)
        crossing = min(1.0, u * math.sqrt((1.0 - correlation) / math.pi))
        low, high = (u, high) if share(u) * crossing > alarms_per_sample else (low, u)
    return high * high


def _share_of_six(u: float) -> float:
    x = 0.5 * u * u
    return math.exp(-x) * (1.0 + x + 0.5 * x * x)


class Region(NamedTuple):
    """An ellipse in the plane that touches the surface: in 95 % of cases the contact is in it."""

    center: Vector3  # m
    normal: Vector3  # out of the tool
    u: Vector3  # with v and the normal a right-handed frame
    v: Vector3
    uu: float  # m²: x from the center is within if x^T M^-1 x <= 1
    uv: float
    vv: float

    def contains(self, point: Vector3) -> bool:
        away = _add(point, self.center, -1.0)
        a, b = _dot(self.u, away), _dot(self.v, away)
        return self.vv * a * a - 2.0 * self.uv * a * b + self.uu * b * b <= self.uu * self.vv - self.uv**2

    @property
    def largest(self) -> float:
        """The longer semi-axis, m."""
        return math.sqrt(0.5 * (self.uu + self.vv) + math.hypot(0.5 * (self.uu - self.vv), self.uv))

    def covariance(self) -> list[float]:
        """(3, 3) row by row, m²; of no extent along the normal."""
        uu, uv, vv = (each / _REGION for each in self[4:])
        pairs = list(zip(self.u, self.v, strict=True))
        return [uu * a * c + uv * (a * d + b * c) + vv * b * d for a, b in pairs for c, d in pairs]


class Contact(NamedTuple):
    """Where one sample's contact is; `point` is the likeliest, the middle of the region is farther out."""

    why: Why
    is_press: bool = True  # towards the tool; a pull if not
    point: Vector3 = ZERO  # m, in the sensor's frame
    region: Region | None = None  # None: there is no point


class ContactDetector:
    """Whether samples are contact (`update`, for every sample), and where (`locate`, where it is wanted)."""

    def __init__(
        self, surface: Surface, uncertainty: Uncertainty, rate_hz: float,
        correlation: float = 0.0, alarms_per_hour: float = 1.0,
    ) -> None:  # fmt: skip
        """CompensationError if it cannot be. `correlation` is of the noise of one sample and the next."""
        values = uncertainty.force, *uncertainty.torque, rate_hz, alarms_per_hour, surface.radius
        if not (min(values) > 0.0 and math.isfinite(sum(values))):
            raise CompensationError(
                "contact needs noise, a sampling rate, false alarms an hour and a radius above 0: set them"
            )
        self.is_contact = False
        self._surface, self._uncertainty = surface, uncertainty
        share = alarms_per_hour / 3600.0 / rate_hz
        self.level = _level(_share_of_six, share, correlation)  # of chi squared
        self._moment_level = _level(lambda u: math.erfc(u * math.sqrt(0.5)), share, correlation)
        # About a point this far to the tool's center of gravity errors of force and torque are independent.
        tool, center = max(uncertainty.tool, uncertainty.motion) ** 2, uncertainty.center
        self._force_variance = both = uncertainty.force**2 + tool
        self._pivot = _add(ZERO, center, tool / both)
        rest = tool * uncertainty.force**2 / both  # N²
        levers = zip(uncertainty.torque, center, strict=True)
        self._torque_variances = [each**2 + rest * (_dot(center, center) - c * c) for each, c in levers]
        ends = surface[:1] if isinstance(surface, Plane) else surface[:2]
        self._reach = max(map(length, ends)) + surface.radius
        self._spin = uncertainty.spin**2

    def update(self, force: Vector3, torque: Vector3, turning: Turning = STILL) -> bool:
        """Whether a compensated sample, N and Nm, is contact; `turning`: rad/s and rad/s²."""
        (fx, fy, fz), (mx, my, mz) = force, torque
        (px, py, pz), (x, y, z) = self._pivot, self._torque_variances
        mx, my, mz = mx - py * fz + pz * fy, my - pz * fx + px * fz, mz - px * fy + py * fx
        if self._spin:
            spun = self._spun(turning)
            x, y, z = x + spun, y + spun, z + spun
        size = (fx * fx + fy * fy + fz * fz) / self._force_variance + mx * mx / x + my * my / y + mz * mz / z
        self.is_contact = size > (_RELEASE if self.is_contact else self.level)
        return self.is_contact

    def _spun(self, turning: Turning) -> float:
        (x, y, z), (a, b, c), *_ = turning
        return self._spin * (a * a + b * b + c * c + (x * x + y * y + z * z) ** 2)

    def locate(self, force: Vector3, torque: Vector3, turning: Turning = STILL) -> Contact:
        """Where the latest sample of `update` is contact."""
        if not self.is_contact:
            return Contact(Why.NO_CONTACT)
        surface, (_, deviations, weight, heavy, *_) = self._surface, self._uncertainty
        a, tool, spun = self._uncertainty.force**2, weight * weight, self._spun(turning)
        b = [each * each + spun for each in deviations]
        ff, mm, least = _dot(force, force), _dot(torque, torque), _REGION * (a + tool)
        if ff < least:
            farthest = (math.sqrt(ff) + math.sqrt(least)) * self._reach
            return Contact(Why.FREE_MOMENT if mm > farthest * farthest else Why.TOO_WEAK)
        turned = _add(torque, _cross(heavy, force), -1.0)  # by which an unknown weight changes f m
        spread = _weighted(b, force, force) + a * mm + tool * _dot(turned, turned)
        if _dot(force, torque) ** 2 > self._moment_level * spread:
            return Contact(Why.FREE_MOMENT)
        if isinstance(surface, Plane):
            at, n, side = surface.center, surface.normal, None
        elif found := _first_hit(surface, force, torque):
            at, n, side = found
        else:
            slack = math.sqrt(_REGION * (max(b) + (a + tool) * self._reach**2) / ff)
            is_near = _first_hit(surface._replace(radius=surface.radius + slack), force, torque)
            return Contact(Why.TOO_WEAK if is_near else Why.OFF_SURFACE)
        u, v = (side, _cross(n, side)) if side else _tangents(n)
        fn, d, cn = _dot(force, n), _dot(at, n), _dot(heavy, n)
        if fn * fn <= least:
            return Contact(Why.TOO_WEAK)
        # The point is at (pu, pv, d), and fn p = q; s: the covariance of fn p - q, but for a p p^T.
        qu, qv = d * _dot(force, u) - _dot(torque, v), d * _dot(force, v) + _dot(torque, u)
        pu, pv = qu / fn, qv / fn
        ru, rv, rest = pu - _dot(heavy, u), pv - _dot(heavy, v), a * d * d + tool * (d - cn) ** 2
        suu, svv = rest + tool * ru * ru + _weighted(b, v, v), rest + tool * rv * rv + _weighted(b, u, u)
        suv = tool * ru * rv - _weighted(b, u, v)
        # The conic: p^T g p - 2 h^T p + ... <= 0, times the determinant of s.
        rest, bent = fn * fn - _REGION * a, suu * svv - suv * suv
        guu, guv, gvv = rest * svv + a * qv * qv, -rest * suv - a * qu * qv, rest * suu + a * qu * qu
        hu, hv, det = fn * (svv * qu - suv * qv), fn * (suu * qv - suv * qu), guu * gvv - guv * guv
        eu, ev = (gvv * hu - guv * hv) / det, (guu * hv - guv * hu) / det
        size = (hu * (eu - pu) + hv * (ev - pv) + _REGION * bent) / det
        foot = _add(ZERO, n, d)
        center, point = (_add(_add(foot, u, x), v, y) for x, y in ((eu, ev), (pu, pv)))
        region = Region(center, n, u, v, size * gvv, -size * guv, size * guu)
        if isinstance(surface, Plane):
            if (away := math.dist(center, at) - surface.radius) > 0.0 and away > region.largest:
                return Contact(Why.OFF_SURFACE)
        elif (math.sqrt(region.vv) if side else region.largest) > surface.radius:
            return Contact(Why.TOO_WEAK)
        return Contact(Why.POINT, fn < 0.0, point, region)


def _first_hit(
    surface: Capsule, force: Vector3, torque: Vector3
) -> tuple[Vector3, Vector3, Vector3 | None] | None:
    """Where the line of action enters, the normal there, and the axis unless at an end; None: nowhere."""
    start, end, radius = surface
    ff, axis = _dot(force, force), _add(end, start, -1.0)
    along, high = _add(ZERO, force, 1.0 / math.sqrt(ff)), length(axis)
    axis = _add(ZERO, axis, 1.0 / high) if high else axis
    foot = _add(_add(ZERO, _cross(force, torque), 1.0 / ff), start, -1.0)  # of the line, from `start`
    t, slope, up = -length(foot) - high - radius, _dot(along, axis), _dot(foot, axis)
    for _ in range(100):  # Newton's method: the distance is convex, and it comes from outside
        at = min(max(up + t * slope, 0.0), high)
        away = _add(_add(foot, along, t), axis, -at)
        distance = length(away)
        gap, nearing = distance - radius, -_dot(away, along) / distance
        if gap < 1e-9 * radius:
            side = axis if 0.0 < at < high else None
            return _add(_add(start, foot), along, t), _add(ZERO, away, 1.0 / distance), side
        if nearing <= 0.0:
            break
        t += gap / nearing
    return None


def _tangents(n: Vector3) -> tuple[Vector3, Vector3]:
    """Two directions that make a right-handed frame with `n`."""
    u = _cross(n, (1.0, 0.0, 0.0) if abs(n[0]) < 0.7 else (0.0, 1.0, 0.0))
    u = _add(ZERO, u, 1.0 / length(u))
    return u, _cross(n, u)


def _add(a: Vector3, b: Vector3, times: float = 1.0) -> Vector3:
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


def _dot(a: Vector3, b: Vector3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _weighted(weights: Sequence[float], a: Vector3, b: Vector3) -> float:
    return weights[0] * a[0] * b[0] + weights[1] * a[1] * b[1] + weights[2] * a[2] * b[2]


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
