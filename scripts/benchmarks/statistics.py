"""What follows from the records: missing and repeated samples, ages.

The virtual sensor numbers its samples, so this is the truth that `bota_ethercat.accounting` can only infer: a
sample is lost if its number is missing between two that arrived, whoever lost it. Pure functions of arrays;
times are CLOCK_MONOTONIC ns.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scripts.benchmarks.records import COLUMNS

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

_NUMBER_WRAP: Final = 2**24
_INSTANT_WRAP_NS: Final = 2**20 * 1_000_000_000  # where the signal `clock` begins anew
_POINTS: Final = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "min": 0.0, "max": 1.0}


class Arrivals(NamedTuple):
    """What arrived of one sensor, in order of arrival."""

    number: Ints
    instant: Ints
    stamp: Ints  # 0 where the sender gives none
    received: Ints

    @property
    def ages(self) -> Floats:
        """How old each sample was when it arrived, ns; of one that came again, each time."""
        return (self.received - self.instant).astype(np.float64)


def read_arrivals(path: Path) -> list[Arrivals]:
    """A recording, by sensor."""
    return split(np.fromfile(path, dtype=np.int64).reshape(-1, COLUMNS))


def split(records: Ints) -> list[Arrivals]:
    """Records by sensor, with what wraps around in the signal made continuous."""
    found = []
    for position in np.unique(records[:, 0]):
        _, number, instant, stamp, received = records[records[:, 0] == position].T
        # Of the instants that it may be, the latest before the arrival, or just after it.
        wraps = (received - instant + _INSTANT_WRAP_NS // 2) // _INSTANT_WRAP_NS
        found.append(
            Arrivals(
                np.unwrap(number, period=_NUMBER_WRAP), instant + wraps * _INSTANT_WRAP_NS, stamp, received
            )
        )
    return found


def count(arrivals: Arrivals) -> dict[str, int]:
    """Of one sensor: samples from the first to the last that arrived (`made`), and which of them arrived."""
    numbers = np.unique(arrivals.number)
    made, taken = int(numbers[-1] - numbers[0]) + 1, len(arrivals.number)
    lost, repeated = made - len(numbers), taken - len(numbers)
    return {"made": made, "arrivals": taken, "lost": lost, "repeated": repeated}


def spread_us(values_ns: Floats) -> dict[str, float] | None:
    """p50, p99, p999, min and max in microseconds; None if there are no values."""
    if not len(values_ns):
        return None
    points = np.quantile(values_ns, list(_POINTS.values())) / 1000
    return dict(zip(_POINTS, points.round(1).tolist(), strict=True))


def summary(streams: Sequence[Arrivals]) -> tuple[dict[str, Any], Floats]:
    """The figures of all sensors together, and all ages in ns."""
    counts = [count(stream) for stream in streams]
    ages = np.concatenate([stream.ages for stream in streams])
    errors = np.concatenate([(each.stamp - each.instant)[each.stamp != 0] for each in streams]).astype(float)
    figures: dict[str, Any] = {name: sum(each[name] for each in counts) for name in counts[0]}
    figures |= {"age_us": spread_us(ages), "stamp_error_us": None}
    if len(errors):
        p99 = float(np.quantile(np.abs(errors), 0.99)) / 1000
        figures["stamp_error_us"] = {"p99_absolute": round(p99, 1)}
    return figures, ages
