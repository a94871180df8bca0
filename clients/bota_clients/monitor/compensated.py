"""`ethercat-monitor --tool`: the newest sample without bias, weight and inertia of the tool; contact."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bota_clients.errors import RecordingError
from bota_clients.recording.columns import columns
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits, Vector3
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.contact import Contact, ContactDetector, surface_of
from bota_ft_compensation.identification.parameter_file import stream_of
from bota_ft_compensation.quantities import CompensationError


class Compensated(NamedTuple):
    """Of one sample, in the sensor's frame; the bounds are of 95 %."""

    force: Vector3  # N
    torque: Vector3  # Nm
    force_bound: float
    torque_bound: float
    contact: Contact | None = None  # None without a surface, `contact.surface`


class NewestCompensated:
    """Of one sensor's `CompensatedStream` the newest sample."""

    def __init__(self, tool: Mapping[str, Any], imu_units: ImuUnits) -> None:
        """`tool`: parameters of the node; RecordingError if its `contact.surface` is wrong."""
        self._tool, self._units = tool, imu_units
        try:
            self._surface = surface_of(tool.get("contact.surface", ""))
        except CompensationError as error:
            raise RecordingError(str(error)) from None
        self.begin()

    def begin(self) -> None:
        """What comes next is of another connection, or another sensor."""
        self._stream = stream_of(self._tool)
        self._detector: ContactDetector | None = None
        self._made_of: object = None
        self.latest: Compensated | None = None
        self.problem = ""  # why there is none, a sentence

    def add(self, frames: Sequence[DataMessage], in_force: InForce) -> None:
        stream = self._stream
        stream.configure(in_force)
        stream.follow_offset()
        samples = columns([each for each in frames if not each.flags & NOT_NEW], self._units)
        if not len(samples):
            return
        wrenches, bounds = stream.compensate(samples)
        wrench, (force_bound, torque_bound) = wrenches[-1].tolist(), bounds[-1].tolist()
        if not math.isfinite(sum(wrench)):
            lost = "not known of the newest sample: it may not be used, or came after lost samples"
            held = f"the wrench cannot be compensated: {stream.hold}"
            self.latest, self.problem = None, held if stream.hold else lost
            return
        force, torque = (wrench[0], wrench[1], wrench[2]), (wrench[3], wrench[4], wrench[5])
        contact = self._contact(force, torque, in_force)
        self.latest, self.problem = Compensated(force, torque, force_bound, torque_bound, contact), ""

    def _contact(self, force: Vector3, torque: Vector3, in_force: InForce) -> Contact | None:
        if self._surface is None:
            return None
        made_of = in_force.info.settings, in_force.info.rate_hz
        if self._detector is None or made_of != self._made_of:
            noise, alarms = self._tool.get("contact.noise", ()), self._tool.get("contact.false_alarms", 1.0)
            self._made_of, noise = made_of, noise if any(noise) else ()
            self._detector = self._stream.contact_detector(self._surface, noise, alarms)
        turning = self._stream.plan.source.turning
        self._detector.update(force, torque, turning)
        return self._detector.locate(force, torque, turning)
