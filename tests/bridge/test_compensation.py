"""wrench_compensated, its parameters, the tare, what stops it, moves of an arm; in simulated time."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter

from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import encode, layout_for
from bota_ft_compensation.alignment import align
from bota_ft_compensation.bounds import Bounds
from bota_ft_compensation.identification.weighted import Array
from bota_ft_compensation.imu import ImuSource
from bota_ft_compensation.quantities import UNKNOWN_ACCURACY, Accelerometer, Accuracy, Payload
from tests.bridge.simulated_node import (
    OVER,
    QUICK,
    RATE_HZ,
    SETTINGS,
    SIDE,
    STEP_S,
    UP,
    ZERO6,
    Node,
    Server,
    Stages,
    is_near,
    sensed,
    six,
    stamp_ns,
    values,
    weight,
)
from tests.compensation.making import BIAS, TOOL
from tests.compensation.motion import Felt, feel, guided

START: dict[str, Any] = {
    "tool_mass": TOOL.mass,
    "tool_center_of_gravity": [*TOOL.center],
    "bias": ZERO6,
    "bias_ramp_time": 0.0,
    "gravity_source": "imu",
}


@pytest.fixture(scope="module")
def server() -> Server:
    return Server()


@pytest.fixture(scope="module")
def node(server: Server) -> Iterator[Node]:
    with Node(server, **QUICK) as started:
        yield started


@pytest.fixture
def stages(node: Node, server: Server) -> Stages:
    """The tool hangs from an upright sensor and is compensated; there is no bias."""
    server.forget_once()
    server.hold(UP)
    for name, value in START.items():
        node.set(name, value)
    stages = Stages(node)
    stages.settle(ZERO6)
    return stages


def test_what_is_subtracted_stands_beside_it(stages: Stages, node: Node) -> None:
    bias = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    node.set("bias", bias)
    measured = node.hear("wrench")
    stages.settle([-part for part in bias])
    node.run(0.2)
    measured.clear()
    stages.forget()
    node.run(0.1)
    assert is_near(stages.bias[0], bias)
    assert is_near(stages.tool[0], weight(UP))
    assert [len(messages) for messages in (measured, *stages.all)] == [10] * 4
    for wrench, *parts in zip(measured, *stages.all, strict=True):
        assert {stamp_ns(part) for part in parts} == {stamp_ns(wrench)}, "the sample's, in all of them"
        assert {part.header.frame_id for part in parts} == {"ft_sensor"}
        total = [sum(axis) for axis in zip(*map(six, parts), strict=True)]
        assert six(wrench) == pytest.approx(total, abs=1e-9)


def test_a_tare_takes_the_offset_and_leaves_the_tool(stages: Stages, server: Server, node: Node) -> None:
    stages.at((1, 0, 2), bias=BIAS, wanted=list(BIAS.values))
    text = node.do("tare", "the weight of tool_mass 0.8 kg is not part of it")
    assert re.search(r"bias of \d+ samples", text)
    stages.settle(ZERO6)
    assert list(node.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-4)
    stages.at(OVER, bias=BIAS)  # in every other pose too


def test_a_tare_waits_for_settled_data(stages: Stages, server: Server, node: Node) -> None:
    (row,) = server.description["sensors"]
    row["settling"] = True
    server.hold(UP, force_x=5.0)  # it has not settled

    def settle() -> None:
        server.hold(UP)
        row["settling"] = False

    node.at(1.0, settle)
    node.do("tare")
    assert list(node.parameters("bias")[0]) == pytest.approx(ZERO6, abs=1e-4)
    row["settling"] = True
    assert node.trigger("tare") == (False, "sensor 0 does not settle: see the server's log")
    row["settling"] = False


def test_a_tare_without_a_payload_takes_all(stages: Stages, server: Server, node: Node) -> None:
    node.set("tool_mass", 0)  # a whole number is a number
    stages.settle(weight(UP))
    node.do("tare", "tool_mass is 0")
    stages.settle(ZERO6)
    stages.at(OVER, wanted=[a - b for a, b in zip(weight(OVER), weight(UP), strict=True)])


@pytest.mark.parametrize(
    ("name", "then"),
    [("tool_mass", 0.0), ("tool_mass", 1.5), ("tool_center_of_gravity", [0.0, 0.1, 0.0])],
)
def test_a_tool_that_is_set_after_a_tare(
    stages: Stages, server: Server, node: Node, name: str, then: Any
) -> None:
    """The bias follows from what the tare measured: nothing jumps, and it holds in every pose."""
    node.set(name, then)
    server.hold((1, 0, 2), bias=BIAS)
    node.run(1.0)
    node.do("tare")
    node.set("bias_ramp_time", 0.5)
    stages.settle(ZERO6)
    stages.forget()
    node.run(0.1)
    node.set(name, START[name])
    node.run(0.1)
    assert max(abs(value) for message in stages.final for value in six(message)) < 1e-3
    assert "if the tool was put on or exchanged since, tare again" in node.log
    assert list(node.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-3)
    stages.at(OVER, bias=BIAS)
    stages.at(SIDE, bias=BIAS)


def test_a_tool_that_is_set_during_a_tare(stages: Stages, server: Server, node: Node) -> None:
    node.set("tool_mass", 0.0)
    server.hold(UP, bias=BIAS)
    node.at(0.15, lambda: node.set("tool_mass", TOOL.mass))
    node.do("tare")
    for up in (UP, OVER):
        stages.at(up, bias=BIAS)


def put(node: Node, **named: Any) -> Any:
    messages = [Parameter(name, value=value).to_parameter_msg() for name, value in named.items()]
    request = SetParametersAtomically.Request(parameters=messages)
    return node.call("set_parameters_atomically", request).result


def test_several_are_set_at_once_a_given_bias_is_of_no_tool(
    stages: Stages, node: Node, server: Server
) -> None:
    assert not put(node, tool_mass=2.0, bias=[0.0] * 5).successful
    assert node.parameters("tool_mass") == [TOOL.mass]
    assert put(node, tool_mass=0.4, bias=[1.0, *ZERO6[1:]]).successful
    half = [part / 2 for part in weight(UP)]
    stages.settle([half[0] - 1.0, *half[1:]])
    node.do("tare")
    node.set("bias", [*BIAS.values])
    node.set("tool_mass", 0.4)
    assert node.parameters("bias") == [pytest.approx([*BIAS.values])]


def test_a_tool_that_a_tare_without_a_source_does_not_see(stages: Stages, server: Server, node: Node) -> None:
    node.set("tool_mass", 0.0)
    node.set("gravity_source", "none")
    node.do("tare")
    node.set("gravity_source", "imu")
    node.until(compensation="ok")
    bias = node.parameters("bias")
    node.set("tool_mass", 1.5)
    told = "with a tool of 1.5 kg it may be wrong by 14.7 N and 0.816 Nm in every pose: tare again"
    assert node.log.count(told) == 1
    node.until(told, compensation="warn")
    assert node.parameters("bias") == bias
    node.set("tool_mass", 0.0)
    node.until(compensation="ok")
    node.set("tool_mass", 1.5)
    node.do("tare")
    node.until(compensation="ok")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angular_rate_x": 20.0}, "the sensor turns: its mean angular rate is 0.35 rad/s"),
        ({"acceleration_z": -1.0}, "the sensor's IMU reads only zeros"),
        ({"acceleration_z": 1.0}, "the stationary accelerometer reads 19.61 m/s² where 9.81 should be"),
    ],
)
def test_a_tare_is_refused(
    stages: Stages, server: Server, node: Node, changes: dict[str, float], words: str
) -> None:
    server.hold(UP, bias=BIAS, **changes)
    node.refuse("tare", words)
    assert list(node.parameters("bias")[0]) == ZERO6


def with_bits(**fields: int) -> bytes:
    data = bytearray(sensed(UP))
    for name, bits in fields.items():
        data[layout_for(len(data)).offsets[name]] = bits
    return bytes(data)


def every_other(server: Server, **bad: Any) -> None:
    good = server.changes
    for _ in range(50):
        server.once(**good)
        server.once(**{**good, **bad})


def test_bad_samples_in_a_tare(stages: Stages, server: Server, node: Node) -> None:
    server.hold(UP, bias=BIAS)
    every_other(server, process_data=sensed(UP, force_x=math.nan))
    node.refuse("tare", "of its samples were not finite")
    assert list(node.parameters("bias")[0]) == ZERO6
    server.forget_once()
    stages.at(UP, bias=BIAS, wanted=list(BIAS.values))
    every_other(server, flags=int(DataFlag.INVALID), process_data=sensed(UP, force_z=50.0))
    node.do("tare")
    assert list(node.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-3)


def test_a_tare_without_samples(stages: Stages, server: Server, node: Node) -> None:
    server.paused = True
    began_ns = server.monotonic_ns()
    done, text = node.trigger("tare")
    server.paused = False
    assert not done
    assert text == "only 0 samples came in 2.5 s: see /diagnostics, stream"
    assert (server.monotonic_ns() - began_ns) * 1e-9 == pytest.approx(2.5, abs=0.1)


def test_clear_and_undo(stages: Stages, server: Server, node: Node) -> None:
    stages.at(UP, bias=BIAS, wanted=list(BIAS.values))
    node.do("tare")
    stages.settle(ZERO6)
    assert node.trigger("clear_tare") == (True, "the bias is zero")
    stages.settle(list(BIAS.values))
    node.do("undo_tare", "back to the bias before: Fx 3.0000")
    stages.settle(ZERO6)
    node.set("bias", [1.0] * 6)
    assert node.trigger("undo_tare") == (False, "there is no tare to undo")
    server.hold(UP, force_x=2e6)  # counts, say
    node.refuse("tare", "parameter bias is ", "it must be 6 numbers")


def test_a_bias_is_ramped_in(stages: Stages, node: Node) -> None:
    node.set("bias_ramp_time", 0.6)
    stages.forget()
    assert values(node.statuses()["compensation"])["bias_ramping"] == "false"
    node.set("bias", [0, 0, -6, 0, 0, 0])
    node.run(0.7)
    seen = [round(six(message)[2], 6) for message in stages.final]
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(6.0)
    steps = [b - a for a, b in itertools.pairwise(seen)]
    assert max(steps) < 0.3
    assert sum(step > 0 for step in steps) > 55


def test_what_is_subtracted_is_told(stages: Stages, server: Server, node: Node) -> None:
    status = node.until(compensation="ok")["compensation"]
    assert status.message == "subtracted: weight and inertia of the tool"
    told = values(status)
    assert (told["gravity_source"], told["orientation_age_s"], told["bias_ramping"]) == ("imu", "", "false")
    server.changes["process_data"] = with_bits(acceleration_saturated=0b10)
    node.until("the IMU's range was exceeded", compensation="warn")


def test_without_a_source_nothing_with_weight_is_compensated(stages: Stages, node: Node) -> None:
    node.set("gravity_source", "none")
    node.until("gravity_source is none", compensation="error")
    assert stages.are_silent()
    node.refuse("tare", "gravity_source is none")
    node.set("tool_mass", 0.0)
    stages.settle(weight(UP))  # nothing to turn: the bias alone needs no orientation


def test_settings_of_the_sensor_that_do_not_go_with_it(stages: Stages, server: Server, node: Node) -> None:
    for changed, words, sensor in (
        ({"inertia_compensation": True}, "the sensor takes gravity off itself", "ok"),
        ({"calibration_matrix": False}, "force and torque are counts and not N and Nm", "error"),
    ):
        server.reconfigure(**changed)
        status = node.until("has stopped", words, compensation="error", sensor=sensor)["compensation"]
        assert stages.are_silent()
        assert "switch it o" in status.message
        node.refuse("tare", words)
    server.reconfigure()
    node.until(compensation="ok", sensor="ok")


# What would mislead is said: settings that change what the wrench means.


@pytest.fixture
def fresh() -> Server:
    made = Server()
    made.hold(UP)
    return made


@pytest.fixture
def weighed(fresh: Server) -> Iterator[Node]:
    with Node(fresh, **START | QUICK) as started:
        started.run(0.3)
        yield started


def test_a_wrench_in_a_configured_frame(weighed: Node, fresh: Server) -> None:
    """How that frame is turned to the IMU's the sensor does not tell."""
    stages = Stages(weighed)
    stages.settle(ZERO6)
    fresh.reconfigure(coordinate_system=True)
    weighed.until(
        "are in a frame configured in the sensor: switch it off, or correct the URDF",
        "has stopped",
        sensor="warn",
        compensation="error",
    )
    assert stages.are_silent()
    weighed.refuse("tare", "the rotation from the IMU to it is unknown")
    weighed.do("identify/start")
    weighed.refuse("identify/add_pose", "the rotation from the IMU to it is unknown")
    weighed.set("tool_mass", 0.0)  # a bias is in any frame what it is
    stages.first()
    weighed.do("tare")
    weighed.set("tool_mass", TOOL.mass)
    assert stages.are_silent()
    fresh.reconfigure(coordinate_system=False)
    weighed.until("in which pose is not known: with a tool of 0.8 kg", sensor="ok", compensation="warn")
    stages.first()
    weighed.do("tare")
    weighed.until(sensor="ok", compensation="ok")


