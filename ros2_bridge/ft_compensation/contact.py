# SPDX-License-Identifier: Apache-2.0
"""Contact: whether something touches the tool, and where on its surface. Plain floats; docs/compensation.md.

`contact.hpp` of the C++ client is its twin. Force and torque together (chi squared, 6 degrees of freedom) are
contact once they are beyond what noise and tool make so many times an hour, until they are within what these
make in 95 % of samples. In the plane that touches the surface m = p x f leaves a conic of points: exact for
Gaussian errors, however weak the force (Fieller's theorem).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Final, NamedTuple, Self

from bota_ethercat.pdo import Vector3
from bota_ethercat.sensor.response import fir_taps
from bota_ethercat.settings import SettingValue
from ft_compensation.quantities import STILL, ZERO, CompensationError, Payload, Turning, length

# Chi squared that 95 % keep to, with 6 and with 2 degrees of freedom, and the root of that with 3.
_RELEASE, _REGION, _CHI_3 = 12.592, 5.991, 2.795
# m/s², standard deviations on each axis: of the accelerometer's noise, brought to the instant of the force,
# and of all that it lets pass in motion, whose extremes are farther out than a Gaussian's.
_IMU_NOISE, _IMU_MOTION = 0.04, 0.07
# Standard deviations of a healthy sensor at SINC 51, N and Nm, and the powers with which they fall.
_NOISE, _NOISE_SINC = (*((0.3, 0.62),) * 3, (0.007, 0.78), (0.007, 0.78), (0.0025, 0.78)), 51
_SINC: Final = (66.0, 26.0, 1.0)  # autocorrelation of the third-order sinc filter, from lag 0
_FARTHEST: Final = 40.0  # standard deviations


class Why(IntEnum):
    """Why there is no point."""

    POINT = 0
    NO_CONTACT = 1
    FREE_MOMENT = 2
    TOO_WEAK = 3
    OFF_SURFACE = 4

    def __str__(self) -> str:
        return _SENTENCES[self]


_SENTENCES: Final = (
    "the contact has a point",
    "force and torque are within their uncertainty",
    "a free moment acts, so the line of action says nothing",
    "the force across the surface is too small for its uncertainty",
    "the line of action does not meet the surface",
)


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
        cls, noise: tuple[float, ...], force_95: float, torque_95: float, tool: Payload, spin_95: float = 0.0
    ) -> Self:
        """Of six standard deviations of the sensor's noise, and of 95 % bounds: N, Nm, and kg m² of inertia.

        `force_95` acts at the tool's center of gravity.
        """
        *force, x, y, z = noise
        torque, weight = torque_95 / _CHI_3, force_95 / _CHI_3
        return cls(
            math.hypot(*force) / math.sqrt(3.0),
            (math.hypot(x, torque), math.hypot(y, torque), math.hypot(z, torque)),
            math.hypot(weight, _IMU_NOISE * tool.mass),
            tool.center,
            spin_95 / _CHI_3,
            math.hypot(weight, _IMU_MOTION * tool.mass),
        )


def healthy_noise(settings: Mapping[str, SettingValue]) -> tuple[float, ...]:
    """Six standard deviations, N and Nm, of a healthy sensor's samples with these settings."""
    shorter = _NOISE_SINC / (settings.get("sinc_length") or _NOISE_SINC)
    passed = math.sqrt(sum(tap * tap for tap in fir_taps())) if settings.get("fir") else 1.0
    return tuple(size * shorter**power * passed for size, power in _NOISE)


def correlation(settings: Mapping[str, SettingValue]) -> float:
    """Of the noise of one sample and the next, by the sensor's filters."""
    taps = fir_taps() if settings.get("fir") else (1.0,)
    lags = [(i - j, a * b) for i, a in enumerate(taps) for j, b in enumerate(taps)]
    zero, one = (
        sum(both * _SINC[abs(lag + by)] for lag, both in lags if abs(lag + by) < len(_SINC)) for by in (0, 1)
    )
    return one / zero


def _level(share: Callable[[float], float], alarms_per_sample: float, correlation: float) -> float:
    """The number of standard deviations that noise exceeds so often, each excursion counted once.

    At most each sample beyond it begins one; samples that are alike cross it by Rice's formula.
    """
    low, high = 0.0, _FARTHEST
    for _ in range(60):
        middle = 0.5 * (low + high)
        crossing = min(1.0, middle * math.sqrt((1.0 - correlation) / math.pi))
        low, high = (middle, high) if share(middle) * crossing > alarms_per_sample else (low, middle)
    return high


def _share_of_six(u: float) -> float:
    x = 0.5 * u * u
    return math.exp(-x) * (1.0 + x + 0.5 * x * x)


