"""What follows from the records: missing and repeated samples, which of them the machine lost, ages.

The virtual sensor numbers its samples, so this is the truth that `protocol.accounting` can only infer: a
sample is lost if its number is missing between two that arrived, whoever lost it. It is lost to a stop of the
machine if a canary slept longer than a sample period (`stops`) and that covers at least half of the time for
which the sample was the sensor's newest. Pure functions of arrays; times are CLOCK_MONOTONIC ns.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scripts.benchmarks.records import COLUMNS

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

_NUMBER_WRAP: Final = 2**24
_INSTANT_WRAP_NS: Final = 2**20 * 1_000_000_000  # where the signal `clock` begins anew
_QUANTILES: Final = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
COVERED: Final = 0.5  # the part of a sample's period that must be a stop for the sample to be lost to it


class Arrivals(NamedTuple):
    """What arrived of one sensor, in order of arrival."""

    number: Ints
    instant: Ints
    stamp: Ints
    """0 where the sender gives none."""
    received: Ints


class Counts(NamedTuple):
    """How many of the samples that the sensor made have arrived."""

    made: int
    """Samples from the first to the last that arrived."""
    arrivals: int
    lost: int
    lost_in_stops: int
    """Of the lost: those lost while the machine stopped."""
    repeated: int
    """Arrivals of a sample that had arrived before."""


def read_numbers(path: Path, columns: int) -> Ints:
    """A file of whole numbers as rows of `columns`."""
    return np.fromfile(path, dtype=np.int64).reshape(-1, columns)


def read_arrivals(path: Path) -> list[Arrivals]:
    """A recording, by sensor."""
    return split(read_numbers(path, COLUMNS))


def split(records: Ints) -> list[Arrivals]:
    """Records by sensor, with what wraps around in the signal made continuous."""
    found = []
    for position in np.unique(records[:, 0]):
        _, number, instant, stamp, received = records[records[:, 0] == position].T
        half = _NUMBER_WRAP // 2
        steps = (np.diff(number) + half) % _NUMBER_WRAP - half
        number = np.concatenate((number[:1], number[:1] + np.cumsum(steps)))
        # Of the instants that it may be, the latest before the arrival, or just after it.
        instant = (
            instant + (received - instant + _INSTANT_WRAP_NS // 2) // _INSTANT_WRAP_NS * _INSTANT_WRAP_NS
        )
        found.append(Arrivals(number, instant, stamp, received))
    return found


def stops(pauses: Iterable[Ints], period_ns: float) -> Ints:
    """The pauses in which a canary slept longer than a sample period, overlapping ones made one."""
    merged: list[list[int]] = []
    long = [row for rows in pauses for row in rows.tolist() if row[1] - row[0] > period_ns]
    for start, end in sorted(long):
        if merged and start <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], end)
        else:
            merged.append([start, end])
    return np.array(merged, dtype=np.int64).reshape(-1, 2)


def count(arrivals: Arrivals, period_ns: float, stopped: Ints) -> Counts:
    """Count what is missing and what came twice."""
    numbers, first = np.unique(arrivals.number, return_index=True)
    if not len(numbers):
        return Counts(0, 0, 0, 0, 0)
    made = int(numbers[-1] - numbers[0]) + 1
    missing = np.setdiff1d(np.arange(numbers[0], numbers[-1] + 1), numbers, assume_unique=True)
    born = np.interp(missing, numbers, arrivals.instant[first] - arrivals.instant[0]) + arrivals.instant[0]
    return Counts(
        made=made,
        arrivals=len(arrivals.number),
        lost=len(missing),
        lost_in_stops=int(np.count_nonzero(covered(born, period_ns, stopped) >= COVERED)),
        repeated=len(arrivals.number) - len(numbers),
    )


def covered(born: Floats, period_ns: float, stopped: Ints) -> Floats:
    """Which part of the period that begins at each of `born` was a stop."""
    part = np.zeros(len(born))
    for start, end in stopped:
        overlap = np.minimum(born + period_ns, end) - np.maximum(born, start)
        part += np.clip(overlap, 0, None) / period_ns
    return part


def ages(arrivals: Arrivals) -> Floats:
    """How old each sample was when it arrived, ns; of one that came again, each time."""
    return (arrivals.received - arrivals.instant).astype(np.float64)


def stamp_errors(arrivals: Arrivals) -> Floats:
    """The sender's time of each sample minus the true one, ns; empty if it gives none."""
    given = arrivals.stamp != 0
    errors: Floats = (arrivals.stamp - arrivals.instant)[given].astype(np.float64)
    return errors


def spread_us(values_ns: Floats) -> dict[str, float] | None:
    """p50, p99, p999, min and max in microseconds; None if there are no values."""
    if not len(values_ns):
        return None
    figures = {name: float(np.quantile(values_ns, q)) for name, q in _QUANTILES.items()}
    figures["min"], figures["max"] = float(np.min(values_ns)), float(np.max(values_ns))
    return {name: round(value / 1000, 1) for name, value in figures.items()}


def summary(streams: list[Arrivals], period_ns: float, stopped: Ints) -> tuple[dict[str, Any], Floats]:
    """One chain's figures, all sensors together, and its ages."""
    counts = [count(stream, period_ns, stopped) for stream in streams]
    all_ages = np.concatenate([ages(stream) for stream in streams] or [np.empty(0)])
    errors = np.concatenate([stamp_errors(stream) for stream in streams] or [np.empty(0)])
    figures: dict[str, Any] = dict(zip(Counts._fields, map(sum, zip(*counts, strict=True)), strict=True))
    figures |= {"age_us": spread_us(all_ages), "stamp_error_us": None}
    if len(errors):
        figures["stamp_error_us"] = {
            "p50": round(float(np.median(errors)) / 1000, 1),
            "p99_absolute": round(float(np.quantile(np.abs(errors), 0.99)) / 1000, 1),
        }
    return figures, all_ages
