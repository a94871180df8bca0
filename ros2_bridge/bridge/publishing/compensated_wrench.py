"""`wrench_compensated` and what was subtracted, a topic each: the compensation as the reader runs it.

The reader calls `publish` for every selected sample, but only while somebody has subscribed or a window is
open. What it goes by is a `Plan`, which the executor's thread replaces as a whole: there are no locks.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import NamedTuple

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Sample, Vector3
from bridge.compensating.tool_sources import Source
from bridge.parameters.compensation import CompensationParameters
from bridge.publishing.filtered_wrench import FilteredTopic
from bridge.publishing.messages import StageTopic
from ft_compensation.bias import BiasRamp
from ft_compensation.compensator import Compensator, Stages
from ft_compensation.payload_watch import PayloadWatch
from ft_compensation.quantities import ZERO, CompensationError
from ft_compensation.stationary import StationaryWindow
from ft_compensation.stationary_limits import StationaryLimits


class Plan(NamedTuple):
    """What is done with a sample."""

    source: Source
    compensator: Compensator
    ramp: BiasRamp
    has_tool: bool
    """Whether anything has weight."""
    watch: PayloadWatch | None = None
    """Checks now and then whether the payload is still the one that is compensated."""


class RestWindow(StationaryWindow):
    """Samples of some time at rest, and the specific force meanwhile."""

    def __init__(self, seconds: float, limits: StationaryLimits, source: Source) -> None:
        super().__init__(seconds, limits)
        self.source = source
        self.done = threading.Event()
        self._sum, self._felt = ZERO, 0
        self._blind = ""

    def take(self, sample: Sample, time_s: float, stamp_s: float, felt: Vector3 | None) -> bool:
        """Take a sample and its specific force, for the reader. True: the window is complete."""
        if felt is None:
            self._blind = self._blind or self.source.why_none(sample, stamp_s) or "not in every sample"
        else:
            (x, y, z), (fx, fy, fz) = self._sum, felt
            self._sum = (x + fx, y + fy, z + fz)
            self._felt += 1
        if self.add(sample, time_s):
            self.done.set()
        return self.done.is_set()

    def specific_force(self) -> Vector3:
        """Its mean in the sensor's frame, m/s²; CompensationError if it was not known all the time."""
        if self._blind or not self._felt:
            raise CompensationError(f"the weight of the tool is not known: {self._blind or 'no sample came'}")
        x, y, z = self._sum
        return x / self._felt, y / self._felt, z / self._felt


class CompensatedOutput:
    """An output of the reader's."""

    fields = ("force", "torque")

    def __init__(self, topics: Sequence[StageTopic | FilteredTopic]) -> None:
        self._all = topics
        self._wanted: tuple[StageTopic | FilteredTopic, ...] = ()
        self._noting: tuple[StageTopic | FilteredTopic, ...] = ()
        self.plan = Plan(Source(), Compensator(), BiasRamp(), has_tool=False)
        self.window: RestWindow | None = None
        """The one that is open."""
        self.hold: str | None = None
        """Why nothing may be published for now, whatever else is known."""
        self.stops_on_saturation = self.is_saturated = False
        """Whether saturated samples are not published, and whether the latest was one of them."""
        self.published = self.withheld = 0
        """Samples since the node started that were compensated, and that were not."""
        self.is_stopped = False
        """Whether the latest could not be compensated."""
        self.sample: Sample | None = None
        """The latest that came here."""
        self.time_s = self.stamp_s = 0.0
        """Its time, s: by the server's monotonic clock, and since the Unix epoch."""

    def is_wanted(self) -> bool:
        """Whether anybody has subscribed to any of the topics, or a window is open."""
        self._wanted = tuple(topic for topic in self._all if topic.is_wanted())
        self._noting = tuple(topic for topic in self._wanted if topic.takes_all)
        if not self._wanted:
            self.is_stopped = False  # nobody misses anything
        return bool(self._wanted) or self.window is not None

    @property
    def has_subscribers(self) -> bool:
        """Whether anybody has subscribed, as of the last look."""
        return bool(self._wanted)

    @property
    def problem(self) -> str:
        """Why single subscribed topics are silent; "" if none is."""
        return "; ".join(topic.problem for topic in self._wanted if topic.problem)

    def tune(self, parameters: CompensationParameters) -> None:
        """Take what parameters say of the topics; for the executor's thread."""
        self.stops_on_saturation = parameters.on_saturation == "stop"
        for topic in self._all:
            topic.tune(parameters)

    def follow(self, sample: Sample, frame: DataMessage) -> None:
        """Give source, open window and filters a sample that is not published."""
        plan = self.plan
        felt = self._felt(plan, sample, frame)
        if self._noting and felt is not None and self.hold is None:
            stages = self._stages(plan, sample, felt, self.time_s)
            for topic in self._noting:
                topic.note(*stages[topic.index], frame)

    def _felt(self, plan: Plan, sample: Sample, frame: DataMessage) -> Vector3 | None:
        """The specific force as far as it is needed, None if it is not known; the window takes the sample."""
        self.sample, time_s, stamp_s = sample, frame.monotonic_ns * 1e-9, frame.stamp_ns * 1e-9
        self.time_s, self.stamp_s = time_s, stamp_s
        window = self.window
        if not plan.has_tool and window is None:
            return ZERO
        felt = plan.source.specific_force(sample, time_s, stamp_s)
        if window is not None and window.take(sample, time_s, stamp_s, felt):
            self.window = None
        return felt if plan.has_tool else ZERO

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Compensate a sample and publish its stages; nothing if the tool's weight is not known."""
        plan = self.plan
        felt = self._felt(plan, sample, frame)
        time_s = self.time_s
        self.is_saturated = self.stops_on_saturation and sample.force_torque_saturated != 0
        if felt is None or self.hold is not None or self.is_saturated:
            self.is_stopped = True
            self.withheld += 1
            return
        self.is_stopped = False
        stages = self._stages(plan, sample, felt, time_s)
        if (watch := plan.watch) is not None and watch.is_due(time_s):
            gravity = -felt[0], -felt[1], -felt[2]
            watch.look(stages.final.force, gravity, sample.angular_rate, time_s)
        for topic in self._wanted:
            topic.send(*stages[topic.index], frame)
        self.published += 1

    @staticmethod
    def _stages(plan: Plan, sample: Sample, felt: Vector3, time_s: float) -> Stages:
        compensator = plan.compensator
        compensator.set_bias(plan.ramp.at(time_s))
        return compensator.compensate(sample.force, sample.torque, felt)
