"""Does a channel stand still while the sensor goes on sampling?

Force and torque come from converters of many bits through a matrix: successive values are never the same for
long. The IMU's values are whole steps of a coarser converter behind a filter that may be slow, so they get
more time. Stretches in which the channel is saturated do not count: that has its own check.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from clients.report.channels import CHANNELS, Channel
from clients.report.check import Check, Level
from clients.report.series import Series
from clients.report.timing import too_few
from clients.report.words import count, figure, listing, seconds

_LONGEST_S: Final = 0.1
_LONGEST_SAMPLES: Final = 16
_IMU_LONGEST_S: Final = 5.0
_WHOLE: Final = 0.9
"""A channel that stands still for this part of a short recording is stuck too."""
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
    return [_longest(series, place, channel) for place, channel in enumerate(CHANNELS)]


def _longest(series: Series, place: int, channel: Channel) -> Run:
    values, time = series.values[:, place], series.time
    if not series.count:
        return Run(channel, 0, 0.0, 0.0, 0.0)
    # Not a number, infinite and saturated values are other checks' business: each is a run of its own.
    apart = ~series.finite[:, place] | series.saturated[:, place]
    changed = (values[1:] != values[:-1]) | apart[1:] | apart[:-1] | (np.diff(time) <= 0)
    starts = np.concatenate(([0], np.flatnonzero(changed) + 1))
    ends = np.concatenate((starts[1:], [series.count])) - 1
    longest = int(np.argmax(time[ends] - time[starts]))
    start, end = int(starts[longest]), int(ends[longest])
    return Run(
        channel, end - start + 1, float(time[start]), float(time[end] - time[start]), float(values[start])
    )


def check(series: Series) -> Check:
    """Does every channel move?"""
    if not series.count:
        return too_few(NAME, 0)
    if series.duration < _SHORTEST_S:
        found = f"The recording is only {seconds(series.duration)} long."
        return Check(NAME, Level.NOT_POSSIBLE, found, "", "Record for at least 10 s.")
    runs = [run for run in longest_runs(series) if not (run.channel.group.is_imu and series.imu_off)]
    stuck = [run for run in runs if run.is_stuck(series.duration)]
    if stuck:
        texts = [
            f"{run.channel.title} stood at {figure(run.value, 5)} {run.channel.group.unit} for "
            f"{seconds(run.length_s)} "
            f"({run.samples} samples) from {seconds(run.begin_s)} on"
            for run in stuck
        ]
        return Check(
            NAME, Level.FAULT, f"{listing(texts)}.", "What is measured there does not come through.",
            "Switch the sensor off and on. If it is the same, it has to be repaired.",
        )  # fmt: skip
    longest = max((run for run in runs if not run.channel.group.is_imu), key=lambda run: run.samples)
    run = count(longest.samples, "sample")
    return Check(NAME, Level.OK, f"No channel stands still; the longest run of one force or torque is {run}.")
