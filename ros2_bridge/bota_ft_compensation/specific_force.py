# SPDX-License-Identifier: Apache-2.0
"""The specific force at the tool's center of gravity: acceleration minus gravity.

An accelerometer measures it: at rest it reads minus gravity. docs/compensation.md has the model; d is from
the IMU to the center of gravity. Nobody needs to know where gravity points.

Without the accelerometer, gravity in the sensor's frame is known by the orientation that a robot tells.
Between two orientations, and for those that come late, the gyroscope turns gravity on. It is known until the
newest orientation is too old: nobody goes on with an old pose. Times are seconds on one clock.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bota_ethercat.pdo import Vector3
from bota_ft_compensation.alignment import Alignment, Array, align
from bota_ft_compensation.outputs import WrenchTransform
from bota_ft_compensation.quantities import (
    DEFAULT_GRAVITY,
    EXACT,
    IDENTITY,
    STILL,
    ZERO,
    Accelerometer,
    Matrix,
    Quaternion,
    Turning,
)
from bota_ft_compensation.turning import PLACES, TENSORS

_TURNING: Final = 0.05  # rad/s: less is a gyroscope's offset
_PUSHED: Final = 0.5  # m/s²: less is an accelerometer's noise
Row = tuple[float, ...]
_ROOM: Final = 16  # times as many rows as are needed
_MOST_RATES: Final = 4096  # remembered for orientations that come late: 2.5 s at 1600 Hz


class ImuSpecificForce:
    """From the sensor's accelerometer and gyroscope, sample by sample.

    It keeps as many samples as the alignment needs, with those that were lost interpolated, in one piece: the
    newest rows of an array, which are moved to its front when it is full.
    """

    def __init__(
        self, lever: Vector3 = ZERO, accelerometer: Accelerometer = EXACT, alignment: Alignment | None = None,
        gyroscope: Matrix = IDENTITY,
    ) -> None:  # fmt: skip
        """`lever` is d, m; `accelerometer` corrects what it reads; angular rates are `gyroscope` times those
        that are read.
        """
        self.lever = lever
        # Angular rate (rad/s) and acceleration (rad/s²) of the latest sample, at force and torque's instant.
        self.turning: Turning = STILL
        # What is read is corrected once it is aligned, which is linear, and exact of what is constant.
        self._base = accelerometer.correct(ZERO)
        whole, rates = np.zeros((12, 12)), np.reshape(gyroscope, (3, 3))
        axes = (accelerometer.correct(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
        whole[:3, :3] = np.array([*axes]) - self._base
        whole[3:6, 3:6] = rates.T
        both = rates @ TENSORS @ rates.T
        whole[6:, 6:] = np.stack([both[:, row, column] for row, column in PLACES], axis=1)
        self._whole = whole
        self.align(alignment or align({}))

    def align(self, alignment: Alignment) -> None:
        """Bring what follows to the instant of force and torque so."""
        self.alignment = alignment
        self._size = alignment.taps.shape[1]
        # The FIR filter is so slow that products of rates pass it otherwise than as products of what passes.
        self._has_products = bool(alignment.settings.get("fir")) and alignment.lag_s is not None
        width = 12 if self._has_products else 6
        self._corrected = np.ascontiguousarray(self._whole[:width, :width])
        self._rows = np.zeros((_ROOM * self._size, width))
        self._end, self._filled = self._size, 0
        self._moved = False  # before the latest gap, or in it
        self._time_s = -math.inf
        self.turning = (ZERO,) * (4 if self._has_products else 2)

    def follow(self, acceleration: Vector3, angular_rate: Vector3, time_s: float) -> Vector3 | None:
        """m/s² at the center of gravity, when force and torque of this sample were (m/s², rad/s).

        None if it is not finite, or if the sensor moves, or did before a gap, and what was just before the
        sample, and so how fast it spins up, is not known.
        """
        row: Row = (*acceleration, *angular_rate)
        total = sum(row)
        if total - total != 0.0:  # NaN or infinity
            self._time_s = -math.inf
            return None
        passed_s, self._time_s = time_s - self._time_s, time_s
        if self._has_products:
            row = (*row, *_products(*angular_rate))
        dx, dy, dz = self.lever
        lead, filled = self.alignment.lead, self._filled
        if 0.0 < passed_s <= self.alignment.gap_s:
            if passed_s > 1.5 * self.alignment.period_s:
                self._bridge(row, passed_s)
            self._append(row)
            if filled < lead <= self._filled:
                self._continue_back()
        else:
            if filled:
                before = self._rows[self._end - self._size : self._end]
                turned, pushed = (before[:, 3:6] ** 2).sum(axis=1), math.dist(before[-1, :3], row[:3])
                self._moved = bool(turned.max() > _TURNING**2) or pushed > _PUSHED
            self._filled, self._end = 1, self._size
            self._rows[: self._size] = row
        if self._filled < lead and (dx or dy or dz) and (self._moved or _turns(angular_rate)):
            return None
        found = self.alignment.taps.dot(self._rows[self._end - self._size : self._end])
        felt, self.turning = self._at_center(found.dot(self._corrected).tolist())
        return felt

    def follow_all(self, rows: Array, times: Array) -> tuple[Array, Array]:
        """As `follow` of each, to the bit: (3, n), NaN for None, and every `turning` (2 or 4, 3, n).

        Of `rows` (n, 6), m/s² and rad/s, those that follow one another without a gap are taken at once.
        """
        count, size, begin = len(rows), self._size, 0
        felt, turned = np.empty((3, count)), np.empty((4 if self._has_products else 2, 3, count))
        good = np.asarray(np.isfinite(rows).all(axis=1))
        passed_s = np.diff(times, prepend=self._time_s)
        most_s = min(self.alignment.gap_s, 1.5 * self.alignment.period_s)
        good &= np.append(True, good[:-1]) & (passed_s > 0.0) & (passed_s <= most_s)
        breaks = np.append(np.flatnonzero(~good), count)
        ends = breaks[np.searchsorted(breaks, np.arange(count))].tolist()
        while begin < count:
            if not good[begin] or self._filled < self.alignment.lead:
                ax, ay, az, wx, wy, wz = rows[begin].tolist()
                now = self.follow((ax, ay, az), (wx, wy, wz), times[begin].item())
                felt[:, begin], turned[:, :, begin], begin = now or math.nan, self.turning, begin + 1
                continue
            end = ends[begin]
            wide = rows[begin:end]
            if self._has_products:
                wide = np.column_stack([wide, *_products(*wide[:, 3:].T)])
            held = np.concatenate([self._rows[self._end - size + 1 : self._end], wide])
            # Multiplied one by one: the sums of a larger product would be in another order.
            found = self.alignment.taps @ sliding_window_view(held, size, axis=0).swapaxes(1, 2)
            part, begin = slice(begin, end), end
            felt[:, part], turned[:, :, part] = self._at_center(np.moveaxis(found @ self._corrected, 0, 2))
            self._rows[:size] = held[-size:]
            self._end, self._filled = size, self._filled + len(found)
            self._time_s = times[end - 1].item()
            self.turning = tuple((x, y, z) for x, y, z in turned[:, :, end - 1].tolist())
        return felt, turned

    def _at_center(self, aligned: Any) -> tuple[Vector3, Turning]:
        """Specific force and turning, by readings (3, 6 or 12) of a sample, or of many."""
        (bx, by, bz), (dx, dy, dz) = self._base, self.lever
        if self._has_products:
            (ax, ay, az, *_), (_, _, _, wx, wy, wz, xx, yy, zz, xy, xz, yz), (_, _, _, tx, ty, tz, *_) = (
                aligned
            )
            turning: Turning = (wx, wy, wz), (tx, ty, tz), (xx, yy, zz), (xy, xz, yz)
        else:
            (ax, ay, az, _, _, _), (_, _, _, wx, wy, wz), (_, _, _, tx, ty, tz) = aligned
            turning = (wx, wy, wz), (tx, ty, tz)
            xx, yy, zz, xy, xz, yz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
        felt = (
            ax + bx + ty * dz - tz * dy + xy * dy + xz * dz - (yy + zz) * dx,
            ay + by + tz * dx - tx * dz + xy * dx + yz * dz - (xx + zz) * dy,
            az + bz + tx * dy - ty * dx + xz * dx + yz * dy - (xx + yy) * dz,
        )
        return felt, turning

    def _bridge(self, row: Row, passed_s: float) -> None:
        """The samples that were lost before one that comes so long after the one before."""
        periods, before = round(passed_s / self.alignment.period_s), self._rows[self._end - 1].copy()
        for lost in range(1, periods):
            self._append(before + lost / periods * (row - before))

    def _continue_back(self) -> None:
        """What precedes the samples since a gap, on the line through them."""
        size, known = self._size, min(self._filled, self._size)
        since = self._rows[self._end - known : self._end].copy()
        steps = np.arange(known) - 0.5 * (known - 1)
        slope = steps @ since / (steps @ steps)
        before = since.mean(axis=0) + (steps[0] - np.arange(size - known, 0, -1)[:, np.newaxis]) * slope
        self._rows[:size] = np.concatenate([before, since])
        self._end = size

    def _append(self, row: Row | Array) -> None:
        self._filled += 1
        if self._end == len(self._rows):
            self._rows[: self._size] = self._rows[-self._size :]
            self._end = self._size
        self._rows[self._end] = row
        self._end += 1


def _products(x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    return x * x, y * y, z * z, x * y, x * z, y * z


def _turns(rate: Sequence[float]) -> bool:
    x, y, z = rate
    return x * x + y * y + z * z > _TURNING * _TURNING


class QuaternionGravity:
    """Gravity from orientations of the sensor in a base frame."""

    def __init__(self, gravity: Vector3 = DEFAULT_GRAVITY, *, stale_after_s: float = 0.1) -> None:
        """`gravity` is in the base, m/s²."""
        self.base_gravity, self.stale_after_s = gravity, stale_after_s
        self._newest_s = -math.inf  # time of the newest orientation
        self._gravity: tuple[float, Vector3] | None = None  # when, and what it was in the sensor's frame
        self._rates: deque[tuple[float, Vector3]] = deque(maxlen=_MOST_RATES)

    def reset(self) -> None:
        self._newest_s = -math.inf
        self._rates.clear()

    def add_rate(self, angular_rate: Vector3, time_s: float) -> None:
        rates = self._rates
        if rates and not 0.0 <= time_s - rates[-1][0] <= self.stale_after_s:
            rates.clear()  # a gap, or a clock that was set: the orientation is held until the next one
        if not math.isfinite(sum(angular_rate)):
            rates.clear()
            return
        rates.append((time_s, angular_rate))
        if self._gravity is not None and len(rates) > 1:
            self._gravity = _propagated(*self._gravity, (rates[-2], rates[-1]))

    def update(self, orientation: Quaternion, time_s: float) -> bool:
        """Take a unit quaternion x, y, z, w of time `time_s`. False: it is older than what is known."""
        # Messages may overtake each other; a clock that was set back is another matter.
        if 0.0 < self._newest_s - time_s <= self.stale_after_s:
            return False
        gravity = WrenchTransform.of(ZERO, orientation).inverse().apply(self.base_gravity, ZERO).force
        self._newest_s = time_s
        later = [each for each in self._rates if each[0] > time_s]
        known = [each for each in self._rates if each[0] <= time_s][-1:]
        self._gravity = _propagated(time_s, gravity, [*known, *later])
        return True

    def age_s(self, now_s: float) -> float:
        """How old the latest orientation is, s; infinite if there is none."""
        return abs(now_s - self._newest_s)

    def gravity(self, now_s: float) -> Vector3 | None:
        """Gravity in the sensor's frame, m/s²; None when the orientation is older than `stale_after_s`."""
        if self._gravity is None or not self.age_s(now_s) <= self.stale_after_s:
            return None
        return self._gravity[1]


def _propagated(
    time_s: float, gravity: Vector3, rates: Sequence[tuple[float, Vector3]]
) -> tuple[float, Vector3]:
    """Gravity of `time_s` turned on by these rates (times ascending), or back, to the last of them."""
    if rates and time_s > rates[-1][0]:
        rates = ((time_s, rates[-1][1]), rates[-1])
    for (before_s, before), (after_s, after) in pairwise(rates):
        passed_s = after_s - max(before_s, time_s)
        x, y, z = (0.5 * passed_s * (a + b) for a, b in zip(before, after, strict=True))
        gx, gy, gz = gravity
        # What stands still turns by minus the rotation vector in the sensor's frame; to second order.
        cx, cy, cz = gy * z - gz * y, gz * x - gx * z, gx * y - gy * x
        gx, gy, gz = (
            gx + cx + 0.5 * (cy * z - cz * y),
            gy + cy + 0.5 * (cz * x - cx * z),
            gz + cz + 0.5 * (cx * y - cy * x),
        )
        size, wanted = math.sqrt(gx * gx + gy * gy + gz * gz), math.sqrt(sum(g * g for g in gravity))
        scale = wanted / size
        gravity, time_s = (gx * scale, gy * scale, gz * scale), after_s
    return time_s, gravity
