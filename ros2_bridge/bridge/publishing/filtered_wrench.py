"""`wrench_filtered`: the compensated wrench, filtered, if configured."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Vector3
from bridge.parameters.compensation import CompensationParameters
from bridge.parameters.table import Parameters
from bridge.publishing.messages import WrenchTopic
from ft_compensation.compensator import Stages
from ft_compensation.outputs.filter import FilterSettings, WrenchFilter
from ft_compensation.quantities import CompensationError


class FilteredTopic:
    """Filters every sample while somebody has subscribed: `publishing_frequency` comes after it."""

    index = Stages._fields.index("final")
    takes_all = True

    def __init__(self, node: Node, parameters: Parameters, rate_hz: Callable[[], float]) -> None:
        """`rate_hz` tells the sensor's sampling rate, 0 if it is not known."""
        self._node, self._frame_id, self._rate_hz = node, parameters.frame_id, rate_hz
        self.problem = ""
        self._topic: WrenchTopic | None = None
        self._filter = WrenchFilter()
        self._settings = FilterSettings()
        self._designed: tuple[FilterSettings, float] | None = None
        self.tune(parameters.compensation)

    def tune(self, parameters: CompensationParameters) -> None:
        """Take other settings from the next sample on; for the executor's thread."""
        self._settings = parameters.filter
        if self._settings.cutoff and self._topic is None:
            self._topic = WrenchTopic(self._node, "wrench_filtered", self._frame_id)

    def is_wanted(self) -> bool:
        """Whether it is configured and anybody has subscribed."""
        if self._topic is None or not self._settings.cutoff:
            return False
        wanted = self._topic.is_wanted()
        if not wanted and self._rate_hz():
            self._is_ready()  # so that the delay is logged before there is a subscriber
        return wanted

    def _is_ready(self) -> bool:
        """Whether there is a filter for the current settings and sampling rate."""
        wanted = self._settings, self._rate_hz()
        if wanted != self._designed:
            self.problem = self._design(*wanted)
            self._designed = wanted
            if self.problem:
                self._node.get_logger().warning(self.problem)
        return not self.problem

    def _design(self, settings: FilterSettings, rate_hz: float) -> str:
        """Make it; why not, a sentence."""
        if not settings.cutoff:
            return "wrench_filtered has stopped: filter.cutoff is 0"
        if not rate_hz:
            return "wrench_filtered has stopped: the server does not report the sampling rate"
        try:
            self._filter.design(settings, rate_hz)
        except CompensationError as error:
            return f"wrench_filtered has stopped: {error}"
        notch = f", notch {settings.notch:g} Hz" if settings.notch else ""
        self._node.get_logger().info(
            f"wrench_filtered is delayed by {self._filter.delay_s * 1e3:.1f} ms: cut-off "
            f"{settings.cutoff:g} Hz{notch}, sampling rate {rate_hz:g} Hz"
        )
        return ""

    def note(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Filter a sample that is not published."""
        if self._is_ready():
            self._filter.step(force, torque, frame.monotonic_ns)

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Filter a sample and publish it."""
        if self._is_ready() and self._topic is not None:
            self._topic.send(*self._filter.step(force, torque, frame.monotonic_ns), frame)
