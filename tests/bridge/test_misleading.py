"""What would mislead is said: settings that change what the wrench means, parameters that are none.

In simulated time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bota_ethercat.control import Event, event
from bota_ethercat.pdo import encode, layout_for
from bridge.node import StartError
from tests.bridge.compensating import QUICK, UP, ZERO6, Stages, hold, sensed
from tests.bridge.simulated_node import SimulatedNode, SimulatedServer
from tests.bridge.streaming import SETTINGS, values
from tests.compensation.making import TOOL

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("_ros")]
OK, WARN, ERROR, STALE = range(4)
WEIGHT: dict[str, Any] = {"tool_mass": TOOL.mass, "tool_center_of_gravity": [*TOOL.center], **QUICK}


@pytest.fixture
def server() -> SimulatedServer:
    made = SimulatedServer()
    hold(made, UP)
    return made


@pytest.fixture
def node(server: SimulatedServer) -> Iterator[SimulatedNode]:
    with SimulatedNode(server, **WEIGHT) as started:
        started.run(0.3)
        yield started


def configure(server: SimulatedServer, **changed: Any) -> None:
    server.send_json(event(Event.RECONFIGURED, sensor=0, settings={**SETTINGS, **changed}))


def test_counts_are_no_newtons(node: SimulatedNode, server: SimulatedServer) -> None:
    node.until(sensor=OK)
    configure(server, calibration_matrix=False)
    node.until("force and torque are counts and not N and Nm: switch it on", sensor=ERROR)
    configure(server, calibration_matrix=True)
    node.until(sensor=OK)


def test_a_wrench_in_a_configured_frame(node: SimulatedNode, server: SimulatedServer) -> None:
    """How that frame is turned to the IMU's the sensor does not tell."""
    stages = Stages(node)
    stages.settle(ZERO6)
    configure(server, coordinate_system=True)
    node.until(
        "are in a frame configured in the sensor: switch it off, or correct the URDF",
        "has stopped",
        sensor=WARN,
        compensation=ERROR,
    )
    assert stages.are_silent()
    assert "the rotation from the IMU to it is unknown" in node.trigger("tare")[1]
    assert node.trigger("identify/start")[0]
    assert "the rotation from the IMU to it is unknown" in node.trigger("identify/add_pose")[1]
    assert node.set_parameter("tool_mass", 0.0) == (True, "")  # a bias is in any frame what it is
    stages.first()
    assert node.trigger("tare")[0]
    assert node.set_parameter("tool_mass", TOOL.mass) == (True, "")
    assert stages.are_silent()
    configure(server, coordinate_system=False)
    node.until("in which pose is not known: with a tool of 0.8 kg", sensor=OK, compensation=WARN)
    stages.first()
    assert node.trigger("tare")[0]
    node.until(sensor=OK, compensation=OK)


@pytest.mark.parametrize(
    ("given", "changes", "words"),
    [
        ({"gravity_source": "none"}, {}, "gravity_source is none"),
        ({}, {"acceleration_z": -1.0}, "the accelerometer reads zero: switch the IMU on"),
        ({"gravity_source": "topic_pose"}, {}, "nothing has come on it yet"),
    ],
)
def test_a_check_at_start_sees_that_nothing_could_be_published(
    server: SimulatedServer, given: dict[str, Any], changes: dict[str, float], words: str
) -> None:
    """With nobody subscribed: whoever looks before the controller starts is told."""
    hold(server, UP, **changes)
    with SimulatedNode(server, **WEIGHT, **given) as node:
        node.until("could not be published if somebody subscribed", words, compensation=ERROR)
        assert node.set_parameter("tool_mass", 0.0) == (True, "")
        node.until("nobody has subscribed", compensation=OK)


def test_the_imu_is_off_by_the_settings(node: SimulatedNode, server: SimulatedServer) -> None:
    node.until("nobody has subscribed", compensation=OK)
    configure(server, imu_active=0)
    node.until("switch the IMU on (settings.imu_active)", compensation=ERROR)


def test_nothing_is_published_with_the_imu_off(node: SimulatedNode, server: SimulatedServer) -> None:
    stages = Stages(node)
    stages.settle(ZERO6)
    hold(server, UP, acceleration_z=-1.0)
    node.run(0.02)
    assert stages.are_silent()
    node.until("switch the IMU on", compensation=ERROR)
    hold(server, UP)
    stages.settle(ZERO6)


def saturated() -> bytes:
    data = bytearray(sensed(UP))
    data[layout_for(len(data)).offsets["force_torque_saturated"]] = 0b100
    return bytes(data)


