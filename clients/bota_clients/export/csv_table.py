"""A recording as CSV, for pandas, MATLAB and spreadsheets; and the names of its columns."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Final

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.numbers import count
from bota_clients.recording.columns import REGISTERS, Columns, Ints, NewSamples, Table, Whole
from bota_clients.recording.order import TimeAxis
from bota_clients.recording.reader import Recording
from bota_ethercat.framing import DataFlag
from bota_ethercat.program.new_file import NewFile

_SECOND: Final = 1_000_000_000
_BEGIN: Final = 100  # frames
VECTORS: Final = {"force": "N", "torque": "Nm", "acceleration": "m_s2", "angular_rate": "rad_s"}
AXES: Final = [f"{name}_{axis}_{unit}" for name, unit in VECTORS.items() for axis in "xyz"]
_FLAGS: Final = (DataFlag.GAP, DataFlag.REPEATED, DataFlag.INVALID)
COLUMNS: Final = (
    "time_s", "stamp_utc", "sensor", "sequence",
    *AXES,
    "temperature_degC",
    *(f"orientation_{axis}" for axis in "xyzw"),
    *(str(flag.name).lower() for flag in _FLAGS),
    *REGISTERS,
)  # fmt: skip
# Nine digits keep a REAL32 to the bit.
_ORIENTATION: Final = ",".join(["%.9g"] * 4)
_WHOLE: Final = ["%d"] * (len(_FLAGS) + len(REGISTERS))
_LINE: Final = ",".join(["%.9f,%sZ,%d,%d", *["%.9g"] * 13, "%s", *_WHOLE]) + "\n"


def write(options: argparse.Namespace, recording: Recording) -> str:
    """The names, then a line for each sample, into a file; says how many. PdoSizeError."""
    there = {sensor.sensor: sensor.frames for sensor in recording.sensors if sensor.frames}
    if not there or options.sensor not in {None, *there}:
        which = "" if options.sensor is None else f" of sensor {options.sensor}"
        raise RecordingError(f"{recording.path} has no samples{which}")
    rows, strays, axis, first_ns, new = 0, 0, TimeAxis(), -1, NewSamples()
    with NewFile(options.output, force=options.force) as file:
        file.write(",".join(COLUMNS) + "\n")
        tables = recording.tables(options.sensor, is_whole=True)
        for table in (each for each in tables if isinstance(each, np.ndarray)):
            sensors = [] if options.all else np.unique(table["sensor"]).tolist()
            flags, is_kept = table["flags"].copy(), np.ones(len(table), bool)
            for sensor in sensors:
                own = table["sensor"] == sensor
                is_kept[own], flags[own] = new.among(flags[own], sensor)
            kept, flags = table[is_kept], flags[is_kept]
            found = Columns.of(kept, options.imu_units)
            if first_ns < 0 and len(found):  # of several sensors another's may be the earliest
                moments = found.monotonic_ns[:_BEGIN]
                first_ns = int(moments[moments > moments[0] - _SECOND].min())
            places = axis.places(found.monotonic_ns, found.stamp_ns)
            held = recording.asked.holds(found.stamp_ns, places - first_ns)
            is_later = np.ones(len(kept), bool)
            for sensor in sensors:
                own = kept["sensor"] == sensor
                is_later[own] = axis.is_later(places[own], sensor)
            strays, held = strays + int((held & ~is_later).sum()), held & is_later
            written = _lines(kept[held], found.where(held), flags[held], places[held], first_ns)
            file.write("".join(written))
            rows += int(held.sum())
        file.finish()
    left_out = sum(there[each] for each in there if options.sensor in (None, each)) - rows - strays
    left = f"; {count(left_out, 'frame')} without a new sample left out" if left_out > 0 else ""
    return "; ".join([f"{count(rows, 'sample')}{left}", *axis.said])


def _lines(table: Table, samples: Columns, flags: Whole, places: Ints, first_ns: int) -> Iterator[str]:
    reals = np.column_stack([*(getattr(samples, name) for name in VECTORS), samples.temperature])
    turned = ["," * 3] * len(samples)
    for row in np.flatnonzero(~np.isnan(samples.orientation).all(axis=1)).tolist():
        turned[row] = _ORIENTATION % (*samples.orientation[row].tolist(),)
    marks = [((flags & int(flag)) != 0).astype(int).tolist() for flag in _FLAGS]
    times = [place / _SECOND for place in (places - first_ns).tolist()]
    stamps = np.datetime_as_string(samples.stamp_ns.view("datetime64[ns]")).tolist()
    columns = [table["sensor"].tolist(), table["sequence"].tolist(), *reals.T.tolist(), turned, *marks]
    columns += [table[name].tolist() for name in REGISTERS]
    return map(_LINE.__mod__, zip(times, stamps, *columns, strict=True))
