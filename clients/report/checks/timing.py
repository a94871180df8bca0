"""Checks of the stream: lost samples, silence, stamps, the clock, the sampling rate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from clients.numbers import count, figure, seconds, share
from clients.report.checks.check import Check, Level
from clients.report.subjects.series import Bools, Floats, Series
from protocol.accounting import StreamAccounting, StreamCounts

_FEWEST: Final = 100
"""Minimum number of samples to judge by."""
_LOST_FAULT: Final = 0.005
"""Share of the samples above which losses are a fault."""
_SILENT_FAULT_S: Final = 0.1
_IRREGULAR: Final = 0.2
"""Share of a period that 95 % of the intervals may deviate by."""
_STEP_NS: Final = 1_000_000
"""CLOCK_REALTIME that moves against CLOCK_MONOTONIC by more than this between two samples was adjusted."""
RATE_TOLERANCE: Final = 0.002
"""Relative deviation of a sensor's clock from its nominal rate."""
_RATE_TOLERANCE_ROUNDED: Final = 0.01
"""The same where only the rate in whole Hz is known."""


@dataclass(frozen=True)
class Timing:
    """Figures of the stream, worked out from a `Series`."""

    series: Series

    @cached_property
    def counts(self) -> StreamCounts:
        """The frames' kinds, as every client counts them."""
        frames = self.series.frames
        accounting = StreamAccounting(every=self.series.step, fresh_only=False)
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


def check_losses(timing: Timing) -> Check:
    """Are all samples there?"""
    name, series = "Lost samples", timing.series
    if series.count < _FEWEST:
        return too_few(name, series.count)
    total, lost = series.count + timing.lost, timing.lost
    if not lost:
        unsure = (
            f" {count(timing.counts.gaps, 'frame')} marked GAP, but no time is missing."
            if timing.counts.gaps
            else ""
        )
        return Check(name, Level.OK, f"None of {count(total, 'sample')}.{unsure}")
    gaps = count(int(np.sum(series.missing > 0)), "place")
    found = f"{lost} of {count(total, 'sample')} ({share(lost, total)}) are missing, in {gaps}."
    remedies = []
    if timing.withheld:
        found += f" {timing.withheld} of them were available at the server, but not read in time."
        remedies.append("Record on a less busy machine, or fewer sensors at once.")
    if timing.withheld < lost:
        which = f"{lost - timing.withheld} of them" if timing.withheld else "All of them"
        found += f" {which} never reached the server."
        remedies.append(
            "Check missed_deadlines and lost_frames in the server's status: a busy machine (use real-time "
            "priority: see ethercat-server --help) or a bad cable. If both are zero, the sensor skipped them."
        )
    return Check(
        name, Level.FAULT if lost > _LOST_FAULT * total else Level.ATTENTION, found,
        "A controller acts on stale data; spectra and derivatives are wrong there.", " ".join(remedies),
    )  # fmt: skip


def check_silence(timing: Timing) -> Check:
    """Did the sensor always send new samples?"""
    name, spans = "Silent or stuck sensor", timing.silences
    if timing.series.duration <= 0:
        return Check(name, Level.NOT_POSSIBLE, "There are no frames.", "", "Record again.")
    if not len(spans) and not timing.counts.repeated and not timing.counts.invalid:
        return Check(name, Level.OK, "The sensor sent new samples all the time.")
    longest, total = (float(spans.max()), float(spans.sum())) if len(spans) else (0.0, 0.0)
    kinds = (
        f"{count(timing.counts.repeated, 'repeated frame')}, {count(timing.counts.invalid, 'invalid one')}"
    )
    found = (
        f"No new sample came in {count(len(spans), 'stretch')}, the longest {seconds(longest)}, together "
        f"{seconds(total)} ({kinds})."
    )
    if not timing.series.count:
        found = f"No new sample came in {seconds(total)} ({kinds})."
    remedies = []
    if timing.counts.repeated:
        remedies.append(
            "Repeated frames: the sensor is stuck, or its rate is lower than nominal; power-cycle it."
        )
    if timing.counts.invalid:
        remedies.append(
            "Invalid frames: the sensor did not answer; check cable, supply and the server's log."
        )
    return Check(
        name, Level.FAULT if longest > _SILENT_FAULT_S else Level.ATTENTION, found,
        "What is published in the meantime is stale.", " ".join(remedies),
    )  # fmt: skip


def check_stamps(timing: Timing) -> Check:
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
    usual, most = (float(np.quantile(off, q)) if len(off) else 0.0 for q in (0.95, 1.0))
    usually = (
        f"95 % of the intervals are within {seconds(usual)} of {seconds(series.period)}, all within "
        f"{seconds(most)}."
    )
    if usual > _IRREGULAR * series.period:
        wrong.append(usually)
        remedies.append(
            "The server did not follow the sensor's clock: is its machine busy? See status, `locked`."
        )
    if wrong:
        return Check(
            name, Level.ATTENTION, " ".join(wrong), "Sensor fusion and derivatives suffer.",
            " ".join(remedies),
        )  # fmt: skip
    return Check(name, Level.OK, usually)


def check_rate(timing: Timing) -> Check:
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
    tolerance = RATE_TOLERANCE if series.subject.sinc_length is not None else _RATE_TOLERANCE_ROUNDED
    if abs(pull) > tolerance:
        return Check(
            name, Level.ATTENTION, found, "The filters in effect are not those of the "
            "settings.",
            "Read them from the sensor (`ethercat-sensor plan`) and set them again.",
        )  # fmt: skip
    return Check(name, Level.OK, found)


def too_few(name: str, samples: int) -> Check:
    """The outcome of a check that has too few samples."""
    found = (
        f"There {'is' if samples == 1 else 'are'} only {count(samples, 'sample')}."
        if samples
        else "There are no samples."
    )
    return Check(name, Level.NOT_POSSIBLE, found, "", "Record for at least 10 s.")
