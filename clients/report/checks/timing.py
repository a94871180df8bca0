"""Checks of the stream: lost samples, silence, stamps, the clock, the sampling rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from clients.numbers import count, figure, seconds
from clients.report.checks.check import Check, judged
from clients.report.subjects.series import Bools, Floats, Series
from protocol.accounting import StreamAccounting, StreamCounts
from protocol.health.limits import LIMITS
from protocol.health.verdict import Finding, Level

Findings = Sequence[Finding]
"""What the judge of streams found that belongs to one check."""

_STALE: Final = "A controller acts on stale data; spectra and derivatives are wrong there."
_FEWEST: Final = 100
"""Minimum number of samples to judge by."""
_STEP_NS: Final = 1_000_000
"""CLOCK_REALTIME that moves against CLOCK_MONOTONIC by more than this between two samples was adjusted."""


@dataclass(frozen=True)
class Timing:
    """Figures of the stream, worked out from a `Series`."""

    series: Series

    @cached_property
    def counts(self) -> StreamCounts:
        """The frames' kinds, as every client counts them."""
        frames = self.series.frames
        accounting = StreamAccounting(every=self.series.step, fresh_only=False)
        # Not the usual interval: where every other sample is lost, that is two periods.
        accounting.rate_hz = self.series.step / (self.series.nominal_period or self.series.period)
        rows = zip(frames.sequence.tolist(), frames.monotonic_ns.tolist(), frames.flags.tolist(), strict=True)
        for sequence, monotonic_ns, flags in rows:
            accounting.take(sequence, monotonic_ns, flags)
        return accounting.counts

    @cached_property
    def lost(self) -> int:
        """Number of missing samples, except those of a silent sensor."""
        return int(self.series.missing.sum())

    @cached_property
    def withheld(self) -> int:
        """Those of the missing samples that the server had numbered: the client or recorder was too slow."""
        return min(self.counts.withheld // self.series.step, self.lost)

    @cached_property
    def silences(self) -> Floats:
        """How long the sensor was silent each time, s, the time before the first and after the last too."""
        s = self.series
        spans: Floats = (s.intervals - (1 + s.missing) * s.period)[s.silent]
        if len(s.frame_time) == 0:
            return np.zeros(0)
        if s.count == 0:
            return np.array([s.duration])
        ends = [s.time[0] - s.frame_time[0], s.frame_time[-1] - s.time[-1]]
        indices = np.flatnonzero(s.frames.fresh)
        edges = [indices[0] > 0, indices[-1] < len(s.frames) - 1]
        outside = [end for end, edge in zip(ends, edges, strict=True) if edge]
        return np.asarray(np.maximum(np.concatenate([spans, outside]), 0.0), np.float64)

    @cached_property
    def regular(self) -> Bools:
        """(n - 1,) intervals with nothing missing in them."""
        return ~self.series.broken

    @cached_property
    def deviations(self) -> Floats:
        """By how much each regular interval differs from the usual one, s."""
        return self.series.intervals[self.regular] - self.series.period

    @cached_property
    def backwards(self) -> int:
        """Samples with a stamp before that of the sample before them."""
        return int(np.sum(self.series.intervals <= 0))

    @cached_property
    def clock_steps(self) -> Floats:
        """Adjustments of CLOCK_REALTIME, s."""
        s = self.series.samples
        moved = np.diff(s.stamp_ns - s.monotonic_ns)
        return np.asarray(moved[np.abs(moved) > _STEP_NS] * 1e-9, np.float64)

    @cached_property
    def mean_period(self) -> float:
        """s, over everything but silences."""
        s = self.series
        kept = ~s.silent & (s.intervals > 0)
        periods = float(np.sum(1 + s.missing[kept]))
        return float(s.intervals[kept].sum() / periods) if periods else s.period

    @property
    def judges_intervals(self) -> bool:
        """Whether there are enough samples to judge their intervals."""
        return self.series.count >= _FEWEST

    @cached_property
    def is_irregular(self) -> bool:
        """Whether the stamps are not those of a clock that is followed."""
        return self.usual_deviation > LIMITS.irregular * self.series.period

    @cached_property
    def usual_deviation(self) -> float:
        """What 95 % of the regular intervals deviate by at most, s."""
        return float(np.quantile(np.abs(self.deviations), 0.95)) if len(self.deviations) else 0.0

    @cached_property
    def not_finite(self) -> Bools:
        """(n,) samples with a value that is no finite number."""
        s = self.series
        wrong: Bools = ~s.finite.all(axis=1) | ~np.isfinite(s.samples.temperature)
        return wrong


def check_losses(timing: Timing, findings: Findings) -> Check:
    """Are all samples there?"""
    name, series = "Lost samples", timing.series
    if series.count < _FEWEST:
        return too_few(name, series.count)
    total, lost = series.count + timing.lost, timing.lost
    if not lost:
        return judged(name, findings, f"None of {count(total, 'sample')}.", matters=_STALE)
    places = count(int(np.sum(series.missing > 0)), "place")
    every = all(finding.size == lost for finding in findings)
    details = f"In {places}." if every else f"{lost} of them where the sensor was not silent, in {places}."
    remedies = []
    if timing.withheld:
        details += f" {timing.withheld} of them were available at the server, but not read in time."
        remedies.append("Record on a less busy machine, or fewer sensors at once.")
    if timing.withheld < lost:
        which = f"{lost - timing.withheld} of them" if timing.withheld else "All of them"
        details += f" {which} never reached the server."
        remedies.append("If missed_deadlines and lost_frames in status are zero, the sensor skipped them.")
    return judged(name, findings, "", details=details, matters=_STALE, remedy=" ".join(remedies))


def check_silence(timing: Timing, findings: Findings) -> Check:
    """Did the sensor always send new samples?"""
    name, spans = "Silent or stuck sensor", timing.silences
    if timing.series.duration <= 0:
        return Check(name, Level.NOT_POSSIBLE, "There are no frames.", "", "Record again.")
    longest, total = (float(spans.max()), float(spans.sum())) if len(spans) else (0.0, 0.0)
    details = (
        f"In {count(len(spans), 'stretch')} without a new sample, the longest {seconds(longest)}, together "
        f"{seconds(total)}: {count(timing.counts.repeated, 'repeated frame')}, "
        f"{count(timing.counts.invalid, 'invalid one')}."
    )
    good = "The sensor sent new samples all the time."
    return judged(
        name, findings, good, details=details, matters="What is published in the meantime is stale."
    )


def check_stamps(timing: Timing, findings: Findings) -> Check:
    """Are the stamps regular and ascending, and was the clock not adjusted?"""
    name, series = "Stamps", timing.series
    if series.count < _FEWEST:
        return too_few(name, series.count)
    wrong, remedies = [], []
    if timing.backwards:
        wrong.append(f"{count(timing.backwards, 'stamp')} not later than the one before.")
        remedies.append("Was the server's machine restarted? Record without interruption.")
    steps = timing.clock_steps
    if len(steps):
        biggest = steps[np.argmax(np.abs(steps))]
        wrong.append(
            f"The system clock was adjusted {count(len(steps), 'time')}, by up to {figure(float(biggest))} s."
        )
        remedies.append("Wait for chrony or NTP to converge before recording.")
    off = np.abs(timing.deviations)
    usually = (
        f"95 % of the intervals are within {_bound(timing.usual_deviation)} of {seconds(series.period)}, "
        f"all within {_bound(float(off.max()) if len(off) else 0.0)}."
    )
    for finding in findings:
        wrong += [f"{finding.found}.", usually]
        remedies.append(f"{finding.remedy}.")
    if wrong:
        return Check(
            name, Level.LOOK, " ".join(wrong), "Sensor fusion and derivatives suffer.",
            " ".join(remedies),
        )  # fmt: skip
    return Check(name, Level.GOOD, usually)


def check_rate(timing: Timing, findings: Findings) -> Check:
    """Is the sampling rate that of the settings?"""
    name, series = "Sampling rate", timing.series
    nominal = series.nominal_period
    if series.count < _FEWEST:
        return too_few(name, series.count)
    if nominal is None:
        return Check(
            name, Level.NOT_POSSIBLE, "Neither settings nor rate are known.", "", "Record the settings too."
        )
    rate, wanted = 1 / timing.mean_period, 1 / nominal
    pull = rate / wanted - 1
    found = f"{rate:.3f} Hz; the settings say {wanted:.3f} Hz ({pull * 1e6:+.0f} ppm)."
    return judged(name, findings, found, details=found)


def too_few(name: str, samples: int) -> Check:
    """The outcome of a check that has too few samples."""
    found = (
        f"There {'is' if samples == 1 else 'are'} only {count(samples, 'sample')}."
        if samples
        else "There are no samples."
    )
    return Check(name, Level.NOT_POSSIBLE, found, "", "Record for at least 10 s.")


def _bound(deviation_s: float) -> str:
    """No finer than stamps mean anything."""
    return seconds(max(deviation_s, 1e-7))
