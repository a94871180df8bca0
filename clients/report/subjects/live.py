"""Subjects from some seconds of a server's stream."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Final

from clients.errors import ReportError
from clients.recording.columns import columns
from clients.report.subjects.recorded import event_remarks, no_sensor
from clients.report.subjects.subject import Subject, subject
from protocol.accounting import NOT_NEW
from protocol.address import Address
from protocol.client import Client
from protocol.errors import ConnectionFailedError
from protocol.framing import DataMessage
from protocol.health.observer import p99
from protocol.pdo import ImuUnits
from protocol.sensor_choice import MOST_PLACES, SensorChoice
from protocol.text import untrusted
from protocol.text.json_text import JsonObject

_BATCH_S: Final = 0.05
_MOST_AGES: Final = 1 << 16

MOST_FRAMES: Final = 4_000_000
"""About half an hour at 1600 Hz; more than that is what a recording is for."""


class Received:
    """Frames in order of arrival."""

    def __init__(self) -> None:
        self.all: deque[DataMessage] = deque(maxlen=MOST_FRAMES)
        self.ages_us: dict[int, deque[float]] = {}
        """By sensor, of the samples that were waited for."""

    def take(self, frames: Sequence[DataMessage], now_ns: int | None) -> None:
        """Add what came just now; `now_ns` is CLOCK_MONOTONIC if it is the server's too."""
        self.all.extend(frames)
        if frames and now_ns is not None and not frames[-1].flags & NOT_NEW:
            ages_us = self.ages_us.setdefault(frames[-1].sensor, deque(maxlen=_MOST_AGES))
            ages_us.append((now_ns - frames[-1].monotonic_ns) * 1e-3)

    def frames(self, sensor: int | None = None) -> Iterable[DataMessage]:
        """The frames of the sensor at this position, or of all."""
        return (frame for frame in self.all if sensor in (None, frame.sensor))


def subjects(
    address: Address,
    seconds: float,
    choice: SensorChoice | None,
    imu_units: ImuUnits,
    progress: Callable[[float], None] = lambda _: None,
) -> list[Subject]:
    """The server's sensors, or those chosen, after `seconds`.

    ConnectionFailedError or RefusedError if there is no stream; ReportError if there is no such sensor.
    """
    with Client(address.port, address.host, fresh_only=False, raw=True, reconnect=False).connect() as client:
        rows = _chosen(client.description, address, choice)
        received, ended = _listen(client, seconds, progress)
        names = [str(event.get("event")) for event in client.events if isinstance(event, dict)]
        changed = "" if ended else _changed(client, rows)
    remarks = [*([ended] if ended else []), *([changed] if changed else []), *event_remarks(names)]
    return [
        replace(
            subject(row, row.get("settings"), columns(received, position, imu_units), str(address), position),
            age_p99_us=p99(received.ages_us.get(position, ())),
        ).with_remarks(remarks)
        for position, row in rows.items()
    ]


def _rows(description: JsonObject) -> dict[int, dict[str, Any]]:
    return {
        row["sensor"]: row
        for row in untrusted.rows(description.get("sensors"))
        if type(row.get("sensor")) is int and 0 <= row["sensor"] < MOST_PLACES
    }


def _chosen(
    description: JsonObject, address: Address, choice: SensorChoice | None
) -> dict[int, dict[str, Any]]:
    rows = _rows(description)
    found = {
        position: row
        for position, row in rows.items()
        if choice is None or choice.matches(position, str(row.get("name")), row.get("serial", -1))
    }
    if not found:
        there = [(position, row.get("name"), row.get("serial")) for position, row in rows.items()]
        raise no_sensor(str(address), choice, there)
    return found


def _listen(client: Client, seconds: float, progress: Callable[[float], None]) -> tuple[Received, str]:
    """The frames of `seconds`, and why they ended early, if they did."""
    received = Received()
    begin, same_clock = time.monotonic(), client.session.same_machine
    while (passed := time.monotonic() - begin) < seconds:
        progress(passed)
        try:
            frames = client.poll(min(_BATCH_S, seconds - passed))
            received.take(frames, round(time.monotonic() * 1e9) if same_clock else None)
        except ConnectionFailedError as error:
            if not received.all:
                raise
            return received, f"The connection ended after {passed:.1f} s of {seconds:g}: {error}."
    if not received.all:
        raise ReportError(
            f"nothing was received in {seconds:g} s: check ethercat-sensor watch and the server's log"
        )
    return received, ""


def _changed(client: Client, rows: dict[int, dict[str, Any]]) -> str:
    now = _rows(client.ask("describe"))
    if any(now.get(position, {}).get("settings") != row.get("settings") for position, row in rows.items()):
        return "The settings were changed while listening: limits and filters here are those of the start."
    return ""
