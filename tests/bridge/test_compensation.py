"""wrench_compensated, its parameters and the tare, by the IMU, in simulated time."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter

from bota_ethercat.control import Event, event
from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import STANDARD_GRAVITY
from ft_compensation.quantities import Payload
from tests.bridge.compensating import (
    OVER,
    QUICK,
    SIDE,
    UP,
    ZERO6,
    Stages,
    hold,
    is_near,
    sensed,
    six,
    stamp_ns,
    weight,
)
from tests.bridge.simulated_node import SimulatedNode, SimulatedServer
from tests.bridge.streaming import SETTINGS, streaming_description, values
from tests.compensation.making import BIAS, TOOL

pytestmark = pytest.mark.ros
OK, WARN, ERROR, STALE = range(4)
START: dict[str, Any] = {
    "tool_mass": TOOL.mass,
    "tool_center_of_gravity": [*TOOL.center],
    "bias": ZERO6,
    "bias_ramp_time": 0.0,
    "gravity_source": "imu",
}


@pytest.fixture(scope="module")
def server() -> SimulatedServer:
    return SimulatedServer()


@pytest.fixture(scope="module")
def node(_ros: None, server: SimulatedServer) -> Iterator[SimulatedNode]:
    with SimulatedNode(server, **QUICK) as started:
        yield started


@pytest.fixture
def stages(node: SimulatedNode, server: SimulatedServer) -> Stages:
    """The tool hangs from an upright sensor and is compensated; there is no bias."""
    server.forget_once()
    hold(server, UP)
    for name, value in START.items():
        assert node.set_parameter(name, value) == (True, "")
    stages = Stages(node)
    stages.settle(ZERO6)
    return stages


def test_what_is_subtracted_stands_beside_it(stages: Stages, node: SimulatedNode) -> None:
    bias = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    assert node.set_parameter("bias", bias) == (True, "")
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


def test_the_weight_goes_along_with_the_pose(stages: Stages, server: SimulatedServer) -> None:
    for up in (SIDE, OVER, (1, 1, 1)):
        hold(server, up)
        stages.settle(ZERO6)
    hold(server, OVER, force_x=3.0, torque_y=0.25)
    stages.settle([3.0, 0.0, 0.0, 0.0, 0.25, 0.0])  # what the environment does is left as it is


def test_a_tare_takes_the_offset_and_leaves_the_tool(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    hold(server, (1, 0, 2), bias=BIAS)
    stages.settle(list(BIAS.values))
    done, text = node.trigger("tare")
    assert done, text
    assert "the weight of tool_mass 0.8 kg is not part of it" in text
    assert re.search(r"bias of \d+ samples", text)
    stages.settle(ZERO6)
    assert list(node.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-4)
    hold(server, OVER, bias=BIAS)
    stages.settle(ZERO6)  # in every other pose too


def test_a_tare_waits_for_settled_data(stages: Stages, server: SimulatedServer, node: SimulatedNode) -> None:
    description = streaming_description()
    (row,) = description["sensors"]
    row["settling"] = True
    server.answers["describe"] = lambda _: {"ok": True, **description}
    hold(server, UP, force_x=5.0)  # it has not settled

    def settle() -> None:
        hold(server, UP)
        row["settling"] = False

    node.at(1.0, settle)
    try:
        done, text = node.trigger("tare")
        assert done, text
        assert list(node.parameters("bias")[0]) == pytest.approx(ZERO6, abs=1e-4)
        row["settling"] = True
        assert node.trigger("tare") == (False, "sensor 0 does not settle: see the server's log")
    finally:
        del server.answers["describe"]


def test_a_tare_without_a_payload_takes_all(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    assert node.set_parameter("tool_mass", 0) == (True, "")  # a whole number is a number
    stages.settle(weight(UP))
    done, text = node.trigger("tare")
    assert done, text
    assert "tool_mass is 0" in text
    stages.settle(ZERO6)
    hold(server, OVER)
    stages.settle([a - b for a, b in zip(weight(OVER), weight(UP), strict=True)])


@pytest.mark.parametrize(
    ("name", "then"),
    [("tool_mass", 0.0), ("tool_mass", 1.5), ("tool_center_of_gravity", [0.0, 0.1, 0.0])],
)
def test_a_tool_that_is_set_right_after_the_tare(
    stages: Stages, server: SimulatedServer, node: SimulatedNode, name: str, then: Any
) -> None:
    """The bias follows from what the tare measured: nothing jumps, and it holds in every pose."""
    assert node.set_parameter(name, then) == (True, "")
    hold(server, (1, 0, 2), bias=BIAS)
    node.run(1.0)
    assert node.trigger("tare")[0]
    assert node.set_parameter("bias_ramp_time", 0.5) == (True, "")
    stages.settle(ZERO6)
    stages.forget()
    node.run(0.1)
    assert node.set_parameter(name, START[name]) == (True, "")
    node.run(0.1)
    assert max(abs(value) for message in stages.final for value in six(message)) < 1e-3
    assert "if the tool was put on or exchanged since, tare again" in node.log
    assert list(node.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-3)
    hold(server, OVER, bias=BIAS)
    stages.settle(ZERO6)
    hold(server, SIDE, bias=BIAS)
    stages.settle(ZERO6)


def test_a_tare_that_is_gone_back_to_is_for_the_tool_of_now(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    assert node.set_parameter("tool_mass", 0.0) == (True, "")
    for up in (UP, SIDE):
        hold(server, up, bias=BIAS)
        node.run(1.0)
        assert node.trigger("tare")[0]
    assert node.set_parameter("tool_mass", TOOL.mass) == (True, "")
    for done in (True, False):
        assert node.trigger("undo_tare")[0] is done
        hold(server, OVER, bias=BIAS)
        stages.settle(ZERO6)


def test_a_tare_that_finds_the_same_bias_is_of_its_own_pose(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    assert node.set_parameter("tool_mass", 0.0) == (True, "")
    for up in (UP, SIDE):
        hold(server, up, payload=Payload(), bias=BIAS)
        node.run(1.0)
        assert node.trigger("tare")[0]
    assert node.set_parameter("tool_mass", TOOL.mass) == (True, "")
    stages.settle(ZERO6)


def put(node: SimulatedNode, **named: Any) -> Any:
    """Set parameters at once; the result."""
    messages = [Parameter(name, value=value).to_parameter_msg() for name, value in named.items()]
    request = SetParametersAtomically.Request(parameters=messages)
    return node.call("set_parameters_atomically", request).result


def test_a_tare_before_an_identification_is_gone_back_to_with_its_tool(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    assert node.set_parameter("tool_mass", 0.0) == (True, "")
    hold(server, SIDE, bias=BIAS)
    node.run(1.0)
    assert node.trigger("tare")[0]
    assert put(node, tool_mass=TOOL.mass, bias=[9.0, *ZERO6[1:]]).successful
    assert list(node.parameters("bias")[0]) == [9.0, *ZERO6[1:]]
    assert node.trigger("undo_tare")[0]
    hold(server, OVER, bias=BIAS)
    stages.settle(ZERO6)


def test_a_bias_that_was_given_is_not_of_a_tool(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    assert node.trigger("tare")[0]
    assert node.set_parameter("bias", [*BIAS.values]) == (True, "")
    assert node.set_parameter("tool_mass", 0.4) == (True, "")
    assert node.parameters("bias") == [pytest.approx([*BIAS.values])]


def test_a_tool_that_a_tare_without_a_source_does_not_know(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    assert node.set_parameter("tool_mass", 0.0) == (True, "")
    assert node.set_parameter("gravity_source", "none") == (True, "")
    assert node.trigger("tare")[0]
    assert node.set_parameter("gravity_source", "imu") == (True, "")
    node.until(compensation=OK)
    bias = node.parameters("bias")
    assert node.set_parameter("tool_mass", 1.5) == (True, "")
    told = "with a tool of 1.5 kg it may be wrong by 14.7 N and 0.816 Nm in every pose: tare again"
    assert node.log.count(told) == 1
    node.until(told, compensation=WARN)
    assert node.parameters("bias") == bias
    assert node.set_parameter("tool_mass", 0.0) == (True, "")
    node.until(compensation=OK)
    assert node.set_parameter("tool_mass", 1.5) == (True, "")
    assert node.trigger("tare")[0]
    node.until(compensation=OK)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angular_rate_x": 20.0}, "the sensor turns: its mean angular rate is 0.35 rad/s"),
        ({"acceleration_z": -1.0}, "the sensor's IMU reads only zeros"),
        ({"acceleration_z": 1.0}, "the stationary accelerometer reads 19.61 m/s² where 9.81 should be"),
    ],
)
def test_a_tare_is_refused(
    stages: Stages, server: SimulatedServer, node: SimulatedNode, changes: dict[str, float], words: str
) -> None:
    hold(server, UP, bias=BIAS, **changes)
    done, text = node.trigger("tare")
    assert not done
    assert words in text
    assert list(node.parameters("bias")[0]) == ZERO6


def every_other(server: SimulatedServer, **bad: Any) -> None:
    """Every other sample of the next second is so."""
    good = server.changes
    for _ in range(50):
        server.once(**good)
        server.once(**{**good, **bad})


def test_a_sample_that_is_not_finite_spoils_a_tare(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    hold(server, UP, bias=BIAS)
    every_other(server, process_data=sensed(UP, force_x=math.nan))
    done, text = node.trigger("tare")
    assert not done
    assert "of its samples were not finite" in text
    assert list(node.parameters("bias")[0]) == ZERO6


def test_an_invalid_frame_is_no_sample_of_a_tare(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    hold(server, UP, bias=BIAS)
    stages.settle(list(BIAS.values))
    every_other(server, flags=int(DataFlag.INVALID), process_data=sensed(UP, force_z=50.0))
    done, text = node.trigger("tare")
    assert done, text
    assert list(node.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-3)


def test_a_tare_without_samples(stages: Stages, server: SimulatedServer, node: SimulatedNode) -> None:
    server.paused = True
    began_ns = server.monotonic_ns()
    done, text = node.trigger("tare")
    server.paused = False
    assert not done
    assert text == "only 0 samples came in 2.5 s: see /diagnostics, stream"
    assert (server.monotonic_ns() - began_ns) * 1e-9 == pytest.approx(2.5, abs=0.1)


def test_clear_and_undo(stages: Stages, server: SimulatedServer, node: SimulatedNode) -> None:
    hold(server, UP, bias=BIAS)
    stages.settle(list(BIAS.values))
    assert node.trigger("tare")[0]
    stages.settle(ZERO6)
    assert node.trigger("clear_tare") == (True, "the bias is zero")
    stages.settle(list(BIAS.values))
    done, text = node.trigger("undo_tare")
    assert done
    assert "back to the bias before: Fx 3.0000" in text
    stages.settle(ZERO6)
    assert node.trigger("undo_tare") == (False, "there is no change of the bias to undo")


def test_a_bias_is_ramped_in(stages: Stages, node: SimulatedNode) -> None:
    assert node.set_parameter("bias_ramp_time", 0.6) == (True, "")
    stages.forget()
    assert node.set_parameter("bias", [0, 0, -6, 0, 0, 0]) == (True, "")
    node.run(0.7)
    seen = [round(six(message)[2], 6) for message in stages.final]
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(6.0)
    steps = [b - a for a, b in itertools.pairwise(seen)]
    assert max(steps) < 0.3
    assert sum(step > 0 for step in steps) > 55


def test_what_is_subtracted_is_told(stages: Stages, server: SimulatedServer, node: SimulatedNode) -> None:
    status = node.until(compensation=OK)["compensation"]
    assert status.message == "subtracted: weight and inertia of the tool"
    told = values(status)
    assert (told["tool_mass"], told["gravity_source"], told["orientation_age_s"]) == ("0.8", "imu", "0.0")


def test_it_says_that_the_imu_is_off(stages: Stages, server: SimulatedServer, node: SimulatedNode) -> None:
    hold(server, UP, acceleration_z=-1.0)
    node.until("settings.imu_active", compensation=ERROR)


def test_without_a_source_nothing_with_weight_is_compensated(stages: Stages, node: SimulatedNode) -> None:
    assert node.set_parameter("gravity_source", "none") == (True, "")
    node.until("gravity_source is none", compensation=ERROR)
    assert stages.are_silent()
    assert "gravity_source is none" in node.trigger("tare")[1]
    assert node.set_parameter("tool_mass", 0.0) == (True, "")
    stages.settle(weight(UP))  # nothing to turn: the bias alone needs no orientation


def test_a_tool_that_is_accelerated_is_no_contact(stages: Stages, server: SimulatedServer) -> None:
    """By 1 m/s² along x: its mass pulls the other way."""
    pulled = {"force_x": -TOOL.mass, "torque_y": -TOOL.mass * TOOL.center[2]}
    pulled["torque_z"] = TOOL.mass * TOOL.center[1]
    hold(server, UP, acceleration_x=1 / STANDARD_GRAVITY, **pulled)
    stages.settle(ZERO6)
    inertia = [pulled["force_x"], 0.0, 0.0, 0.0, pulled["torque_y"], pulled["torque_z"]]
    assert is_near(stages.tool[-1], [a + b for a, b in zip(weight(UP), inertia, strict=True)])


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("tool_mass", -1.0, "tool_mass"),
        ("tool_mass", "heavy", "Wrong parameter type"),
        ("tool_mass", 1001.0, "tool_mass"),
        ("tool_center_of_gravity", [0.0, 0.0], "it must be 3 numbers, none beyond 10 either way"),
        ("tool_center_of_gravity", [0.0, 0.0, float("nan")], "it must be 3 numbers"),
        ("gravity", [0, 0, 0], "must be at least 0.1 m/s² long"),
        ("bias", [1.0] * 7, "it must be 6 numbers"),
        ("gravity_source", "accelerometer", "it must be none or imu or topic_pose"),
        ("orientation.mounting", [1.0, 0.0, 0.0, 1.0], "a rotation is a quaternion of length 1"),
        ("bias_directory", "", "it must be text that is not empty"),
        ("frame_id", "other", "read-only"),
    ],
)
def test_a_wrong_value_is_refused_and_the_old_one_stays(
    stages: Stages, node: SimulatedNode, name: str, value: Any, words: str
) -> None:
    before = node.parameters(name)
    done, reason = node.set_parameter(name, value)
    assert not done
    assert words in reason
    after = node.parameters(name)
    assert list(after[0]) == list(before[0]) if hasattr(before[0], "__iter__") else after == before


def test_several_are_set_at_once_or_not_at_all(stages: Stages, node: SimulatedNode) -> None:
    assert not put(node, tool_mass=2.0, bias=[0.0] * 5).successful
    assert node.parameters("tool_mass") == [TOOL.mass]
    assert put(node, tool_mass=0.4, bias=[1.0, *ZERO6[1:]]).successful
    half = [part / 2 for part in weight(UP)]
    stages.settle([half[0] - 1.0, *half[1:]])


def test_settings_of_the_sensor_that_do_not_go_with_it(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    for changed, words in (
        ({"inertia_compensation": True}, "the sensor takes gravity off itself"),
        ({"calibration_matrix": False}, "force and torque are counts"),
    ):
        server.send_json(event(Event.RECONFIGURED, sensor=0, settings={**SETTINGS, **changed}))
        status = node.until(words, compensation=WARN)["compensation"]
        assert "switch it o" in status.message
        done, text = node.trigger("tare")
        assert not done
        assert words in text
    server.send_json(event(Event.RECONFIGURED, sensor=0, settings=SETTINGS))
    node.until(compensation=OK)


def test_the_sensors_own_tare_says_that_the_bias_does_not_fit(
    stages: Stages, server: SimulatedServer, node: SimulatedNode
) -> None:
    server.answers["tare"] = lambda _: {"ok": True}
    assert "~/tare" not in node.trigger("sensor_tare")[1]
    assert node.set_parameter("bias", [1, 0, 0, 0, 0, 0]) == (True, "")
    assert "The node's own bias was for the old offset: call ~/tare" in node.trigger("sensor_tare")[1]


def test_without_a_server(stages: Stages, server: SimulatedServer, node: SimulatedNode) -> None:
    server.listens = False
    server.drop()
    node.until(link=ERROR, compensation=STALE)
    done, text = node.trigger("tare")
    assert not done
    assert "there is no server at localhost:" in text
    assert node.trigger("clear_tare")[0]
    server.listens = True
    stages.settle(ZERO6)
    node.until(compensation=OK)
