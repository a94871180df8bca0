# SPDX-License-Identifier: Apache-2.0
"""The specific force at the tool, sample by sample: from the sensor's IMU, or from the robot (messages, TF).

Messages of the robot have a callback group of their own, which waits for no service: a pose that is not taken
is stale. TF is looked up at intervals.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, Final, NamedTuple

from geometry_msgs.msg import PoseStamped, QuaternionStamped
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import Imu

from bota_ethercat.pdo import Sample, Vector3
from bota_ethercat.sensor.frames import IMU_HEIGHTS
from bota_ethercat.sensor.response import force_torque_response
from bota_ethercat.settings import SettingValue
from bridge.parameters.table import TOPIC_SOURCES, ParameterError, Parameters
from bridge.stream.link import Link
from ft_compensation.alignment import align
from ft_compensation.quantities import STILL, Quaternion, Turning, unit_quaternion, vector
from ft_compensation.specific_force import ImuSpecificForce, QuaternionGravity
from ft_compensation.stream import IMU_IS_OFF

_TF_PERIOD_S: Final = 0.005
_NS_PER_S: Final = 1_000_000_000
# How long an executor may take to release the previous subscription: DDS has one type per topic.
_LET_GO_S: Final = 1.0
# Type of the messages, and the quaternion in one, by the value of the parameter `gravity_source`.
TOPIC_KINDS: Final[dict[str, tuple[Any, Callable[[Any], Any]]]] = {
    "topic_pose": (PoseStamped, attrgetter("pose.orientation")),
    "topic_quaternion": (QuaternionStamped, attrgetter("quaternion")),
    "topic_imu": (Imu, attrgetter("orientation")),
}


# What a source depends on, besides the sensor's model.
_DEPENDS_ON: Final = (
    "gravity_source", "gravity", "payload", "accelerometer", "imu_position", "orientation_topic",
    "orientation_base_frame", "orientation_mounting", "orientation_stale_after",
)  # fmt: skip


class Source:
    """The specific force at the tool's center of gravity, m/s² in the sensor's frame. Of this class: none.

    The reader alone calls `specific_force`; the others are for the diagnostics' thread too.
    """

    describe = "none"  # its name for people
    is_imu = False  # whether it is the sensor's own
    has_inertia = False  # whether it has the tool's acceleration in it; else it is minus gravity
    turning: Turning = STILL  # of the latest sample, where it has

    def __init__(self, why: str = "gravity_source is none") -> None:
        """`why` there is none."""
        self._why = why
        self.close: Callable[[], object] = lambda: None  # stop listening

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        """m/s², for this sample; None if what is known is too old, or nothing is.

        `time_s` is by a monotonic clock, `stamp_s` by the wall clock, as in the stamps of messages.
        """
        return None

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        """Why there is none for this sample, a sentence; empty if nothing is known to be wrong."""
        return (
            f"{self._why}, so the weight of the tool is not known: set gravity_source to a source, or set "
            "tool_mass to 0"
        )

    def age_s(self, time_s: float) -> float:  # noqa: ARG002
        """How old the robot's orientation is; infinite where there is none."""
        return math.inf


class ImuSource(Source):
    """The sensor's own accelerometer and gyroscope, at the instant of its force and torque."""

    describe = "imu"
    is_imu = has_inertia = True

    def __init__(self, parameters: Parameters, link: Link) -> None:
        """`link` knows the sensor's model and filters."""
        super().__init__()
        position = parameters.imu_position
        if not any(position):  # as the drawings of the model have it
            position = 0.0, 0.0, IMU_HEIGHTS.get(link.info.name[4:8], 0.0)
        self._imu = ImuSpecificForce(_lever(parameters, position), parameters.accelerometer)
        self._link = link
        self._settings: Mapping[str, SettingValue] | None = None  # those of the alignment

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        """Of this sample."""
        if self._link.info.settings is not self._settings:
            self._settings = self._link.info.settings
            self._imu.align(align(self._settings, self._link.info.rate_hz))
        found = self._imu.follow(sample.acceleration, sample.angular_rate, time_s)
        self.turning = self._imu.turning
        return found if any(sample.acceleration) else None

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        """The IMU is off or broken."""
        if not any(sample.acceleration):
            return IMU_IS_OFF
        return "" if sample.is_finite else "the IMU sends NaN or infinity: see the status stream"


