"""A wrench in another frame: what statics says, and what must hold for any frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.pdo import Vector3
from ft_compensation.outputs.frames import WrenchTransform
from ft_compensation.quantities import ZERO, Quaternion
from tests.compensation.equations import matrix_from_quaternion

HALF = math.sqrt(0.5)
UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)
ABOUT_X: Quaternion = (HALF, 0.0, 0.0, HALF)
"""A quarter of a turn: y of the turned frame is z of the other."""
NUMBERS = st.floats(-100.0, 100.0)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
QUATERNIONS = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 4)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(
        lambda q: (q[0] / math.hypot(*q), q[1] / math.hypot(*q), q[2] / math.hypot(*q), q[3] / math.hypot(*q))
    )
)
TRANSFORMS = st.builds(WrenchTransform.of, VECTORS, QUATERNIONS)


def near(values: tuple[float, ...]) -> object:
    return pytest.approx(values, abs=1e-9)


def test_a_push_on_the_tool_center_point_has_no_torque_there() -> None:
    """The TCP is 0.2 m in front of the sensor, which feels 5 N across at that arm: 1 Nm."""
    tcp = WrenchTransform.of((0.0, 0.0, 0.2), UPRIGHT).inverse()
    force, torque = tcp.apply((5.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    assert force == near((5.0, 0.0, 0.0))
    assert torque == near(ZERO)


def test_a_push_on_the_sensor_has_a_torque_about_the_tool_center_point() -> None:
    """There it acts 0.2 m behind: about y it turns the other way than in front."""
    tcp = WrenchTransform.of((0.0, 0.0, 0.2), UPRIGHT).inverse()
    assert tcp.apply((5.0, 0.0, 0.0), ZERO).torque == near((0.0, -1.0, 0.0))


def test_a_weight_on_a_stretched_arm_in_the_base() -> None:
    """The sensor is 0.8 m before the base and 0.5 m above, its z axis horizontal along the base's -y.

    A kilogram hangs on it: in the base 9.81 N down, and about its origin 0.8 m x 9.81 N, tipping forward
    (about +y); the height has no part in it.
    """
    base = WrenchTransform.of((0.8, 0.0, 0.5), ABOUT_X)
    weight = 9.81
    force, torque = base.apply((0.0, -weight, 0.0), ZERO)  # the sensor's y axis points up
    assert force == near((0.0, 0.0, -weight))
    assert torque == near((0.0, 0.8 * weight, 0.0))


def test_a_pure_torque_is_the_same_about_every_point() -> None:
    force, torque = WrenchTransform.of((3.0, -2.0, 1.0), ABOUT_X).apply(ZERO, (0.0, 2.0, 0.0))
    assert force == near(ZERO)
    assert torque == near((0.0, 0.0, 2.0))


def test_a_frame_of_no_distance_and_turn_changes_nothing() -> None:
    assert WrenchTransform().apply((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)).values == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


@given(TRANSFORMS, VECTORS, VECTORS)
def test_there_and_back_is_where_it_was(transform: WrenchTransform, force: Vector3, torque: Vector3) -> None:
    there = transform.apply(force, torque)
    assert transform.inverse().apply(*there).values == pytest.approx((*force, *torque), abs=1e-8)


@given(VECTORS, QUATERNIONS, VECTORS, VECTORS, VECTORS, VECTORS)
def test_power_is_the_same_in_every_frame(
    translation: Vector3,
    quaternion: Quaternion,
    force: Vector3,
    torque: Vector3,
    velocity: Vector3,
    rate: Vector3,
) -> None:
    """Of a moving body: force times velocity of the frame's origin, plus torque times angular rate."""
    to_target = matrix_from_quaternion(quaternion)
    omega = to_target @ rate
    # The target's origin as a point of the body, seen from the source's, which is at `translation`.
    moved = to_target @ velocity - np.cross(omega, translation)
    there = WrenchTransform.of(translation, quaternion).apply(force, torque)
    power = np.dot(force, velocity) + np.dot(torque, rate)
    assert np.dot(there.force, moved) + np.dot(there.torque, omega) == pytest.approx(power, abs=1e-5)


@pytest.mark.parametrize(
    ("translation", "quaternion"),
    [
        (ZERO, (0.0, 0.0, 0.0, 0.0)), (ZERO, (0.5, 0.5, 0.5, 0.6)), (ZERO, (0.0, 0.0, math.nan, 1.0)),
        ((0.0, math.inf, 0.0), UPRIGHT), ((math.nan, 0.0, 0.0), UPRIGHT),
    ],
)  # fmt: skip
def test_what_is_no_pose(translation: Vector3, quaternion: Quaternion) -> None:
    with pytest.raises(ValueError, match=r"a rotation is a quaternion of length 1|three finite numbers"):
        WrenchTransform.of(translation, quaternion)


def test_a_quaternion_that_is_nearly_a_rotation_is_made_one() -> None:
    force = WrenchTransform.of(ZERO, (0.0, 0.0, 0.0, 0.995)).apply((1.0, 2.0, 3.0), ZERO).force
    assert force == near((1.0, 2.0, 3.0))
