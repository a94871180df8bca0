"""wrench_compensated, its parameters and the tare, with the accelerometer. One node for all tests."""

from __future__ import annotations

import itertools
import math
import re
import time
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from geometry_msgs.msg import WrenchStamped

from protocol.control import Event, event
from protocol.framing import DataFlag
from protocol.pdo import encode
from tests.bridge.compensating import (
    OVER,
    QUICK,
    SIDE,
    UP,
    ZERO6,
    Stages,
    comes_to_rest,
    hold,
    is_near,
    sensed,
    settle,
    six,
    weight,
)
from tests.bridge.conftest import Listener, NodeThread, starter, wait_until
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.shared import listener, server, stream
from tests.bridge.streaming import SETTINGS, Diagnostics, Stream, values
from tests.compensation.making import BIAS, TOOL

__all__ = ["listener", "server", "stream"]
pytestmark = pytest.mark.ros
OK, WARN, ERROR, STALE = range(4)
START: dict[str, Any] = {
    "tool_mass": TOOL.mass,
    "tool_center_of_gravity": [*TOOL.center],
    "bias": ZERO6,
    "bias_ramp_time": 0.0,
    "orientation_source": "accelerometer",
    "compensate_inertia": False,
}


@pytest.fixture(scope="module")
def node(server: ScriptedServer, stream: Stream, listener: Listener) -> Iterator[NodeThread]:
    hold(stream, UP)
    with starter(listener) as start:
        yield start(server.port, **QUICK)


@pytest.fixture(scope="module")
def _stages(listener: Listener, node: NodeThread) -> Stages:
    return Stages(listener)


@pytest.fixture
def stages(_stages: Stages, stream: Stream, listener: Listener, node: NodeThread) -> Iterator[Stages]:
    """The tool hangs from an upright sensor and is compensated; there is no bias."""
    stream.forget_once()
    hold(stream, UP)
    for name, value in START.items():
        assert listener.set_parameter(name, value) == (True, "")
    _stages.settle(ZERO6)
    _stages.forget()
    yield _stages
    assert node.is_running
    assert "Traceback" not in node.log


def test_what_is_subtracted_stands_beside_it(stages: Stages, stream: Stream, listener: Listener) -> None:
    assert listener.set_parameter("bias", [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]) == (True, "")
    stages.settle([-1.0, -2.0, -3.0, -0.1, -0.2, -0.3])
    measured = listener.subscribe(WrenchStamped, "wrench")
    wait_until(lambda: not measured.empty(), "a wrench")
    stages.forget()
    got = [settle(stages.bias, [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]), settle(stages.gravity, weight(UP))]
    got += [stages.inertia.get(timeout=20), stages.final.get(timeout=20), measured.get(timeout=20)]
    by_stamp: dict[tuple[int, int], list[list[float]]] = {}
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        by_stamp.clear()
        for position, messages in enumerate(
            (measured, stages.bias, stages.gravity, stages.inertia, stages.final)
        ):
            for message in list(messages.queue):
                key = message.header.stamp.sec, message.header.stamp.nanosec
                by_stamp.setdefault(key, []).append([float(position), *six(message)])
        whole = [rows for rows in by_stamp.values() if len(rows) == 5]
        if len(whole) > 5:
            break
        time.sleep(0.05)
    assert len(whole) > 5
    for rows in whole:  # the stamp is the sample's in all, and the stages add up
        _, wrench, bias, gravity, inertia, final = [None, *(row[1:] for row in sorted(rows))]
        assert wrench is not None
        for axis in range(6):
            total = bias[axis] + gravity[axis] + inertia[axis] + final[axis]
            assert wrench[axis] == pytest.approx(total, abs=1e-9)
    assert got[0].header.frame_id == "ft_sensor"


def test_gravity_goes_along_with_the_pose(stages: Stages, stream: Stream) -> None:
    for up in (SIDE, OVER, (1, 1, 1)):
        hold(stream, up)
        stages.settle(ZERO6)
    hold(stream, OVER, force_x=3.0, torque_y=0.25)
    stages.settle([3.0, 0.0, 0.0, 0.0, 0.25, 0.0])  # what the environment does is left as it is


