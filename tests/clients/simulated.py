"""Recordings made in simulated time: the virtual sensor's own samples through the server's own stream.

Nothing waits. Time passes by the polls: as in the server's loop, the sample clock says when the next one is
due, and each wakes a little late, by a seeded amount. A sample costs a fifth of a millisecond of CPU, so what
was simulated once is kept: frames and columns are not to be changed in place.
"""

from __future__ import annotations

import functools
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

from bota_clients.recording.columns import Columns, columns
from bota_clients.report.series import Subject
from bota_ethercat.framing import DataMessage, FrameDecoder
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import SensorInfo
from bota_ethercat.settings import sampling_rate_hz, start_up_defaults
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.ethercat.clock import Clock
from ethercat_server.ethercat.exchange import Exchange
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sensor.sensor import Identity, Sensor
from ethercat_server.virtual_sensor.bus import Bus
from ethercat_server.virtual_sensor.faults import obey
from ethercat_server.virtual_sensor.options import SensorOptions

START_NS = 3_600 * 10**9
STARTED_AT_NS = 1_767_225_600 * 10**9
"""2026-01-01 00:00:00 UTC"""
_EXCHANGE_NS = 40_000


@dataclass(frozen=True)
class Script:
    """What to do to the sensor, and when: commands of the virtual sensor by seconds after the start."""

    commands: tuple[tuple[float, str], ...] = ()
    lost_frames: float = 0.0
    """Part of the exchanges whose frame does not come back."""


@functools.cache
def simulate(
    seconds: float, *commands: str, script: Script = Script(), begin: float = 0.0, **options: Any
) -> tuple[DataMessage, ...]:
    """The frames of so many seconds from `begin` on, when `commands` are given.

    `options` are `SensorOptions`'. In the signal `scene` there is a contact 5 s after power-on.
    """
    sensor = SensorOptions(**{"sinc_length": 64, **options})
    bus = Bus([sensor], START_NS)
    todo = sorted([*((0.0, line) for line in commands), *script.commands])
    chance = random.Random(sensor.seed)
    now = start = START_NS + round(begin * 1e9)
    clock = SimpleNamespace(monotonic_ns=lambda: now, time_ns=lambda: now - START_NS + STARTED_AT_NS)
    life = bus.sensors[0].life
    assert life is not None
    wire = list[bytes]()
    end = start + round(seconds * 1e9)
    round_trip, sent, unanswered = RoundTrip(), now, 0
    settings = {"sinc_length": life.sampler.clock.sinc_length}
    stream = SensorStream(Sensor(0, Identity("", 1, "", ""), settings), round_trip, cast(Clock, clock))
    while now < end:
        while todo and now >= start + todo[0][0] * 1e9:
            answer = obey(bus, todo.pop(0)[1])
            assert answer == "ok", answer
        poll = stream.clock.next_poll_ns(sent, unanswered, in_flight=unanswered > 0)
        sent = max(now, int(poll)) + round(chance.expovariate(1 / 8_000))
        bus.set_time(sent + _EXCHANGE_NS // 2)
        data, now = life.inputs(), sent + _EXCHANGE_NS
        valid = not (script.lost_frames and chance.random() < script.lost_frames)
        made, unanswered = None, unanswered + 1
        if valid:
            made = stream.take(data, exchange := Exchange(sent, now, b"", 3, 0))
            unanswered = 0
            if stream.finish(exchange):
                round_trip.learn(sent, now, now)
                stream.clock.learn(now)
        if made is None and now >= stream.idle_at_ns:
            made = stream.idle(now)
        if made is not None:
            wire.append(made[0])
    decoder, frames = FrameDecoder(), list[DataMessage]()
    decoder.feed(b"".join(wire))
    decoder.take_data(frames)
    return tuple(frames)


def decoded(frames: Sequence[DataMessage], imu_units: ImuUnits = ImuUnits.G_DPS) -> Columns:
    return columns([frame for frame in frames if frame.sensor == 0], imu_units)


def described(sinc_length: int = 64, **settings: Any) -> dict[str, Any]:
    """A row of a reply to `describe`."""
    return {
        "sensor": 0, "name": "BFT-SENS-ECAT-M8", "serial": 4711, "hardware": "RM200V4_6adc", "firmware":
        "1.3.8",
        "pdo_size": 61, "rate_hz": sampling_rate_hz(sinc_length), "state": "OP",
        "settings": {
            **start_up_defaults(), "coordinate_system": False, "inertia_compensation": False,
            "orientation_estimation": False, "sinc_length": sinc_length, **settings,
        },
    }  # fmt: skip


def subject_of(
    frames: Sequence[DataMessage],
    row: Mapping[str, Any] | None = None,
    source: str = "simulated.mcap",
    **kind: Any,
) -> Subject:
    info = SensorInfo.parse(described() if row is None else row)
    assert info is not None
    return Subject(info, decoded(frames, **kind), source)


def sensor(seconds: float, *commands: str, **options: Any) -> Subject:
    """A simulated sensor as a report's subject."""
    frames = simulate(seconds, *commands, **options)
    return subject_of(frames, described(options.get("sinc_length", 64)))
