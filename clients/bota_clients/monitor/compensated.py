"""`ethercat-monitor --tool`: the newest sample without bias, weight and inertia of the tool; contact."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bota_clients.errors import RecordingError
from bota_clients.export.windows import Windows
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits, Vector3
from bota_ethercat.replies import SensorInfo
from bota_ethercat.stream.timeline import InForce
from bota_ethercat_bridge.ft_compensation.contact import Contact, ContactDetector, detector_of, surface_of
from bota_ethercat_bridge.ft_compensation.identification.parameter_file import payload_of
from bota_ethercat_bridge.ft_compensation.quantities import CompensationError


class Compensated(NamedTuple):
    """Of one sample, in the sensor's frame; the bounds are of 95 %."""

    force: Vector3  # N
    torque: Vector3  # Nm
    force_bound: float
    torque_bound: float
    contact: Contact | None = None  # None without a surface, `contact.surface`


class CompensatedStream:
    """Of one sensor; as `ethercat-export --tool` and the ROS 2 node compensate."""

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
        self._windows = Windows(1, tool=self._tool, imu_units=self._units)
        self._detector: ContactDetector | None = None
        self._made_of: object = None
        self.latest: Compensated | None = None
        self.problem = ""  # why there is none, a sentence

    def add(self, frames: Sequence[DataMessage], in_force: InForce) -> None:
        windows, info = self._windows, in_force.info
        try:
            windows.configure(in_force)
            windows.add(frames)
        except RecordingError as error:
            self.begin()
            self.problem = str(error)
            return
        slots = windows.take(rest=True)
        if not (slots := slots[slots["number"] >= 0]).size:
            return
        newest = slots[-1]
        wrench, (force_bound, torque_bound) = newest["compensated"].tolist(), newest["bounds"].tolist()
        if not math.isfinite(sum(wrench)):
            why = windows.doubt or "it is not finite, or came after lost samples"
            self.latest, self.problem = None, f"not known of the newest sample: {why}"
            return
        force, torque = (wrench[0], wrench[1], wrench[2]), (wrench[3], wrench[4], wrench[5])
        contact = self._contact(force, torque, info)
        self.latest, self.problem = Compensated(force, torque, force_bound, torque_bound, contact), ""

    def _contact(self, force: Vector3, torque: Vector3, info: SensorInfo) -> Contact | None:
        if self._surface is None:
            return None
        if self._detector is None or (info.settings, info.rate_hz) != self._made_of:
            self._made_of = info.settings, info.rate_hz
            noise = self._tool.get("contact.noise", ())
            self._detector = detector_of(
                self._surface, payload_of(self._tool), info.settings, info.rate_hz,
                noise=noise if any(noise) else (), accelerometer=self._windows.accelerometer,
                alarms_per_hour=self._tool.get("contact.false_alarms", 1.0),
            )  # fmt: skip
        self._detector.update(force, torque, self._windows.turning)
        return self._detector.locate(force, torque, self._windows.turning)