def test_a_tare_takes_the_offset_and_leaves_the_tool(
    stages: Stages, stream: Stream, listener: Listener
) -> None:
    hold(stream, (1, 0, 2), bias=BIAS)
    stages.settle(list(BIAS.values))
    done, text = listener.trigger("tare")
    assert done, text
    assert "the weight of tool_mass 0.8 kg is not part of it" in text
    assert re.search(r"bias of \d+ samples", text)
    stages.settle(ZERO6)
    assert list(listener.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-4)
    hold(stream, OVER, bias=BIAS)
    stages.settle(ZERO6)  # in every other pose too


def test_a_tare_without_a_payload_takes_all(stages: Stages, stream: Stream, listener: Listener) -> None:
    assert listener.set_parameter("tool_mass", 0) == (True, "")  # a whole number is a number
    stages.settle(weight(UP))
    done, text = listener.trigger("tare")
    assert done, text
    assert "tool_mass is 0" in text
    stages.settle(ZERO6)
    hold(stream, OVER)
    stages.settle([a - b for a, b in zip(weight(OVER), weight(UP), strict=True)])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angular_rate_x": 20.0}, "the sensor turns: its mean angular rate is 0.35 rad/s"),
        ({"acceleration_z": -1.0}, "the sensor's IMU reads only zeros"),
        ({"acceleration_z": 1.0}, "the stationary accelerometer reads 19.61 m/s² where 9.81 should be"),
    ],
)
def test_a_tare_is_refused(
    stages: Stages, stream: Stream, listener: Listener, changes: dict[str, float], words: str
) -> None:
    hold(stream, UP, bias=BIAS, **changes)
    time.sleep(0.1)
    done, text = listener.trigger("tare")
    assert not done
    assert words in text
    assert list(listener.parameters("bias")[0]) == ZERO6


