"""The sensors to report on, from a recording that `ethercat-record` made or from some seconds of a server's
stream."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from bota_clients.errors import ReportError
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
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.observer import p99
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.sensor_choice import MOST_PLACES, SensorChoice
from bota_ethercat.text import untrusted
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import printable

_MOST_EVENTS_NAMED: Final = 10
_MOST_SENSORS_NAMED: Final = 4
_LONGEST_CHANGE_NS: Final = 2_000_000_000  # a change of settings takes the sensor out of operation for less


def of_recording(path: Path, choice: SensorChoice | None, imu_units: ImuUnits) -> list[Subject]:
    """The sensors of the recording at `path`, or those chosen, by position.

    RecordingError if it cannot be read, ReportError if it has no such sensor.
    """
    with open_recording(path) as recording:
        recorded = [s for s in recording.sensors if not recording.chosen or s.sensor in recording.chosen]
        found = [sensor for sensor in recorded if _meant(sensor, choice)]
        if not found:
            there = [(s.sensor, who.name, who.serial) for s in recorded for *_, who in s.history]
            raise _no_sensor(str(path), choice, dict.fromkeys(there))
        remarks = [f"The recording was cut off: {recording.cut_off}."] if recording.cut_off else []
        if others := [str(sensor.sensor) for sensor in recording.sensors if sensor not in recorded]:
            remarks.append(f"Not recorded, because others were chosen: sensor {listing(others)}.")
        remarks += _event_remarks(event.name for event in recording.events)
        subjects = [_subject(recording, sensor, choice, imu_units) for sensor in found]
        return [subject.with_remarks(remarks) for subject in subjects]


def _no_sensor(
    where: str, choice: SensorChoice | None, there: Iterable[tuple[object, object, object]]
) -> ReportError:
    """The error that the chosen sensor does not exist, with those that do."""
    known = [printable(f"{position} ({name}, serial {serial})", 80) for position, name, serial in there]
    if choice is None or not known:
        return ReportError(f"{where} has no sensor")
    return ReportError(f"{where} has no sensor {choice}: it has {', '.join(known[:16])}")


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


class _Frames:
    """The frames of one sensor, and how many of them came before each entry of its history."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.before: list[int] = []

    def frames(self, sensor: int | None = None) -> Iterator[DataMessage]:
        """Its frames. The order in the file decides what came first, because clocks differ."""
        assert sensor is not None
        histories, so_far = Histories(), 0
        for item in self._recording.everything(sensor):
            if isinstance(item, DataMessage):
                so_far += 1
                yield item
            else:
                histories.take(item)
                self.before += [so_far] * (len(histories.of(sensor)) - len(self.before))


def _subject(
    recording: Recording, sensor: RecordedSensor, choice: SensorChoice | None, imu_units: ImuUnits
) -> Subject:
    """Its longest stretch without a change of settings or sensor."""
    source, history = _Frames(recording), sensor.history
    frames = columns(source, sensor.sensor, imu_units)
    row, values, remarks = sensor._asdict(), None, list[str]()
    if history:
        # The first settings were in effect before they were received.
        ends = [0, *source.before[1:], len(frames)]
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


_BATCH_S: Final = 0.05
_MOST_AGES: Final = 1 << 16
_MOST_FRAMES: Final = 4_000_000  # half an hour at 1600 Hz; more than that is what a recording is for


class _Received:
    """Frames in order of arrival, and by sensor the ages of the samples that were waited for, µs."""

    def __init__(self) -> None:
        self.all: deque[DataMessage] = deque(maxlen=_MOST_FRAMES)
        self.ages_us: defaultdict[int, deque[float]] = defaultdict(lambda: deque(maxlen=_MOST_AGES))

    def frames(self, sensor: int | None = None) -> Iterator[DataMessage]:
        """The frames of the sensor at this position, or of all."""
        return (frame for frame in self.all if sensor in (None, frame.sensor))


def of_server(
    address: Address,
    seconds: float,
    choice: SensorChoice | None,
    imu_units: ImuUnits,
    show: Callable[..., None],
) -> list[Subject]:
    """The server's sensors, or those chosen, after `seconds`; `show` gets the time so far, s, as `completed`.

    ConnectionFailedError or RefusedError if there is no stream; ReportError if there is no such sensor.
    """
    with Client(address.port, address.host, fresh_only=False, raw=True, reconnect=False).connect() as client:
        there = _rows(client.description)
        rows = {
            position: row
            for position, row in there.items()
            if choice is None or choice.matches(position, str(row.get("name")), row.get("serial", -1))
        }
        if not rows:
            known = [(position, row.get("name"), row.get("serial")) for position, row in there.items()]
            raise _no_sensor(str(address), choice, known)
        received, remark = _listen(client, seconds, show)
        if not remark:
            now = _rows(client.ask("describe"))
            if any(now.get(at, {}).get("settings") != row.get("settings") for at, row in rows.items()):
                changed = "The settings were changed while listening"
                remark = f"{changed}: limits and filters here are those of the start."
        events = [str(event.get("event")) for event in client.events if isinstance(event, dict)]
    remarks = [*([remark] if remark else []), *_event_remarks(events)]
    return [
        replace(
            subject(row, row.get("settings"), columns(received, position, imu_units), str(address), position),
            age_p99_us=p99(received.ages_us[position]),
        ).with_remarks(remarks)
        for position, row in rows.items()
    ]


def _rows(description: JsonObject) -> dict[int, dict[str, Any]]:
    return {
        row["sensor"]: row
        for row in untrusted.rows(description.get("sensors"))
        if type(row.get("sensor")) is int and 0 <= row["sensor"] < MOST_PLACES
    }


def _listen(client: Client, seconds: float, show: Callable[..., None]) -> tuple[_Received, str]:
    """What came in `seconds`, and why it ended early, if it did."""
    received = _Received()
    begin = time.monotonic()
    while (passed := time.monotonic() - begin) < seconds:
        show(completed=passed)
        try:
            frames = client.poll(min(_BATCH_S, seconds - passed))
        except ConnectionFailedError as error:
            if not received.all:
                raise
            return received, f"The connection ended after {passed:.1f} s of {seconds:g}: {error}."
        received.all.extend(frames)
        if frames and client.session.same_machine and not frames[-1].flags & NOT_NEW:
            age_us = time.monotonic() * 1e6 - frames[-1].monotonic_ns * 1e-3
            received.ages_us[frames[-1].sensor].append(age_us)
    if not received.all:
        raise ReportError(
            f"nothing was received in {seconds:g} s: check ethercat-sensor watch and the server's log"
        )
    return received, ""