@pytest.mark.parametrize(
    ("given", "changes", "words"),
    [
        ({"gravity_source": "none"}, {}, "gravity_source is none"),
        ({}, {"acceleration_z": -1.0}, "the accelerometer reads zero: switch the IMU on"),
        ({"gravity_source": "topic_pose"}, {}, "orientation: nobody publishes it"),
    ],
)
def test_a_check_at_start_sees_that_nothing_could_be_published(
    fresh: Server, given: dict[str, Any], changes: dict[str, float], words: str
) -> None:
    """With nobody subscribed: whoever looks before the controller starts is told."""
    fresh.hold(UP, **changes)
    with Node(fresh, **START | QUICK | given) as weighed:
        weighed.until("could not be published if somebody subscribed", words, compensation="error")
        weighed.set("tool_mass", 0.0)
        weighed.until("nobody has subscribed", compensation="ok")


def test_nothing_is_published_with_the_imu_off(weighed: Node, fresh: Server) -> None:
    stages = Stages(weighed)
    stages.settle(ZERO6)
    fresh.hold(UP, acceleration_z=-1.0)
    weighed.run(0.02)
    assert stages.are_silent()
    weighed.until("switch the IMU on", compensation="error")
    stages.at(UP)
    weighed.until(compensation="ok")
    fresh.reconfigure(imu_active=0)
    weighed.until("switch the IMU on (settings.imu_active)", compensation="error")