def test_a_tare_while_the_force_moves_is_refused(stages: Stages, stream: Stream, listener: Listener) -> None:
    still, pushed = sensed(UP), sensed(UP, force_y=9.0)
    for position in range(1000):  # for longer than the call may take
        stream.once(process_data=pushed if position // 3 % 2 else still)
    done, text = listener.trigger("tare")
    assert not done
    assert "the sensor is not stationary: force y moved by" in text
    assert list(listener.parameters("bias")[0]) == ZERO6


def test_a_saturated_sample_spoils_a_tare(stages: Stages, stream: Stream, listener: Listener) -> None:
    saturated = bytearray(sensed(UP))
    mask = encode(61, {"force_torque_saturated": 4})
    saturated = bytearray(a | b for a, b in zip(saturated, mask, strict=True))
    # Again and again: on a busy machine the call takes its time, and a window has 30 samples.
    for position in range(1000):
        stream.once(process_data=bytes(saturated) if position % 10 == 9 else sensed(UP))
    done, text = listener.trigger("tare")
    assert not done
    assert "force or torque was saturated" in text


def every_other(stream: Stream, **bad: Any) -> None:
    """Every other frame is so from now on, until after a window, however late that is."""
    good = stream.changes
    for _ in range(1000):
        stream.once(**{**good, **bad})
        stream.once(**good)


def test_a_sample_that_is_not_finite_spoils_a_tare(
    stages: Stages, stream: Stream, listener: Listener
) -> None:
    hold(stream, UP, bias=BIAS)
    every_other(stream, process_data=sensed(UP, force_x=math.nan))
    done, text = listener.trigger("tare")
    assert not done
    assert "of its samples were not finite" in text
    assert list(listener.parameters("bias")[0]) == ZERO6


def test_an_invalid_frame_is_no_sample_of_a_tare(stages: Stages, stream: Stream, listener: Listener) -> None:
    hold(stream, UP, bias=BIAS)
    stages.settle(list(BIAS.values))
    every_other(stream, flags=int(DataFlag.INVALID), process_data=sensed(UP, force_z=50.0))
    done, text = listener.trigger("tare")
    assert done, text
    assert list(listener.parameters("bias")[0]) == pytest.approx(BIAS.values, abs=1e-3)
    stream.forget_once()
    assert listener.trigger("clear_tare")[0]


def test_a_tare_without_samples(stages: Stages, stream: Stream, listener: Listener) -> None:
    stream.paused = True
    try:
        done, text = listener.trigger("tare")
    finally:
        stream.paused = False
    assert not done
    assert "samples came in" in text
    assert "/diagnostics" in text


def test_clear_and_undo(stages: Stages, stream: Stream, listener: Listener) -> None:
    hold(stream, UP, bias=BIAS)
    wait_until(lambda: listener.trigger("tare")[0], "rest")  # what was before may be among the first samples
    stages.settle(ZERO6)
    assert listener.trigger("clear_tare") == (True, "the bias is zero")
    stages.settle(list(BIAS.values))
    done, text = listener.trigger("undo_tare")
    assert done
    assert "back to the bias before: Fx 3.0000" in text
    stages.settle(ZERO6)
    assert listener.trigger("undo_tare") == (False, "there is no change of the bias to undo")


def test_a_bias_is_ramped_in(stages: Stages, stream: Stream, listener: Listener) -> None:
    assert listener.set_parameter("bias_ramp_time", 0.6) == (True, "")
    stages.forget()
    assert listener.set_parameter("bias", [0, 0, -6, 0, 0, 0]) == (True, "")
    seen: list[float] = []
    while not seen or seen[-1] < 6.0 - 1e-3:
        seen.append(six(stages.final.get(timeout=20))[2])
    assert seen == sorted(seen)
    steps = [b - a for a, b in itertools.pairwise(seen)]
    assert sum(0.0 < step < 3.0 for step in steps) > 5


def test_it_stops_when_the_accelerometer_is_of_no_use(
    stages: Stages, stream: Stream, listener: Listener
) -> None:
    diagnostics = Diagnostics(listener)
    status = diagnostics.until(compensation=OK)["compensation"]
    assert status.message == "gravity is subtracted"
    assert values(status)["tool_mass"] == "0.8"
    assert values(status)["orientation_source"] == "accelerometer"
    assert float(values(status)["orientation_age_s"]) < 0.5
    hold(stream, UP, acceleration_z=0.5)  # it is being shaken
    diagnostics.until("wrench_compensated has stopped: the accelerometer has not for", compensation=ERROR)
    comes_to_rest(stages.final)
    done, text = listener.trigger("tare")
    assert not done
    assert "accelerometer reads" in text
    hold(stream, UP)
    stages.settle(ZERO6)
    status = diagnostics.until("gravity is subtracted", compensation=OK)["compensation"]
    assert int(values(status)["withheld"]) > 10


def test_it_says_that_the_imu_is_off(stages: Stages, stream: Stream, listener: Listener) -> None:
    diagnostics = Diagnostics(listener)
    hold(stream, UP, acceleration_z=-1.0)
    diagnostics.until("settings.imu_active", compensation=ERROR)


def test_without_a_source_nothing_with_weight_is_compensated(
    stages: Stages, stream: Stream, listener: Listener
) -> None:
    diagnostics = Diagnostics(listener)
    assert listener.set_parameter("orientation_source", "none") == (True, "")
    diagnostics.until("orientation_source is none", compensation=ERROR)
    comes_to_rest(stages.final)
    assert "orientation_source is none" in listener.trigger("tare")[1]
    assert listener.set_parameter("tool_mass", 0.0) == (True, "")
    stages.settle(weight(UP))  # nothing to turn: the bias alone needs no orientation
    assert listener.set_parameter("orientation_source", "accelerometer") == (True, "")


def test_the_sensors_own_estimate(stages: Stages, stream: Stream, listener: Listener) -> None:
    diagnostics = Diagnostics(listener)
    assert listener.set_parameter("orientation_source", "sensor") == (True, "")
    diagnostics.until("settings.orientation_estimation", compensation=ERROR)
    over = {"orientation_x": 1.0}  # half a turn about x, while the accelerometer says something else
    hold(stream, OVER, size=77, acceleration_x=5.0, **over)
    stages.settle(ZERO6)
    diagnostics.until(compensation=OK)


def test_inertia_is_taken_off_where_it_is_asked_for(
    stages: Stages, stream: Stream, listener: Listener
) -> None:
    assert listener.set_parameter("orientation_source", "sensor") == (True, "")
    # The tool is accelerated by 1 m/s² along x: its mass pulls the other way.
    pulled = {"force_x": -TOOL.mass, "acceleration_x": 1 / 9.80665, "orientation_w": 1.0}
    pulled |= {"torque_y": -TOOL.mass * TOOL.center[2], "torque_z": TOOL.mass * TOOL.center[1]}
    hold(stream, UP, size=77, **pulled)
    left = [pulled["force_x"], 0, 0, 0, pulled["torque_y"], pulled["torque_z"]]
    stages.settle(left)
    assert is_near(stages.inertia.get(timeout=20), ZERO6)
    assert listener.set_parameter("compensate_inertia", True) == (True, "")
    stages.settle(ZERO6)
    settle(stages.inertia, left)


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
        ("orientation_source", "imu", "it must be none or accelerometer or sensor or topic_pose"),
        ("orientation.mounting", [1.0, 0.0, 0.0, 1.0], "a rotation is a quaternion of length 1"),
        ("bias_directory", "", "it must be text that is not empty"),
        ("frame_id", "other", "read-only"),
    ],
)
def test_a_wrong_value_is_refused_and_the_old_one_stays(
    stages: Stages, listener: Listener, name: str, value: Any, words: str
) -> None:
    before = listener.parameters(name)
    done, reason = listener.set_parameter(name, value)
    assert not done
    assert words in reason
    after = listener.parameters(name)
    assert list(after[0]) == list(before[0]) if hasattr(before[0], "__iter__") else after == before


