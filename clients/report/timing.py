"""Checks of the stream: lost samples, silence, stamps, the clock, the sampling rate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from clients.report.check import Check, Level
from clients.report.series import Bools, Floats, Series
from clients.report.words import count, figure, seconds, share
from protocol.framing import DataFlag

_FEWEST: Final = 100
"""Samples that a judgement needs."""
_LOST_FAULT: Final = 0.005
"""Part of the samples from which on losses are a fault."""
_SILENT_FAULT_S: Final = 0.1
_IRREGULAR: Final = 0.2
"""Part of a period by which one stamp in twenty may be off."""
_STEP_NS: Final = 1_000_000
"""CLOCK_REALTIME moved against CLOCK_MONOTONIC by more than this between two samples: it was set."""
RATE_TOLERANCE: Final = 0.002
"""A real sensor's clock differs from the nominal one by less than this part."""
_RATE_TOLERANCE_ROUNDED: Final = 0.01
"""Where only the rate in whole Hz is known."""


@dataclass(frozen=True)
class Timing:
    """Figures of the stream, worked out from a `Series`."""

    series: Series

    @cached_property
    def lost(self) -> int:
        """Samples that are missing, beside those of a silent sensor."""
        return int(self.series.missing.sum())

    @cached_property
    def withheld(self) -> int:
        """Those of the lost ones that the server had numbered: the client or recorder was too slow."""
        s = self.series
        jumps = np.diff(s.samples.sequence) // s.step - 1 - s.others
        return int(np.minimum(np.maximum(jumps, 0), s.missing).sum())

    @cached_property
    def repeated(self) -> int:
        """Frames without anything new."""
        return int(
            np.sum(self.series.frames.flags & (DataFlag.REPEATED | DataFlag.INVALID) == DataFlag.REPEATED)
        )

    @cached_property
    def invalid(self) -> int:
        """Frames with a short working counter."""
        return int(np.sum(self.series.frames.flags & DataFlag.INVALID != 0))

    @cached_property
    def gaps(self) -> int:
        """Frames marked GAP."""
        return int(np.sum(self.series.samples.flags & DataFlag.GAP != 0))

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
        places = np.flatnonzero(s.frames.fresh)
        edges = [places[0] > 0, places[-1] < len(s.frames) - 1]
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
        """By how much CLOCK_REALTIME was set, each time, s."""
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
    """Are there all samples?"""
    name, series = "Lost samples", timing.series
    if series.count < _FEWEST:
        return too_few(name, series.count)
    total, lost = series.count + timing.lost, timing.lost
    if not lost:
        unsure = f" {count(timing.gaps, 'sample')} marked GAP, but no time is missing." if timing.gaps else ""
        return Check(name, Level.OK, f"None of {count(total, 'sample')}.{unsure}")
    places = int(np.sum(series.missing > 0))
    found = (
        f"{lost} of {count(total, 'sample')} ({share(lost, total)}) are missing, in {count(places, 'place')}."
    )
    remedies = []
    if timing.withheld:
        found += f" {timing.withheld} of them the server had, but this client did not take them in time."
        remedies.append("Record on a less busy machine, or fewer sensors at once.")
    if timing.withheld < lost:
        which = f"{lost - timing.withheld} of them" if timing.withheld else "All of them"
        found += f" {which} the server never saw."
        remedies.append(
            "Look at missed_deadlines and lost_frames in the server's status: is the machine busy (real-time "
            "priority, `ethercat-server --help`), the cable good? If both are zero the sensor left them out."
        )
    return Check(
        name, Level.FAULT if lost > _LOST_FAULT * total else Level.ATTENTION, found,
        "A controller sees old data; spectra and derivatives are wrong there.", " ".join(remedies),
    )  # fmt: skip


def check_silence(timing: Timing) -> Check:
    """Did the sensor always give something new?"""
    name, spans = "Silent or stuck sensor", timing.silences
    if timing.series.duration <= 0:
        return Check(name, Level.NOT_POSSIBLE, "There are no frames.", "", "Record again.")
    if not len(spans) and not timing.repeated and not timing.invalid:
        return Check(name, Level.OK, "The sensor gave something new all the time.")
    longest, total = (float(spans.max()), float(spans.sum())) if len(spans) else (0.0, 0.0)
    kinds = f"{count(timing.repeated, 'repeated frame')}, {count(timing.invalid, 'invalid one')}"
    found = (
        f"Nothing new came in {count(len(spans), 'stretch')}, the longest {seconds(longest)}, together "
        f"{seconds(total)} ({kinds})."
    )
    if not timing.series.count:
        found = f"Nothing new came at all, in {seconds(total)} ({kinds})."
    remedies = []
    if timing.repeated:
        remedies.append(
            "Repeated frames: the sensor is stuck, or its rate is lower than it should be; switch it "
            "off and on."
        )
    if timing.invalid:
        remedies.append(
            "Invalid frames: the sensor did not answer; look at cable, supply and the server's log."
        )
    return Check(
        name, Level.FAULT if longest > _SILENT_FAULT_S else Level.ATTENTION, found,
        "What is published meanwhile is old.", " ".join(remedies),
    )  # fmt: skip


def check_stamps(timing: Timing) -> Check:
    """Are the stamps even, rising, and of a clock that was left alone?"""
    name, series = "Stamps", timing.series
    if series.count < _FEWEST:
        return too_few(name, series.count)
    wrong, remedies = [], []
    if timing.backwards:
        wrong.append(f"{count(timing.backwards, 'stamp')} not after the one before.")
        remedies.append("Was the server's machine restarted in between? Record in one piece.")
    steps = timing.clock_steps
    if len(steps):
        biggest = steps[np.argmax(np.abs(steps))]
        wrong.append(
            f"The wall clock was set {count(len(steps), 'time')}, at most by {figure(float(biggest))} s."
        )
        remedies.append("Let chrony or NTP settle before recording.")
    off = np.abs(timing.deviations)
    usual, most = (float(np.quantile(off, q)) if len(off) else 0.0 for q in (0.95, 1.0))
    spread = (
        f"95 % of the intervals are within {seconds(usual)} of {seconds(series.period)}, all within "
        f"{seconds(most)}."
    )
    if usual > _IRREGULAR * series.period:
        wrong.append(spread)
        remedies.append(
            "The server did not follow the sensor's clock: is its machine busy? See status, `locked`."
        )
    if wrong:
        return Check(
            name, Level.ATTENTION, " ".join(wrong), "Fusing with other sensors and derivatives suffer.",
            " ".join(remedies),
        )  # fmt: skip
    return Check(name, Level.OK, spread)


def check_rate(timing: Timing) -> Check:
    """Does the sensor sample as fast as its settings say?"""
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
            name, Level.ATTENTION, found, "Filters and limits that follow from the settings are not "
            "those in force.",
            "Read them from the sensor (`ethercat-sensor plan`) and set them again.",
        )  # fmt: skip
    return Check(name, Level.OK, found)


def too_few(name: str, samples: int) -> Check:
    """The answer where nothing can be said."""
    found = (
        f"There {'is' if samples == 1 else 'are'} only {count(samples, 'sample')}."
        if samples
        else "There are no samples."
    )
    return Check(name, Level.NOT_POSSIBLE, found, "", "Record for at least 10 s.")