def test_saturated_samples_can_be_left_out(weighed: Node, fresh: Server) -> None:
    stages, raw = Stages(weighed), weighed.hear("wrench")
    stages.settle(ZERO6)

    def saturate() -> tuple[int, int]:
        """How many messages there are of ten samples, three of them saturated."""
        weighed.run(0.05)
        stages.forget()
        raw.clear()
        for _ in range(3):
            fresh.once(process_data=with_bits(force_torque_saturated=0b100))
        weighed.run(0.1)
        return len(raw), len(stages.final)

    assert saturate() == (10, 10)
    weighed.set("on_saturation", "stop")
    weighed.statuses()  # the next one comes after what follows
    assert saturate() == (10, 7)
    weighed.until("3 samples were not compensated: force or torque was saturated", compensation="warn")
    fresh.changes = {"process_data": with_bits(force_torque_saturated=0b100)}
    array = weighed.until(
        "has stopped: force or torque was saturated or out of range, and on_saturation is stop",
        compensation="error",
    )
    assert int(values(array["sensor"])["saturated_samples"]) > 6


# Moves of an arm, slow and late orientations, numbers that are not finite.


HEAVY = Payload(2.0)


class Arm(Server):
    """Sends what `felt` says, a row a step."""

    felt: Felt | None = None

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
def moved(arm: Arm) -> Iterator[Node]:
    given: dict[str, Any] = {"tool_mass": HEAVY.mass, "bias_ramp_time": 0.0, "rest.duration": 0.3}
    with Node(arm, **given) as started:  # the position of the IMU is that of the model
        yield started


