"""The offset that the sensor itself adds to every sample (object 0x8000), where it changes in a recording.

The server reports a change once all six numbers are written, which takes some exchanges: samples shortly
before that have some of them.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.recording.columns import Columns, columns, joined
from bota_clients.recording.reader import RecordedSensor, Recording
from bota_ethercat.pdo import ImuUnits

# Writing one takes twelve requests, each of one or two exchanges, or a few ms of a real mailbox.
_DOUBT_S, _DOUBT_PERIODS = 0.1, 24
DOUBT_AFTER: Final = 2  # sample periods: one may have been measured before the last number was written


def doubt_ns(rate_hz: float) -> int:
    """How long before a change was reported samples may have part of it."""
    return round(max(_DOUBT_S, _DOUBT_PERIODS / rate_hz) * 1e9)


def at_last_offset(
    recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits
) -> tuple[Columns, tuple[float, ...] | None]:
    """A sensor's columns as if its last offset had been in force all the time, and that offset.

    Without the samples in which a change was being written. None: the recording does not say the offset.
    RecordingError if it says so in part only.
    """
    told = [row.offset for row in sensor.offsets]
    if not told or set(told) == {None}:
        return columns(recording.frames(sensor.sensor), imu_units), None
    if None in told:
        raise RecordingError(
            f"{recording.path}: the own offset of sensor {sensor.sensor} is not known all the time: record "
            "from one server"
        )
    last = np.array(told[-1])
    parts, in_doubt, before = list[Columns](), list[tuple[int, int]](), last
    for info, batch in recording.batches(sensor.sensor):
        part, shift = columns(batch, imu_units), last - info.offset
        if parts and (shift != before).any():
            at_ns, rate_hz = batch[0].monotonic_ns, info.rate_hz or 1.0
            in_doubt.append((at_ns - doubt_ns(rate_hz), at_ns + round(DOUBT_AFTER * 1e9 / rate_hz)))
        part.force[:] += shift[:3]
        part.torque[:] += shift[3:]
        parts.append(part)
        before = shift
    found = joined(parts)
    is_sure = np.ones(len(found), bool)
    for begin_ns, end_ns in in_doubt:
        is_sure &= (found.monotonic_ns < begin_ns) | (found.monotonic_ns > end_ns)
    return found.where(is_sure), told[-1]
