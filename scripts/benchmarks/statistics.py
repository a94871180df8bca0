"""What follows from the records: missing samples, ages.

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
_POINTS: Final = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


class Arrivals(NamedTuple):
    """What arrived of one sensor, in order of arrival."""

    number: Ints
    instant: Ints
    stamp: Ints  # 0 where the sender gives none
    received: Ints

    @property
    def ages(self) -> Floats:
        """How old each sample was when it arrived first, ns."""
        first = np.unique(self.number, return_index=True)[1]
        return (self.received - self.instant)[first].astype(np.float64)


def read_arrivals(path: Path) -> list[Arrivals]:
    """A recording, by sensor, with what wraps around in the signal made continuous."""
    records, found = np.fromfile(path, dtype=np.int64).reshape(-1, COLUMNS), []
    for position in np.unique(records[:, 0]):
        _, number, instant, stamp, received = records[records[:, 0] == position].T
        # Of the instants that it may be, the latest before the arrival, or just after it.
        wraps = (received - instant + _INSTANT_WRAP_NS // 2) // _INSTANT_WRAP_NS
        number, instant = unwrap(number), instant + wraps * _INSTANT_WRAP_NS
        found.append(Arrivals(number, instant, stamp, received))
    return found


def count(arrivals: Arrivals) -> dict[str, int]:
    """Of one sensor: samples from the first to the last that arrived; those that did not, or came again."""
    made, lost = span(arrivals.number)
    return {"made": made, "lost": lost, "repeated": len(arrivals.number) - (made - lost)}


def span(numbers: Ints) -> tuple[int, int]:
    """How many samples there are from the first number to the last, and how many of them are missing."""
    if not len(numbers):
        return 0, 0
    present = np.unique(numbers)
    made = int(present[-1] - present[0]) + 1
    return made, made - len(present)


def unwrap(numbers: Sequence[int] | Ints) -> Ints:
    """Numbers of samples, made continuous where those of the signal begin anew."""
    return np.unwrap(np.array(numbers, dtype=np.int64), period=_NUMBER_WRAP).astype(np.int64)


def lost_by_end(subscribers: Sequence[Arrivals], clients: Sequence[Arrivals]) -> dict[str, int]:
    """What a subscriber lost while a client recorded at the same server, too, of each sensor.

    Lost at the server, or before it, is what neither has; lost after it what the client alone has.
    """
    lost = {"lost_at_server": 0, "lost_after_server": 0}
    for subscriber, client in zip(subscribers, clients, strict=True):
        ours, theirs = subscriber.number, client.number
        begin, end = max(ours.min(), theirs.min()), min(ours.max(), theirs.max())
        here, there = (np.unique(each[(begin <= each) & (each <= end)]) for each in (ours, theirs))
        either = np.union1d(here, there)
        lost["lost_at_server"] += max(0, int(end - begin) + 1) - len(either)
        lost["lost_after_server"] += len(either) - len(here)
    return lost


def spread_us(values_ns: Floats) -> dict[str, float]:
    """p50, p99, p999 in microseconds."""
    points = np.quantile(values_ns, list(_POINTS.values())) / 1000
    return dict(zip(_POINTS, points.round(1).tolist(), strict=True))


def summary(streams: Sequence[Arrivals]) -> tuple[dict[str, Any], Floats]:
    """The figures of all sensors together, and all ages in ns."""
    counts = [count(stream) for stream in streams]
    ages = np.concatenate([stream.ages for stream in streams])
    errors = np.concatenate([(each.stamp - each.instant)[each.stamp != 0] for each in streams])
    figures: dict[str, Any] = {name: sum(each[name] for each in counts) for name in counts[0]}
    figures |= {"age_us": spread_us(ages)}
    if len(errors):
        figures["stamp_error_us"] = {"p99": round(float(np.quantile(np.abs(errors), 0.99)) / 1000, 1)}
    return figures, ages
