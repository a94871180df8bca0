"""Moves of an arm, slow and late orientations, numbers that are not finite; the node in simulated time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bota_ethercat.pdo import STANDARD_GRAVITY, encode
from bridge.compensating.tool_sources import ListenerSource, Oriented
from bridge.parameters.compensation import DEFAULTS
from ft_compensation.bias import force_bound_95
from ft_compensation.quantities import Accelerometer, Payload
from tests.bridge.compensating import UP, Stages, hold, six, weight
from tests.bridge.simulated_node import STEP_S, SimulatedNode, SimulatedServer
from tests.bridge.streaming import values
from tests.compensation.making import sample
from tests.compensation.motion import Array, Felt, feel, guided, waypoints

pytestmark = pytest.mark.ros
OK, WARN, ERROR, STALE = range(4)
HEAVY = Payload(2.0)


class Arm(SimulatedServer):
    """Sends what `felt` says, a row a step."""

    felt: Felt | None = None
    clock_step_ns = 0
    """By how much the wall clock has been set."""

    def time_ns(self) -> int:
        return super().time_ns() + self.clock_step_ns

    def play(self, felt: Felt) -> None:
        self.felt, self.first = felt, self.sent

    def step(self) -> None:
        if (felt := self.felt) is not None:
            row = min(self.sent - self.first, len(felt.times) - 1)
            of = {"force": felt.force, "torque": felt.torque, "acceleration": felt.acceleration / 9.80665}
            of["angular_rate"] = np.degrees(felt.rate)
            values = {f"{n}.{a}": float(rows[row, i]) for n, rows in of.items() for i, a in enumerate("xyz")}
            self.changes = {"process_data": encode(61, values)}
        super().step()


@pytest.fixture
def arm() -> Arm:
    return Arm()


@pytest.fixture
def node(_ros: None, arm: Arm) -> Iterator[SimulatedNode]:
    given: dict[str, Any] = {"tool_mass": HEAVY.mass, "bias_ramp_time": 0.0, "rest.duration": 0.3}
    with SimulatedNode(arm, imu_position=[0.0, 0.0, -0.0257], **given) as started:
        yield started


def forces(stages: Stages) -> Array:
    return np.array([np.linalg.norm(six(message)[:3]) for message in stages.final])


@pytest.mark.parametrize("radians", [0.0, 1.0])
def test_a_move_is_no_contact(arm: Arm, node: SimulatedNode, radians: float) -> None:
    """From the first sample on, of which none is withheld; the weight alone would leave more than 2 N."""
    stages = Stages(node)
    felt = feel(waypoints(0.8, 0.5, 3, metres=0.5, radians=radians), HEAVY, 6.0, 1.0 / STEP_S)
    arm.play(felt)
    node.run(6.0)
    assert np.ptp(np.linalg.norm(felt.force, axis=1)) > 2.0
    assert len(stages.final) >= 599
    left = forces(stages)
    assert math.sqrt(float((left**2).mean())) < 0.35
    assert float(np.quantile(left, 0.99)) < 1.0
    told = values(node.until(compensation=OK)["compensation"])
    assert (told["withheld"], told["gravity_source"]) == ("0", "imu")


@pytest.mark.parametrize("set_by_s", [-0.45, 0.1, 3600.0])
def test_setting_the_wall_clock_changes_nothing(arm: Arm, node: SimulatedNode, set_by_s: float) -> None:
    """Angular acceleration is a slope over monotonic time."""
    stages = Stages(node)
    arm.play(feel(guided(5), HEAVY, 3.0, 1.0 / STEP_S))
    node.run(1.0)
    arm.clock_step_ns = round(set_by_s * 1e9)
    stages.forget()
    node.run(2.0)
    assert len(stages.final) == 200
    assert forces(stages).max() < 0.35


def test_what_the_accelerometers_own_errors_may_make_is_told_in_newtons(
    arm: Arm, node: SimulatedNode
) -> None:
    """As it is expected of any, and as identification has found it."""
    hold(arm, UP)
    Stages(node)

    def told() -> float:
        return float(values(node.until(compensation=OK)["compensation"])["accelerometer_force"])

    assert told() == pytest.approx(force_bound_95(HEAVY, Accelerometer()), abs=1e-3)
    known = Accelerometer(offset_interval=(0.02,) * 3, scale_interval=(0.0,) * 3)
    for name in ("offset_interval", "scale_interval"):
        assert node.set_parameter(f"accelerometer.{name}", [*getattr(known, name)]) == (True, "")
    assert told() == pytest.approx(force_bound_95(HEAVY, known), abs=1e-3)
    assert force_bound_95(HEAVY, known) < 0.1 * force_bound_95(HEAVY, Accelerometer())


def test_numbers_that_are_not_finite_stop_only_what_needs_them(arm: Arm, node: SimulatedNode) -> None:
    stages = Stages(node)
    hold(arm, UP)
    stages.first()
    hold(arm, UP, acceleration_y=math.nan)
    node.run(0.1)
    assert stages.are_silent()
    node.until("wrench_compensated has stopped: the IMU sends NaN or infinity", compensation=ERROR)
    assert node.set_parameter("tool_mass", 0.0) == (True, "")
    stages.settle(weight(UP))
    node.until(compensation=OK)


class Pose:
    """A topic's listener."""

    latest: Oriented | None = None
    problem, describe = "", "topic /pose"


@pytest.mark.parametrize("set_by_s", [0.0, -3600.0, -0.05, 0.05, 3600.0])
def test_an_orientation_of_a_topic_is_carried_on_to_the_sample(set_by_s: float) -> None:
    """The robot turns by 2 rad/s about x and tells its pose 20 ms late, twenty times a second; meanwhile the
    wall clock, by which poses are stamped, is set."""
    listening: Any = Pose()
    source, speed, begin_s, wall_s = ListenerSource(DEFAULTS, listening), 2.0, 1000.0, 1e9
    for step in range(100):
        t = step * 0.01
        if step == 50:
            wall_s += set_by_s
        if step % 5 == 2:
            half = 0.5 * speed * (t - 0.02)
            stamp_ns = round((wall_s + t - 0.02) * 1e9)
            listening.latest = Oriented((math.sin(half), 0.0, 0.0, math.cos(half)), stamp_ns)
        got = source.specific_force(sample(angular_rate=(speed, 0.0, 0.0)), begin_s + t, wall_s + t)
        if step > 2:
            wanted = 0.0, STANDARD_GRAVITY * math.sin(speed * t), STANDARD_GRAVITY * math.cos(speed * t)
            assert got == pytest.approx(wanted, abs=1e-3)
