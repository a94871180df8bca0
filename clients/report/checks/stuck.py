"""Does a channel keep its value while the sensor continues to sample?

Force and torque come from high-resolution converters through a matrix, so successive values are hardly ever
equal. The values of the IMU are steps of a coarser converter behind a filter that may be slow, so they have
more time. Saturated samples do not count: they have their own check.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from clients.numbers import count, figure, listing, seconds
from clients.report.checks.channels import CHANNELS, Channel
from clients.report.checks.check import Check
from clients.report.checks.timing import too_few
from clients.report.subjects.series import Series
from protocol.health.verdict import Level

_LONGEST_S: Final = 0.1
_LONGEST_SAMPLES: Final = 16
_IMU_LONGEST_S: Final = 5.0
_WHOLE: Final = 0.9
"""A channel that is constant for this share of a short recording is stuck too."""
_SHORTEST_S: Final = 1.0
"""Shorter recordings say nothing about the IMU."""
NAME: Final = "Stuck values"


class Run(NamedTuple):
    """The longest stretch in which one channel had the same value."""

    channel: Channel
    samples: int
    begin_s: float
    length_s: float
    value: float

    def is_stuck(self, duration_s: float) -> bool:
        """Whether a healthy sensor does not do that; `duration_s` is that of the recording."""
        if self.channel.group.is_imu:
            return self.length_s > min(_IMU_LONGEST_S, max(_WHOLE * duration_s, _SHORTEST_S))
        return self.samples > _LONGEST_SAMPLES and self.length_s > _LONGEST_S


def longest_runs(series: Series) -> list[Run]:
    """One for each channel."""
    return [_longest(series, index, channel) for index, channel in enumerate(CHANNELS)]


def _longest(series: Series, index: int, channel: Channel) -> Run:
    values, time = series.values[:, index], series.time
    if not series.count:
        return Run(channel, 0, 0.0, 0.0, 0.0)
    # Values that are saturated or not finite belong to other checks: each is a run of its own.
    apart = ~series.finite[:, index] | series.saturated[:, index]
    changed = (values[1:] != values[:-1]) | apart[1:] | apart[:-1] | (np.diff(time) <= 0)
    starts = np.concatenate(([0], np.flatnonzero(changed) + 1))
    ends = np.concatenate((starts[1:], [series.count])) - 1
    longest = int(np.argmax(time[ends] - time[starts]))
    start, end = int(starts[longest]), int(ends[longest])
    return Run(
        channel, end - start + 1, float(time[start]), float(time[end] - time[start]), float(values[start])
    )


def check(series: Series) -> Check:
    """Do the values of every channel change?"""
    if not series.count:
        return too_few(NAME, 0)
    if series.duration < _SHORTEST_S:
        found = f"The recording is only {seconds(series.duration)} long."
        return Check(NAME, Level.NOT_POSSIBLE, found, "", "Record for at least 10 s.")
    runs = [run for run in longest_runs(series) if not (run.channel.group.is_imu and series.imu_off)]
    stuck = [run for run in runs if run.is_stuck(series.duration)]
    if stuck:
        texts = [
            f"{run.channel.title} was constant at {figure(run.value, 5)} {run.channel.group.unit} for "
            f"{seconds(run.length_s)} "
            f"({run.samples} samples) from {seconds(run.begin_s)} on"
            for run in stuck
        ]
        return Check(
            NAME, Level.TROUBLE, f"{listing(texts)}.", "The channel does not measure.",
            "Power-cycle the sensor. If it persists, it needs repair.",
        )  # fmt: skip
    longest = max((run for run in runs if not run.channel.group.is_imu), key=lambda run: run.samples)
    run = count(longest.samples, "sample")
    return Check(
        NAME, Level.GOOD, f"No channel is stuck; the longest constant run of a force or torque is {run}."
    )
