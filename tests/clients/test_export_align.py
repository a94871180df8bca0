"""`ethercat-export align`: the offset between two clocks, from how sensor and robot turned."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bota_clients.errors import RecordingError
from bota_clients.export.align import find_offset
from bota_clients.export.cli import main
from bota_clients.export.dataset import Clock
from tests.clients.bags import imu, joint_states, write_bag
from tests.clients.recordings import PERIOD_NS, START_NS, frame, record
from tests.ended import run_here
from tests.json_schema import problems
from tests.simulation import more_if_long

Array = NDArray[np.float64]
Motion = Callable[[Array], Array]
OFFSET_S, DRIFT = -17.25, 60e-6
GYROSCOPE_S = 2.9e-3
URDF = """<robot name="arm">
 <link name="base"/> <link name="upper"/> <link name="lower"/> <link name="slide"/> <link name="tool"/>
 <joint name="first" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
 <joint name="second" type="continuous"><parent link="upper"/><child link="lower"/>
  <origin xyz="0 0 0.4" rpy="0.3 0 1.2"/><axis xyz="0 2 0"/></joint>
 <joint name="rail" type="prismatic"><parent link="lower"/><child link="slide"/></joint>
 <joint name="mount" type="fixed"><parent link="slide"/><child link="tool"/><origin rpy="0 1.57 0"/></joint>
</robot>"""


def about(axis: int, angle: float) -> Array:
    """(3, 3): turned about a coordinate axis, rad."""
    rotation, (a, b) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    rotation[a, a] = rotation[b, b] = math.cos(angle)
    rotation[b, a] = math.sin(angle)
    rotation[a, b] = -rotation[b, a]
    return rotation


def joints(t: Array) -> Array:
    """(n, 2) rad, of a motion without a rhythm."""
    first = 0.5 * np.sin(2.3 * t) + 0.3 * np.sin(5.1 * t + 1) + 0.4 * np.sin(0.7 * t * (1 + t / 70))
    return np.stack(
        [first, 0.4 * np.sin(3.1 * t + 2) + 0.3 * np.sin(1.3 * t) + 0.2 * np.sin(6.7 * t)], axis=1
    )


def rates(t: Array) -> Array:
    """(n, 3) rad/s of the link before the mount: its own joint's, and the first one's, by hand."""
    first, second = ((joints(t + 1e-4) - joints(t - 1e-4)) / 2e-4).T
    x, y, z = (about(2, 1.2) @ about(0, 0.3))[2]  # the first axis as the second joint's parent has it
    c, s = np.cos(joints(t)[:, 1]), np.sin(joints(t)[:, 1])
    return np.stack([(c * x - s * z) * first, y * first + second, (s * x + c * z) * first], axis=1)


@pytest.mark.parametrize("topic", more_if_long(["/joint_states"], ["/imu", "/joint_states"]))
def test_the_offset_and_drift_of_a_robots_clock(tmp_path: Path, topic: str) -> None:
    noise = np.random.default_rng(1)
    felt = rates(np.arange(0, 24, PERIOD_NS * 1e-9) - GYROSCOPE_S) @ about(0, 0.7) @ about(1, 2.0) + 0.02
    felt = np.degrees(felt + noise.normal(0, 0.005, felt.shape))
    frames = (
        frame(number, **dict(zip(("angular_rate.x", "angular_rate.y", "angular_rate.z"), row, strict=True)))
        for number, row in enumerate(felt.tolist())
    )
    record(tmp_path / "run.mcap", frames, fir=False, angular_rate_filter=3)
    instants = np.arange(1, 23, 0.008)
    # What the robot's clock shows at these instants, s; some messages are late.
    stamps = (instants - OFFSET_S) / (1 + DRIFT)
    stamps_ns = START_NS + np.rint(1e9 * stamps + noise.normal(0, 2e5, len(stamps))).astype(np.int64)
    if topic == "/imu":
        turned = rates(instants) + noise.normal(0, 0.01, (len(instants), 3))
        messages = [imu(at, row) for at, row in zip(stamps_ns.tolist(), turned.tolist(), strict=True)]
    else:
        at_s = zip(stamps_ns.tolist(), joints(instants).tolist(), strict=True)
        messages = [joint_states(at, gripper=0.1, second=row[1], first=row[0]) for at, row in at_s]
        messages.insert(100, joint_states(int(stamps_ns[100]), another=1.0))
    bag = write_bag(tmp_path / "bag", topic, messages)
    (tmp_path / "arm.urdf").write_text(URDF)
    given = ["--topic", topic, "--urdf", tmp_path / "arm.urdf", "--link", "tool"]
    ended = run_here(main, "align", tmp_path / "run.mcap", bag, *given)
    assert ended.code == 0, ended.err
    assert not problems("export-align", ended.json)
    found = Clock(ended.json["stamp_ns"], ended.json["monotonic_ns"], ended.json["drift_ppm"])
    exact_ns = START_NS + np.rint(1e9 * stamps).astype(np.int64)
    error_ms = found.instants(exact_ns) * 1e-6 - instants * 1e3
    assert abs(error_ms).max() < 0.5
    assert abs(error_ms[len(error_ms) // 2]) < 2 * ended.json["interval_ms"] < 0.5
    assert ended.json["offset_ms"] == pytest.approx(OFFSET_S * 1e3, abs=5)


def periodic(t: Array) -> Array:
    return np.stack([np.sin(6.0 * t), np.sin(6.0 * t + 1), np.cos(6.0 * t)], axis=1)


@pytest.mark.parametrize(
    ("sensor", "robot", "said"),
    [
        (lambda t: 0 * rates(t), rates, "the sensor hardly turned"),
        (rates, lambda t: 0 * rates(t), "the robot hardly turned"),
        (rates, lambda t: np.roll(rates(t[::-1]) ** 2, 1, axis=1), "the robot's motion explains only"),
        (periodic, periodic, "the motion repeats itself"),
        (lambda t: rates(t)[: len(t) // 5], rates, "the sensor was recorded for less than 10 s"),
    ],
)  # fmt: skip
def test_a_motion_that_says_nothing_is_refused(sensor: Motion, robot: Motion, said: str) -> None:
    noise = np.random.default_rng(1)
    times = np.arange(0, 40, 0.005)
    felt, turned = (turn(times) + noise.normal(0, 0.01, turn(times).shape) for turn in (sensor, robot))
    stamps = np.rint(times * 1e9).astype(np.int64)
    with pytest.raises(RecordingError, match=said):
        find_offset(stamps[: len(felt)], felt, stamps, turned)
