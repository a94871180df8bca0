"""Moves of an arm as the sensor's accelerometer and gyroscope feel them, with the truth; seeded.

Independent of the virtual sensor: other noise, other moves. The sensor is turned about an axis of its own
and shifted along axes of the world; between them it rests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.pdo import STANDARD_GRAVITY

Array = NDArray[np.float64]
REST_S: Final = 2.0
"""Before and after a move."""
TURN_RATE: Final = 2.0
"""rad/s"""
_PAUSE_S: Final = 0.3
_SPEED_UP: Final = 10.0
"""rad/s²"""


class Move(NamedTuple):
    """What the arm does for `seconds` between two rests."""

    kind: str
    seconds: float
    acceleration: Callable[[Array], Array] = lambda t: np.zeros((len(t), 3))
    """Times (n,) in s since the move began, to (n, 3) in m/s², in the world; zero outside of the move."""
    rate: float = 0.0
    """rad/s"""
    axis: int = 0
    """Turned about it, in the sensor."""
    rests: bool = True
    """Whether it begins at rest; if not, in the middle of the move."""


class Imu(NamedTuple):
    """A healthy sensor: half of the noise that its maker's test allows, and a gyroscope that is off."""

    acceleration_noise: float = 0.05
    """m/s²"""
    rate_noise: float = 0.0017
    """rad/s"""
    rate_offset: float = 0.03
    """rad/s, length"""
    rate_scale: float = 0.0
    acceleration_offset: float = 0.0
    """m/s², length"""


class Felt(NamedTuple):
    """What the sensor measures: n samples."""

    times: Array
    """(n,) s"""
    acceleration: Array
    """(n, 3) m/s²"""
    rate: Array
    """(n, 3) rad/s"""
    up: Array
    """(n, 3) the truth, a unit vector in the sensor's frame"""
    own: Array
    """(n, 3) the acceleration of the arm in the sensor's frame, m/s²"""


HEALTHY: Final = Imu()


def feel(move: Move, rate_hz: float = 800.0, seed: int = 0, imu: Imu = HEALTHY, lost: float = 0.0) -> Felt:
    """Make the samples of a move, in a random pose; of these a part of `lost` is missing."""
    draw = np.random.default_rng(seed)
    before = REST_S if move.rests else -0.5 * move.seconds
    times = np.arange(0.0, before + move.seconds + REST_S, 1.0 / rate_hz)
    t = times - before
    # The pose: quaternion of uniform distribution.
    start = _matrix(draw.normal(size=4))
    angle, speed = _turn(t, move)
    rates = np.zeros((len(t), 3))
    rates[:, move.axis] = speed
    inside = (t >= 0) & (t < move.seconds)
    world = move.acceleration(t) * inside[:, None]
    c, s = np.cos(angle), np.sin(angle)

    def to_sensor(vectors: Array) -> Array:
        """From the world, by the transposed matrix."""
        v = vectors @ start
        a, b = (move.axis + 1) % 3, (move.axis + 2) % 3
        found = v.copy()
        found[:, a], found[:, b] = c * v[:, a] + s * v[:, b], c * v[:, b] - s * v[:, a]
        return found

    up = to_sensor(np.tile((0.0, 0.0, 1.0), (len(t), 1)))
    own = to_sensor(world)
    offset, tilted = (v / np.linalg.norm(v) for v in draw.normal(size=(2, 3)))
    acceleration = own + STANDARD_GRAVITY * up + imu.acceleration_offset * tilted
    acceleration += draw.normal(scale=imu.acceleration_noise, size=acceleration.shape)
    measured = rates * (1 + imu.rate_scale) + imu.rate_offset * offset
    measured += draw.normal(scale=imu.rate_noise, size=measured.shape)
    kept = draw.random(len(t)) >= lost
    return Felt(*(part[kept] for part in (times, acceleration, measured, up, own)))


