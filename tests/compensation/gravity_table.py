"""The table in docs/compensation.md: the error of each estimator of gravity, by kind of move, simulated."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from tests.compensation.estimators import ESTIMATORS, Found
from tests.compensation.moves import HEALTHY, feel, moves

RATE_HZ: Final = 400.0
SEEDS: Final = 2
Row = tuple[str, list[tuple[float, float]]]
"""Kind of move; for each estimator root mean square and largest tilt, degrees."""


def figures(found: Iterable[Found]) -> tuple[float, float]:
    """Root mean square and largest tilt, degrees, of all samples with an answer."""
    error = np.concatenate([each.error for each in found])
    return float(np.degrees(np.sqrt(np.nanmean(error**2)))), float(np.degrees(np.nanmax(error)))


def table() -> Sequence[Row]:
    """A row for each kind of move, and one for all."""
    felt = [
        (move.kind, feel(move, RATE_HZ, seed, HEALTHY))
        for seed, move in enumerate(move for move in moves() for _ in range(SEEDS))
    ]
    found = {name: [(kind, estimate(each)) for kind, each in felt] for name, estimate in ESTIMATORS.items()}
    kinds = dict.fromkeys(kind for kind, _ in felt)
    rows = [
        (kind, [figures(each for its, each in every if its == kind) for every in found.values()])
        for kind in kinds
    ]
    return [*rows, ("all", [figures(each for _, each in every) for every in found.values()])]


def lines(rows: Sequence[Row]) -> list[str]:
    """As Markdown."""
    head = ["| Tilt, rms/worst, ° | " + " | ".join(ESTIMATORS) + " |", "|---|" + "---|" * len(ESTIMATORS)]
    return head + [
        f"| {kind} | " + " | ".join(f"{rms:.2f}/{worst:.1f}" for rms, worst in cells) + " |"
        for kind, cells in rows
    ]
