"""The sensor's orientation from ROS, by messages or TF, and the choice of the source of the tool's load.

TF is looked up at intervals, also for other frames of the wrench.

Every orientation is a quaternion x, y, z, w (the rotation that takes the sensor's vectors to the base's) and
its time, or a sentence that says why there is none. They are listened to in a callback group of their own,
which waits for no service: a pose that is not taken is old.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from operator import attrgetter
from typing import Any, Final, NamedTuple

from geometry_msgs.msg import PoseStamped, QuaternionStamped
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from bota_ethercat.pdo import Vector3
from bota_ethercat.sensor.frames import IMU_HEIGHTS
from bridge.compensating.tool_sources import Filters, ImuSource, ListenerSource, Oriented, Source
from bridge.parameters.table import TOPIC_SOURCES, OrientationParameters, ParameterError, Parameters
from ft_compensation.quantities import Quaternion, unit_quaternion

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


class UnusableError(Exception):
    """There is no pose or orientation to be had just now; the text says why."""


class Pose(NamedTuple):
    """Of a frame in another."""

    translation: Vector3
    rotation: Quaternion
    stamp_ns: int  # since the Unix epoch; 0: static, it holds at any time


LookUp = Callable[[str, str], Pose]  # of the second frame in the first, the latest; UnusableError


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


def follow_tf(node: Node, group: CallbackGroup, look: Callable[[LookUp], object]) -> Callable[[], None]:
    """Listen to TF, in a callback group of tf2_ros's, and call `look` every _TF_PERIOD_S, until what is
    returned is called."""
    from rclpy.time import Time  # noqa: PLC0415
    from tf2_ros import Buffer, TransformException, TransformListener  # noqa: PLC0415 - see check_tf

    buffer = Buffer()
    listener = TransformListener(buffer, node, spin_thread=False)

    def look_up(base: str, frame: str) -> Pose:
        try:
            found = buffer.lookup_transform(base, frame, Time())
            t, q = found.transform.translation, found.transform.rotation
            rotation = unit_quaternion((q.x, q.y, q.z, q.w))
        except (TransformException, ValueError) as error:
            why = " ".join(str(error).split())
            raise UnusableError(f"TF has no pose of {frame} in {base}: {why}") from None
        return Pose((t.x, t.y, t.z), rotation, stamp_ns(found.header.stamp))

    timer = node.create_timer(_TF_PERIOD_S, lambda: look(look_up), group)

    def close() -> None:
        node.destroy_timer(timer)
        listener.unregister()

    return close


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


class OrientationListener:
    """From construction to `close`. Read `latest` and `problem` from any thread: they are replaced."""

    def __init__(self, node: Node, chosen: OrientationParameters, frame: str, group: CallbackGroup) -> None:
        """`chosen.source` is a key of TOPIC_KINDS, or `tf`: then `frame` is the sensor's.

        ParameterError if ROS refuses to listen there.
        """
        self.latest: Oriented | None = None
        self.problem = "nothing has come yet"  # what was wrong with what came last; empty if nothing was
        self.subscription: Any = None  # to a topic; None: to TF
        self.close: Callable[[], object]  # stop listening
        if chosen.source != "tf":
            self._subscribe(node, chosen, group)
            return

        def read(look_up: LookUp) -> Oriented:
            _, rotation, stamp = look_up(chosen.base_frame, frame)
            return Oriented(rotation, stamp or time.time_ns())  # static transforms hold at any time, so now

        self.describe = f"TF from {chosen.base_frame} to {frame}"
        self.close = follow_tf(node, group, lambda look_up: self._take(lambda: read(look_up)))

    def _subscribe(self, node: Node, chosen: OrientationParameters, group: CallbackGroup) -> None:
        kind, find = TOPIC_KINDS[chosen.source]
        resolved = node.resolve_topic_name(chosen.topic)
        self.describe = f"topic {resolved}"
        self.problem = "nothing has come on it yet"

        def read(message: Any) -> Oriented:
            if isinstance(message, Imu) and message.orientation_covariance[0] == -1.0:
                raise UnusableError("its messages say that they have none (orientation_covariance[0] is -1)")
            if not (stamp := stamp_ns(message.header.stamp)):
                raise UnusableError(
                    "its messages have no time stamp: the publisher must fill in header.stamp"
                )
            q = find(message)
            try:
                return Oriented(multiply(unit_quaternion((q.x, q.y, q.z, q.w)), chosen.mounting), stamp)
            except ValueError as error:
                raise UnusableError(f"what it sends is none: {error}") from None

        profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        deadline_s = time.monotonic() + _LET_GO_S
        while self.subscription is None:
            try:
                self.subscription = node.create_subscription(
                    kind,
                    resolved,
                    lambda message: self._take(lambda: read(message)),
                    profile,
                    callback_group=group,
                )
            except RuntimeError as error:
                if time.monotonic() < deadline_s:
                    time.sleep(0.01)
                    continue
                raise ParameterError(
                    f"parameter orientation.topic is {chosen.topic!r}: ROS refuses to listen there "
                    f"({error}); choose another topic"
                ) from None
        self.close = lambda: node.destroy_subscription(self.subscription)

    def _take(self, read: Callable[[], Oriented]) -> None:
        try:
            self.latest, self.problem = read(), ""
        except UnusableError as error:
            self.problem = str(error)


class SourceChoice:
    """Opens the source of the tool's load that the parameters name, and closes the previous one."""

    def __init__(self, node: Node, frame: str, filters: Filters) -> None:
        """`frame` is the sensor's, for TF."""
        self.source: Source = Source()
        self._listener: OrientationListener | None = None
        self._opened: object = None  # what the open source depends on
        self._node, self._frame, self._filters = node, frame, filters
        self._group = MutuallyExclusiveCallbackGroup()

    def check(self, wanted: Parameters) -> None:
        """ParameterError if it is not available on this machine, or its topic's name is invalid."""
        chosen = wanted.orientation
        if chosen.source == "tf":
            check_tf()
        if chosen.source not in TOPIC_SOURCES:
            return
        try:
            resolved = self._node.resolve_topic_name(chosen.topic)
        except RuntimeError as error:  # rclpy has no public name for it
            reason = str(error).removeprefix("failed to resolve name: ").partition(", at /")[0]
            raise ParameterError(f"parameter orientation.topic is {chosen.topic!r}: {reason}") from None
        kind, _ = TOPIC_KINDS[chosen.source]
        previous = self._listener.subscription if self._listener is not None else None
        for own in (*self._node.publishers, *self._node.subscriptions):
            # DDS has one type for a topic in a process.
            if own is not previous and own.topic_name == resolved and own.msg_type is not kind:
                raise ParameterError(
                    f"parameter orientation.topic is {chosen.topic!r}: this node itself has that topic, with "
                    f"{own.msg_type.__name__} messages and not {kind.__name__}"
                )

    def open(self, wanted: Parameters, model: str) -> None:
        """Open the source that is wanted, for a sensor of this model, unless it is open.

        ParameterError if that cannot be; then there is none.
        """
        name, listened = wanted.orientation.source, (wanted.orientation, wanted.gravity)
        # As given, else as the drawings of the model have it.
        position = wanted.imu_position
        if not any(position):
            position = 0.0, 0.0, IMU_HEIGHTS.get(model[4:8], 0.0)
        opened = (wanted.accelerometer, position, wanted.payload.center) if name == "imu" else listened
        if opened == self._opened:
            return
        self.close()
        if name == "none":
            self.source = Source()
        elif name == "imu":
            self.source = ImuSource(wanted, position, self._filters)
        else:
            try:
                self._listener = OrientationListener(self._node, wanted.orientation, self._frame, self._group)
            except ParameterError as error:
                self.source = Source(str(error))
                raise
            self.source = ListenerSource(wanted, self._listener)
        self._opened = opened

    def close(self) -> None:
        """Stop listening for orientations."""
        self._opened = None
        if self._listener is not None:
            self._listener.close()
            self._listener = None
