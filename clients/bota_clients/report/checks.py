"""Every check of a sensor, what it measures, and the verdict that they come to.

Noise is compared with a healthy sensor although the sensor may move and touch things. The samples are
divided into windows of half a second (at least 32 samples). A cubic is fitted to each and subtracted,
which removes slow motion and drift; the residual, by its degrees of freedom, gives the standard deviation
of the window. The noise is the median over the calmer half of the windows, by the range of the cubics of
force and torque, which excludes contacts and quick motion. If the accelerometer shows that the sensor was
shaken even then, vibration cannot be told from noise and nothing is judged. A median misses intermittent
noise, so every window is also judged by its second differences, which motion and contacts hardly affect.
Windows in which the accelerometer was shaken do not count.

Stuck values: force and torque come from high-resolution converters through a matrix, so successive values
are hardly ever equal. The values of the IMU are steps of a coarser converter behind a filter that may be
slow, so they have more time. Saturated samples do not count: they have their own check.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from bota_clients.numbers import count, figure, listing, seconds, share
from bota_clients.report import spectrum
from bota_clients.report.series import (
    ACCELERATION,
    ANGULAR_RATE,
    CHANNELS,
    GROUPS,
    Bools,
    Channel,
    Floats,
    Ints,
    Series,
    Subject,
    noise_limit,
)
from bota_ethercat.accounting import StreamAccounting, StreamCounts
from bota_ethercat.health.judge import Observation, judge
from bota_ethercat.health.verdict import LIMITS, Finding, Level
from bota_ethercat.health.verdict import Verdict as StreamVerdict
from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ethercat.sensor.warnings_register import WarningFlag, WarningMeaning, explain


@dataclass(frozen=True, slots=True)
class Check:
    """One check and its outcome. Texts are plain; whoever shows them escapes them."""

    name: str
    level: Level
    found: str
    """What was found, with figures."""
    matters: str = ""
    """Why it matters; empty where nothing is wrong."""
    remedy: str = ""
    """What to do; empty where nothing is wrong."""


def judged(
    name: str, findings: Sequence[Finding], good: str, *, details: str = "", matters: str = "",
    remedy: str = "",
) -> Check:  # fmt: skip
    """What the judge of streams found, with more `details` and `remedy`; `good` if it found nothing."""
    if not findings:
        return Check(name, Level.GOOD, good)
    found = " ".join([*(f"{each.found}." for each in findings), *([details] if details else [])])
    remedies = dict.fromkeys([*(f"{each.remedy}." for each in findings), *([remedy] if remedy else [])])
    return Check(name, findings[0].level, found, matters, " ".join(remedies))


@dataclass(frozen=True, slots=True)
class Verdict:
    """The overall result."""

    level: Level
    """GOOD, NOT_POSSIBLE, LOOK or TROUBLE."""
    sentence: str

    @property
    def headline(self) -> str:
        """One or two words."""
        return "Not conclusive" if self.level is Level.NOT_POSSIBLE else self.level.words.capitalize()


def verdict(checks: Sequence[Check]) -> Verdict:
    """The worst check decides; only a sensor that could be checked completely is healthy."""
    wrong = [check for check in checks if check.level >= Level.LOOK]
    unchecked = [check for check in checks if check.level is Level.NOT_POSSIBLE]
    left_out = [check for check in checks if check.level is Level.NOT_APPLICABLE]
    not_checked = f"It could not be checked: {_names(unchecked)}." if unchecked else ""
    if wrong:
        worst = max(check.level for check in wrong)
        found = f"{len(wrong)} of {len(checks)} checks found something: {_names(wrong)}."
        return Verdict(worst, f"{found} {not_checked}".rstrip())
    if unchecked:
        return Verdict(
            Level.NOT_POSSIBLE, f"Nothing wrong was found, but not everything was checked. {not_checked}"
        )
    sentence = "All checks passed."
    if left_out:
        sentence = f"All applicable checks passed. Not applicable: {_names(left_out)}."
    return Verdict(Level.GOOD, sentence)


def _names(checks: Sequence[Check]) -> str:
    return ", ".join(check.name.lower().replace("imu", "IMU") for check in checks)


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


WINDOW_S: Final = 0.5
FEWEST_SAMPLES: Final = 32
"""Minimum number of samples in a window."""
ORDER: Final = 3
FEWEST_WINDOWS: Final = 8
"""Minimum number of windows to judge by."""
_NOISY: Final = 1.5
"""A window above this multiple of the limit is noisy; one of few samples needs more, to allow for chance."""
_VERY_NOISY: Final = 4.0
_FEWEST_NOISY: Final = 2  # windows: one may be a knock
_TO_DEVIATION: Final = 1.4826 / math.sqrt(6)
"""Makes the median size of second differences of white noise its standard deviation."""
_FILLED: Final = 0.8
"""Minimum share of its samples that a window must have."""
_UNEVEN: Final = 4.0
"""An IMU axis above this multiple of the noise of the other two is reported."""
_UNEVEN_FLOOR: Final = {ACCELERATION.name: 0.02, ANGULAR_RATE.name: 0.0035}
"""m/s² and rad/s below which it does not matter."""
NOISE_NAME: Final = "Noise of force and torque"
IMU_NAME: Final = "Noise of the IMU"


@dataclass(frozen=True)
class Noise:
    """What was measured."""

    deviation: Floats
    """(12,) standard deviation; NaN if unknown."""
    limit: Floats
    """(12,) of a healthy sensor; NaN if unknown."""
    windows: int
    """Number of windows."""
    calm: int
    """Number of windows used."""
    window_s: float
    noisy: Ints
    """(12,) windows that are clearly above the limit, of all."""
    worst: Floats
    """(12,) standard deviation in the worst of these."""

    @property
    def shaken(self) -> bool:
        """Whether the sensor was shaken, even in the calm windows."""
        return bool(_shaken(self.deviation, self.limit))


def measure_noise(series: Series) -> Noise:
    """The noise of all channels."""
    length = max(WINDOW_S, FEWEST_SAMPLES * series.period)
    limits = np.array([_limit(series, channel) for channel in CHANNELS])
    usable = series.finite & ~series.saturated
    number = np.floor(series.time / length).astype(np.int64)
    # A clock that jumps back must not join samples that are far apart.
    edges = np.flatnonzero(np.diff(number) != 0) + 1
    starts, ends = np.concatenate(([0], edges)), np.concatenate((edges, [series.count]))
    fewest = max(FEWEST_SAMPLES // 2, int(_FILLED * length / series.period))
    deviations, ranges, roughs, sizes = [], [], [], []
    for start, end in zip(starts, ends, strict=True):
        if end - start < fewest:
            continue
        values = series.values[start:end]
        good = np.asarray(usable[start:end].all(axis=0))
        deviation, reach = _window(series.time[start:end], values, good)
        deviations.append(deviation)
        ranges.append(reach)
        roughs.append(_rough(values, good))
        sizes.append(end - start)
    if len(deviations) < FEWEST_WINDOWS:
        unknown = np.full(len(CHANNELS), np.nan)
        return Noise(unknown, limits, len(deviations), 0, length, np.zeros(len(CHANNELS), np.int64), unknown)
    all_deviations, reaches = np.array(deviations), np.array(ranges)[:, :6]
    # A window in which a channel is unusable counts as the least calm.
    reaches = np.where(np.isfinite(reaches), reaches, np.inf)
    usual = np.median(reaches, axis=0)
    known = (usual > 0) & np.isfinite(usual)
    unrest = (reaches[:, known] / usual[known]).max(axis=1) if known.any() else np.zeros(len(reaches))
    calm = np.argsort(unrest, kind="stable")[: max(FEWEST_WINDOWS, len(unrest) // 2)]
    kept = all_deviations[calm]
    measured = np.sum(np.isfinite(kept), axis=0) >= FEWEST_WINDOWS // 2
    deviation = np.full(len(CHANNELS), np.nan)
    deviation[measured] = np.nanmedian(kept[:, measured], axis=0)
    rough = np.where(_shaken(all_deviations, limits)[:, None], np.nan, np.array(roughs))
    noisy = rough > limits * np.maximum(_NOISY, 1 + 5 / np.sqrt(sizes))[:, None]
    worst = np.where(noisy, rough, 0.0).max(axis=0)
    return Noise(deviation, limits, len(deviations), len(calm), length, noisy.sum(axis=0), worst)


def _shaken(deviation: Floats, limit: Floats) -> Bools:
    """Whether at least two axes of the accelerometer are above their limit: that is motion."""
    shaken: Bools = np.sum(deviation[..., 6:9] > limit[6:9], axis=-1) >= 2
    return shaken


def _limit(series: Series, channel: Channel) -> float:
    length = series.subject.sinc_length
    if channel.group.is_imu:
        return float("nan") if series.imu_off else noise_limit(channel, 0)
    if length is None or not series.subject.settings.get("calibration_matrix", False):
        return float("nan")
    return noise_limit(channel, length)


def _rough(values: Floats, good: Bools) -> Floats:
    """Standard deviation of each channel as its second differences tell it."""
    rough = np.full(values.shape[1], np.nan)
    rough[good] = np.median(np.abs(np.diff(values[:, good], 2, axis=0)), axis=0) * _TO_DEVIATION
    return rough


def _window(time: Floats, values: Floats, good: Bools) -> tuple[Floats, Floats]:
    """Standard deviation of each channel about its cubic, and how far the cubic ranges."""
    middle, half = (time[0] + time[-1]) / 2, max((time[-1] - time[0]) / 2, 1e-12)
    basis = np.polynomial.legendre.legvander((time - middle) / half, ORDER)
    deviation = np.full(values.shape[1], np.nan)
    reach = np.full(values.shape[1], np.nan)
    fit, *_ = np.linalg.lstsq(basis, values[:, good], rcond=None)
    trend = basis @ fit
    rest = values[:, good] - trend
    deviation[good] = np.sqrt(np.sum(rest**2, axis=0) / (len(time) - ORDER - 1))
    reach[good] = np.ptp(trend, axis=0)
    # A constant value has no noise; the fit leaves rounding errors.
    deviation[good & (values == values[0]).all(axis=0)] = 0.0
    return deviation, reach


def check_force_torque(series: Series, noise: Noise) -> Check:
    """Is the noise of force and torque that of a healthy sensor?"""
    settings = series.subject.settings
    if series.subject.sinc_length is None:
        return _not_possible(
            NOISE_NAME, "The SINC length is not known, so no limit is known.", "Record the settings too."
        )
    if not settings.get("calibration_matrix", False):
        return _not_possible(
            NOISE_NAME,
            "Force and torque are raw counts (the calibration matrix is off), and the "
            "limits are in N and Nm.",
            "Enable calibration_matrix and record again.",
        )
    return _judge(NOISE_NAME, noise, range(6),
                  "Small forces are hidden by it, and a controller reacts to it.",
                  "Record again with the sensor stationary and unloaded. If it persists, check cable, "
                  "shield and supply, then contact the manufacturer.")  # fmt: skip


def check_imu(series: Series, noise: Noise) -> Check:
    """Is the noise of the IMU that of a healthy sensor?"""
    if series.imu_off:
        return Check(IMU_NAME, Level.NOT_APPLICABLE, "The IMU is off.")
    found = _judge(
        IMU_NAME, noise, range(6, 12), "Gravity compensation and the like become noisy.",
        "Record again with the sensor stationary. If it persists, contact the manufacturer.",
    )  # fmt: skip
    if found.level is not Level.GOOD:
        return found
    uneven = [text for group in (ACCELERATION, ANGULAR_RATE) for text in _uneven(group.name, noise)]
    if uneven:
        return Check(
            IMU_NAME, Level.LOOK, f"{listing(uneven)}. That is below the limit.",
            "Three axes of one chip should be alike, unless the sensor vibrates about one axis.",
            "Record again with the sensor stationary. If it persists, contact the manufacturer.",
        )  # fmt: skip
    return found


def _uneven(group: str, noise: Noise) -> list[str]:
    indices = [index for index, channel in enumerate(CHANNELS) if channel.group.name == group]
    for index in indices:
        others = float(np.median([noise.deviation[other] for other in indices if other != index]))
        own = float(noise.deviation[index])
        if own > _UNEVEN_FLOOR[group] and own > _UNEVEN * others > 0:
            channel = CHANNELS[index]
            return [f"{channel.title} has {figure(own / others, 2)} times the noise of the other two axes "
                    f"({figure(own)} {channel.group.unit})"]  # fmt: skip
    return []


def _not_possible(name: str, why: str, remedy: str) -> Check:
    return Check(name, Level.NOT_POSSIBLE, why, "", remedy)


def _judge(name: str, noise: Noise, indices: range, matters: str, remedy: str) -> Check:
    if noise.calm == 0:
        return _not_possible(
            name, f"Only {noise.windows} windows of {figure(noise.window_s, 2)} s could be used; "
            f"{FEWEST_WINDOWS} are needed.", "Record for at least 10 s without interruption.",
        )  # fmt: skip
    ratio = noise.deviation / noise.limit
    unknown = [CHANNELS[index].title for index in indices if not np.isfinite(ratio[index])]
    above = [index for index in indices if ratio[index] > 1]
    if above and noise.shaken:
        return _not_possible(
            name, "The sensor was shaken all the time (the accelerometer shows it), so noise cannot "
            "be told from vibration.", "Record again with the sensor stationary.",
        )  # fmt: skip
    if above:
        texts = [
            f"{CHANNELS[p].title} has a noise of {figure(noise.deviation[p])} {CHANNELS[p].group.unit}, "
            f"{figure(ratio[p], 2)} times the limit of {figure(noise.limit[p])}"
            for p in above
        ]
        return Check(name, Level.TROUBLE, f"{listing(texts)}.", matters, remedy)
    noisy = [index for index in indices if noise.noisy[index] >= _FEWEST_NOISY]
    if noisy:
        times = noise.worst / noise.limit
        texts = [
            f"{CHANNELS[p].title} is noisy in {noise.noisy[p]} of {noise.windows} windows of "
            f"{figure(noise.window_s, 2)} s, at worst {figure(noise.worst[p])} {CHANNELS[p].group.unit}, "
            f"{figure(times[p], 2)} times the limit of {figure(noise.limit[p])}"
            for p in noisy
        ]
        level = Level.TROUBLE if max(times[noisy]) > _VERY_NOISY else Level.LOOK
        return Check(name, level, f"{listing(texts)}.", matters, remedy)
    if unknown:
        return _not_possible(
            name, f"It could not be measured for {listing(unknown)}: too often saturated or not a number.",
            "Fix that first, then record again.",
        )  # fmt: skip
    worst = max(indices, key=lambda index: float(ratio[index]))
    return Check(
        name, Level.GOOD, f"At most {figure(100 * ratio[worst], 2)} % of a healthy sensor's limit "
        f"({CHANNELS[worst].title}: {figure(noise.deviation[worst])} {CHANNELS[worst].group.unit}).",
    )  # fmt: skip


OF_SATURATION = (
    WarningFlag.FORCE_TORQUE_SATURATED
    | WarningFlag.ACCELERATION_SATURATED
    | WarningFlag.ANGULAR_RATE_SATURATED
)


class Raised(NamedTuple):
    """One bit of the warnings register that was set."""

    meaning: WarningMeaning
    samples: int
    first_s: float


def raised(series: Series) -> list[Raised]:
    """The warnings that were set in some sample, lowest bit first."""
    register = series.samples.warnings
    every = int(np.bitwise_or.reduce(register)) if len(register) else 0
    found = []
    for meaning in explain(every):
        indices = np.flatnonzero(register & meaning.flag)
        found.append(Raised(meaning, len(indices), float(series.time[indices[0]])))
    return found


class Saturated(NamedTuple):
    """One channel that was saturated."""

    channel: Channel
    samples: int
    first_s: float


def saturated(series: Series) -> list[Saturated]:
    """The channels that the sensor says were saturated."""
    found = []
    for index, channel in enumerate(CHANNELS):
        indices = np.flatnonzero(series.saturated[:, index])
        if len(indices):
            found.append(Saturated(channel, len(indices), float(series.time[indices[0]])))
    return found


def unknown_saturation_bits(series: Series) -> bool:
    """Whether a saturation field has an undefined bit."""
    return any(
        bool(np.any(getattr(series.samples, group.saturation) & ~_known_bits(group.saturation)))
        for group in GROUPS
    )


def _known_bits(field: str) -> int:
    return sum(channel.bit for channel in CHANNELS if channel.group.saturation == field)


def check_saturation(series: Series, findings: Sequence[Finding]) -> Check:
    """Were all channels within their range?"""
    name = "Saturation"
    if not series.count:
        return too_few(name, 0)
    texts = [
        f"{each.channel.title} was saturated in {count(each.samples, 'sample')} "
        f"({share(each.samples, series.count)}), first {seconds(each.first_s)} after the start"
        for each in saturated(series)
    ]
    if unknown_saturation_bits(series):
        texts.append("a saturation field has an undefined bit")
    details = f"{listing(texts)}." if texts else ""
    return judged(
        name, findings, "No channel was saturated.", details=details,
        matters="The measured values are less than the real ones.",
        remedy="If it is unloaded, it may have been damaged by overload: tare it and compare.",
    )  # fmt: skip


def check_warnings(series: Series, findings: Sequence[Finding]) -> Check:
    """Did the sensor report a warning other than saturation?"""
    name = "Warnings"
    if not series.count:
        return too_few(name, 0)
    found = [each for each in raised(series) if not each.meaning.flag & OF_SATURATION]
    only = " other than of saturation" if raised(series) else ""
    texts = [
        f"{each.meaning.meaning} ({each.meaning.severity.value}) in {count(each.samples, 'sample')}, first "
        f"{seconds(each.first_s)} after the start"
        for each in found
    ]
    return judged(
        name, findings, f"The sensor reported no warnings{only}.",
        details=f"{listing(texts)}." if texts else "", matters="The sensor reports it.",
    )  # fmt: skip


def check_numbers(series: Series, not_finite: Bools, findings: Sequence[Finding]) -> Check:
    """Is every value a finite number?"""
    name = "Numbers"
    if not series.count:
        return too_few(name, 0)
    channels = [c.title for index, c in enumerate(CHANNELS) if not series.finite[:, index].all()]
    if not np.isfinite(series.samples.temperature).all():
        channels.append("Temperature")
    wrong = int(not_finite.sum())
    return judged(
        name, findings, "Every value is a finite number.",
        details=f"{count(wrong, 'sample')} ({share(wrong, series.count)}): {listing(channels)}.",
        matters="A single one of them corrupts every sum and filter.",
    )  # fmt: skip


_LONGEST_S: Final = 0.1
_LONGEST_SAMPLES: Final = 16
_IMU_LONGEST_S: Final = 5.0
_WHOLE: Final = 0.9
"""A channel that is constant for this share of a short recording is stuck too."""
_SHORTEST_S: Final = 1.0
"""Shorter recordings say nothing about the IMU."""
STUCK_NAME: Final = "Stuck values"


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


def check_stuck(series: Series) -> Check:
    """Do the values of every channel change?"""
    if not series.count:
        return too_few(STUCK_NAME, 0)
    if series.duration < _SHORTEST_S:
        found = f"The recording is only {seconds(series.duration)} long."
        return Check(STUCK_NAME, Level.NOT_POSSIBLE, found, "", "Record for at least 10 s.")
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
            STUCK_NAME, Level.TROUBLE, f"{listing(texts)}.", "The channel does not measure.",
            "Power-cycle the sensor. If it persists, it needs repair.",
        )  # fmt: skip
    longest = max((run for run in runs if not run.channel.group.is_imu), key=lambda run: run.samples)
    run = count(longest.samples, "sample")
    return Check(
        STUCK_NAME,
        Level.GOOD,
        f"No channel is stuck; the longest constant run of a force or torque is {run}.",
    )


_GRAVITY_TOLERANCE: Final = 1.0
"""m/s²: an accelerometer's offset is well below it."""
_FEWEST_POINTS: Final = 4
_MOST_POINTS: Final = 300
_TURNED_DEG: Final = 2.0
_LEAST_CHANGE: Final = 0.5
"""°C: below this a drift per degree is meaningless."""