class Oriented(NamedTuple):
    """One orientation, or acceleration, of the robot."""

    quaternion: Quaternion  # the rotation that takes the sensor's vectors to those of a frame
    stamp_ns: int  # since the Unix epoch
    # In that frame, minus the specific force that an accelerometer measured, m/s²; None: it is gravity alone.
    apparent_gravity: Vector3 | None = None


class RobotSource(Source):
    """A topic or TF: the latest value, propagated to the sample's time by the sensor's gyroscope.

    `take` is for the subscriber's thread; `latest` and `problem` are replaced, never changed in place.
    """

    def __init__(self, parameters: Parameters, describe: str, link: Link) -> None:
        """`link` knows the sensor's filters."""
        super().__init__()
        self.describe, self._link = describe, link
        self.latest: Oriented | None = None
        self.problem = "nothing has come yet"  # why the latest message is unusable; empty if it is not
        self._gravity, self._limit_s = parameters.gravity, parameters.orientation_stale_after
        self._turn = QuaternionGravity(stale_after_s=self._limit_s)
        self._imu = ImuSpecificForce(_lever(parameters, parameters.imu_position))
        self._settings: Mapping[str, SettingValue] | None = None  # those of its alignment
        self._taken: Oriented | None = None

    @property
    def has_inertia(self) -> bool:  # type: ignore[override]
        """Whether the messages have accelerations."""
        return self.latest is not None and self.latest.apparent_gravity is not None

    def take(self, read: Callable[[], Oriented]) -> None:
        """Take what `read` gives, or why it is unusable."""
        try:
            self.latest, self.problem = read(), ""
        except UnusableError as error:
            self.problem = str(error)

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:
        """From the latest value, if its time is close to the sample's."""
        turn, latest = self._turn, self.latest
        turn.follow(sample.angular_rate, time_s)
        if latest is not self._taken and latest is not None:
            self._taken = latest
            turn.base_gravity = latest.apparent_gravity or self._gravity
            then_s = latest.stamp_ns * 1e-9 - stamp_s + time_s
            if not turn.update(latest.quaternion, then_s):
                # The publisher's clock went back, or it is another publisher: the latest counts.
                turn.reset()
                turn.update(latest.quaternion, then_s)
        found = turn.gravity(time_s)
        if found is None or latest is None:
            return None
        x, y, z = found
        if latest.apparent_gravity is None:
            return -x, -y, -z
        if self._link.info.settings is not self._settings:
            self._settings, rate_hz = self._link.info.settings, self._link.info.rate_hz
            # The robot's accelerometer is taken to have no delay.
            filters = {name: value for name, value in self._settings.items() if name != "acceleration_filter"}
            self._imu.align(align(filters, rate_hz, force_torque_response(filters, rate_hz or None).delay_s))
        felt = self._imu.follow((-x, -y, -z), sample.angular_rate, time_s)
        self.turning = self._imu.turning
        return felt

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        """Nothing has come, it stopped, it is of no use, or its stamps are of another time."""
        if self.latest is None:
            return f"no orientation from {self.describe}: {self.problem}"
        off = why_off(stamp_s - self.latest.stamp_ns * 1e-9, self._limit_s)
        why = self.problem or "it has stopped, is slow, or has another clock"
        return off and f"the latest orientation from {self.describe} {off}: {why}"

    def age_s(self, time_s: float) -> float:
        """Between the stamps of sample and orientation."""
        return self._turn.age_s(time_s)


