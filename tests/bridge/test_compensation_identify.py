"""The services ~/identify/... in simulated time: from the first pose to a parameter file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from diagnostic_msgs.msg import DiagnosticStatus

from bota_ethercat.pdo import STANDARD_GRAVITY
from ft_compensation.quantities import NO_PAYLOAD
from tests.bridge.compensating import OVER, QUICK, SIDE, UP, ZERO6, Stages, hold, sensed
from tests.bridge.simulated_node import SimulatedNode, SimulatedServer
from tests.compensation.making import AXES, BIAS, TOOL, written_parameters

pytestmark = pytest.mark.ros
Take = Callable[..., str]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kept")


@pytest.fixture(scope="module")
def server() -> SimulatedServer:
    return SimulatedServer()


@pytest.fixture(scope="module")
def node(_ros: None, server: SimulatedServer, folder: Path) -> Iterator[SimulatedNode]:
    with SimulatedNode(server, **QUICK, bias_directory=folder / "deeper") as started:
        yield started


@pytest.fixture
def started(node: SimulatedNode, server: SimulatedServer) -> SimulatedNode:
    server.forget_once()
    hold(server, UP, bias=BIAS)
    node.run(0.1)
    done, text = node.trigger("identify/start")
    assert done
    assert "gravity is known by imu" in text
    assert "turn the sensor so that its +z axis points up" in text
    return node


@pytest.fixture
def take(started: SimulatedNode, server: SimulatedServer) -> Take:
    """Holds the sensor so, one after the other, and adds the poses; what the last one said."""

    def take_poses(*ups: tuple[float, float, float]) -> str:
        text = ""
        for up in ups:
            hold(server, up, bias=BIAS)
            done, text = started.trigger("identify/add_pose")
            assert done, text
        return text

    return take_poses


def test_from_six_poses_to_a_compensated_wrench(
    started: SimulatedNode, take: Take, server: SimulatedServer, folder: Path
) -> None:
    text = take(*AXES)
    assert "pose 6 taken (up is -1.00, 0.00, 0.00 in the sensor's frame)" in text
    assert "the poses suffice" in text
    done, text = started.trigger("identify/solve")
    assert done, text
    for words in (
        "mass 0.8000 ± ", "center of gravity (4.0", "Bias Fx 3.0000 Fy -1.5000 Fz 7.2500",
        "95 % confidence", "Residuals by pose, 1: ", "Condition 1.",
        "One more pose would help most so: turn", "identify/apply",
    ):  # fmt: skip
        assert words in text, text
    assert started.parameters("tool_mass") == [0.0]  # solving changes nothing
    path = folder / "deeper" / "sensor-1-payload.yaml"
    assert f"Written to {path}" in text
    written = written_parameters(path)
    assert written["tool_mass"] == pytest.approx(TOOL.mass, abs=1e-4)
    assert written["gravity"] == list(started.parameters("gravity")[0])
    assert "# mass 0.8000" in path.read_text()
    done, text = started.trigger("identify/apply")
    assert done
    assert "in force: tool_mass 0.8000 kg" in text
    (mass, center, bias) = started.parameters("tool_mass", "tool_center_of_gravity", "bias")
    assert mass == pytest.approx(TOOL.mass, abs=1e-4)
    assert list(center) == pytest.approx(TOOL.center, abs=1e-5)
    assert list(bias) == pytest.approx(BIAS.values, abs=1e-4)
    hold(server, (1, -2, 1.5), bias=BIAS, force_z=-5.0)
    Stages(started).settle([0.0, 0.0, -5.0, 0.0, 0.0, 0.0], within=2e-3)
    assert started.set_parameter("tool_mass", 0.0)[0]
    assert started.trigger("clear_tare")[0]


def test_the_offset_of_the_accelerometer_is_found_and_subtracted_from_then_on(
    started: SimulatedNode, server: SimulatedServer, folder: Path
) -> None:
    """Wrench and tare go by the corrected acceleration: 0.2 m/s² are 0.16 N here."""
    off = {"acceleration_x": 0.02, "acceleration_y": -0.015}  # g
    for up in AXES:
        hold(server, up, bias=BIAS, **off)
        assert started.trigger("identify/add_pose")[0]
    done, text = started.trigger("identify/solve")
    assert done, text
    assert "Accelerometer: offset x 0.196 ± " in text
    offset = [0.02 * STANDARD_GRAVITY, -0.015 * STANDARD_GRAVITY, 0.0]
    written = written_parameters(folder / "deeper" / "sensor-1-payload.yaml")
    assert written["accelerometer.offset"] == pytest.approx(offset, abs=2e-3)
    assert started.trigger("identify/apply")[0]
    found, scale = started.parameters("accelerometer.offset", "accelerometer.scale")
    assert list(found) == pytest.approx(offset, abs=2e-3)
    assert list(scale) == pytest.approx([1.0] * 3, abs=1e-3)
    for name in ("accelerometer.offset_interval", "accelerometer.scale_interval"):
        (half,) = started.parameters(name)
        assert written[name] == pytest.approx(list(half), abs=1e-8)
        assert 0.0 < max(half) < 0.01
    stages = Stages(started)
    hold(server, (1, -2, 1.5), bias=BIAS, force_z=-5.0, **off)
    stages.settle([0.0, 0.0, -5.0, 0.0, 0.0, 0.0], within=5e-3)
    hold(server, (1, -2, 1.5), bias=BIAS, **off)
    assert started.trigger("tare")[0]
    hold(server, (-2, 1, 1), bias=BIAS, **off)
    stages.settle(ZERO6, within=1e-2)
    for name, value in (
        ("tool_mass", 0.0), ("accelerometer.offset", [0.0] * 3),
        ("accelerometer.scale", [1.0] * 3), ("accelerometer.offset_interval", [0.784] * 3),
        ("accelerometer.scale_interval", [0.0098] * 3),
    ):  # fmt: skip
        assert started.set_parameter(name, value)[0]
    assert started.trigger("clear_tare")[0]


def test_the_file_is_one_that_the_node_starts_with(started: SimulatedNode, take: Take, folder: Path) -> None:
    path = folder / "mine.yaml"
    assert started.set_parameter("identify.file", str(path)) == (True, "")
    take(*AXES)
    done, text = started.trigger("identify/solve")
    assert done, text
    assert started.set_parameter("identify.file", "auto") == (True, "")
    with SimulatedNode(SimulatedServer(), "--params-file", str(path)) as other:
        mass, bias = other.parameters("tool_mass", "bias")
    assert mass == pytest.approx(TOOL.mass, abs=1e-4)
    assert list(bias) == pytest.approx(BIAS.values, abs=1e-4)


def test_poses_that_do_not_suffice_are_refused_with_what_is_missing(
    started: SimulatedNode, take: Take
) -> None:
    done, text = started.trigger("identify/solve")
    assert not done
    assert "there is no pose yet" in text
    take(UP, UP, UP, UP)
    done, text = started.trigger("identify/solve")
    assert not done
    assert "all 4 poses had gravity in the same direction" in text
    assert "points up" in text
    text = take(OVER, SIDE, (-1, 0, 0))
    assert "not enough yet: the sensor was turned about one axis only" in text
    done, text = started.trigger("identify/solve")
    assert not done
    assert "gravity never changed along the sensor's y axis" in text
    assert started.trigger("identify/apply") == (
        False, "there is no result to apply: call identify/solve first",
    )  # fmt: skip
    take((0, 1, 0))
    assert started.trigger("identify/solve")[0]


def test_a_pose_that_is_no_good_is_not_taken(
    started: SimulatedNode, take: Take, server: SimulatedServer
) -> None:
    take(UP)
    for position in range(100):
        server.once(process_data=sensed(UP, force_x=9.0 * (position % 2)))
    done, text = started.trigger("identify/add_pose")
    assert not done
    assert "the sensor is not stationary: force x moved by" in text
    server.forget_once()
    assert "pose 2 taken" in take(SIDE)
    done, text = started.trigger("identify/drop_pose")
    assert done
    assert "1 are left; not enough yet" in text
    assert "pose 2 taken" in take(OVER)


def test_a_result_is_of_the_poses_that_there_are(started: SimulatedNode, take: Take) -> None:
    take(UP, SIDE, OVER, (0, 1, 0))
    assert started.trigger("identify/solve")[0]
    take((0, -1, 0))
    assert not started.trigger("identify/apply")[0]


def test_cancel_changes_nothing(started: SimulatedNode, take: Take) -> None:
    take(UP, SIDE)
    assert started.trigger("identify/cancel") == (
        True, "identification cancelled, 2 poses dropped; nothing was changed",
    )  # fmt: skip
    for service in ("add_pose", "drop_pose", "solve", "cancel"):
        done, text = started.trigger(f"identify/{service}")
        assert not done
        assert "call identify/start first" in text
    assert not started.trigger("identify/apply")[0]
    assert list(started.parameters("bias")[0]) == ZERO6


def test_starting_again_drops_what_was_there(started: SimulatedNode, take: Take) -> None:
    take(UP, SIDE)
    done, text = started.trigger("identify/start")
    assert done
    assert "the 2 poses before are dropped" in text
    assert "pose 1 taken" in take(UP)


def test_it_does_not_start_without_an_orientation(node: SimulatedNode) -> None:
    assert node.set_parameter("gravity_source", "none") == (True, "")
    done, text = node.trigger("identify/start")
    assert not done
    assert "gravity_source is none" in text
    assert node.set_parameter("gravity_source", "imu") == (True, "")


def test_a_file_that_cannot_be_written(started: SimulatedNode, take: Take) -> None:
    assert started.set_parameter("identify.file", "/proc/no/such.yaml") == (True, "")
    take(*AXES)
    done, text = started.trigger("identify/solve")
    assert done  # the answer stands
    assert "Not written: " in text
    assert "/proc/no" in text
    assert started.set_parameter("identify.file", "auto") == (True, "")


def test_a_tool_that_was_lost_is_a_warning_and_nothing_is_changed(
    node: SimulatedNode, server: SimulatedServer
) -> None:
    assert node.set_parameter("tool_mass", TOOL.mass)[0]
    Stages(node)
    server.forget_once()
    for up in AXES:
        hold(server, up, payload=NO_PAYLOAD)
        node.run(2.5)
    words = "a tool of 0.00 kg would explain the measurements in"
    node.until(f"{words} 6 orientations, but tool_mass is 0.80 kg", compensation=DiagnosticStatus.WARN[0])
    assert node.log.count(words) == 1
    assert node.parameters("tool_mass") == [TOOL.mass]
    assert node.set_parameter("tool_mass", 0.0)[0]
    node.until("nothing is subtracted", compensation=DiagnosticStatus.OK[0])
