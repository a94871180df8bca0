"""Subjects from a recording that `ethercat-record` made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from clients.recording.columns import Columns, columns
from clients.recording.reader import RecordedSensor, Recording, Settings, open_recording
from clients.report.errors import ReportError
from clients.report.subject import Subject, subject
from clients.report.words import moment
from protocol.pdo import ImuUnits
from protocol.sensor_choice import SensorChoice
from protocol.text import printable

_MOST_EVENTS_NAMED = 10


def subjects(path: Path, choice: SensorChoice | None, imu_units: ImuUnits) -> list[Subject]:
    """The sensors of the recording at `path`, or those that are meant, by place.

    RecordingError says why it cannot be read, ReportError that it has no such sensor.
    """
    with open_recording(path) as recording:
        found = [
            sensor
            for sensor in recording.sensors
            if choice is None or choice.matches(sensor.sensor, sensor.name, sensor.serial)
        ]
        if not found:
            raise no_sensor(str(path), choice, [(s.sensor, s.name, s.serial) for s in recording.sensors])
        return [_subject(recording, sensor, imu_units) for sensor in found]


def no_sensor(
    where: str, choice: SensorChoice | None, there: Iterable[tuple[object, object, object]]
) -> ReportError:
    """That the sensor that is meant is not there, and which are."""
    known = [printable(f"{place} ({name}, serial {serial})", 80) for place, name, serial in there]
    if choice is None or not known:
        return ReportError(f"{where} has no sensor")
    return ReportError(f"{where} has no sensor {choice}: it has {', '.join(known[:16])}")


def _subject(recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits) -> Subject:
    every = columns(recording, sensor.sensor, imu_units)
    settings, kept, remarks = _longest_stretch(sensor, every)
    row = {**sensor._asdict(), "rate_hz": settings.rate_hz if settings else sensor.rate_hz}
    values = settings.values if settings else None
    made = subject(row, values, kept, recording.path.name, sensor.sensor)
    if recording.cut_off:
        remarks.append(f"The recording was cut off: {recording.cut_off}.")
    return made.with_remarks([*remarks, *event_remarks(event.name for event in recording.events)])


def event_remarks(names: Iterable[str]) -> list[str]:
    """A remark that says which events there were, if any."""
    counts = Counter(printable(name, 40) for name in names)
    counts.pop("connected", None)
    if not counts:
        return []
    told = [f"{name} ({times})" for name, times in sorted(counts.items())[:_MOST_EVENTS_NAMED]]
    more = f" and {len(counts) - _MOST_EVENTS_NAMED} other kinds" if len(counts) > _MOST_EVENTS_NAMED else ""
    return [f"Events of the whole recording: {', '.join(told)}{more}."]


def _longest_stretch(sensor: RecordedSensor, every: Columns) -> tuple[Settings | None, Columns, list[str]]:
    """The frames in which the settings were the same for longest: limits and filters follow from them."""
    if len(sensor.history) <= 1 or not len(every):
        return (sensor.history[0] if sensor.history else None), every, []
    # The first settings were in force before they were asked for.
    begins = [0, *(settings.stamp_ns for settings in sensor.history[1:])]
    which = np.searchsorted(begins, every.stamp_ns, side="right") - 1
    counts = np.bincount(which, minlength=len(begins))
    longest = int(np.argmax(counts))
    kept = every.where(which == longest)
    return (
        sensor.history[longest], kept,
        [f"The settings were changed {len(begins) - 1} times while it was recorded; this report is of "
        f"the longest stretch "
         f"without a change, from {moment(int(kept.stamp_ns[0]))} to {moment(int(kept.stamp_ns[-1]))}."],
    )  # fmt: skip
