"""What the judge of streams is told of a recorded or received stream."""

from __future__ import annotations

import functools
import operator

import numpy as np

from clients.report.checks.timing import Timing
from clients.report.subjects.series import Ints
from protocol.health.judge import Observation
from protocol.health.limits import LIMITS


def observe(timing: Timing) -> Observation:
    """The whole stream."""
    series, counts = timing.series, timing.counts
    samples, nominal = series.samples, series.nominal_period
    temperatures = samples.temperature[np.isfinite(samples.temperature)]
    coldest = float(temperatures.min()) if len(temperatures) else None
    extreme = coldest if coldest is not None and coldest < LIMITS.coldest else None
    return Observation(
        seconds=series.duration,
        samples=series.count,
        lost=max(timing.lost, counts.missing),
        repeated=counts.repeated,
        invalid=counts.invalid,
        silent_s=float(timing.silences.max()) if len(timing.silences) else 0.0,
        rate_hz=1 / timing.mean_period if timing.judges_intervals else None,
        nominal_hz=1 / nominal if nominal else 0.0,
        age_p99_us=series.subject.age_p99_us,
        not_finite=int(np.sum(timing.not_finite)),
        warnings=_either(samples.warnings),
        force_torque_saturated=_either(samples.force_torque_saturated),
        acceleration_saturated=_either(samples.acceleration_saturated),
        angular_rate_saturated=_either(samples.angular_rate_saturated),
        temperature=extreme if extreme is not None or not len(temperatures) else float(temperatures.max()),
        locked=False if timing.judges_intervals and timing.is_irregular else None,
        settings=series.subject.settings,
    )


def _either(bits: Ints) -> int:
    return functools.reduce(operator.or_, map(int, np.unique(bits)), 0)