def _lever(parameters: Parameters, imu_position: Vector3) -> Vector3:
    """From an IMU to the center of gravity."""
    (cx, cy, cz), (x, y, z) = parameters.payload.center, imu_position
    return cx - x, cy - y, cz - z


def why_off(behind_s: float, limit_s: float) -> str:
    """That something is too far from the sample in time, the end of a clause; empty if it is not."""
    if abs(behind_s) <= limit_s:
        return ""
    order = "older" if behind_s > 0 else "newer"
    return f"is {abs(behind_s):.3g} s {order} than the sample (limit {limit_s:g} s, orientation.stale_after)"


# What is listened to.


class UnusableError(Exception):
    """There is no pose or orientation to be had just now; the text says why."""


class Pose(NamedTuple):
    """Of a frame in another."""

    translation: Vector3
    rotation: Quaternion
    stamp_ns: int  # since the Unix epoch; 0: static, it holds at any time


def stamp_ns(stamp: Any) -> int:
    """A message's time, ns since the Unix epoch; 0 if it has none."""
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def check_tf(wanted: str = "parameter gravity_source is 'tf'", instead: str = "take another source") -> None:
    """ParameterError if tf2_ros is missing. `wanted`: what needs it, `instead`: what to do without it."""
    try:
        import tf2_ros  # noqa: F401, PLC0415 - only where it is asked for: not everybody has it
    except ImportError as error:
        raise ParameterError(
            f"{wanted}: it needs tf2_ros, which cannot be loaded ({error}): "
            f"sudo apt install ros-$ROS_DISTRO-tf2-ros-py and source ROS 2, or {instead}"
        ) from None


class Tf:
    """The transforms that `node` hears, in a callback group of tf2_ros's, until `close`."""

    def __init__(self, node: Node) -> None:
        from tf2_ros import Buffer, TransformListener  # noqa: PLC0415 - see check_tf

        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, node, spin_thread=False)

    def close(self) -> None:
        """Listen no longer."""
        self._listener.unregister()

    def look_up(self, base: str, frame: str, at_ns: int = 0) -> Pose:
        """Of the second frame in the first at this time, ns since the Unix epoch; 0: the latest.

        UnusableError if there is none, or none yet.
        """
        from tf2_ros import TransformException  # noqa: PLC0415

        try:
            found = self._buffer.lookup_transform(base, frame, Time(nanoseconds=at_ns))
            t, q = found.transform.translation, found.transform.rotation
            rotation = unit_quaternion((q.x, q.y, q.z, q.w))
        except (TransformException, ValueError) as error:
            why = " ".join(str(error).split())
            raise UnusableError(f"TF has no pose of {frame} in {base}: {why}") from None
        return Pose((t.x, t.y, t.z), rotation, stamp_ns(found.header.stamp))


def open_tf(node: Node, wanted: Parameters, group: CallbackGroup, link: Link) -> RobotSource:
    """A source that looks up the orientation of the sensor in TF."""
    base, frame = wanted.orientation_base_frame, wanted.frame_id
    source, tf = RobotSource(wanted, f"TF from {base} to {frame}", link), Tf(node)

    def read() -> Oriented:
        _, rotation, stamp = tf.look_up(base, frame)
        return Oriented(rotation, stamp or time.time_ns())  # static transforms hold at any time, so now

    def close() -> None:
        node.destroy_timer(timer)
        tf.close()

    timer = node.create_timer(_TF_PERIOD_S, lambda: source.take(read), group)
    source.close = close
    return source


