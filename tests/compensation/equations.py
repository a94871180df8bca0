"""The compensation on NumPy arrays: the reference that `ft_compensation.compensator` is tested against.

Every function takes one sample, shape (3,), or many, shape (n, 3), and what belongs to them as either;
NumPy's broadcasting joins the two. SI units. All vectors but `gravity` of IV.2 are in the sensor's frame.

Signs:
- A wrench is the load that acts ON the sensor, as the sensor measures it: a tool hanging below an upright
  sensor gives a force along gravity.
- The bias is what is SUBTRACTED: corrected = measured - bias. (The sensor's own offset, object 0x8000, is
  added by the sensor; that is another thing.)
- Gravity is the acceleration of a falling body and points down: (0, 0, -9.80665) in a base frame whose z is
  up. An accelerometer at rest measures minus that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def subtract_bias(measured: ArrayLike, bias: ArrayLike) -> Array:
    """IV.1: measured - bias. Forces (N) or torques (Nm), (3,) or (n, 3)."""
    return _array(measured) - _array(bias)


def matrix_from_quaternion(orientation: ArrayLike) -> Array:
    """Rotation matrices (3, 3) or (n, 3, 3) from quaternions x, y, z, w, (4,) or (n, 4), of any length but 0.

    The matrix turns as the quaternion does. The orientation of a sensor in its base, as poses, Imu messages
    and TF have it, turns vectors of the sensor's frame into the base's; IV.2 needs its transpose.
    """
    q = _array(orientation)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(norm > 0.0):
        raise ValueError("a quaternion of length 0 is no orientation")
    x, y, z, w = np.moveaxis(q / norm, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def gravity_in_sensor(sensor_r_base: ArrayLike, gravity: ArrayLike) -> Array:
    """IV.2: gravity in the sensor's frame, m/s², (3,) or (n, 3).

    Args:
        sensor_r_base: rotation matrix (3, 3) or (n, 3, 3) that turns vectors of the base frame into the
            sensor's.
        gravity: in the base frame, m/s², (3,) or (n, 3).
    """
    turned: Array = np.einsum("...ij,...j->...i", _array(sensor_r_base), _array(gravity))
    return turned


def gravity_in_sensor_from_quaternion(orientation: ArrayLike, gravity: ArrayLike) -> Array:
    """IV.2 from the orientation of the sensor in the base frame, a quaternion x, y, z, w, (4,) or (n, 4).

    This is the direction of poses, Imu messages, TF (base to sensor) and the sensor's own estimate: the
    quaternion turns vectors of the sensor's frame into the base's, and the inverse of that is what IV.2
    applies.
    """
    return gravity_in_sensor(np.swapaxes(matrix_from_quaternion(orientation), -1, -2), gravity)


def gravity_force(mass: ArrayLike, gravity: ArrayLike) -> Array:
    """IV.3: mass (kg, one number or (n,)) times gravity in the sensor's frame: N, (3,) or (n, 3)."""
    return _array(mass)[..., np.newaxis] * _array(gravity)


def torque_of(center: ArrayLike, force: ArrayLike) -> Array:
    """IV.4: the torque about the wrench origin, Nm, of a force (N) that acts at `center` (m)."""
    return np.cross(_array(center), _array(force))


def inertial_force(
    mass: ArrayLike,
    center: ArrayLike,
    gravity: ArrayLike,
    acceleration: ArrayLike,
    angular_rate: ArrayLike = (0.0, 0.0, 0.0),
    *,
    angular_acceleration: ArrayLike = (0.0, 0.0, 0.0),
    imu_position: ArrayLike = (0.0, 0.0, 0.0),
) -> Array:
    """What the tool's mass adds to the force on an accelerated sensor: N, (3,) or (n, 3).

    -m (a + alpha x d + omega x (omega x d)), where a = acceleration + gravity is how the IMU really moves
    and d leads from it to the center of gravity. Its torque is `torque_of(center, force)`: the payload is a
    point mass, so its own moment of inertia is left out.

    Args:
        mass: kg.
        center: center of gravity, m from the wrench origin.
        gravity: in the sensor's frame, m/s².
        acceleration: what the accelerometer measures (specific force: minus gravity at rest), m/s².
        angular_rate: rad/s.
        angular_acceleration: rad/s². The sensor does not measure it and `Compensator` leaves it out.
        imu_position: m from the wrench origin.
    """
    d = _array(center) - _array(imu_position)
    rate = _array(angular_rate)
    moved = _array(acceleration) + _array(gravity)
    moved = moved + np.cross(_array(angular_acceleration), d) + np.cross(rate, np.cross(rate, d))
    return -_array(mass)[..., np.newaxis] * moved


class ArrayStages(NamedTuple):
    """Every stage of the compensation: N and Nm, (3,) or (n, 3)."""

    corrected_force: Array
    corrected_torque: Array
    gravity_force: Array
    gravity_torque: Array
    inertia_force: Array
    inertia_torque: Array
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
    acceleration: ArrayLike | None = None,
    angular_rate: ArrayLike = (0.0, 0.0, 0.0),
    imu_position: ArrayLike = (0.0, 0.0, 0.0),
) -> ArrayStages:
    """IV.5, from the measured force (N) and torque (Nm), (3,) or (n, 3), and everything before it.

    Args:
        force: measured, N.
        torque: measured, Nm.
        bias: (6,) or (n, 6): N, Nm.
        mass: of the tool, kg.
        center: of gravity, m.
        gravity: in the sensor's frame, m/s².
        acceleration: measured, m/s²; without it the inertial term is 0.
        angular_rate: rad/s, for the inertial term.
        imu_position: m, for the inertial term.
    """
    bias = _array(bias)
    corrected_force = subtract_bias(force, bias[..., :3])
    corrected_torque = subtract_bias(torque, bias[..., 3:])
    weight = gravity_force(mass, gravity)
    weight_torque = torque_of(center, weight)
    if acceleration is None:
        inertia, inertia_torque = np.zeros_like(weight), np.zeros_like(weight_torque)
    else:
        inertia = inertial_force(mass, center, gravity, acceleration, angular_rate, imu_position=imu_position)
        inertia_torque = torque_of(center, inertia)
    return ArrayStages(
        corrected_force,
        corrected_torque,
        weight,
        weight_torque,
        inertia,
        inertia_torque,
        corrected_force - weight - inertia,
        corrected_torque - weight_torque - inertia_torque,
    )


def _array(values: ArrayLike) -> Array:
    return np.asarray(values, dtype=np.float64)