def test_saturated_samples_can_be_left_out(node: SimulatedNode, server: SimulatedServer) -> None:
    stages, raw = Stages(node), node.hear("wrench")
    stages.settle(ZERO6)

    def saturate() -> tuple[int, int]:
        """How many messages there are of ten samples, three of them saturated."""
        node.run(0.05)
        stages.forget()
        raw.clear()
        for _ in range(3):
            server.once(process_data=saturated())
        node.run(0.1)
        return len(raw), len(stages.final)

    assert saturate() == (10, 10)
    assert node.set_parameter("on_saturation", "stop") == (True, "")
    node.statuses()  # the next one comes after what follows
    assert saturate() == (10, 7)
    node.until("3 samples were not compensated, because force or torque was saturated", compensation=WARN)
    server.changes = {"process_data": saturated()}
    array = node.until(
        "has stopped: force or torque is saturated, and on_saturation is stop", compensation=ERROR
    )
    assert int(values(array["sensor"])["saturated_samples"]) > 6


def test_limits_and_covariances_can_be_set_while_it_runs(
    node: SimulatedNode, server: SimulatedServer
) -> None:
    imu, wrenches, temperatures = node.hear("imu/data_raw"), node.hear("wrench"), node.hear("temperature")
    node.run(0.2)
    for name, value in (
        ("angular_velocity_covariance", [0.5, 0.25, 0.125]),
        ("linear_acceleration_covariance", [1, 2, 3]),
        ("temperature_variance", 0.5),
        ("diagnostics.temperature_warn", 20.0),
        ("publishing_frequency", 10.0),
    ):
        assert node.set_parameter(name, value) == (True, "")
    for messages in (imu, wrenches, temperatures):
        messages.clear()
    server.changes = {"process_data": encode(61, {"temperature": 25.0})}
    node.run(2.0)
    assert len(wrenches) in range(19, 23)
    assert list(imu[-1].angular_velocity_covariance)[::4] == [0.5, 0.25, 0.125]
    assert list(imu[-1].linear_acceleration_covariance)[::4] == [1.0, 2.0, 3.0]
    assert imu[-1].orientation_covariance[0] == -1.0
    assert temperatures[-1].variance == 0.5
    node.until("25.0 °C", sensor=WARN)
    assert "vibration above 5 Hz appear at lower frequencies" in node.log
    assert node.set_parameter("publishing_frequency", 0) == (True, "")
    wrenches.clear()
    node.run(0.5)
    assert len(wrenches) == 50
    done, reason = node.set_parameter("diagnostics.lost_warn", 0)
    assert not done
    assert "lost_warn out of range" in reason
    done, reason = node.set_parameter("linear_acceleration_covariance", [1.0, 2.0])
    assert not done
    assert "it must be 3 numbers, the variances, or 9" in reason


def test_a_limit_at_start_warns_of_aliasing(server: SimulatedServer) -> None:
    with SimulatedNode(server, publishing_frequency=50.0) as node:
        node.run(0.1)
        assert "takes the newest of 100 samples a second, without a low-pass" in node.log
        assert node.set_parameter("publishing_frequency", 100.0) == (True, "")
        assert node.log.count("aliasing") == 1


def test_parameters_that_are_none_are_named(server: SimulatedServer) -> None:
    given = {"publish_frequency": 100.0, "settings.sinc_lenght": 64, "zzz": 1, "use_sim_time": True}
    with SimulatedNode(server, **given) as node:
        assert "unknown parameter publish_frequency" in node.log
        assert "did you mean 'publishing_frequency'?" in node.log
        assert "did you mean 'settings.sinc_length'?" in node.log
        assert "unknown parameter zzz" in node.log
        assert "use_sim_time is true, but a real sensor has no simulation time" in node.log
        assert node.log.count("unknown parameter") == 3
    with SimulatedNode(server, sensor=0, **{"qos_overrides./wrench.publisher.depth": 3}) as node:
        assert "unknown parameter" not in node.log
        assert "use_sim_time" not in node.log


@pytest.mark.parametrize("name", ["frame_id", "imu_frame_id", "orientation.base_frame"])
def test_frames_have_no_leading_slash(name: str) -> None:
    with pytest.raises(
        StartError, match=f"parameter {name} is '/ft': frames have no leading slash, give 'ft'"
    ):
        SimulatedNode(SimulatedServer(), **{name: "/ft"})


def test_the_array_follows_the_namespace(node: SimulatedNode) -> None:
    assert node.name.replace("bridge", "sensone_sensor_data") in node.topics
    assert node.node.resolve_topic_name("/sensone_sensor_data") not in node.topics
