"""Recordings made in simulated time, by a server in memory.

A sample costs a third of a millisecond of CPU, so what was simulated once is kept: frames and columns are not
to be changed in place.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

from bota_clients.recording.columns import Columns, columns
from bota_clients.report.series import Subject
from bota_ethercat.framing import DataMessage
from bota_ethercat.replies import SensorInfo
from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.descriptions import sensor_row
from tests.simulation import Simulation

STARTED_AT_NS = 1_767_225_600 * 10**9
"""2026-01-01 00:00:00 UTC"""


@functools.cache
def simulate(
    seconds: float,
    *commands: str,
    at: tuple[tuple[float, str], ...] = (),
    lost: float = 0.0,
    begin: float = 0.0,
    **options: Any,
) -> tuple[DataMessage, ...]:
    """The frames of so many seconds from `begin` on, when `commands` are given; others `at` their seconds.

    `lost` is the part of the exchanges whose frame does not come back; `options` are `SensorOptions`'. In the
    signal `scene` there is a contact 5 s after power-on.
    """
    options = {"sinc_length": 64, **options}
    sensor = SensorOptions(**options)
    machine = Machine(seed=sensor.seed, lost=lost)
    simulation = Simulation(sensor, machine=machine, settings={"sinc_length": options["sinc_length"]})
    simulation.run(begin)
    for line in commands:
        simulation.command(line)
    for at_s, line in at:
        simulation.at(at_s, line)
    before, moved_ns = len(simulation.frames), STARTED_AT_NS - simulation.clock.time_ns()
    simulation.run(seconds)
    return tuple(each._replace(stamp_ns=each.stamp_ns + moved_ns) for each in simulation.frames[before:])


def subject_of(
    frames: Sequence[DataMessage], row: Mapping[str, Any], source: str = "simulated.mcap"
) -> Subject:
    info = SensorInfo.parse(row)
    assert info is not None
    return Subject(info, [columns(frames)], source)


def whole(subject: Subject) -> Columns:
    """Its frames."""
    (found,) = subject.parts
    return found


def sensor(seconds: float, *commands: str, **options: Any) -> Subject:
    """A simulated sensor as a report's subject."""
    frames = simulate(seconds, *commands, **options)
    return subject_of(frames, sensor_row(sinc_length=options.get("sinc_length", 64)))