def _turn(t: Array, move: Move) -> tuple[Array, Array]:
    """Angle and rate of a trapezoid of the rate over the move."""
    if not move.rate:
        return np.zeros_like(t), np.zeros_like(t)
    ramp = move.rate / _SPEED_UP
    corners = np.array((0.0, ramp, move.seconds - ramp, move.seconds))
    speeds = np.array((0.0, move.rate, move.rate, 0.0))
    angles = np.array((0.0, 0.5 * ramp * move.rate, (move.seconds - 1.5 * ramp) * move.rate,
                       (move.seconds - ramp) * move.rate))  # fmt: skip
    speed = np.interp(t, corners, speeds)
    part = np.clip(np.searchsorted(corners, t, side="right") - 1, 0, 3)
    within = np.where(t < move.seconds, np.maximum(t - corners[part], 0.0), 0.0)
    slope = np.array((_SPEED_UP, 0.0, -_SPEED_UP, 0.0))[part]
    return np.where(t < 0, 0.0, angles[part] + speeds[part] * within + 0.5 * slope * within**2), speed


def _matrix(q: Array) -> Array:
    """The rotation matrix of a quaternion x, y, z, w of any length."""
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
                     (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
                     (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))))  # fmt: skip


def along(axis: int, values: Array) -> Array:
    """Along one axis of the world, (n, 3)."""
    found = np.zeros((len(values), 3))
    found[:, axis] = values
    return found


def there_and_back(axis: int, seconds: float, size: float) -> tuple[float, Callable[[Array], Array]]:
    """Speed up and brake, `seconds` each, a short pause, and the same back."""
    corners = np.cumsum((0.0, seconds, seconds, _PAUSE_S, seconds, seconds))
    sizes = np.array((0.0, size, -size, 0.0, -size, size, 0.0))

    def acceleration(t: Array) -> Array:
        return along(axis, sizes[np.searchsorted(corners, t, side="right")])

    return float(corners[-1]), acceleration


def vibration(axis: int, hertz: float, size: float = 2.0) -> Callable[[Array], Array]:
    return lambda t: along(axis, size * np.sin(2 * np.pi * hertz * t))


def shocks(t: Array) -> Array:
    """Ten half waves of 5 ms and 60 m/s², to and fro."""
    number, within = np.divmod(t, 0.2)
    wave = np.where(within < 0.005, np.sin(np.pi * within / 0.005), 0.0)
    direction = np.where(number % 2, -1.0, 1.0)
    return np.stack((60 * wave * direction, 30 * wave * direction, -20 * wave), axis=1)


def free_fall(t: Array) -> Array:
    """For 0.3 s, and caught within 0.1 s."""
    return along(2, np.where(t < 0.3, -STANDARD_GRAVITY, 3 * STANDARD_GRAVITY))


def acceptance(axis: int = 0) -> Move:
    """0.4 s at 2.5 m/s², and braked as hard: the move that the compensated wrench must survive."""
    corners = np.cumsum((0.0, 0.4, 0.4))
    sizes = np.array((0.0, 2.5, -2.5, 0.0))

    def acceleration(t: Array) -> Array:
        return along(axis, sizes[np.searchsorted(corners, t, side="right")])

    return Move("acceptance", float(corners[-1]), acceleration)


def moves() -> Iterator[Move]:
    """Everything that is to be survived."""
    for axis, seconds, size in product(range(3), (0.2, 0.5, 1.0), (1.0, 2.5, 5.0)):
        yield Move("translations", *there_and_back(axis, seconds, size))
    for axis, seconds in product(range(3), (1.0, 3.0)):
        yield Move("turns", seconds, rate=TURN_RATE, axis=axis)
    for axis, seconds, size in product(range(3), (0.2, 0.5, 1.0), (2.5, 5.0)):
        yield Move("both at once", *there_and_back((axis + 1) % 3, seconds, size), TURN_RATE, axis)
    for axis, hertz in product((0, 2), (20.0, 31.0, 45.0, 60.0)):
        yield Move("vibration", 3.0, vibration(axis, hertz))
    yield Move("shocks, free fall", 2.0, shocks)
    yield Move("shocks, free fall", 0.4, free_fall)
    for axis, seconds, size in product((0, 2), (0.4, 1.0), (1.0, 2.5, 5.0)):
        there = there_and_back(axis, seconds, size)
        yield Move("start in motion", *there, rests=False)
        yield Move("start in motion", *there, TURN_RATE, axis, rests=False)
    yield Move("start in motion", 6.0, vibration(0, 31.0), rests=False)