def forces(stages: Stages) -> Array:
    return np.array([np.linalg.norm(six(message)[:3]) for message in stages.final])


@pytest.mark.parametrize("set_by_s", [-0.45, 0.1, 3600.0])
def test_setting_the_wall_clock_changes_nothing(arm: Arm, moved: Node, set_by_s: float) -> None:
    """Angular acceleration is a slope over monotonic time."""
    stages = Stages(moved)
    arm.play(feel(guided(5), HEAVY, 3.0, 1.0 / STEP_S))
    moved.run(1.0)
    arm.clock_step_ns = round(set_by_s * 1e9)
    stages.forget()
    moved.run(2.0)
    assert len(stages.final) == 200
    assert forces(stages).max() < 0.35


def test_how_wrong_the_force_may_be_is_told(arm: Arm, moved: Node) -> None:
    """As it is expected of any IMU and sensor, after a tare, and as identification has found them."""
    arm.hold(UP)
    Stages(moved)

    def told() -> float:
        return float(values(moved.until(compensation="ok")["compensation"])["force_bound"])

    def expected(known: Accelerometer, accuracy: Accuracy = UNKNOWN_ACCURACY) -> float:
        lever = ImuSource(HEAVY.center).lever_of("BFT-SENS-ECAT-M8")
        return float(Bounds(HEAVY, known, align(SETTINGS, RATE_HZ), lever, None, accuracy).at()[0])

    assert told() == pytest.approx(expected(Accelerometer()), rel=0.01)
    moved.do("tare")  # by this accelerometer, whose offset is part of the bias from now on
    assert told() < 0.7 * expected(Accelerometer())
    known = Accelerometer(
        offset_interval=(0.02,) * 3, scale_interval=(0.0,) * 3, cross_axis_interval=(0.0,) * 6
    )
    for name in ("offset_interval", "scale_interval", "cross_axis_interval"):
        moved.set(f"accelerometer.{name}", [*getattr(known, name)])
    moved.set("bias", [0.01] * 6)  # of no tare
    assert told() == pytest.approx(expected(known), rel=0.01)
    quiet = Accuracy(noise=(0.01,) * 3 + (0.001,) * 3)
    moved.set("accuracy.noise", [*quiet.noise])
    assert told() == pytest.approx(expected(known, quiet), rel=0.01)
    assert expected(known, quiet) < 0.9 * expected(known)


