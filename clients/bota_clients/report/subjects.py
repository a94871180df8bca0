"""The sensors to report on, from a recording that `ethercat-record` made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from bota_clients.errors import ClientError
from bota_clients.numbers import count, listing, moment
from bota_clients.recording.columns import Columns, columns
from bota_clients.recording.reader import (
    Histories,
    Identity,
    RecordedSensor,
    Recording,
    Settings,
    open_recording,
)
from bota_clients.report.series import Subject, subject
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.sensor_choice import SensorChoice
from bota_ethercat.text.untrusted import printable

_MOST_EVENTS_NAMED: Final = 10
_MOST_SENSORS_NAMED: Final = 4
_LONGEST_CHANGE_NS: Final = 2_000_000_000  # a change of settings takes the sensor out of operation for less


def of_recording(path: Path, choice: SensorChoice | None, imu_units: ImuUnits) -> list[Subject]:
    """The sensors of the recording at `path`, or those chosen, by position.

    RecordingError if it cannot be read, ClientError if it has no such sensor.
    """
    with open_recording(path) as recording:
        recorded = [s for s in recording.sensors if not recording.chosen or s.sensor in recording.chosen]
        found = [sensor for sensor in recorded if _meant(sensor, choice)]
        if not found:
            there = [
                (s.sensor, who.name, who.serial)
                for s in recorded
                for row in s.history
                for who in [row.identity]
            ]
            raise _no_sensor(str(path), choice, dict.fromkeys(there))
        remarks = [f"The recording was cut off: {recording.cut_off}."] if recording.cut_off else []
        if others := [str(sensor.sensor) for sensor in recording.sensors if sensor not in recorded]:
            remarks.append(f"Not recorded, because others were chosen: sensor {listing(others)}.")
        remarks += _event_remarks(event.name for event in recording.events)
        subjects = [_subject(recording, sensor, choice, imu_units) for sensor in found]
        return [subject.with_remarks(remarks) for subject in subjects]


def _no_sensor(
    where: str, choice: SensorChoice | None, there: Iterable[tuple[object, object, object]]
) -> ClientError:
    """The error that the chosen sensor does not exist, with those that do."""
    known = [printable(f"{position} ({name}, serial {serial})", 80) for position, name, serial in there]
    if choice is None or not known:
        return ClientError(f"{where} has no sensor")
    return ClientError(f"{where} has no sensor {choice}: it has {', '.join(known[:16])}")


def _event_remarks(names: Iterable[str]) -> list[str]:
    """A remark that says which events there were, if any."""
    counts = Counter(printable(name, 40) for name in names)
    counts.pop("connected", None)
    told = [f"{name} ({times})" for name, times in sorted(counts.items())]
    return [f"Events of the whole recording: {listing(told, _MOST_EVENTS_NAMED)}."] if told else []


def _meant(sensor: RecordedSensor, choice: SensorChoice | None) -> list[int]:
    """Which entries of its history are of a chosen sensor; [0] if there is no history."""
    told = [settings.identity for settings in sensor.history] or [Identity()]
    return [
        number
        for number, who in enumerate(told)
        if choice is None or choice.matches(sensor.sensor, who.name, who.serial)
    ]


def _frames(recording: Recording, sensor: int, before: list[int]) -> Iterator[DataMessage]:
    """The frames of a sensor; `before` gets how many of them came before each entry of its history.

    The order in the file decides what came first, because clocks differ.
    """
    histories, so_far = Histories(), 0
    for item in recording.everything(sensor):
        if isinstance(item, DataMessage):
            so_far += 1
            yield item
        else:
            histories.take(item)
            before += [so_far] * (len(histories.of(sensor)) - len(before))


def _subject(
    recording: Recording, sensor: RecordedSensor, choice: SensorChoice | None, imu_units: ImuUnits
) -> Subject:
    """Its longest stretch without a change of settings or sensor."""
    before, history = list[int](), sensor.history
    frames = columns(_frames(recording, sensor.sensor, before), imu_units)
    row, values, remarks = sensor._asdict(), None, list[str]()
    if history:
        # The first settings were in effect before they were received.
        ends = [0, *before[1:], len(frames)]
        longest = max(_meant(sensor, choice), key=lambda number: ends[number + 1] - ends[number])
        kept, numbers = history[longest], np.arange(len(frames))
        row |= {**kept.identity._asdict(), "rate_hz": kept.rate_hz}
        values = kept.values
        frames = frames.where((numbers >= ends[longest]) & (numbers < ends[longest + 1]))
        if longest + 1 < len(history):
            # Without the end in which the change was made already: the sensor gives nothing then.
            last = np.flatnonzero(frames.fresh)[-1:].max(initial=-1)
            changing = frames.monotonic_ns > frames.monotonic_ns[-1:] - _LONGEST_CHANGE_NS
            frames = frames.where(~changing | (np.arange(len(frames)) <= last))
        remarks = _remarks(history, kept, frames)
    if (tared := len(sensor.offsets) - 1) > 0:
        remarks.append(
            f"The sensor's own offset was changed {count(tared, 'time')} (by a tare, say): forces before and "
            "after differ by that."
        )
    made = subject(row, values, frames, recording.path.name, sensor.sensor)
    return made.with_remarks(remarks)


def _remarks(history: Sequence[Settings], kept: Settings, frames: Columns) -> list[str]:
    """What was changed while it was recorded, and which part this is."""
    if len(history) == 1:
        return []
    remarks = []
    sensors = list(dict.fromkeys(settings.identity for settings in history))
    if len(sensors) > 1:
        there = [f"{who.name}, serial {who.serial}, firmware {who.firmware}" for who in sensors]
        remarks.append(
            f"The sensor was exchanged while it was recorded ({'; '.join(there[:_MOST_SENSORS_NAMED])}): "
            f"this report is of serial {kept.identity.serial}; --sensor serial:N chooses."
        )
    if changes := sum(new.identity == old.identity for old, new in pairwise(history)):
        remarks.append(f"The settings were changed {count(changes, 'time')} while it was recorded.")
    if len(frames):
        first, last = (moment(int(frames.stamp_ns[row])) for row in (0, -1))
        remarks.append(f"This report is of the longest stretch without a change, from {first} to {last}.")
    return remarks
