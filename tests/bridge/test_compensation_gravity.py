"""Gravity in the node: moves, slow turns, numbers that are not finite; in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bridge.compensating.gravity_sources import AccelerometerSource, ListenerSource, Oriented
from bridge.parameters.compensation import AccelerometerParameters, CompensationParameters
from ft_compensation.attitude.tilt import GyroscopeOffset
from ft_compensation.identification.estimation import OFFSET_PRIOR
from protocol.pdo import STANDARD_GRAVITY, encode
from tests.bridge.compensating import UP, Stages, hold, is_near, sensed, six, weight
from tests.bridge.simulated_node import STEP_S, SimulatedNode, SimulatedServer
from tests.bridge.streaming import values
from tests.compensation.making import sample
from tests.compensation.moves import Array, Felt, acceptance, feel

pytestmark = pytest.mark.ros
OK, WARN, ERROR, STALE = range(4)
MASS = 2.0
"""kg"""


class Arm(SimulatedServer):
    """Sends what `felt` says, a row a step."""

    felt: Felt | None = None

    def play(self, felt: Felt) -> None:
        self.felt, self.first = felt, self.sent

    def step(self) -> None:
        if self.felt is not None:
            row = min(self.sent - self.first, len(self.felt.times) - 1)
            self.changes = {"process_data": process_data(self.felt, row)}
        super().step()


def process_data(felt: Felt, row: int) -> bytes:
    """A sample of a tool whose center of gravity is the sensor's origin."""
    force = MASS * (-STANDARD_GRAVITY * felt.up[row] - felt.own[row])
    quantities = {
        "force": force,
        "acceleration": felt.acceleration[row] / STANDARD_GRAVITY,
        "angular_rate": np.degrees(felt.rate[row]),
    }
    named = {f"{name}.{axis}": float(v[i]) for name, v in quantities.items() for i, axis in enumerate("xyz")}
    return encode(61, named)


@pytest.fixture
def arm() -> Arm:
    return Arm()


@pytest.fixture
def node(_ros: None, arm: Arm) -> Iterator[SimulatedNode]:
    with SimulatedNode(arm, tool_mass=MASS, bias_ramp_time=0.0) as started:
        yield started


def scene(turned: Callable[[float], tuple[float, float]], seconds: float, about: int) -> Felt:
    """No noise; at the time t turned by an angle with a rate about an axis, from upright."""
    times = np.arange(0.0, seconds, STEP_S)
    angle, speed = np.array([turned(float(t)) for t in times]).T
    rate, up = np.zeros((len(times), 3)), np.zeros((len(times), 3))
    rate[:, about] = speed
    up[:, 2] = 1.0
    if about == 0:
        up[:, 1], up[:, 2] = np.sin(angle), np.cos(angle)
    return Felt(times, STANDARD_GRAVITY * up, rate, up, np.zeros_like(up))


