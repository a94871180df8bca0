"""The sensors to report on, from a recording that `ethercat-record` made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.numbers import count, listing, moment
from bota_clients.recording.columns import Columns, columns, joined
from bota_clients.recording.reader import InForce, RecordedSensor, Recording, open_recording
from bota_clients.report.series import Subject
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import SensorInfo
from bota_ethercat.text.untrusted import printable

_MOST_EVENTS_NAMED: Final = 10
_MOST_SENSORS_NAMED: Final = 4
_LONGEST_CHANGE_NS: Final = 2_000_000_000  # a change of settings takes the sensor out of operation for less


def of_recording(path: Path, imu_units: ImuUnits) -> list[Subject]:
    """The sensors of the recording at `path`, by position; RecordingError if there is none to be read."""
    with open_recording(path) as recording:
        recorded = [s for s in recording.sensors if not recording.chosen or s.sensor in recording.chosen]
        if not recorded:
            raise RecordingError(f"{path} has no sensor")
        remarks = [f"The recording was cut off: {recording.cut_off}."] if recording.cut_off else []
        if others := [str(sensor.sensor) for sensor in recording.sensors if sensor not in recorded]:
            remarks.append(f"Not recorded, because others were chosen: sensor {listing(others)}.")
        remarks += _event_remarks(event.name for event in recording.events)
        return [_subject(recording, sensor, imu_units).with_remarks(remarks) for sensor in recorded]


def _event_remarks(names: Iterable[str]) -> list[str]:
    """A remark that says which events there were, if any."""
    counts = Counter(printable(name, 40) for name in names)
    counts.pop("connected", None)
    told = [f"{name} ({times})" for name, times in sorted(counts.items())]
    return [f"Events of the whole recording: {listing(told, _MOST_EVENTS_NAMED)}."] if told else []


def _subject(recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits) -> Subject:
    """Its longest stretch without a change of settings or sensor."""
    # The order in the file decides what came first, because clocks differ.
    stretches: list[tuple[SensorInfo, list[Columns]]] = [(sensor.info, [columns([])])]
    for info, frames in recording.batches(sensor.sensor):
        if InForce(0, stretches[-1][0]).is_changed(info):
            stretches.append((info, []))
        stretches[-1][1].append(columns(frames, imu_units))
    longest = max(range(len(stretches)), key=lambda number: sum(map(len, stretches[number][1])))
    kept, found = stretches[longest][0], joined(stretches[longest][1])
    if longest + 1 < len(stretches):
        # Without the end in which the change was made already: the sensor gives nothing then.
        last = np.flatnonzero(found.fresh)[-1:].max(initial=-1)
        changing = found.monotonic_ns > found.monotonic_ns[-1:] - _LONGEST_CHANGE_NS
        found = found.where(~changing | (np.arange(len(found)) <= last))
    remarks = [] if kept.settings else ["The settings are not known."]
    remarks += _remarks([row.info for row in sensor.history], kept, found)
    if (tared := len(sensor.offsets) - 1) > 0:
        remarks.append(
            f"The sensor's own offset was changed {count(tared, 'time')} (by a tare, say): forces before and "
            "after differ by that."
        )
    return Subject(kept, found, recording.path.name).with_remarks(remarks)


def _remarks(history: Sequence[SensorInfo], kept: SensorInfo, frames: Columns) -> list[str]:
    """What was changed while it was recorded, and which part this is."""
    if len(history) < 2:
        return []
    remarks = []
    there = dict.fromkeys(f"{who.name}, serial {who.serial}, firmware {who.firmware}" for who in history)
    if len(there) > 1:
        remarks.append(
            f"The sensor was exchanged while it was recorded ({'; '.join([*there][:_MOST_SENSORS_NAMED])}): "
            f"this report is of serial {kept.serial}."
        )
    if changes := sum(new.serial == old.serial for old, new in pairwise(history)):
        remarks.append(f"The settings were changed {count(changes, 'time')} while it was recorded.")
    if len(frames):
        first, last = (moment(int(frames.stamp_ns[row])) for row in (0, -1))
        remarks.append(f"This report is of the longest stretch without a change, from {first} to {last}.")
    return remarks