def open_topic(node: Node, wanted: Parameters, group: CallbackGroup, link: Link) -> RobotSource:
    """A source that listens to `orientation.topic`; ParameterError if ROS refuses to listen there."""
    kind, _ = TOPIC_KINDS[wanted.gravity_source]
    topic = node.resolve_topic_name(wanted.orientation_topic)
    source = RobotSource(wanted, f"topic {topic}", link)
    source.problem = "nothing has come on it yet"
    profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

    def on_message(message: Any) -> None:
        source.take(lambda: read_message(message, wanted))

    deadline_s = time.monotonic() + _LET_GO_S
    while True:
        try:
            listening = node.create_subscription(kind, topic, on_message, profile, callback_group=group)
            break
        except RuntimeError as error:
            if time.monotonic() < deadline_s:
                time.sleep(0.01)
                continue
            raise ParameterError(
                f"parameter orientation.topic is {wanted.orientation_topic!r}: ROS refuses to listen there "
                f"({error}); choose another topic"
            ) from None
    source.close = lambda: node.destroy_subscription(listening)
    return source


def read_message(message: Any, wanted: Parameters) -> Oriented:
    """What a message of a kind of TOPIC_KINDS says; UnusableError if that is nothing."""
    mounting, apparent_gravity = wanted.orientation_mounting, None
    try:
        if isinstance(message, Imu):
            # By REP 145 it is the specific force. -1, or nothing filled in: it has none.
            x, y, z = vector(attrgetter("x", "y", "z")(message.linear_acceleration), "an acceleration")
            if message.linear_acceleration_covariance[0] != -1.0 and (x or y or z):
                apparent_gravity = -x, -y, -z
            elif message.orientation_covariance[0] == -1.0:
                raise UnusableError(
                    "its messages say that they have none (orientation_covariance[0] is -1), nor acceleration"
                )
        if not (stamp := stamp_ns(message.header.stamp)):
            raise UnusableError("its messages have no time stamp: the publisher must fill in header.stamp")
        if apparent_gravity is not None:
            return Oriented(mounting, stamp, apparent_gravity)
        q = TOPIC_KINDS[wanted.gravity_source][1](message)
        return Oriented(multiply(unit_quaternion((q.x, q.y, q.z, q.w)), mounting), stamp)
    except ValueError as error:
        raise UnusableError(f"what it sends is none: {error}") from None


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation that first turns by `b`, then by `a`."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


class SourceChoice:
    """Opens the source that the parameters name, and closes the previous one."""

    def __init__(self, node: Node, link: Link) -> None:
        self.source: Source = Source()
        self._opened: object = None  # what the open source depends on
        self._node, self._link = node, link
        self._group = MutuallyExclusiveCallbackGroup()

    def check(self, wanted: Parameters) -> None:
        """ParameterError if it is not available on this machine, or its topic's name is invalid."""
        if wanted.gravity_source == "tf":
            check_tf()
        if wanted.gravity_source not in TOPIC_SOURCES:
            return
        try:
            self._node.resolve_topic_name(wanted.orientation_topic)
        except RuntimeError as error:  # rclpy has no public name for it
            reason = str(error).removeprefix("failed to resolve name: ").partition(", at /")[0]
            raise ParameterError(
                f"parameter orientation.topic is {wanted.orientation_topic!r}: {reason}"
            ) from None

    def open(self, wanted: Parameters) -> None:
        """Open the source that is wanted, for the sensor that is or was there, unless it is open.

        ParameterError if that cannot be; then there is none.
        """
        opened = [getattr(wanted, name) for name in _DEPENDS_ON] + [self._link.info.name]
        if opened == self._opened:
            return
        self.close()
        try:
            if wanted.gravity_source == "imu":
                self.source = ImuSource(wanted, self._link)
            elif wanted.gravity_source == "tf":
                self.source = open_tf(self._node, wanted, self._group, self._link)
            elif wanted.gravity_source in TOPIC_SOURCES:
                self.source = open_topic(self._node, wanted, self._group, self._link)
        except ParameterError as error:
            self.source = Source(str(error))
            raise
        self._opened = opened

    def close(self) -> None:
        """Stop listening."""
        self._opened = None
        self.source.close()
        self.source = Source()
