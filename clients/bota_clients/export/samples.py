"""What `ethercat-export RECORDING run.parquet` does: all samples as columns of numbers, one row a sample.

Names and units are those of the CSV, places of lost samples and the compensated wrench those of `Windows`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from bota_clients.errors import NothingAskedForError, RecordingError
from bota_clients.export.csv_table import AXES, VECTORS
from bota_clients.export.windows import Array, Arrays, Windows, interpolated
from bota_clients.recording.columns import RECORD, REGISTERS, Columns, joined
from bota_clients.recording.reader import Recording
from bota_ethercat.framing import DataFlag

MOST_LOST: Final = 100_000  # rows of one gap
# By how much the wall clock goes otherwise than CLOCK_MONOTONIC between two samples unless it was set.
_STEP_NS: Final = 1_000_000
_SLEW: Final = 0.001


def samples_of(recording: Recording, windows: Windows, sensor: int = 0) -> Iterator[Arrays]:
    """Blocks of rows, with the places and the compensated wrench of `windows`, of a length of `MOST_LOST`.

    RecordingError.
    """
    batches, held = recording.batches(sensor, windows.imu_units, is_whole=True), Columns.empty(0)
    begin, taken = 0, 0  # samples: number of the first that is held, and how many were taken
    for samples in itertools.chain(windows.follow(batches), [None]):
        if samples is not None:
            held = joined([held, samples])
        slots = windows.take(rest=samples is None)
        if not len(slots):
            continue
        is_with_tool = windows.stream is not None
        yield _rows(slots, held, slots["number"] - begin, windows.begin_ns, tool=is_with_tool)
        taken = int(slots["number"].max(initial=taken - 1)) + 1
        keep = max(taken - 1, 0)  # lost samples that follow are between this one and the next
        held, begin = held.where(slice(keep - begin, None)), keep
    if not taken:
        raise RecordingError(f"{recording.path} has no new and valid samples")


def in_part(recording: Recording, windows: Windows, blocks: Iterator[Arrays]) -> Iterator[Arrays]:
    """Of blocks of the whole the rows of the part that is asked for; RecordingError if there are none.

    So the filters of the compensation have seen what came before it.
    """
    rows = 0
    for block in blocks:
        stamps = block["stamp_ns" if "stamp_ns" in block else "stamp_utc"].astype(np.int64)
        held = recording.asked.holds(stamps, block["monotonic_ns"] - windows.begin_ns)
        rows += int(held.sum())
        if held.any():
            yield block if held.all() else {name: array[held] for name, array in block.items()}
    if not rows:
        raise NothingAskedForError(f"{recording.path} has nothing to export {recording.asked.part}")


def _rows(slots: Array, samples: Columns, index: Array, first_ns: int, *, tool: bool) -> Arrays:
    """Of each slot, by the index of its sample; negative: it was lost."""
    is_lost = slots["number"] < 0
    index, any_lost = np.where(is_lost, 0, index), bool(is_lost.any())

    def column(name: str, lost: Any = np.nan) -> Array:
        values = getattr(samples, name)[index]
        if any_lost:
            values[is_lost] = lost
        return np.asarray(values)

    monotonic_ns = slots["monotonic_ns"]
    stamp = samples.stamp_ns[index].view("datetime64[ns]")
    if any_lost:
        at, here, there = monotonic_ns[is_lost], samples.monotonic_ns, samples.stamp_ns
        passed, stamped = np.diff(here), np.diff(there)
        is_set = np.append(False, abs(stamped - passed) > _STEP_NS + _SLEW * passed)
        stamp[is_lost] = interpolated(at, here, there).view("datetime64[ns]")
        behind = np.minimum(np.searchsorted(here, monotonic_ns), len(here) - 1)
        stamp[is_lost & is_set[behind]] = np.datetime64("NaT")
    found: Arrays = {
        "time_s": (monotonic_ns - first_ns) * 1e-9, "stamp_utc": stamp, "monotonic_ns": monotonic_ns,
        "sequence": slots["sequence"], "valid": slots["valid"][:, 0],
    }  # fmt: skip
    found |= zip(AXES, np.hstack([column(name) for name in VECTORS], dtype=np.float32).T, strict=True)
    if tool:
        wrench = np.where(found["valid"][:, np.newaxis], slots["compensated"], np.nan)
        found["compensated_valid"] = np.asarray(np.isfinite(wrench).all(axis=1))
        found |= {f"compensated_{name}": part for name, part in zip(AXES, wrench.T, strict=False)}
        force, torque = np.where(found["compensated_valid"], slots["bounds"].T, np.nan).astype(np.float32)
        found |= {"compensated_force_bound_N": force, "compensated_torque_bound_Nm": torque}
    found["temperature_degC"] = column("temperature").astype(np.float32)
    turned = column("orientation").astype(np.float32)
    found |= {f"orientation_{axis}": part for axis, part in zip("xyzw", turned.T, strict=True)}
    found["gap"] = np.asarray(column("flags", 0) & int(DataFlag.GAP), bool)
    return found | {name: column(name, 0).astype(RECORD[name]) for name in REGISTERS}
