"""`ethercat-export align`: the offset between two clocks, from how sensor and robot turned."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bota_clients.errors import RecordingError
from bota_clients.export import align
from bota_clients.export.align import _robot_rates, _shared, find_offset
from bota_clients.export.cli import main
from bota_clients.export.dataset import ForeignClock
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


@pytest.mark.parametrize(("topic", "most"), [("/joint_states", 20_000), ("/imu", 1500)])
def test_the_offset_and_drift_of_a_robots_clock(
    tmp_path: Path, topic: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of all samples and messages, or of `most` at most."""
    monkeypatch.setattr(align, "_MOST", most)
    monkeypatch.setattr(align, "_AT_ONCE", 500)
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
        messages[200].position = messages[200].position[:0]  # velocities only
        messages[300].position[1] = math.nan
    bag = write_bag(tmp_path / "bag", topic, messages)
    (tmp_path / "arm.urdf").write_text(URDF)
    given = ["--topic", topic, "--urdf", tmp_path / "arm.urdf", "--link", "tool"]
    ended = run_here(main, "align", tmp_path / "run.mcap", bag, *given)
    assert ended.code == 0, ended.err
    assert not problems("export-align", ended.json)
    left_out = 0 if topic == "/imu" else 2
    assert ended.json["left_out"] == left_out
    assert (f"{left_out} messages left out, without finite angles or rates" in ended.err) is bool(left_out)
    assert ended.json["bend_ms"] == 0.0
    found = ForeignClock(ended.json["stamp_ns"], ended.json["monotonic_ns"], ended.json["drift_ppm"])
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


def test_instants_are_compared_where_both_are_known_all_around() -> None:
    def known(*parts: tuple[float, float]) -> list[tuple[Array, Array]]:
        return [(np.arange(begin, end, 0.005), np.zeros((0, 3))) for begin, end in parts]

    instants = _shared(known((0, 10), (20, 30)), known((-5, 4), (6, 24.0)), -100.0)
    assert len(instants) == 0
    instants = _shared(known((100, 110), (120, 130)), known((-5, 4), (6, 24.0)), 100.0)
    edges = np.flatnonzero(np.diff(instants) > 0.1)
    ends = [instants[0], *instants[np.sort([*edges, *(edges + 1)])], instants[-1]]
    assert ends == pytest.approx([0.4, 3.6, 6.4, 9.6, 20.4, 23.6], abs=0.02)


def straight(share: Array) -> Array:
    return 0.0 * share


def slewed(share: Array) -> Array:
    return np.asarray(1e-3 * np.clip(2 * share - 1, 0, 1))


def warmed(share: Array) -> Array:
    return np.asarray(4e-3 * (share - 0.5) ** 2)


def stepped(share: Array) -> Array:
    return np.asarray(1e-3 * (share > 0.6))