class Region(NamedTuple):
    """An ellipse in the plane that touches the surface: with 95 % the point of contact is in it."""

    center: Vector3  # m
    normal: Vector3  # out of the tool
    u: Vector3  # with v and the normal a right-handed frame
    v: Vector3
    uu: float  # m²: (a, b) from the center is within if (a, b) M^-1 (a, b) <= 1
    uv: float
    vv: float

    def contains(self, point: Vector3) -> bool:
        away = [at - center for at, center in zip(point, self.center, strict=True)]
        a, b = _dot(self.u, away), _dot(self.v, away)
        return self.vv * a * a - 2.0 * self.uv * a * b + self.uu * b * b <= self.uu * self.vv - self.uv**2

    @property
    def largest(self) -> float:
        """The longer semi-axis, m."""
        half = 0.5 * (self.uu - self.vv)
        return math.sqrt(0.5 * (self.uu + self.vv) + math.hypot(half, self.uv))

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


_NO_POINT: Final = {why: Contact(why) for why in Why}


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
        self.level = _level(_share_of_six, share, correlation) ** 2  # of chi squared
        self._moment_level = _level(lambda u: math.erfc(u * math.sqrt(0.5)), share, correlation) ** 2
        tool, arm = max(uncertainty.tool, uncertainty.motion), length(uncertainty.center)
        self._force_variance = uncertainty.force**2 + tool**2
        self._torque_variances = [each**2 + (tool * arm) ** 2 for each in uncertainty.torque]
        self._spin = uncertainty.spin**2
        ends = (surface.center,) if isinstance(surface, Plane) else (surface.start, surface.end)
        self._reach = max(map(length, ends)) + surface.radius
        self._frame = _frame(surface.normal) if isinstance(surface, Plane) else None

    def update(self, force: Vector3, torque: Vector3, turning: Turning = STILL) -> bool:
        """Whether a compensated sample, N and Nm, is contact; `turning`: rad/s and rad/s²."""
        (fx, fy, fz), (mx, my, mz) = force, torque
        x, y, z = self._torque_variances
        if self._spin:
            spun = self._spun(turning)
            x, y, z = x + spun, y + spun, z + spun
        size = (fx * fx + fy * fy + fz * fz) / self._force_variance + mx * mx / x + my * my / y + mz * mz / z
        self.is_contact = size > (_RELEASE if self.is_contact else self.level)
        return self.is_contact

    def _spun(self, turning: Turning) -> float:
        (x, y, z), (a, b, c) = turning
        return self._spin * (a * a + b * b + c * c + (x * x + y * y + z * z) ** 2)

    def locate(self, force: Vector3, torque: Vector3, turning: Turning = STILL) -> Contact:
        """Where the latest sample of `update` is contact."""
        if not self.is_contact:
            return _NO_POINT[Why.NO_CONTACT]
        known, surface = self._uncertainty, self._surface
        (fx, fy, fz), (mx, my, mz), (cx, cy, cz) = force, torque, known.center
        a, tool, spun = known.force**2, known.tool**2, self._spun(turning) if self._spin else 0.0
        bx, by, bz = known.torque
        bx, by, bz = bx * bx + spun, by * by + spun, bz * bz + spun
        ff, mm = fx * fx + fy * fy + fz * fz, mx * mx + my * my + mz * mz
        if ff < _REGION * (a + tool):
            farthest = (math.sqrt(ff) + _CHI_3 * math.sqrt(a + tool)) * self._reach
            return _NO_POINT[Why.FREE_MOMENT if mm > farthest * farthest else Why.TOO_WEAK]
        # A weight that is not known turns f and m about the center of gravity.
        lx, ly, lz = mx - cy * fz + cz * fy, my - cz * fx + cx * fz, mz - cx * fy + cy * fx
        spread = bx * fx * fx + by * fy * fy + bz * fz * fz + a * mm + tool * (lx * lx + ly * ly + lz * lz)
        if (fx * mx + fy * my + fz * mz) ** 2 > self._moment_level * spread:
            return _NO_POINT[Why.FREE_MOMENT]
        if isinstance(surface, Plane):
            (px, py, pz), normal, is_round = surface.center, surface.normal, False
            u, v = self._frame or _frame(normal)
        else:
            variance = max(bx, by, bz) + (a + tool) * self._reach**2
            found = _first_hit(surface, force, torque, math.sqrt(_REGION * variance))
            if isinstance(found, Why):
                return _NO_POINT[found]
            (px, py, pz), normal, side = found
            is_round = side is None
            u, v = _frame(normal) if side is None else (side, _cross(normal, side))
        (nx, ny, nz), (ux, uy, uz), (vx, vy, vz) = normal, u, v
        fn = fx * nx + fy * ny + fz * nz
        if fn * fn <= _REGION * (a + tool):
            return _NO_POINT[Why.TOO_WEAK]
        # The point is at (pu, pv, d), and fn p = q; s: the covariance of fn p - q, but for a p p^T.
        d = px * nx + py * ny + pz * nz
        qu = d * (fx * ux + fy * uy + fz * uz) - mx * vx - my * vy - mz * vz
        qv = d * (fx * vx + fy * vy + fz * vz) + mx * ux + my * uy + mz * uz
        pu, pv = qu / fn, qv / fn
        ru, rv = pu - cx * ux - cy * uy - cz * uz, pv - cx * vx - cy * vy - cz * vz
        rest = a * d * d + tool * (d - cx * nx - cy * ny - cz * nz) ** 2
        suu = rest + tool * ru * ru + bx * vx * vx + by * vy * vy + bz * vz * vz
        svv = rest + tool * rv * rv + bx * ux * ux + by * uy * uy + bz * uz * uz
        suv = tool * ru * rv - bx * ux * vx - by * uy * vy - bz * uz * vz
        # The conic: p^T g p - 2 h^T p + ... <= 0, times the determinant of s.
        rest = fn * fn - _REGION * a
        guu, guv, gvv = rest * svv + a * qv * qv, -rest * suv - a * qu * qv, rest * suu + a * qu * qu
        hu, hv = fn * (svv * qu - suv * qv), fn * (suu * qv - suv * qu)
        det, bent = guu * gvv - guv * guv, suu * svv - suv * suv
        eu, ev = (gvv * hu - guv * hv) / det, (guu * hv - guv * hu) / det
        size = (hu * (eu - pu) + hv * (ev - pv) + _REGION * bent) / det
        center = d * nx + eu * ux + ev * vx, d * ny + eu * uy + ev * vy, d * nz + eu * uz + ev * vz
        region = Region(center, normal, u, v, size * gvv, -size * guv, size * guu)
        if isinstance(surface, Plane):
            if (away := math.dist(center, surface.center) - surface.radius) > 0.0 and away > region.largest:
                return _NO_POINT[Why.OFF_SURFACE]
        elif (region.largest if is_round else math.sqrt(region.vv)) > surface.radius:
            return _NO_POINT[Why.TOO_WEAK]
        point = d * nx + pu * ux + pv * vx, d * ny + pu * uy + pv * vy, d * nz + pu * uz + pv * vz
        return Contact(Why.POINT, fn < 0.0, point, region)


