# SPDX-License-Identifier: Apache-2.0
"""A sample on its way from the stream to the topics of compensated wrenches, in the reader's thread.

The `Plan` says what is done with a sample; the executor's thread replaces it as a whole, so there are no
locks. Nothing is done unless somebody has subscribed or a window is open.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from rclpy.node import Node

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import WRENCH, Sample, Values, Vector3
from bota_ethercat.replies import SensorInfo
from bota_ethercat.stream.usable import ACCELERATION, ANGULAR_RATE, FORCE_TORQUE, Usability, judge
from bota_ethercat_bridge.compensating.sources import Source
from bota_ethercat_bridge.ft_compensation.bias import BiasRamp
from bota_ethercat_bridge.ft_compensation.compensator import Compensator, Stages
from bota_ethercat_bridge.ft_compensation.quantities import ZERO, CompensationError, StationaryLimits
from bota_ethercat_bridge.ft_compensation.stationary import StationaryWindow, triple
from bota_ethercat_bridge.parameters.table import Parameters
from bota_ethercat_bridge.publishing.contact import ContactTopic
from bota_ethercat_bridge.publishing.messages import Stamps, decoder
from bota_ethercat_bridge.publishing.wrenches import FilteredTopic, TfFrames, WrenchTopic, make_frames
from bota_ethercat_bridge.stream.link import NodeClock

_BY_IMU: Final = (FORCE_TORQUE, ACCELERATION, ANGULAR_RATE)  # what is needed of a sample
_STAGES: Final = {"wrench_compensated": "final", "compensation/bias": "bias", "compensation/tool": "tool"}


class Plan(NamedTuple):
    source: Source = Source()
    compensator: Compensator = Compensator()
    ramp: BiasRamp = BiasRamp()
    has_tool: bool = False  # whether anything has weight


class RestWindow(StationaryWindow):
    def __init__(self, seconds: float, limits: StationaryLimits, source: Source) -> None:
        super().__init__(seconds, limits)
        self.source, self.done = source, threading.Event()
        self._specific_forces, self._unknown = list[Vector3](), ""

    def observe(self, sample: Sample, time_s: float, stamp_s: float, specific_force: Vector3 | None) -> None:
        if specific_force is None:
            self._unknown = self._unknown or self.source.why_none(sample, stamp_s) or "not in every sample"
        else:
            self._specific_forces.append(specific_force)
        if self.add(sample, time_s):
            self.done.set()

    def specific_force(self) -> Vector3:
        """Its mean in the sensor's frame, m/s²; CompensationError if it was not known all the time."""
        if self._unknown or not self._specific_forces:
            why = self._unknown or "no sample came"
            raise CompensationError(f"the weight of the tool is not known: {why}")
        return triple(np.mean(self._specific_forces, axis=0))


