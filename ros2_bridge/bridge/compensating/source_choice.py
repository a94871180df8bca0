"""Opens the source of gravity that the parameters name, and closes the previous one."""

from __future__ import annotations

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from bridge.compensating.gravity_sources import (
    AccelerometerSource,
    ListenerSource,
    NoSource,
    SensorSource,
    Source,
)
from bridge.compensating.orientations import OrientationListener, check_can_listen
from bridge.parameters.compensation import CompensationParameters
from ft_compensation.attitude.tilt import GyroscopeOffset


class SourceChoice:
    """The source in force, and what outlives it."""

    def __init__(self, node: Node, frame: str) -> None:
        """`frame` is the sensor's, for TF."""
        self.source: Source = NoSource()
        self.listener: OrientationListener | None = None
        """The listener of a source that uses a topic or TF."""
        self._node, self._frame = node, frame
        self._listening = MutuallyExclusiveCallbackGroup()
        self._gyroscope = GyroscopeOffset()

    def check(self, wanted: CompensationParameters) -> None:
        """ParameterError if it is not available on this machine."""
        check_can_listen(self._node, wanted.orientation, self.listener)

    def open(self, wanted: CompensationParameters) -> None:
        """Open the source that is wanted; ParameterError if it is not available."""
        self.close()
        self.source = self._opened(wanted)

    def _opened(self, wanted: CompensationParameters) -> Source:
        name = wanted.orientation.source
        if name == "none":
            return NoSource()
        if name == "accelerometer":
            return AccelerometerSource(wanted, self._gyroscope)
        if name == "sensor":
            return SensorSource(wanted)
        self.listener = OrientationListener(self._node, wanted.orientation, self._frame, self._listening)
        return ListenerSource(wanted, self.listener)

    def another_sensor(self, wanted: CompensationParameters) -> None:
        """Forget the previous sensor's IMU."""
        self._gyroscope = GyroscopeOffset()
        if isinstance(self.source, AccelerometerSource):
            self.source = AccelerometerSource(wanted, self._gyroscope)

    def close(self) -> None:
        """Stop listening for orientations."""
        if self.listener is not None:
            self.listener.close()
            self.listener = None


def is_same_source(one: CompensationParameters, other: CompensationParameters) -> bool:
    """Whether they ask for the same source."""
    parts = [(each.orientation, each.accelerometer, each.gravity) for each in (one, other)]
    return parts[0] == parts[1]
