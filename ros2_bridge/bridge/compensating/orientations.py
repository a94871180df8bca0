"""The sensor's orientation from ROS, by messages or TF, and the choice of the source of the tool's load.

Every orientation is a quaternion x, y, z, w (the rotation that takes the sensor's vectors to the base's) and
its time, or a sentence that says why there is none. They are listened to in a callback group of their own,
which waits for no service: a pose that is not taken is old.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from operator import attrgetter
from typing import Any, Final

from geometry_msgs.msg import PoseStamped, QuaternionStamped
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from bota_ethercat.pdo import Vector3
from bota_ethercat.sensor.frames import IMU_HEIGHTS
from bridge.compensating.tool_sources import ImuSource, ListenerSource, Oriented, Source
from bridge.parameters.compensation import TOPIC_SOURCES, CompensationParameters, OrientationParameters
from bridge.parameters.row import ParameterError
from bridge.transforms import Tf, UnusableError, check_tf, follow_tf, look_up, stamp_ns
from ft_compensation.quantities import Quaternion, unit_quaternion

_LET_GO_S: Final = 1.0
"""How long an executor may take to release the previous subscription: DDS has one type per topic."""
TOPIC_KINDS: Final[dict[str, tuple[Any, Callable[[Any], Any]]]] = {
    "topic_pose": (PoseStamped, attrgetter("pose.orientation")),
    "topic_quaternion": (QuaternionStamped, attrgetter("quaternion")),
    "topic_imu": (Imu, attrgetter("orientation")),
}
"""Type of the messages, and the quaternion in one, by the value of the parameter `gravity_source`."""


def read_message(message: Any, quaternion: Any) -> Oriented:
    """The orientation in a message; UnusableError if it has none that can be used."""
    if isinstance(message, Imu) and message.orientation_covariance[0] == -1.0:
        raise UnusableError("its messages say that they have none (orientation_covariance[0] is -1)")
    if not (stamp := stamp_ns(message.header.stamp)):
        raise UnusableError("its messages have no time stamp: the publisher must fill in header.stamp")
    try:
        return Oriented(unit_quaternion((quaternion.x, quaternion.y, quaternion.z, quaternion.w)), stamp)
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


class OrientationListener:
    """From construction to `close`. Read `latest` and `problem` from any thread: they are replaced."""

    def __init__(self, node: Node, chosen: OrientationParameters, frame: str, group: CallbackGroup) -> None:
        """`chosen.source` is a key of TOPIC_KINDS, or `tf`: then `frame` is the sensor's.

        ParameterError if ROS refuses to listen there.
        """
        self.latest: Oriented | None = None
        self.problem = "nothing has come yet"
        """What was wrong with what came last; empty if nothing was."""
        self.subscription: Any = None
        """To a topic; None: to TF."""
        self.close: Callable[[], object]
        """Stop listening."""
        if chosen.source != "tf":
            self._subscribe(node, chosen, group)
            return

        def read(tf: Tf) -> Oriented:
            _, rotation, stamp = look_up(tf, chosen.base_frame, frame)
            return Oriented(rotation, stamp or time.time_ns())  # static transforms hold at any time, so now

        self.describe = f"TF from {chosen.base_frame} to {frame}"
        self.close = follow_tf(node, group, lambda tf: self._take(lambda: read(tf)))

    def _subscribe(self, node: Node, chosen: OrientationParameters, group: CallbackGroup) -> None:
        kind, find = TOPIC_KINDS[chosen.source]
        resolved = node.resolve_topic_name(chosen.topic)
        self.describe = f"topic {resolved}"
        self.problem = "nothing has come on it yet"

        def read(message: Any) -> Oriented:
            quaternion, stamp = read_message(message, find(message))
            return Oriented(multiply(quaternion, chosen.mounting), stamp)

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

    def __init__(self, node: Node, frame: str) -> None:
        """`frame` is the sensor's, for TF."""
        self.source: Source = Source()
        self._listener: OrientationListener | None = None
        self._opened: object = None
        """What the open source depends on."""
        self._node, self._frame = node, frame
        self._group = MutuallyExclusiveCallbackGroup()

    def check(self, wanted: CompensationParameters) -> None:
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

    def open(self, wanted: CompensationParameters, model: str) -> None:
        """Open the source that is wanted, for a sensor of this model, unless it is open.

        ParameterError if that cannot be; then there is none.
        """
        name, listened = wanted.orientation.source, (wanted.orientation, wanted.gravity)
        position = imu_position(wanted, model)
        opened = (wanted.accelerometer, position, wanted.payload.center) if name == "imu" else listened
        if opened == self._opened:
            return
        self.close()
        if name == "none":
            self.source = Source()
        elif name == "imu":
            self.source = ImuSource(wanted, position)
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


def imu_position(wanted: CompensationParameters, model: str) -> Vector3:
    """The IMU's position in frame_id, m: as given, else as the drawings of the model have it."""
    if any(wanted.imu_position):
        return wanted.imu_position
    return 0.0, 0.0, IMU_HEIGHTS.get(model[4:8], 0.0)
