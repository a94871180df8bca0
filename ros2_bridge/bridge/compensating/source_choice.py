"""Opens the source of the tool's specific force that the parameters name, and closes the previous one."""

from __future__ import annotations

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from bridge.compensating.orientation_listener import OrientationListener, check_can_listen
from bridge.compensating.tool_sources import ImuSource, ListenerSource, NoSource, Source
from bridge.parameters.compensation import CompensationParameters
from protocol.pdo import Vector3
from protocol.sensor.frames import IMU_HEIGHTS


class SourceChoice:
    """The source in force, and what outlives it."""

    def __init__(self, node: Node, frame: str) -> None:
        """`frame` is the sensor's, for TF."""
        self.source: Source = NoSource()
        self.listener: OrientationListener | None = None
        """The listener of a source that uses a topic or TF."""
        self._node, self._frame = node, frame
        self._listening = MutuallyExclusiveCallbackGroup()

    def check(self, wanted: CompensationParameters) -> None:
        """ParameterError if it is not available on this machine."""
        check_can_listen(self._node, wanted.orientation, self.listener)

    def open(self, wanted: CompensationParameters, model: str) -> None:
        """Open the source that is wanted, for a sensor of this model; ParameterError if that cannot be."""
        self.close()
        name = wanted.orientation.source
        if name == "none":
            self.source = NoSource()
        elif name == "imu":
            self.source = ImuSource(wanted, imu_position(wanted, model))
        else:
            self.listener = OrientationListener(self._node, wanted.orientation, self._frame, self._listening)
            self.source = ListenerSource(wanted, self.listener)

    def close(self) -> None:
        """Stop listening for orientations."""
        if self.listener is not None:
            self.listener.close()
            self.listener = None


def imu_position(wanted: CompensationParameters, model: str) -> Vector3:
    """The IMU's position in frame_id, m: as given, else as the drawings of the model have it."""
    if any(wanted.imu_position):
        return wanted.imu_position
    return 0.0, 0.0, IMU_HEIGHTS.get(model[4:8], 0.0)


def is_same_source(one: CompensationParameters, other: CompensationParameters) -> bool:
    """Whether they ask for the same source."""
    parts = [
        (each.orientation, each.accelerometer, each.gravity, each.imu_position, each.payload)
        for each in (one, other)
    ]
    return parts[0] == parts[1]
