"""The frames of a subject as the checks want them: new and valid samples on a time axis, and what is between.

Worked out once. A sample is a frame that is neither REPEATED nor INVALID. Times are seconds of
CLOCK_MONOTONIC since the first frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from clients.recording.columns import Columns
from clients.report.checks.channels import CHANNELS
from clients.report.subjects.subject import Subject
from protocol.framing import DataFlag

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

_LONGER: Final = 1.5
"""An interval of more than this many periods has room for a lost sample."""
_SURELY_LONGER: Final = 2.5
"""One of more than this has lost some whether they are marked or not."""
_SHORT: Final = 0.75
"""An interval shorter than this follows one that a late stamp made too long."""
_COVERED_PERIODS: Final = 4
_COVERED_S: Final = 0.01
"""A frame without a sample tells of a silence as far as this, or `_COVERED_PERIODS`, from a sample, ..."""
_COVERED_BETWEEN_S: Final = 0.1
"""... and as far as this from the next such frame: the server looks less often after a sensor it has lost."""


@dataclass(frozen=True)
class Series:
    """Samples of one subject; n samples."""

    subject: Subject

    @cached_property
    def frames(self) -> Columns:
        """Every frame, also those that are no samples."""
        return self.subject.columns

    @cached_property
    def samples(self) -> Columns:
        """The n samples."""
        return self.frames.where(self.frames.fresh)

    @property
    def count(self) -> int:
        """n."""
        return len(self.samples)

    @cached_property
    def frame_time(self) -> Floats:
        """Of every frame, s since the first."""
        moments = self.frames.monotonic_ns
        return np.asarray((moments - moments[:1]) * 1e-9, np.float64)

    @cached_property
    def time(self) -> Floats:
        """(n,) s since the first frame."""
        return self.frame_time[self.frames.fresh]

    @cached_property
    def duration(self) -> float:
        """From the first frame to the last, s; 0 if there are fewer than two."""
        return float(max(np.ptp(self.frame_time), 0.0)) if len(self.frame_time) else 0.0

    @cached_property
    def values(self) -> Floats:
        """(n, 12): the channels in the order of `CHANNELS`."""
        s = self.samples
        return np.hstack([s.force, s.torque, s.acceleration, s.angular_rate])

    @cached_property
    def finite(self) -> Bools:
        """(n, 12) where a value is a finite number."""
        return np.isfinite(self.values)

    @cached_property
    def saturated(self) -> Bools:
        """(n, 12) where the sensor says that a channel is saturated."""
        return (
            np.column_stack([getattr(self.samples, c.group.saturation) & c.bit != 0 for c in CHANNELS])
            if self.count
            else np.zeros((0, len(CHANNELS)), bool)
        )

    @cached_property
    def intervals(self) -> Floats:
        """(n - 1,) from one sample to the next, s."""
        return np.diff(self.time)

    @cached_property
    def step(self) -> int:
        """One sample in so many was asked of the server (`every`)."""
        jumps = np.diff(self.frames.sequence)
        return max(1, int(np.median(jumps))) if len(jumps) else 1

    @cached_property
    def nominal_period(self) -> float | None:
        """What the settings say of the interval between two samples, s."""
        period = self.subject.nominal_period_s
        return None if period is None else period * self.step

    @cached_property
    def period(self) -> float:
        """The usual interval between two samples, s; what the settings say if there are none."""
        forward = self.intervals[self.intervals > 0]
        return float(np.median(forward)) if len(forward) else self.nominal_period or 1e-3

    @property
    def rate(self) -> float:
        """Hz."""
        return 1 / self.period

    @cached_property
    def silent(self) -> Bools:
        """(n - 1,) whether REPEATED or INVALID frames lie between one sample and the next."""
        return self.others > 0

    @cached_property
    def others(self) -> Ints:
        """(n - 1,) how many REPEATED or INVALID frames that are."""
        return np.diff(np.flatnonzero(self.frames.fresh)) - 1

    @cached_property
    def missing(self) -> Ints:
        """(n - 1,) how many samples are missing between one and the next, beside those of a silent sensor.

        Told by the time that passed and by the mark GAP. A stamp that is late makes one interval long and the
        next one short: that is no loss. Where the sensor was silent, it is the time of which no frame tells.
        """
        wide = self.intervals / self.period
        if not len(wide):
            return np.zeros(0, np.int64)
        following = np.append(wide[1:], 1.0)
        late_stamp = following < _SHORT
        periods = np.where(late_stamp, wide + following - 1, wide)
        missing = np.round(np.clip(periods, 0, 1e12)).astype(np.int64) - 1
        marked = (self.samples.flags[1:] & DataFlag.GAP != 0) | (np.diff(self.samples.sequence) > self.step)
        lost = ((wide > _LONGER) & marked) | (wide > _SURELY_LONGER)
        return np.where(self.silent, self._untold, np.where(lost, np.maximum(missing, 0), 0))

    @cached_property
    def _untold(self) -> Ints:
        """(n - 1,) samples that have room between frames too far apart to tell of a silence."""
        fresh, intervals = self.frames.fresh, np.diff(self.frame_time)
        near = np.where(fresh[:-1] | fresh[1:], _COVERED_S, _COVERED_BETWEEN_S)
        wide = intervals > np.maximum(near, _COVERED_PERIODS * self.period)
        room = np.round(np.clip(intervals / self.period, 0, 1e12)).astype(np.int64) - 1
        summed = np.concatenate(([0], np.cumsum(np.where(wide, room, 0))))
        return np.diff(summed[np.flatnonzero(fresh)])

    @cached_property
    def broken(self) -> Bools:
        """(n - 1,) whether the samples on either side do not follow one another."""
        return (
            self.silent
            | (self.missing > 0)
            | (self.intervals <= 0)
            | (self.intervals > _SURELY_LONGER * self.period)
        )

    @cached_property
    def imu_off(self) -> bool:
        """Whether the IMU is switched off."""
        return self.subject.settings.get("imu_active") == 0
