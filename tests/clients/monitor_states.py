"""States of the monitor that are the same every time: made by its model from frames made here."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

from bota_clients.monitor.model import Model, State
from bota_ethercat.control import Event
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import encode
from bota_ethercat.stream.timeline import Timeline
from bota_ethercat.text.json_text import JsonObject
from tests import descriptions
from tests.descriptions import sensor_row

ADDRESS = "localhost:12001"
OWN_PEER = "127.0.0.1:40000"
RATE_HZ = 800
PERIOD_NS = 1_250_000
START_S = 1000.0
SECONDS = 8.0

Values = Mapping[str, float]


def description(names: Sequence[str] = ("BFT-SENS-ECAT-M8",), **settings: Any) -> JsonObject:
    """A reply to `describe`."""
    return descriptions.description(
        *(
            sensor_row(sensor, name=name, serial=1234 + sensor, pdo_size=77, **settings)
            for sensor, name in enumerate(names)
        )
    )


def status(sensors: int = 1, mode: str = "locked", sent: int = 0) -> dict[str, Any]:
    """A reply to `status`; `sent` frames to this client so far."""
    spread = {"p50": 120.0, "p99": 290.0, "p999": 400.0, "max": 900.0}
    row = {
        "fresh": 300_000, "repeated": 0, "invalid": 0, "lost_samples": 2, "recoveries": 0,
        "clock": {"mode": mode, "period_us": 1250.01, "offset_ppm": -4.2, "uncertainty_us": 38.0},
    }  # fmt: skip
    clients = [
        {"peer": "127.0.0.1:51234", "sent": 4 * sent, "withheld": 12},
        {"peer": OWN_PEER, "sent": sent, "withheld": 0},
    ]
    return {
        "cycles": 800_000, "missed_deadlines": 3, "lost_frames": 1, "uptime_s": 4567.0,
        "last_10s": {"wake_us": spread, "exchange_us": spread, "age_us": [spread] * sensors},
        "sensors": [{"sensor": position, **row} for position in range(sensors)], "clients": clients,
    }  # fmt: skip


_TIMELINES: WeakKeyDictionary[Model, Timeline] = WeakKeyDictionary()


def connect(model: Model, described: JsonObject, peer: str, at_s: float) -> None:
    """As the monitor's reader does what a client hands out."""
    model.connected(described, peer, at_s)
    for in_force in _TIMELINES.setdefault(model, Timeline()).connected(described):
        model.tell(in_force, at_s)


def describe(model: Model, described: JsonObject, at_s: float) -> None:
    for in_force in _TIMELINES[model].describe(described):
        model.tell(in_force, at_s)


def happen(model: Model, event: JsonObject, at_s: float) -> None:
    model.add_event(event, at_s)
    for in_force in _TIMELINES[model].event(event):
        model.tell(in_force, at_s)


def process_data(values: Values) -> bytes:
    return encode(77, dict(values))


def moving(k: int) -> dict[str, float]:
    """A tool that swings, and touches something after five seconds."""
    turn = 2 * math.pi * k / (5 * RATE_HZ)
    touch = -18.0 if 5.0 < k / RATE_HZ < 5.4 else 0.0
    return {
        "force.x": 6.2 * math.sin(turn), "force.y": 3.1 * math.cos(turn), "force.z": -8.4 + touch,
        "torque.x": 0.31 * math.cos(turn), "torque.y": 0.12 - touch * 0.01,
        "torque.z": 0.02 * math.sin(3 * turn),
        "acceleration.x": 0.2 * math.sin(turn), "acceleration.y": 0.1, "acceleration.z": 0.97,
        "angular_rate.x": 12.0 * math.cos(turn), "angular_rate.y": 0.5, "angular_rate.z": -3.0,
        "temperature": 34.6,
    }  # fmt: skip


@functools.cache
def _moving_data(k: int) -> bytes:
    return process_data(moving(k))


def frame(k: int, values: Values | None = None, *, sensor: int = 0, flags: int = 0) -> DataMessage:
    """Frame number k of a sensor at 800 Hz."""
    monotonic_ns = round(START_S * 1e9) + k * PERIOD_NS + 1300 * (k * k % 7 - 3)
    data = _moving_data(k) if values is None else process_data(values)
    return DataMessage(k, monotonic_ns, monotonic_ns, sensor, flags, 3, data)


def now(k: int) -> float:
    """The moment at which frame k has come."""
    return START_S + k * PERIOD_NS * 1e-9 + 0.0002


def fed(model: Model, sensors: int, frames: Mapping[int, Values] | None = None) -> float:
    """Feed the model eight seconds, with other values in some frames of sensor 0; the moment it ends."""
    other = frames or {}
    count = round(SECONDS * RATE_HZ)
    for first in range(0, count, 40):
        numbers = range(first, first + 40)
        batch = [
            frame(k, {**moving(k), **other[k]} if k in other and not position else None, sensor=position)
            for k in numbers
            for position in range(sensors)
        ]
        model.add_frames(batch, now(numbers[-1]))
        for last in batch[-sensors:]:
            model.note_age(last, last.monotonic_ns + 190_000 + first * first % 61_000)
    return now(count - 1)


@functools.cache
def healthy() -> State:
    """One sensor, all well."""
    model = Model(ADDRESS)
    connect(model, description(), OWN_PEER, START_S)
    model.add_status(status(), START_S + 6.9)
    end_s = fed(model, 1)
    model.add_status(status(sent=800), START_S + 7.9)
    return model.state(end_s)


@functools.cache
def troubled() -> State:
    """Two sensors: the first is overloaded, too warm now and was out of sync; four frames did not come."""
    model = Model(ADDRESS)
    connect(model, description(("BFT-SENS-ECAT-M8", "BFT-ROKS-ECAT-M8")), OWN_PEER, START_S)
    overload = {"force.z": -412.0, "force_torque_saturated": 4, "warnings": 0b10001}
    frames: dict[int, Values] = {6390: overload, 3000: {"warnings": 0b1000}}
    frames |= {k: {**frames.get(k, {}), "warnings": 0b100000 | int(frames.get(k, {}).get("warnings", 0))}
               for k in range(6000, 6400)}  # fmt: skip
    end_s = fed(model, 2, frames)
    model.add_frames([frame(6405, sensor=0, flags=DataFlag.GAP)], end_s)
    model.add_status(status(2, mode="oversampling"), START_S + 7.9)
    model.say("Sensor 0 is not tared: it is not at rest", bad=True)
    state = model.state(end_s)
    assert state.message is not None
    return replace(state, message=state.message._replace(text=f"12:00:00{state.message.text[8:]}"))


@functools.cache
def gone() -> State:
    """The server is gone for a minute."""
    model = Model(ADDRESS)
    connect(model, description(), OWN_PEER, START_S)
    end_s = fed(model, 1)
    happen(model, {"event": Event.SHUTTING_DOWN}, end_s)
    model.gone("no server answers (Connection refused)", end_s)
    return replace(model.state(end_s + 65), events=())
