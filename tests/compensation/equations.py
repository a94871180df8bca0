"""The compensation on NumPy arrays: the reference that `ft_compensation.compensator` is tested against.

Every function takes one sample, shape (3,), or many, shape (n, 3), and what belongs to them as either;
NumPy's broadcasting joins the two. SI units. All vectors but `gravity` of IV.2 are in the sensor's frame. The
signs are those of docs/compensation.md: a wrench acts ON the sensor, the bias is SUBTRACTED, gravity is the
acceleration of a falling body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def matrix_from_quaternion(orientation: ArrayLike) -> Array:
    """Rotation matrices (3, 3) or (n, 3, 3) from quaternions x, y, z, w, (4,) or (n, 4), of any length but 0.

    The matrix turns as the quaternion does. The orientation of a sensor in its base, as poses, Imu messages
    and TF have it, turns vectors of the sensor's frame into the base's; IV.2 needs its transpose.
    """
    q = _array(orientation)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def gravity_in_sensor(sensor_r_base: ArrayLike, gravity: ArrayLike) -> Array:
    """IV.2: gravity in the sensor's frame, m/s², by a rotation of vectors of the base frame into it."""
    turned: Array = np.einsum("...ij,...j->...i", _array(sensor_r_base), _array(gravity))
    return turned


def gravity_in_sensor_from_quaternion(orientation: ArrayLike, gravity: ArrayLike) -> Array:
    """IV.2 from the orientation of the sensor in the base frame: its inverse is what IV.2 applies."""
    return gravity_in_sensor(np.swapaxes(matrix_from_quaternion(orientation), -1, -2), gravity)


def gravity_force(mass: ArrayLike, gravity: ArrayLike) -> Array:
    """IV.3: mass (kg, one number or (n,)) times gravity in the sensor's frame: N."""
    return _array(mass)[..., np.newaxis] * _array(gravity)


def torque_of(center: ArrayLike, force: ArrayLike) -> Array:
    """IV.4: the torque about the wrench origin, Nm, of a force (N) that acts at `center` (m)."""
    return np.cross(_array(center), _array(force))


class ArrayStages(NamedTuple):
    """Every stage of the compensation: N and Nm, (3,) or (n, 3)."""

    corrected_force: Array
    corrected_torque: Array
    tool_force: Array
    tool_torque: Array
    final_force: Array
    final_torque: Array


def compensate(
    force: ArrayLike,
    torque: ArrayLike,
    *,
    bias: ArrayLike,
    mass: ArrayLike,
    center: ArrayLike,
    gravity: ArrayLike,
) -> ArrayStages:
    """IV.5 and everything before it. `bias` (6,) or (n, 6): N, Nm; `gravity` in the sensor's frame, or minus
    the specific force."""
    bias = _array(bias)
    corrected_force, corrected_torque = _array(force) - bias[..., :3], _array(torque) - bias[..., 3:]  # IV.1
    tool = gravity_force(mass, gravity)
    tool_torque = torque_of(center, tool)
    return ArrayStages(
        corrected_force,
        corrected_torque,
        tool,
        tool_torque,
        corrected_force - tool,
        corrected_torque - tool_torque,
    )


def _array(values: ArrayLike) -> Array:
    return np.asarray(values, dtype=np.float64)
