"""A recording as CSV, for pandas, MATLAB and spreadsheets; and the names of its columns."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import chain, islice
from typing import Final

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.numbers import count
from bota_clients.recording.order import TimeAxis
from bota_clients.recording.reader import Recording
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import Sample, SampleDecoder
from bota_ethercat.program.new_file import NewFile

_SECOND: Final = 1_000_000_000
_BEGIN: Final = 100  # frames
VECTORS: Final = (("force", "N"), ("torque", "Nm"), ("acceleration", "m_s2"), ("angular_rate", "rad_s"))
_FLAGS: Final = (DataFlag.GAP, DataFlag.REPEATED, DataFlag.INVALID)
REGISTERS: Final = (
    "force_torque_saturated", "acceleration_saturated", "angular_rate_saturated", "warnings", "status",
)  # fmt: skip
COLUMNS: Final = (
    "time_s", "stamp_utc", "sensor", "sequence",
    *(f"{name}_{axis}_{unit}" for name, unit in VECTORS for axis in "xyz"),
    "temperature_degC",
    *(f"orientation_{axis}" for axis in "xyzw"),
    *(str(flag.name).lower() for flag in _FLAGS),
    *REGISTERS,
)  # fmt: skip


def new_samples(frames: Iterable[DataMessage], gaps: dict[int, int]) -> Iterator[DataMessage]:
    """Those that are new and valid; a GAP of others is also the next sample's, of which `gaps` knows."""
    for frame in frames:
        flags = frame.flags | gaps.pop(frame.sensor, 0)
        if flags & NOT_NEW:
            gaps[frame.sensor] = flags & DataFlag.GAP
        else:
            yield frame._replace(flags=flags) if flags != frame.flags else frame


def write(options: argparse.Namespace, recording: Recording) -> str:
    """The names, then a line for each sample, into a file; says how many. PdoSizeError."""
    there = {sensor.sensor: sensor.frames for sensor in recording.sensors if sensor.frames}
    if not there or options.sensor not in {None, *there}:
        which = "" if options.sensor is None else f" of sensor {options.sensor}"
        raise RecordingError(f"{recording.path} has no samples{which}")
    decoder = cache(lambda size: SampleDecoder(size, options.imu_units))
    written, axis, first_ns = 0, TimeAxis(), -1
    frames = recording.frames(options.sensor)
    if not options.all:
        frames = new_samples(frames, {})
    # Of several sensors another's may be the earliest.
    begin = [*islice(frames, _BEGIN)]
    moments = [frame.monotonic_ns for frame in begin]
    first_ns = min((each for each in moments if each > moments[0] - _SECOND), default=0)
    with NewFile(options.output, force=options.force) as file:
        file.write(",".join(COLUMNS) + "\n")
        for frame in chain(begin, frames):
            written += 1
            place_ns = axis.place(frame)
            first_ns = place_ns if first_ns < 0 else first_ns
            sample = decoder(len(frame.process_data)).decode(frame.process_data)
            when = f"{(place_ns - first_ns) / _SECOND:.9f},{np.datetime64(frame.stamp_ns, 'ns')}Z"
            file.write(f"{when},{frame.sensor},{frame.sequence},{_values(sample, frame.flags)}\n")
        file.finish()
    left_out = (sum(there.values()) if options.sensor is None else there[options.sensor]) - written
    left = f"; {count(left_out, 'frame')} without a new sample left out" if left_out else ""
    return "; ".join([f"{count(written, 'sample')}{left}", *axis.said])


def _values(sample: Sample, flags: int) -> str:
    # Nine digits keep a REAL32 to the bit.
    reals = ",".join([f"{value:.9g}" for value in (*sample.array, sample.temperature)])
    orientation = ",".join([f"{value:.9g}" for value in sample.orientation or ()]) or ",,,"
    whole = [int(bool(flags & flag)) for flag in _FLAGS] + [getattr(sample, name) for name in REGISTERS]
    return f"{reals},{orientation},{','.join(map(str, whole))}"