def test_several_are_set_at_once_or_not_at_all(stages: Stages, stream: Stream, listener: Listener) -> None:
    from rcl_interfaces.srv import SetParametersAtomically
    from rclpy.parameter import Parameter

    def put(**named: Any) -> Any:
        messages = [Parameter(name, value=value).to_parameter_msg() for name, value in named.items()]
        request = SetParametersAtomically.Request(parameters=messages)
        return listener.call(SetParametersAtomically, "set_parameters_atomically", request).result

    assert not put(tool_mass=2.0, bias=[0.0] * 5).successful
    assert listener.parameters("tool_mass") == [TOOL.mass]
    assert put(tool_mass=0.4, bias=[1.0, *ZERO6[1:]]).successful
    half = [part / 2 for part in weight(UP)]
    stages.settle([half[0] - 1.0, *half[1:]])


def test_settings_of_the_sensor_that_do_not_go_with_it(
    stages: Stages, server: ScriptedServer, listener: Listener
) -> None:
    diagnostics = Diagnostics(listener)
    for changed, words in (
        ({"inertia_compensation": True}, "the sensor takes gravity off itself"),
        ({"calibration_matrix": False}, "force and torque are counts"),
    ):
        server.send_json(event(Event.RECONFIGURED, sensor=0, settings={**SETTINGS, **changed}))
        status = diagnostics.until(words, compensation=WARN)["compensation"]
        assert "switch it o" in status.message
        done, text = listener.trigger("tare")
        assert not done
        assert words in text
    server.send_json(event(Event.RECONFIGURED, sensor=0, settings=SETTINGS))
    diagnostics.until(compensation=OK)


def test_the_sensors_own_tare_says_that_the_bias_does_not_fit(
    stages: Stages, server: ScriptedServer, listener: Listener
) -> None:
    server.answers["tare"] = lambda _: {"ok": True}
    assert "~/tare" not in listener.trigger("sensor_tare")[1]
    assert listener.set_parameter("bias", [1, 0, 0, 0, 0, 0]) == (True, "")
    assert "The node's own bias was for the old offset: call ~/tare" in listener.trigger("sensor_tare")[1]


def test_without_a_server(stages: Stages, server: ScriptedServer, stream: Stream, listener: Listener) -> None:
    description, server.description = server.description, {**server.description, "sensors": []}
    diagnostics = Diagnostics(listener)
    server.drop()
    diagnostics.until(link=ERROR, compensation=STALE)
    done, text = listener.trigger("tare")
    assert not done
    assert "there is no server at localhost:" in text or "has no sensor 0" in text
    assert listener.trigger("clear_tare")[0]
    server.description = description
    stages.settle(ZERO6)
    diagnostics.until(compensation=OK)
