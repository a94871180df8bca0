# SPDX-License-Identifier: Apache-2.0
"""The topics `contact`, the point with its region, and `contact/detected`, whether there is contact."""

from __future__ import annotations

import math
from typing import Final

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from std_msgs.msg import Bool, Header

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Vector3
from bota_ethercat_bridge.parameters.table import Parameters, parse_surface
from bota_ethercat_bridge.publishing.messages import Stamps, Topic, create_publisher
from bota_ethercat_bridge.publishing.wrenches import WrenchTopic
from bota_ethercat_bridge.rclpy_internals import packing
from bota_ft_compensation.compensator import Stages
from bota_ft_compensation.contact import ContactDetector, Why
from bota_ft_compensation.stream import CompensatedStream

_PERIOD_NS: Final = 40_000_000  # of the point, which takes as long as two samples take to compensate


class ContactTopic(WrenchTopic):
    """Takes every compensated sample; publishes at each change of what is detected, and 25 times a second."""

    def __init__(
        self,
        node: Node,
        parameters: Parameters,
        stamps: Stamps,
        stream: CompensatedStream,
    ) -> None:
        Topic.__init__(self, node, PoseWithCovarianceStamped, "contact")
        message = PoseWithCovarianceStamped(header=Header(frame_id=parameters.frame_id))
        self._pack = packing(message, 43)
        self._stamps, self.index = stamps, Stages._fields.index("final")
        self._detected = create_publisher(node, Bool, "contact/detected")
        self._stream = stream
        self.why = Why.NO_CONTACT  # of the latest point
        self._detector: ContactDetector | None = None
        self._made_of: object = None
        self._next_ns = 0
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        self._parameters = parameters

    def is_wanted(self) -> bool:
        wanted = super().is_wanted() or bool(self._detected.get_subscription_count())
        if wanted and self._stream.in_force.info.rate_hz:
            self._follow(self._parameters)
        return wanted

    def _follow(self, parameters: Parameters) -> None:
        """Another detector where parameters, bias or settings are others."""
        plan, info = self._stream.plan, self._stream.in_force.info
        made_of = parameters, plan.ramp.taken, plan.source.is_imu, info.settings, info.rate_hz
        if made_of == self._made_of:
            return
        self._made_of = made_of
        surface = parse_surface(parameters.contact_surface)
        assert surface is not None  # there is no topic without one
        self._detector = self._stream.contact_detector(
            surface, parameters.contact_noise, parameters.contact_false_alarms
        )

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        if (detector := self._detector) is None:
            return
        turning, was = self._stream.plan.source.turning, detector.is_contact
        if detector.update(force, torque, turning) is was and frame.monotonic_ns < self._next_ns:
            return
        self._next_ns = frame.monotonic_ns + _PERIOD_NS
        self._detected.publish(Bool(data=detector.is_contact))
        self.why, _, _, region = detector.locate(force, torque, turning)
        if region is None:
            return
        x, y, z = region.normal  # the pose's z axis
        turn = math.sqrt(0.5 + 0.5 * z)
        pose = (-0.5 * y / turn, 0.5 * x / turn, 0.0, turn) if turn > 1e-6 else (1.0, 0.0, 0.0, 0.0)
        a, b, c, d, e, f, g, h, i = region.covariance()
        none = (0.0, 0.0, 0.0)
        covariance = a, b, c, *none, d, e, f, *none, g, h, i, *none, *(0.0,) * 18
        next(self._sends)(
            self._pack(frame.stamp_ns - self._stamps.wrench_ns, *region.center, *pose, *covariance)
        )