@dataclass(frozen=True)
class Drift:
    """How the readings moved over the recording: medians of m equal spans."""

    time: Floats
    """(m,) s, the middle of each span"""
    load: Floats
    """(m, 6) force (N) and torque (Nm) less those of the first span"""
    temperature: Floats
    """(m,) °C"""
    turned_deg: float
    """By how much the direction of gravity moved at most, as the accelerometer saw it; NaN without one."""

    @property
    def known(self) -> bool:
        """Whether the recording is long enough."""
        return len(self.time) >= _FEWEST_POINTS

    @property
    def turned(self) -> bool:
        """Whether the sensor was turned, so that the load moved too."""
        return not self.turned_deg < _TURNED_DEG

    @property
    def change(self) -> Floats:
        """(6,) from the first tenth of the spans to the last."""
        tenth = max(1, len(self.time) // 10)
        late: Floats = np.median(self.load[-tenth:], axis=0) - np.median(self.load[:tenth], axis=0)
        return late

    @property
    def temperature_change(self) -> float:
        """°C, likewise."""
        tenth = max(1, len(self.time) // 10)
        return float(np.median(self.temperature[-tenth:]) - np.median(self.temperature[:tenth]))

    def sentence(self) -> str:
        """What it means."""
        if not self.known:
            return "The recording is too short to determine drift."
        if self.turned:
            how = (
                "The IMU cannot tell whether the sensor was turned"
                if np.isnan(self.turned_deg)
                else f"The sensor was turned by up to {figure(self.turned_deg, 2)}°"
            )
            return f"{how}: the readings changed with the load too, so they say nothing about drift."
        per_degree = ""
        if abs(self.temperature_change) >= _LEAST_CHANGE:
            slopes = self.change / self.temperature_change
            per_degree = (
                f" That is {figure(float(slopes[np.argmax(np.abs(slopes[:3]))]), 2)} N/°C on the axis that "
                "changed most."
            )
        return (
            "The sensor was not turned. If its load was constant, the change of the readings is its drift; "
            f"no limit is published for it.{per_degree}"
        )


def drift(series: Series) -> Drift:
    """Medians over time; samples that are not numbers are left out."""
    s = series.samples
    good = series.finite.all(axis=1) & np.isfinite(s.temperature) & ~series.saturated[:, :6].any(axis=1)
    time, load = series.time[good], series.values[good, :6]
    acceleration, temperature = s.acceleration[good], s.temperature[good]
    points = int(np.clip(series.duration, 0, _MOST_POINTS))
    nothing = Drift(np.zeros(0), np.zeros((0, 6)), np.zeros(0), float("nan"))
    if points < _FEWEST_POINTS or not len(time):
        return nothing
    index = np.clip((time / series.duration * points).astype(np.int64), 0, points - 1)
    rows = [rows for point in range(points) if len(rows := np.flatnonzero(index == point))]
    if len(rows) < _FEWEST_POINTS:
        return nothing
    loads = np.array([np.median(load[r], axis=0) for r in rows])
    directions = np.array([np.median(acceleration[r], axis=0) for r in rows])
    return Drift(
        np.array([np.median(time[r]) for r in rows]), loads - loads[0],
        np.array([np.median(temperature[r]) for r in rows]), _turned(directions),
    )  # fmt: skip


def _turned(directions: Floats) -> float:
    lengths = np.linalg.norm(directions, axis=1)
    if np.any(lengths < STANDARD_GRAVITY / 4):
        return float("nan")
    units = directions / lengths[:, None]
    return float(np.degrees(np.arccos(np.clip(units @ units[0], -1, 1)).max()))


def check_gravity(series: Series) -> Check:
    """Does the accelerometer measure 1 g?"""
    name = "Gravity"
    if series.imu_off:
        return Check(name, Level.NOT_APPLICABLE, "The IMU is off.")
    lengths = np.linalg.norm(series.samples.acceleration[series.finite[:, 6:9].all(axis=1)], axis=1)
    if not len(lengths):
        return too_few(name, 0)
    usual = float(np.median(lengths))
    found = (
        f"The accelerometer measures {figure(usual)} m/s² (median of the norm); {STANDARD_GRAVITY} is one g."
    )
    if abs(usual - STANDARD_GRAVITY) <= _GRAVITY_TOLERANCE:
        return Check(name, Level.GOOD, found)
    remedy = "If the sensor was stationary: check acceleration_range_g and the acceleration offset (0x8001)."
    if abs(usual / STANDARD_GRAVITY - STANDARD_GRAVITY) < _GRAVITY_TOLERANCE:
        remedy = "This firmware sends SI units: use --imu-raw-units si (ROS node: imu_raw_units)."
    elif abs(usual * STANDARD_GRAVITY - STANDARD_GRAVITY) < _GRAVITY_TOLERANCE:
        remedy = "This firmware sends g: omit --imu-raw-units si."
    return Check(name, Level.LOOK, found, "Gravity compensation subtracts the wrong weight.", remedy)


def check_temperature(series: Series, findings: Sequence[Finding]) -> Check:
    """Is the temperature plausible?"""
    name = "Temperature"
    finite = series.samples.temperature[np.isfinite(series.samples.temperature)]
    if not len(finite):
        return too_few(name, 0)
    low, high = float(finite.min()), float(finite.max())
    found = f"{figure(low)} to {figure(high)} °C."
    return judged(name, findings, found, details=found)


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


@dataclass(frozen=True)
class Examination:
    """One sensor, examined."""

    subject: Subject
    series: Series
    timing: Timing
    noise: Noise
    spectrum: spectrum.Spectrum | None
    drift: Drift
    stream: StreamVerdict
    """Of the judge of all programs; the checks beyond it are this report's own."""
    checks: tuple[Check, ...]
    verdict: Verdict


_AGE: Final = "Age of samples"
_SETTINGS: Final = "Settings"
"""Checks that are there only if something was found."""
_CHECKS: Final = {
    "lost": "lost", "silence": "silence", "invalid": "silence", "repeated": "silence",
    "not_finite": "numbers", "rate": "rate", "temperature": "temperature", "clock": "stamps",
    "age": _AGE, "calibration_matrix": _SETTINGS, "coordinate_system": _SETTINGS,
    **{f"warning {1 << bit}": "saturation" if 1 << bit & OF_SATURATION else "warnings"
       for bit in range(32)},
}  # fmt: skip
"""To which check each finding of the judge of streams belongs."""


def examine(subject: Subject) -> Examination:
    """Measure and judge."""
    series = Series(subject)
    timing, measured = Timing(series), measure_noise(series)
    verdict_on_stream = judge(observe(timing))
    of: dict[str, list[Finding]] = {check: [] for check in _CHECKS.values()}
    for finding in verdict_on_stream.findings:
        of[_CHECKS[finding.key]].append(finding)
    checks = (
        check_losses(timing, of["lost"]),
        check_silence(timing, of["silence"]),
        check_stuck(series),
        check_force_torque(series, measured),
        check_imu(series, measured),
        check_saturation(series, of["saturation"]),
        check_warnings(series, of["warnings"]),
        check_numbers(series, timing.not_finite, of["numbers"]),
        check_stamps(timing, of["stamps"]),
        check_rate(timing, of["rate"]),
        check_gravity(series),
        check_temperature(series, of["temperature"]),
        *(judged(name, of[name], "") for name in (_AGE, _SETTINGS) if of[name]),
    )
    return Examination(
        subject, series, timing, measured, spectrum.measure(series), drift(series),
        verdict_on_stream, checks, verdict(checks),
    )  # fmt: skip
