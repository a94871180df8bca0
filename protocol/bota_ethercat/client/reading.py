# SPDX-License-Identifier: Apache-2.0
"""What a client knows of one sensor: its newest frame, its newest sample, and what that is worth now.

Conditions, their numbers and the rules are those of the C++ header (`reading.hpp`).
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final, NamedTuple

from bota_ethercat.accounting import FrameKind, StreamAccounting
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import LAYOUTS, ImuUnits, Sample, SampleDecoder
from bota_ethercat.replies import Delays, SensorInfo
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.stream.usable import FORCE_TORQUE

_REPEATED, _INVALID, _GAP = int(DataFlag.REPEATED), int(DataFlag.INVALID), int(DataFlag.GAP)
_CLOCK_TOLERANCE_NS: Final = 1_000_000
_MIN_SILENCE_NS: Final = 30_000_000  # three times the pace of REPEATED frames
_WARNINGS_AT: Final = LAYOUTS[min(LAYOUTS)].offsets["warnings"]
WARNINGS: Final = slice(_WARNINGS_AT, _WARNINGS_AT + 4)
_NO_WARNINGS: Final = bytes(4)


class Condition(IntEnum):
    """Whether the newest sample may be used, and if not, why. A higher number takes precedence.

    0 to 2: there is a sample no older than `max_age_s`, and they say what it is worth. Others: there is none.
    """

    meaning: str
    FRESH = 0, "fresh"
    SATURATED = 1, "saturated: the sensor is overloaded"
    NOT_FINITE = 2, "faulty: the sensor sends NaN or infinity, or reports that its ADC or supply is at fault"
    LATE = 3, "late: what arrives is too old"
    BAD_CLOCK = 4, "bad clock: the server's stamps are ahead of this machine's"
    REPEATED = 5, "repeated: the sensor gives nothing new"
    INVALID = 6, "invalid: the sensor does not answer on the bus"
    SILENT = 7, "silent: nothing arrives from the server"
    SENSOR_LOST = 8, "lost: the server says that the sensor is lost"
    DISCONNECTED = 9, "disconnected"

    def __new__(cls, number: int, meaning: str) -> Condition:
        """A number with its meaning."""
        member = int.__new__(cls, number)
        member._value_, member.meaning = number, meaning
        return member

    def __str__(self) -> str:
        return self.meaning


# Of a recent sample, by its usability.
_USABILITY: Final = (Condition.FRESH, Condition.SATURATED, Condition.NOT_FINITE)


class Reading(NamedTuple):
    """What is known of a sensor at the moment of a call."""

    condition: Condition
    sensor: int
    sample: Sample | None  # the newest new and valid one; None before the first
    frame: DataMessage | None  # what it came in: sequence, stamps, flags
    is_new: bool  # no earlier reading had it
    # Of the sample, now; infinity if unknown. From its arrival where the server's clock is not ours.
    age_s: float
    gap: bool  # samples were lost or withheld, or the connection was lost, since the reading before
    passed_over: int  # new samples since the reading before that came before this one
    warnings_seen: int  # warnings registers of all of them, joined by OR: a warning can last one sample
    delay_ns: Delays  # of the filters with which the sample was made

    def measured_ns(self, channel: str = "force_torque") -> int | None:
        """When it was measured, CLOCK_REALTIME: `frame.stamp_ns` less the group delay of the filters.

        `acceleration` and `angular_rate` are the other channels. None: no sample, or an unknown delay.
        """
        delay_ns = getattr(self.delay_ns, channel)
        return None if self.frame is None or delay_ns is None else self.frame.stamp_ns - delay_ns

    @property
    def fresh(self) -> bool:
        """The one thing to ask before a sample is used: it is recent, finite and not saturated."""
        return self.condition is Condition.FRESH


class ReceivedSensor:
    """One sensor of a `Session`."""

    def __init__(self, sensor: int, *, every: int, fresh_only: bool, imu_units: ImuUnits) -> None:
        self.accounting = StreamAccounting(every=every, fresh_only=fresh_only)
        self.sensor = sensor
        self.unread = 0  # new samples since the last reading
        self.told_ns = -1  # up to this instant, of the server's clock, it was told to be silent
        self._decoders = {size: SampleDecoder(size, imu_units) for size in LAYOUTS}
        self._flags = 0
        self._received_ns = self._sampled_received_ns = 0
        self._sampled: DataMessage | None = None
        self._same_clock = self._reconnected = self._gap = False
        self._carried = 0
        self._warnings = 0
        self.in_force = InForce(SensorInfo(sensor))
        self._sampled_delay_ns = Delays()

    @property
    def in_force(self) -> InForce:
        """What the server says of it now."""
        return self._in_force

    @in_force.setter
    def in_force(self, now: InForce) -> None:
        self._in_force, self.lost = now, now.lost is not None
        self.accounting.rate_hz = now.info.rate_hz or self.accounting.rate_hz

    def begin(self) -> None:
        """A new connection."""
        self._reconnected = self.accounting.counts.frames > 0  # what was lost meanwhile is not known
        self.accounting.begin()

    def add(self, frame: DataMessage, received_ns: int, same_clock: bool) -> DataMessage | None:
        """A frame that arrived at `received_ns`; itself if it brings a new, valid sample.

        GAP of a frame that brings none is carried to the next that does.
        """
        sequence, _, monotonic_ns, _, flags, _, process_data = frame
        accounting = self.accounting
        unusual = flags or self._reconnected or self._carried or self.lost
        if unusual or not accounting.count_next(sequence, monotonic_ns):
            restarts = accounting.counts.restarts
            kind = accounting.count(sequence, monotonic_ns, flags)
            if kind is FrameKind.OLD:
                return None
            if self._reconnected or accounting.counts.restarts > restarts:
                self._reconnected, self._carried = False, _GAP
            if kind is not FrameKind.NEW:
                self._flags, self._received_ns = flags, received_ns
                self._carried |= flags & _GAP
                return None
            if self._carried:
                frame, self._carried = frame._replace(flags=flags | self._carried), 0
            self._gap = self._gap or frame.flags & _GAP != 0
        self._flags, self._same_clock = flags, same_clock
        self._sampled, self._received_ns, self._sampled_received_ns = frame, received_ns, received_ns
        self._sampled_delay_ns = self._in_force.info.delay_ns
        self.unread += 1
        if (warnings := process_data[WARNINGS]) != _NO_WARNINGS:
            self._warnings |= int.from_bytes(warnings, "little")
        return frame

    @property
    def steady(self) -> DataMessage | None:
        """The newest frame if the one after it would be nothing unusual but for what is in it; else None."""
        unusual = self._flags or self._reconnected or self._carried or self.lost
        return None if unusual or not self.accounting.has_begun else self._sampled

    def add_run(self, last: DataMessage, received_ns: int, same_clock: bool) -> None:
        """As `add` for each frame after `steady`, all with its warnings and without flags, up to this one."""
        before = self.accounting.count_run(last.sequence)
        self.unread += before
        self.add(last, received_ns, same_clock)

    def decode(self, frame: DataMessage) -> Sample:
        """The sample in a frame."""
        return self._decoders[len(frame.process_data)].decode(frame.process_data)

    def read(self, max_age_ns: int, now_ns: int, *, connected: bool) -> Reading:
        """What is known as of `now_ns`; the next reading begins."""
        frame, sample, age_ns, ahead = self._sampled, None, math.inf, False
        if frame is not None:
            sample = self.decode(frame)
            since_ns = now_ns - (frame.monotonic_ns if self._same_clock else self._sampled_received_ns)
            ahead = since_ns < -_CLOCK_TOLERANCE_NS
            age_ns = math.inf if ahead else max(0, since_ns)
        if sample is not None and age_ns <= max_age_ns:
            condition = _USABILITY[FORCE_TORQUE.judge(sample)]
        else:
            silence_ns = max(2 * max_age_ns, _MIN_SILENCE_NS)
            condition = self.why_old(silence_ns, now_ns, connected=connected, ahead=ahead)
        reading = Reading(
            condition, self.sensor, sample, frame, self.unread > 0, age_ns * 1e-9,
            self._gap or self._carried != 0, max(0, self.unread - 1), self._warnings, self._sampled_delay_ns,
        )  # fmt: skip
        self.unread = self._warnings = 0
        self._gap = False
        return reading

    def why_old(self, silence_ns: int, now_ns: int, *, connected: bool, ahead: bool = False) -> Condition:
        """Why there is no recent sample; SILENT after `silence_ns` without any frame."""
        if not connected:
            return Condition.DISCONNECTED
        if self.lost:
            return Condition.SENSOR_LOST
        if not self.accounting.has_begun or now_ns - self._received_ns >= silence_ns:
            return Condition.SILENT
        if self._flags & _INVALID:
            return Condition.INVALID
        if self._flags & _REPEATED:
            return Condition.REPEATED
        return Condition.BAD_CLOCK if ahead else Condition.LATE