def chained(*parts: Felt) -> Felt:
    """One after the other; their times do not count."""
    return Felt(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def forces(stages: Stages) -> Array:
    return np.array([np.linalg.norm(six(message)[:3]) for message in stages.final])


def test_the_move_that_passed_for_tilt(arm: Arm, node: SimulatedNode) -> None:
    """Defaults, a tool of 2 kg, 0.4 s at 2.5 m/s² and back: 5.0 N of its own, and then nothing."""
    stages, felt = Stages(node), feel(acceptance(), 1.0 / STEP_S, seed=2)
    node.run(0.1)
    arm.play(felt)
    node.run(1.9)
    stages.forget()
    node.run(2.7)
    left, own = forces(stages), np.linalg.norm(felt.own[190:460], axis=1)
    assert len(left) == len(own)
    late = slice(1, None)  # the first message is of the row before, or of the row after
    moving = (own[late] > 1.0) & (own[:-1] > 1.0)
    assert left[late][moving].min() > 4.4
    assert left[late][moving].max() < 6.2
    assert left[100:].max() < 0.5
    told = values(node.until(compensation=OK)["compensation"])
    assert 5.5 < float(told["gravity_tilt_deg"]) < 7.0, "the offset of the accelerometer is not known"
    tilt = math.radians(float(told["gravity_tilt_deg"]))
    assert float(told["gravity_tilt_force"]) == pytest.approx(MASS * STANDARD_GRAVITY * tilt, rel=0.02)


def test_the_bound_of_the_tilt_holds_at_rest_whatever_the_offset_of_the_accelerometer() -> None:
    """As much as identification expects; once that has found it, the bound is tighter."""
    chance, within, known = np.random.default_rng(7), 0, 0
    for _ in range(200):
        offset = chance.normal(0.0, OFFSET_PRIOR, 3)
        up = chance.normal(size=3)
        up /= np.linalg.norm(up)
        source = AccelerometerSource(CompensationParameters(), GyroscopeOffset())
        read = STANDARD_GRAVITY * up + offset
        for number in range(300):
            source.gravity(sample(acceleration=tuple(read)), number * 0.01)
        if source.tilt is None:  # the gate: |f| is too far from g, and there is no answer
            continue
        known += 1
        cosine = float(np.dot(read, up) / np.linalg.norm(read))
        within += math.acos(min(1.0, cosine)) <= source.tilt
    assert known > 100
    assert within >= 0.95 * known
    identified = CompensationParameters(accelerometer=AccelerometerParameters(offset=(0.1, 0.0, 0.0)))
    better = AccelerometerSource(identified, GyroscopeOffset())
    for number in range(300):
        better.gravity(sample(acceleration=(0.1, 0.0, STANDARD_GRAVITY)), number * 0.01)
    assert better.tilt is not None
    assert better.tilt < math.radians(3.0)


def test_a_turn_about_the_vertical_during_a_tare_does_not_tilt_another_pose(
    arm: Arm, node: SimulatedNode
) -> None:
    """It passes for rest. Were it learned as the gyroscope's offset, gravity would be off by 1.4° later."""
    stages = Stages(node)
    arm.play(scene(lambda t: (0.045 * t, 0.045), 60.0, about=2))
    node.run(1.0)
    assert node.trigger("tare")[0]
    quarter = math.pi / 2
    rolls = scene(lambda t: (min(t, 1.0) * quarter, quarter if t < 1.0 else 0.0), 3.0, about=0)
    arm.play(chained(scene(lambda t: (0.0, 0.0), 0.5, about=2), rolls))
    node.run(1.45)
    stages.forget()
    node.run(2.0)
    assert forces(stages).max() < MASS * STANDARD_GRAVITY * math.radians(0.5)


def test_numbers_that_are_not_finite_stop_only_what_needs_them(arm: Arm, node: SimulatedNode) -> None:
    stages = Stages(node)
    hold(arm, UP)
    node.run_until(lambda: stages.final, "wrench_compensated")
    hold(arm, UP, acceleration_y=math.nan)
    node.run(0.1)
    assert stages.are_silent()
    node.until("wrench_compensated has stopped: the IMU sends NaN or infinity", compensation=ERROR)
    assert node.set_parameter("tool_mass", 0.0) == (True, "")
    stages.settle(weight(UP))
    node.until(compensation=OK)
    assert node.set_parameter("compensate_inertia", True) == (True, "")
    stages.settle(weight(UP))  # without a mass there is none


def test_the_inertial_term_needs_the_accelerometer(arm: Arm, node: SimulatedNode) -> None:
    for name, value in (("orientation_source", "sensor"), ("compensate_inertia", True)):
        assert node.set_parameter(name, value) == (True, "")
    stages = Stages(node)
    arm.changes = {"process_data": sensed(UP, size=77, orientation_w=1.0, acceleration_x=math.nan)}
    node.until("the IMU, which compensate_inertia needs, sends NaN", compensation=ERROR)
    assert stages.are_silent()
    assert node.set_parameter("compensate_inertia", False) == (True, "")
    stages.forget()
    node.run_until(lambda: stages.final, "wrench_compensated")
    assert is_near(stages.gravity[-1], [0.0, 0.0, -MASS * STANDARD_GRAVITY, 0.0, 0.0, 0.0])


def test_it_says_why_it_does_not_start(arm: Arm, node: SimulatedNode) -> None:
    """An arm that moves from the beginning."""
    stages = Stages(node)
    felt = scene(lambda t: (0.0, 0.0), 20.0, about=2)
    own = np.zeros_like(felt.up)
    own[:, 0] = 2.0 * np.sin(2 * math.pi * 1.0 * felt.times)
    arm.play(felt._replace(acceleration=felt.acceleration + own, own=own))
    node.until("too much to start with: keep the sensor stationary for a second", compensation=ERROR)
    assert stages.are_silent()
    hold(arm, UP)
    arm.felt = None
    stages.forget()
    node.run_until(lambda: stages.final, "wrench_compensated")
    node.until(compensation=OK)


class Pose:
    """A topic's listener."""

    latest: Oriented | None = None
    problem, describe = "", "topic /pose"


def test_an_orientation_of_a_topic_is_carried_on_to_the_sample() -> None:
    """The robot turns by 2 rad/s about x and tells its pose 20 ms late, twenty times a second."""
    listening: Any = Pose()
    source, speed, begin_s = ListenerSource(CompensationParameters(), listening), 2.0, 1000.0
    for step in range(100):
        t = step * 0.01
        if step % 5 == 2:
            half = 0.5 * speed * (t - 0.02)
            stamp_ns = round((begin_s + t - 0.02) * 1e9)
            listening.latest = Oriented((math.sin(half), 0.0, 0.0, math.cos(half)), stamp_ns)
        got = source.gravity(sample(angular_rate=(speed, 0.0, 0.0)), begin_s + t)
        if step > 2:
            wanted = 0.0, -STANDARD_GRAVITY * math.sin(speed * t), -STANDARD_GRAVITY * math.cos(speed * t)
            assert got == pytest.approx(wanted, abs=1e-3)


def test_the_beginning_is_no_error(arm: Arm, node: SimulatedNode) -> None:
    """The accelerometer needs half a second of rest."""
    hold(arm, UP)
    node.until(compensation=OK)
    stages, before = Stages(node), len(node.hear("/diagnostics"))
    node.run_until(lambda: stages.final, "wrench_compensated")
    node.run(1.5)
    reports = node.hear("/diagnostics")[before:]
    levels = [s.level for report in reports for s in report.status if s.name.endswith("compensation")]
    assert set(levels) == {bytes([OK])}


@pytest.mark.parametrize("step_s", [0.1, 0.45, -0.45, -30.0, 3600.0])
def test_a_clock_that_is_set_is_no_force(arm: Arm, node: SimulatedNode, step_s: float) -> None:
    """CLOCK_REALTIME steps while the sensor turns at 1 rad/s: angles are integrated over CLOCK_MONOTONIC."""
    stages = Stages(node)
    arm.play(scene(lambda t: (max(0.0, t - 2.0), float(t > 2.0)), 6.0, about=0))
    node.run(3.0)
    set_ns = round(step_s * 1e9)
    time_ns = arm.time_ns
    arm.time_ns = lambda: time_ns() + set_ns  # type: ignore[method-assign]
    stages.forget()
    node.run(2.0)
    assert len(stages.final) > 190, "nothing is withheld"
    assert forces(stages).max() < 0.3
