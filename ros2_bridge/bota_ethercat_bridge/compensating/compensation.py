# SPDX-License-Identifier: Apache-2.0
"""A sample on its way from the stream to the topics of compensated wrenches, in the reader's thread.

The stream's `Plan` says what is done with a sample; the executor's thread replaces it as a whole, so there
are no locks. Nothing is done unless somebody has subscribed or a window is open.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import numpy as np
from rclpy.node import Node

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import WRENCH, Sample, Values, Vector3
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.rest import StationaryLimits
from bota_ethercat_bridge.parameters.table import Parameters
from bota_ethercat_bridge.publishing.contact import ContactTopic
from bota_ethercat_bridge.publishing.messages import Stamps, decoder
from bota_ethercat_bridge.publishing.wrenches import FilteredTopic, TfFrames, WrenchTopic, make_frames
from bota_ethercat_bridge.stream.link import NodeClock
from bota_ft_compensation.imu import GravityCheck, Source
from bota_ft_compensation.quantities import ZERO, CompensationError
from bota_ft_compensation.stationary import StationaryWindow, triple
from bota_ft_compensation.stream import CompensatedStream

_STAGES: Final = {"wrench_compensated": "final", "compensation/bias": "bias", "compensation/tool": "tool"}


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
        stream: what compensates, and what is done with a sample; the window that is open.
        has_subscribers: as of the last look.
        published, withheld: samples since the node started that were compensated, and that were not.
        why_withheld: of the latest of these; empty: the source knew nothing.
        is_stopped: whether the latest sample could not be compensated.
        gravity: whether it looks right.
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
        self.stream = CompensatedStream()
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
            ContactTopic(node, parameters, stamps, self.stream)
            if parameters.contact_surface.strip()
            else None
        )
        touched = [self.contact] if self.contact else []
        self.topics: list[WrenchTopic] = [final, *frames, *filtered, *touched, *subtracted]
        self._wanted: list[WrenchTopic] = []
        self.window: RestWindow | None = None
        self.has_subscribers = self.is_stopped = False
        self.published = self.withheld = 0
        self.why_withheld = ""
        self.decode = decoder(parameters).sample
        self.gravity = GravityCheck()
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
        self.stream.use_saturated = parameters.on_saturation != "stop"
        for topic in self.topics:
            topic.configure(parameters)

    def _feel(self, sample: Sample, frame: DataMessage) -> Vector3 | None:
        """The specific force as far as it is needed, None if it is not known; the window takes the sample."""
        self.sample, time_s, stamp_s = sample, frame.monotonic_ns * 1e-9, frame.stamp_ns * 1e-9
        self.time_s, self.stamp_s = time_s, stamp_s
        window, stream = self.window, self.stream
        if window is None or window.done.is_set():
            felt, gravity = stream.feel(sample, time_s, stamp_s), self.gravity
            if not 0.0 < gravity.due_s - time_s < 1.0 and stream.plan.has_tool:
                gravity.look(sample, felt, time_s, by_imu=stream.plan.source.is_imu)
            return felt
        felt = stream.feel(sample, time_s, stamp_s, always=True)
        window.observe(sample, time_s, stamp_s, felt)
        return felt if stream.plan.has_tool else ZERO

    def publish(self, values: Values, frame: DataMessage) -> None:
        """Compensate a sample and publish its stages; nothing if the tool's weight is not known."""
        stream, sample = self.stream, self.decode(values)
        felt, why = self._feel(sample, frame), stream.why_not(sample)
        if felt is None or why:
            self.is_stopped = True
            self.withheld += 1
            self.why_withheld = why
            return
        self.is_stopped = False
        stages = stream.stages(sample, self.time_s, felt)
        for topic in self._wanted:
            topic.send(*stages[topic.index], frame)
        self.published += 1

    def observe(self, values: Values, frame: DataMessage) -> None:
        """Give source, open window and filter a sample that is not published."""
        stream, sample = self.stream, self.decode(values)
        felt, filtered = self._feel(sample, frame), self._filtered
        if filtered in self._wanted and filtered and felt is not None and not stream.why_not(sample):
            filtered.note(*stream.stages(sample, self.time_s, felt).final, frame)
