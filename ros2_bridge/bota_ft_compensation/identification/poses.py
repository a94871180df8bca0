# SPDX-License-Identifier: Apache-2.0
"""Static poses for payload identification: what they have seen so far, and which one to take next.

What counts is where gravity points in the sensor's frame. A turn about the vertical changes nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ft_compensation.bias import check_at_rest
from bota_ft_compensation.quantities import ZERO, CompensationError, Wrench, length
from bota_ft_compensation.stationary import Array, StationaryMeans, triple

_LEAST_POSES: Final = 4
MOST_POSES: Final = 1000
# Of the directions of gravity, in g: less is one direction, or one line; less along an axis is worth a note.
_LEAST_SPREAD, _UNCHECKED_SPREAD = 0.02, 0.1
_SAME_POSE: Final = 0.97  # cosine: directions nearer than 14° are the same pose
_LARGEST_OFFSET: Final = 1.5  # m/s²: of an accelerometer whose offset is yet to be found


class Pose(NamedTuple):
    """What was measured while the sensor was stationary, with nothing touching the tool."""

    wrench: Wrench  # mean, N and Nm; nothing subtracted
    gravity: Vector3  # in the sensor's frame, m/s²
    force_spread: Vector3 = ZERO  # standard deviation of single samples, N
    torque_spread: Vector3 = ZERO  # likewise, Nm
    samples: int = 1
    acceleration: Vector3 | None = (
        None  # what the accelerometer read, m/s²; None if it is not to be identified
    )
    acceleration_spread: Vector3 = ZERO  # standard deviation of single samples, m/s²
    time_s: float | None = None  # when, by the clock of the other poses
    alike: float = 1.0  # as `StationaryMeans.alike`

    @property
    def up(self) -> Vector3:
        """The direction in the sensor's frame that points up: opposite to gravity, length 1."""
        x, y, z = self.gravity
        size = length(self.gravity)
        return -x / size, -y / size, -z / size


def pose_of(
    means: StationaryMeans, gravity: Vector3 | None = None, magnitude: float = STANDARD_GRAVITY
) -> Pose:
    """A pose from a stationary window.

    `gravity` (in the sensor's frame, m/s²) is from the window's own accelerometer, with length `magnitude`,
    unless it is given. CompensationError if the accelerometer reads nothing like g.
    """
    acceleration: Vector3 | None = means.acceleration
    x, y, z = means.acceleration
    if gravity is None:
        check_at_rest(means.acceleration, magnitude, _LARGEST_OFFSET)
        scale = -magnitude / length(means.acceleration)  # only the direction is taken from it
        gravity = x * scale, y * scale, z * scale
    elif not length(gravity) > 0.0:
        raise CompensationError("a pose without gravity says nothing about a payload")
    elif abs(length(means.acceleration) - magnitude) > _LARGEST_OFFSET:
        acceleration = None  # off, or broken
    return Pose(
        means.wrench, gravity, means.force_spread, means.torque_spread, means.samples,
        acceleration, means.acceleration_spread, means.time_s, means.alike,
    )  # fmt: skip


class Coverage(NamedTuple):
    """How well some poses see a payload."""

    poses: int
    # Standard deviation of gravity's direction along three axes, in g, best seen first; 0.58 is ideal.
    spread: Vector3
    missing: str | None  # why the poses do not suffice, a sentence; None if they do
    next_pose: str  # what to do next, a sentence
    unchecked: str = ""  # the direction along which nothing contradicts an error, if there is one

    @property
    def source(self) -> str:
        return f"{self.poses} poses" if self.poses else "free motion"

    @property
    def advice(self) -> str:
        if self.missing is None:
            return f"the poses suffice; one more would help most: {self.next_pose}"
        return f"not enough yet: {self.missing}; {self.next_pose}"


def coverage(poses: Sequence[Pose]) -> Coverage:
    if not poses:
        return Coverage(0, ZERO, "there is no pose yet", _sentence(np.array((0.0, 0.0, 1.0))))
    down = -np.array([pose.up for pose in poses])  # where gravity points in the sensor's frame
    spread, axes = _spread(down)
    return Coverage(
        len(poses),
        triple(spread),
        _missing(len(poses), spread, axes),
        _sentence(_next_up(down)),
        _name_direction(axes[2]) if spread[2] < _UNCHECKED_SPREAD else "",
    )


def _name_direction(direction: Array) -> str:
    """A line in the sensor's frame in words: "the sensor's x axis", or its components."""
    unit = direction / np.linalg.norm(direction)
    axis = int(np.abs(unit).argmax())
    if abs(unit[axis]) > _SAME_POSE:
        return f"the sensor's {'xyz'[axis]} axis"
    unit = unit * np.sign(unit[axis])
    parts = ", ".join(f"{round(float(part), 2) + 0.0:.2f}" for part in unit)
    return f"the direction ({parts}) of the sensor's frame"


def _spread(down: Array) -> tuple[Array, Array]:
    """Standard deviations along the principal axes (largest first), the axes as rows."""
    moved = down - down.mean(axis=0)
    values, vectors = np.linalg.eigh(np.atleast_2d(moved.T @ moved) / len(down))
    return np.sqrt(np.maximum(values[::-1], 0.0)), vectors.T[::-1]


def _missing(count: int, spread: Array, axes: Array) -> str | None:
    if spread[0] < _LEAST_SPREAD:
        same = "the only pose had" if count == 1 else f"all {count} poses had"
        return (
            f"{same} gravity in the same direction of the sensor's frame (turning about the vertical does "
            "not count), so weight and bias cannot be told apart: mass and center of gravity are unseen"
        )
    if spread[1] < _LEAST_SPREAD:
        return (
            f"gravity moved only along {_name_direction(axes[0])}, so the center of gravity along it is "
            "unseen: tilt the sensor about another axis too"
        )
    if count < _LEAST_POSES:
        return f"there {'is' if count == 1 else 'are'} {count} of at least {_LEAST_POSES} poses"
    return None


# Directions that may point up: the axes, then between two of them, then between three.
_CANDIDATES: Final = [
    np.array(signs, dtype=np.float64)
    for signs in sorted(
        (signs for signs in itertools.product((1, 0, -1), repeat=3) if any(signs)),
        key=lambda signs: (sum(map(abs, signs)), [-sign for sign in signs[::-1]]),
    )
]


def _next_up(down: Array) -> Array:
    """The candidate that, pointing up, helps the worst seen direction most; the simplest one of equals."""
    best, best_gain = _CANDIDATES[0], -1.0
    for candidate in _CANDIDATES:
        up = candidate / np.linalg.norm(candidate)
        spread, _ = _spread(np.vstack([down, -up]))
        # Where one more pose cannot help the worst direction, it may help the second or the first.
        gain = float(spread[2] + 0.1 * spread[1] + 0.01 * spread[0])
        # One that was taken already is the last resort, and so is one that is hard to aim at.
        gain -= 0.5 * bool((down @ -up).max() > _SAME_POSE) + 0.15 * (np.abs(candidate).sum() - 1)
        if gain > best_gain + 1e-9:
            best, best_gain = candidate, gain
    return best


def _sentence(up: Array) -> str:
    axes = [f"{'+' if part > 0 else '-'}{name}" for name, part in zip("xyz", up, strict=True) if part]
    if len(axes) == 1:
        return f"turn the sensor so that its {axes[0]} axis points up"
    named = ", ".join(axes[:-1]) + f" and {axes[-1]}"
    return f"turn the sensor so that its {named} axes point up equally steeply"