class Compensation:
    """Compensates the reader's samples, and hands them to the topics.

    Attributes:
        plan, window: what is done with a sample, and the window that is open.
        hold: why nothing may be published for now, whatever else is known; empty if it may.
        has_subscribers: as of the last look.
        published, withheld: samples since the node started that were compensated, and that were not.
        why_withheld: of the latest of these; empty: the source knew nothing.
        is_stopped: whether the latest sample could not be compensated.
        sample, time_s, stamp_s: the latest, its time by the server's monotonic clock and since 1970.
    """

    parts = (WRENCH,)

    def __init__(
        self,
        node: Node,
        parameters: Parameters,
        stamps: Stamps,
        info: Callable[[], SensorInfo],
        clock: NodeClock,
    ) -> None:
        frames = make_frames(node, parameters, stamps, clock)
        self.frames = TfFrames(node, frames)
        final, *subtracted = (
            WrenchTopic(node, topic, parameters.frame_id, stamps, stage) for topic, stage in _STAGES.items()
        )
        self._filtered = (
            FilteredTopic(node, parameters, stamps, lambda: info().rate_hz)
            if parameters.filter_cutoff
            else None
        )
        filtered = [self._filtered] if self._filtered else []
        self.contact = (
            ContactTopic(node, parameters, stamps, info, lambda: self.plan)
            if parameters.contact_surface.strip()
            else None
        )
        touched = [self.contact] if self.contact else []
        self.topics: list[WrenchTopic] = [final, *frames, *filtered, *touched, *subtracted]
        self._wanted: list[WrenchTopic] = []
        self.plan, self.hold = Plan(), ""
        self.window: RestWindow | None = None
        self.has_subscribers = self.is_stopped = False
        self.published = self.withheld = 0
        self.why_withheld = ""
        self.decode = decoder(parameters).sample
        self.sample: Sample | None = None
        self.time_s = self.stamp_s = 0.0
        self.configure(parameters)

    def is_wanted(self) -> bool:
        self._wanted = [topic for topic in self.topics if topic.is_wanted()]
        self.frames.want(self._wanted)
        self.has_subscribers = bool(self._wanted)
        self.is_stopped = self.is_stopped and self.has_subscribers
        return self.has_subscribers or self.window is not None

    @property
    def problem(self) -> str:
        """Why single topics are silent, or would be with a subscriber; "" if none is."""
        return "; ".join(topic.problem for topic in self.topics if topic.problem)

    def configure(self, parameters: Parameters) -> None:
        self._stops_on_saturation = parameters.on_saturation == "stop"
        for topic in self.topics:
            topic.configure(parameters)

    def _specific_force(self, plan: Plan, sample: Sample, frame: DataMessage) -> Vector3 | None:
        """The specific force as far as it is needed, None if it is not known; the window takes the sample."""
        self.sample, time_s, stamp_s = sample, frame.monotonic_ns * 1e-9, frame.stamp_ns * 1e-9
        self.time_s, self.stamp_s = time_s, stamp_s
        window = self.window
        if not plan.has_tool and window is None:
            return ZERO
        specific_force = plan.source.specific_force(sample, time_s, stamp_s)
        if window is not None and not window.done.is_set():
            window.observe(sample, time_s, stamp_s, specific_force)
        return specific_force if plan.has_tool else ZERO

    def publish(self, values: Values, frame: DataMessage) -> None:
        """Compensate a sample and publish its stages; nothing if the tool's weight is not known."""
        plan, sample = self.plan, self.decode(values)
        specific_force = self._specific_force(plan, sample, frame)
        why = self.hold
        if (
            sample.warnings
            or sample.force_torque_saturated
            or sample.acceleration_saturated
            or sample.angular_rate_saturated
        ):
            why = why or self._why_unusable(plan, sample)
        if specific_force is None or why:
            self.is_stopped = True
            self.withheld += 1
            self.why_withheld = why
            return
        self.is_stopped = False
        stages = self._stages(plan, sample, specific_force)
        for topic in self._wanted:
            topic.send(*stages[topic.index], frame)
        self.published += 1

    def _why_unusable(self, plan: Plan, sample: Sample) -> str:
        """Why this sample is not to be compensated; empty if it is."""
        channels = _BY_IMU if plan.has_tool and plan.source.is_imu else _BY_IMU[:1]
        usability, why = judge(sample, channels)
        if usability is Usability.SATURATED:
            return f"{why}, and on_saturation is stop" if self._stops_on_saturation else ""
        return why

    def observe(self, values: Values, frame: DataMessage) -> None:
        """Give source, open window and filter a sample that is not published."""
        plan, sample = self.plan, self.decode(values)
        specific_force = self._specific_force(plan, sample, frame)
        filtered = self._filtered
        if filtered in self._wanted and filtered and specific_force is not None and not self.hold:
            filtered.note(*self._stages(plan, sample, specific_force).final, frame)

    def _stages(self, plan: Plan, sample: Sample, specific_force: Vector3) -> Stages:
        compensator = plan.compensator
        compensator.bias = plan.ramp.at(self.time_s)
        return compensator.compensate(sample.force, sample.torque, specific_force, plan.source.turning)