def test_how_wrong_the_torque_may_be_is_told_in_the_present_motion(arm: Arm, moved: Node) -> None:
    """An unknown inertia matters while the tool spins; once it is identified, hardly."""
    Stages(moved)

    def told() -> float:
        return float(values(moved.until(compensation="ok")["compensation"])["torque_bound"])

    arm.hold(UP)
    still = told()
    arm.play(feel(guided(5, radians=1.0), HEAVY, 20.0, 1.0 / STEP_S))
    moved.run(1.0)
    moving = max(told() for _ in range(3))
    assert moving > still + 0.01
    moved.set("tool_inertia", [1e-3] * 3 + [0.0] * 3)
    moved.set("tool_inertia_interval", [1e-6] * 6)
    assert max(told() for _ in range(3)) < still + 0.01


def test_numbers_that_are_not_finite_stop_only_what_needs_them(arm: Arm, moved: Node) -> None:
    stages = Stages(moved)
    arm.hold(UP)
    stages.first()
    arm.hold(UP, acceleration_y=math.nan)
    moved.run(0.1)
    assert stages.are_silent()
    moved.until("wrench_compensated has stopped: the IMU sends NaN or infinity", compensation="error")
    moved.set("tool_mass", 0.0)
    stages.settle(weight(UP))
    moved.until(compensation="ok")
