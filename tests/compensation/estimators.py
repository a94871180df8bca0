"""What finds gravity in the samples of `moves`: the node's filter, its previous one, and two libraries."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

import numpy as np

from ft_compensation.orientation import AccelerometerGravity
from protocol.pdo import STANDARD_GRAVITY, Vector3
from tests.compensation.moves import Array, Felt

_SETTLED_S: Final = 1.0
"""What the others say in the first second is not held against them."""
_WARM_UP: Final = 4
"""Seconds of rest, that first one repeated, which the libraries are given before: imufusion needs 3."""


class Found(NamedTuple):
    """n samples."""

    error: Array
    """(n,) tilt, rad; NaN where there was no answer"""
    covers: Array
    """(n,) the tilt that was said to be possible, rad; NaN if nothing was"""


def tilt(up: Array, truth: Array) -> Array:
    """The angle between two rows of vectors, rad."""
    cross = np.linalg.norm(np.cross(up, truth), axis=1)
    angle: Array = np.arctan2(cross, np.einsum("ij,ij->i", up, truth))
    return angle


def node(felt: Felt, source: AccelerometerGravity | None = None) -> Found:
    """What the node does."""
    source = source or AccelerometerGravity()
    up, covers = np.full_like(felt.up, math.nan), np.full(len(felt.times), math.nan)
    rows = zip(felt.times.tolist(), felt.acceleration.tolist(), felt.rate.tolist(), strict=True)
    for number, (time_s, acceleration, rate) in enumerate(rows):
        source.update(acceleration, rate, time_s)
        gravity = source.gravity(time_s)
        if gravity is not None:
            up[number] = gravity
            covers[number] = source.tilt_95
    return Found(tilt(-up, felt.up), covers)


def before(felt: Felt) -> Found:
    """The node's previous, complementary filter: gated by the length alone, time constant 0.5 s."""
    x, y, z = (-felt.acceleration[0]).tolist()
    rows = zip(felt.times.tolist(), felt.acceleration.tolist(), felt.rate.tolist(), strict=True)
    then, found = 0.0, np.empty_like(felt.up)
    for number, (time_s, (ax, ay, az), (wx, wy, wz)) in enumerate(rows):
        passed_s, then = time_s - then, time_s
        ux, uy, uz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        x, y, z = x - passed_s * ux, y - passed_s * uy, z - passed_s * uz
        if abs(math.sqrt(ax * ax + ay * ay + az * az) - STANDARD_GRAVITY) <= 0.5:
            share = 1.0 - math.exp(-passed_s / 0.5)
            x, y, z = x - share * (ax + x), y - share * (ay + y), z - share * (az + z)
        found[number] = -x, -y, -z
    return _settled(felt, found)


def by_vqf(felt: Felt) -> Found:
    """Laidig and Seel's VQF, as it comes."""
    import vqf

    period_s = float(np.median(np.diff(felt.times)))
    rate, acceleration = _warmed_up(felt)
    return _settled(felt, _up(vqf.VQF(period_s).updateBatch(rate, acceleration)["quat6D"]))


def by_imufusion(felt: Felt) -> Found:
    """Madgwick's filter with its rejection of accelerations, and its estimate of the offset."""
    import imufusion

    rate_hz = 1.0 / float(np.median(np.diff(felt.times)))
    ahrs, settings = imufusion.Ahrs(), imufusion.AhrsSettings()
    settings.sample_rate, settings.acceleration_rejection = rate_hz, 10.0
    settings.rejection_timeout, settings.gyroscope_range = 5.0, 250.0
    ahrs.set_settings(settings)
    offset, resting = imufusion.Bias(), imufusion.BiasSettings()
    resting.sample_rate = rate_hz
    offset.set_settings(resting)
    found = []
    rates, accelerations = _warmed_up(felt)
    for rate, acceleration in zip(np.degrees(rates), accelerations / STANDARD_GRAVITY, strict=True):
        ahrs.update_no_magnetometer(offset.update(rate), acceleration)
        found.append(ahrs.get_quaternion())
    return _settled(felt, _up(np.array(found)))


def _up(quaternions: Array) -> Array:
    """Up in the sensor's frame, (n, 3), by its orientation w, x, y, z, (n, 4)."""
    w, x, y, z = quaternions.T
    return np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), axis=1)


def _warmed_up(felt: Felt) -> tuple[Array, Array]:
    """Rate and acceleration, with a longer rest before if there is one."""
    first = felt.times < _SETTLED_S
    rests = not felt.own[first].any() and np.ptp(felt.up[first], axis=0).max() < 1e-9
    count = _WARM_UP if rests else 0
    rate, acceleration = (
        np.ascontiguousarray(np.concatenate([part[first]] * count + [part]))
        for part in (felt.rate, felt.acceleration)
    )
    return rate, acceleration


def _settled(felt: Felt, up: Array) -> Found:
    up = up[-len(felt.times) :]
    error = tilt(up, felt.up)
    error[felt.times < _SETTLED_S] = math.nan
    return Found(error, np.full_like(error, math.nan))


ESTIMATORS: Final[Mapping[str, Callable[[Felt], Found]]] = {
    "this filter": node,
    "previous filter": before,
    "VQF": by_vqf,
    "imufusion": by_imufusion,
}


def compensated(felt: Felt, mass: float) -> Array:
    """What the node leaves of the force in free motion, (n, 3) N: the tool's inertia, if all is well."""
    source, left = AccelerometerGravity(), []
    measured = mass * (-STANDARD_GRAVITY * felt.up - felt.own)
    rows = zip(felt.times.tolist(), felt.acceleration.tolist(), felt.rate.tolist(), measured, strict=True)
    for time_s, acceleration, rate, force in rows:
        source.update(acceleration, rate, time_s)
        gravity: Vector3 | None = source.gravity(time_s)
        left.append((math.nan,) * 3 if gravity is None else force - mass * np.array(gravity))
    return np.array(left)