def _frame(n: Vector3) -> tuple[Vector3, Vector3]:
    """Two directions that make a right-handed frame with `n`."""
    x, y, z = n
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def _first_hit(
    surface: Capsule, force: Vector3, torque: Vector3, slack: float
) -> tuple[Vector3, Vector3, Vector3 | None] | Why:
    """Where the line of action enters, the normal there, and the axis where it is not a ball's.

    `slack`, Nm: by how much the torque may be wrong.
    """
    (fx, fy, fz), (mx, my, mz), (sx, sy, sz), radius = force, torque, surface.start, surface.radius
    ff = fx * fx + fy * fy + fz * fz
    f = math.sqrt(ff)
    ex, ey, ez = fx / f, fy / f, fz / f
    at = (fy * mz - fz * my) / ff, (fz * mx - fx * mz) / ff, (fx * my - fy * mx) / ff
    wx, wy, wz = at[0] - sx, at[1] - sy, at[2] - sz
    hx, hy, hz = (end - start for end, start in zip(surface.end, surface.start, strict=True))
    high = math.sqrt(hx * hx + hy * hy + hz * hz)
    if high:
        hx, hy, hz = hx / high, hy / high, hz / high
    eh, wh, we = ex * hx + ey * hy + ez * hz, wx * hx + wy * hy + wz * hz, wx * ex + wy * ey + wz * ez
    ww = wx * wx + wy * wy + wz * wz
    up = 0.0 if eh >= 0.0 else high  # of the end that it comes from
    if high and (steep := 1.0 - eh * eh) > 1e-12:
        b, gap2 = we - wh * eh, ww - wh * wh
        gap2 -= b * b / steep
        if gap2 > radius * radius:
            return Why.OFF_SURFACE if (math.sqrt(gap2) - radius) * f > slack else Why.TOO_WEAK
        t = -b / steep - math.sqrt((radius * radius - gap2) / steep)
        up = min(max(wh + t * eh, 0.0), high)
    is_side = 0.0 < up < high
    if not is_side:  # the ball at that end
        b = we - up * eh
        gap2 = ww - 2.0 * up * wh + up * up - b * b
        if gap2 > radius * radius:
            return Why.OFF_SURFACE if (math.sqrt(gap2) - radius) * f > slack else Why.TOO_WEAK
        t = -b - math.sqrt(radius * radius - gap2)
    x, y, z = wx + t * ex, wy + t * ey, wz + t * ez
    nx, ny, nz = (x - up * hx) / radius, (y - up * hy) / radius, (z - up * hz) / radius
    return (x + sx, y + sy, z + sz), (nx, ny, nz), (hx, hy, hz) if is_side else None


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Vector3, b: list[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
