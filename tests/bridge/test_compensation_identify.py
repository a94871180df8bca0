"""The services ~/identify/... in simulated time: from the first pose to a parameter file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from tests.bridge.simulated_node import OVER, QUICK, SIDE, UP, ZERO6, Node, Server, Stages, sensed, values
from tests.compensation.making import AXES, BIAS, TOOL, written_parameters

Take = Callable[..., str]


@pytest.fixture
def server() -> Server:
    return Server()


@pytest.fixture
def node(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with Node(server, **QUICK) as started:
        yield started


@pytest.fixture
def started(node: Node, server: Server) -> Node:
    server.hold(UP, bias=BIAS)
    node.run(0.1)
    node.do("identify/start", "gravity is known by imu", "turn the sensor so that its +z axis points up")
    return node


@pytest.fixture
def take(started: Node, server: Server) -> Take:
    """Holds the sensor so, one after the other, and adds the poses; what the last one said."""

    def take_poses(*ups: tuple[float, float, float]) -> str:
        text = ""
        for up in ups:
            server.hold(up, bias=BIAS)
            text = started.do("identify/add_pose")
        return text

    return take_poses


def test_from_poses_to_the_contact_force(started: Node, take: Take, server: Server, tmp_path: Path) -> None:
    text = take(*AXES)
    assert "pose 6 taken (up is -1.00, 0.00, 0.00 in the sensor's frame)" in text
    assert "the poses suffice" in text
    path = tmp_path / "bota-ethercat-bridge" / "sensor-100-payload.yaml"
    started.do(
        "identify/solve", "mass 0.8000 ± ", "center of gravity (4.0", "Bias Fx 3.0000 Fy -1.5000 Fz 7.2500",
        "95 % confidence", "Residuals by pose, 1: ",
        "One more pose would help most so: turn", f"Written to {path}", "identify/apply",
    )  # fmt: skip
    assert started.parameters("tool_mass") == [0.0]  # solving changes nothing
    written = written_parameters(path)
    assert written["tool_mass"] == pytest.approx(TOOL.mass, abs=1e-4)
    assert written["gravity"] == list(started.parameters("gravity")[0])
    assert "# mass 0.8000" in path.read_text()
    started.do("identify/apply", "in force: tool_mass 0.8000 kg")
    (mass, center, bias) = started.parameters("tool_mass", "tool_center_of_gravity", "bias")
    assert mass == pytest.approx(TOOL.mass, abs=1e-4)
    assert list(center) == pytest.approx(TOOL.center, abs=1e-5)
    assert list(bias) == pytest.approx(BIAS.values, abs=1e-4)
    assert values(started.statuses()["compensation"])["bias_from"] == "identified"
    server.hold((1, -2, 1.5), bias=BIAS, force_z=-5.0)
    Stages(started).settle([0.0, 0.0, -5.0, 0.0, 0.0, 0.0], within=2e-3)


def test_the_accelerometers_offset_is_found_and_subtracted(
    started: Node, server: Server, tmp_path: Path
) -> None:
    """Wrench and tare go by the corrected acceleration: 0.2 m/s² are 0.16 N here."""
    off = {"acceleration_x": 0.02, "acceleration_y": -0.015}  # g
    for up in AXES:
        server.hold(up, bias=BIAS, **off)
        started.do("identify/add_pose")
    started.do("identify/solve", "Accelerometer: offset x 0.196 ± ")
    offset = [0.02 * STANDARD_GRAVITY, -0.015 * STANDARD_GRAVITY, 0.0]
    written = written_parameters(tmp_path / "bota-ethercat-bridge" / "sensor-100-payload.yaml")
    assert written["accelerometer.offset"] == pytest.approx(offset, abs=2e-3)
    started.do("identify/apply")
    found, scale = started.parameters("accelerometer.offset", "accelerometer.scale")
    assert list(found) == pytest.approx(offset, abs=2e-3)
    assert list(scale) == pytest.approx([1.0] * 3, abs=1e-3)
    for name in ("accelerometer.offset_interval", "accelerometer.scale_interval"):
        (half,) = started.parameters(name)
        assert written[name] == pytest.approx(list(half), abs=1e-8)
        assert 0.0 < max(half) < 0.01
    stages = Stages(started)
    stages.at(
        (1, -2, 1.5), bias=BIAS, force_z=-5.0, **off, wanted=[0.0, 0.0, -5.0, 0.0, 0.0, 0.0], within=5e-3
    )
    server.hold((1, -2, 1.5), bias=BIAS, **off)
    started.do("tare")
    stages.at((-2, 1, 1), bias=BIAS, **off, wanted=ZERO6, within=1e-2)


def test_the_file_is_one_that_the_node_starts_with(
    started: Node, take: Take, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take(*AXES)
    started.set("identify.file", "/proc/no/such.yaml")
    started.do("identify/solve", "Not written: ", "/proc/no")  # the answer stands
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", "relative")  # which does not count
    started.set("identify.file", "auto")
    default = tmp_path / ".local" / "state" / "bota-ethercat-bridge" / "sensor-100-payload.yaml"
    started.do("identify/solve", f"Written to {default}")
    path = tmp_path / "mine.yaml"
    started.set("identify.file", str(path))
    started.do("identify/solve")
    with Node(Server(), "--params-file", str(path)) as other:
        mass, bias = other.parameters("tool_mass", "bias")
    assert mass == pytest.approx(TOOL.mass, abs=1e-4)
    assert list(bias) == pytest.approx(BIAS.values, abs=1e-4)


def test_poses_that_do_not_suffice_are_refused_with_what_is_missing(started: Node, take: Take) -> None:
    started.refuse("identify/solve", "there is no pose yet")
    take(UP, UP, UP, UP)
    started.refuse("identify/solve", "all 4 poses had gravity in the same direction", "points up")
    assert "not enough yet: gravity moved only along the sensor's z axis" in take(OVER)
    assert started.trigger("identify/apply") == (
        False, "there is no result to apply: call identify/solve first",
    )  # fmt: skip
    take(SIDE, (-1, 0, 0))
    started.do("identify/solve", "do not determine the accelerometer's offset along y")


def test_a_pose_that_is_no_good_is_not_taken(started: Node, take: Take, server: Server) -> None:
    take(UP)
    for position in range(100):
        server.once(process_data=sensed(UP, force_x=9.0 * (position % 2)))
    started.refuse("identify/add_pose", "the sensor is not stationary: force x moved by")
    server.forget_once()
    assert "pose 2 taken" in take(SIDE)
    started.do("identify/drop_pose", "1 are left; not enough yet")
    assert "pose 2 taken" in take(OVER)


def test_a_result_is_of_the_poses_that_there_are(started: Node, take: Take) -> None:
    take(UP, SIDE, OVER, (0, 1, 0))
    started.do("identify/solve")
    take((0, -1, 0))
    assert not started.trigger("identify/apply")[0]
    started.do("identify/solve")
    started.do("identify/start", "the 5 poses before are dropped")
    started.refuse("identify/apply", "there is no result to apply")
    assert "pose 1 taken" in take(UP)


def test_it_does_not_start_without_an_orientation(node: Node) -> None:
    node.set("gravity_source", "none")
    node.refuse("identify/start", "gravity_source is none")
    for service in ("add_pose", "drop_pose", "solve"):
        node.refuse(f"identify/{service}", "call identify/start first")