@pytest.mark.parametrize("seed", more_if_long([0, 1], range(20)))
@pytest.mark.parametrize("bend", [straight, slewed, warmed, stepped])
def test_a_clock_that_is_not_straight_is_told_and_the_interval_holds(bend: Motion, seed: int) -> None:
    """A robot's clock that bends by 1 ms against a line; its stamps jitter by 0.5 ms."""
    noise = np.random.default_rng(seed)
    times, begin_s = np.arange(0, 40, 0.00125), noise.uniform(0, 20)
    instants = np.arange(1, 39, 0.008)
    stamps = (instants - OFFSET_S) / (1 + DRIFT) + bend((instants - 1) / 38)
    stamps_ns = np.rint(1e9 * np.sort(stamps + noise.normal(0, 5e-4, len(stamps)))).astype(np.int64)
    felt = rates(times + begin_s) @ about(0, 0.7) + noise.normal(0, 0.005, (len(times), 3))
    turned = rates(instants + begin_s) + noise.normal(0, 0.01, (len(instants), 3))
    clock, found = find_offset(np.rint(1e9 * times).astype(np.int64), felt, stamps_ns, turned)
    error_ms = clock.instants(np.rint(1e9 * stamps).astype(np.int64)) * 1e-6 - instants * 1e3
    assert (found["bend_ms"] > 0) is (bend is not straight)
    assert abs(error_ms[len(error_ms) // 2]) < (1 if found["bend_ms"] else 2) * found["interval_ms"]


# An arm with what only some makers have in their descriptions, as xacro expands them: UR, KUKA, xArm, Franka.
# Each joint: name, type, rpy, axis; "": left out, of a joint that does not turn some have zeros.
PI_2 = "1.5707963267948966"
JOINTS = [
    ("base_link-base_link_inertia", "fixed", "0 0 3.141592653589793", ""),
    ("shoulder_pan_joint", "revolute", "0 0 0", "0 0 1"),
    ("wrist_3_joint", "continuous", f"{PI_2} 3.141592653589793 3.14", "0 0 1"),
    ("joint_a1", "revolute", "", "0 0 -1"),
    ("left_joint2", "revolute", f"-{PI_2} 0 0", ""),
    ("left_drive_joint", "revolute", "0 0 0", "1 0 0"),
    ("left_finger_joint", "revolute", "0 0 0.5", "-1 0 0"),
    ("joint_a2", "revolute", "0 0 0", "0 2 0"),
    ("fr3_finger_joint1", "prismatic", "0 0 0", "0 1 0"),
    ("flange-tool0", "fixed", f"0 {PI_2} 0", "0 0 0"),
]
MIMIC, OF, MULTIPLIER, PLUS = "left_finger_joint", "left_drive_joint", -0.5, 0.1
LINKS = [f"link{number}" for number in range(len(JOINTS) + 1)]


def described() -> str:
    parts = [f'<link name="{link}"><inertial><origin rpy="0 0 0"/></inertial></link>' for link in LINKS]
    for (name, kind, rpy, axis), parent, child in zip(JOINTS, LINKS, LINKS[1:], strict=False):
        origin = f'<origin rpy="{rpy}" xyz="0 0 0.1"/>' if rpy else '<origin xyz="0 0 0.1"/>'
        along = f'<axis xyz="{axis}"/>' if axis else ""
        mimic = f'<mimic joint="{OF}" multiplier="{MULTIPLIER}" offset="{PLUS}"/>' * (name == MIMIC)
        parts.append(
            f'<joint name="{name}" type="{kind}"><!-- of the arm --><parent link="{parent}"/>'
            f'<child link="{child}"/>{origin}{along}{mimic}'
            '<limit lower="-3" upper="3" effort="1" velocity="1"/><dynamics damping="0"/></joint>'
        )
    inner = f'<joint name="{JOINTS[1][0]}"><command_interface name="position"/></joint>'
    parts.append(f'<ros2_control name="arm" type="system">{inner}</ros2_control>')
    parts.append(f'<transmission name="t">{inner}</transmission><gazebo/>')
    xml = '<?xml version="1.0" ?><!-- by xacro --><robot name="arm" xmlns:xacro="http://wiki.ros.org/xacro">'
    return "".join([xml, *parts, "</robot>"])


def size_of_rate(t: Array) -> Array:
    """(n,) rad/s, of what is behind the last joint that turns: by the angles of `angle`, and their slopes."""
    turned, total = np.tile(np.eye(3), (len(t), 1, 1)), np.zeros((len(t), 3))
    for name, kind, rpy, axis in JOINTS:
        roll, pitch, yaw = map(float, (rpy or "0 0 0").split())
        turned = turned @ about(2, yaw) @ about(1, pitch) @ about(0, roll)
        if kind in ("fixed", "prismatic"):
            continue
        unit = np.array((axis or "1 0 0").split(), float)
        unit /= np.linalg.norm(unit)
        follows, factor, plus = (OF, MULTIPLIER, PLUS) if name == MIMIC else (name, 1.0, 0.0)
        slope = factor * (angle(follows, t + 1e-4) - angle(follows, t - 1e-4)) / 2e-4
        total += slope[:, np.newaxis] * (turned @ unit)
        which, sign = int(np.abs(unit).argmax()), float(unit.sum())
        now = sign * (factor * angle(follows, t) + plus)
        turned = turned @ np.stack([about(which, each) for each in now.tolist()])
    return np.asarray(np.linalg.norm(total, axis=1))


def angle(joint: str, t: Array) -> Array:
    """rad"""
    number = [name for name, *_ in JOINTS].index(joint)
    return np.asarray(0.5 * np.sin((1 + 0.3 * number) * t + number))


def test_an_arm_as_its_makers_describe_it(tmp_path: Path) -> None:
    """Every link behind the last joint that turns is one body; the other joints' axes may be zeros."""
    path, text = tmp_path / "arm.urdf", described()
    path.write_text(text)
    t = np.arange(0.0, 2.0, 0.004)
    names = [name for name, kind, *_ in JOINTS if kind != "fixed" and name != MIMIC]
    columns = {name: angle(name, t).tolist() for name in names}
    messages = [
        joint_states(START_NS + 4_000_000 * row, **{name: columns[name][row] for name in names[::-1]})
        for row in range(len(t))
    ]
    bag = write_bag(tmp_path / "bag", "/joint_states", messages)
    for link in LINKS[-3:]:
        _, found, left_out = _robot_rates(bag, "/joint_states", path, link)
        assert left_out == 0
        assert np.linalg.norm(found, axis=1) == pytest.approx(size_of_rate(t[:-1] + 0.002), abs=2e-4)
    for link, said in (
        (LINKS[0], "has no joint that turns link"),
        ("tool9", "has no link 'tool9'; it has link0"),
    ):
        with pytest.raises(RecordingError, match=said):
            _robot_rates(bag, "/joint_states", path, link)
    path.write_text(text.replace('rpy="0 0 0"', 'rpy="0 0 ${pi/2}"'))
    with pytest.raises(RecordingError, match="cannot be read as URDF, as xacro writes it: could not convert"):
        _robot_rates(bag, "/joint_states", path, LINKS[-1])


def test_messages_that_say_nothing_are_refused_with_their_number(tmp_path: Path) -> None:
    messages = [joint_states(START_NS + number, first=0.0, second=math.inf) for number in range(30)]
    (tmp_path / "arm.urdf").write_text(URDF)
    bag = write_bag(tmp_path / "bag", "/joint_states", messages)
    few = write_bag(tmp_path / "few", "/joint_states", [joint_states(START_NS, first=0.0, second=0.0)])
    for each, which in ((bag, ", but for 30 that do not tell how the link turned,"), (few, "")):
        with pytest.raises(RecordingError) as error:
            _robot_rates(each, "/joint_states", tmp_path / "arm.urdf", "tool")
        assert str(error.value) == (
            f"the messages of /joint_states in {each}{which} are too few, or not in the order of their stamps"
        )
