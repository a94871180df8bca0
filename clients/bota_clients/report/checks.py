"""Every check of a sensor, and the verdict that they come to.

What every program judges (losses, silence, rate, ...) is judged by `bota_ethercat.health.judge`. Noise, stuck
values, stamps and gravity are this report's own.

Stuck values: force and torque come from high-resolution converters through a matrix, so successive values
are hardly ever equal. The values of the IMU are steps of a coarser converter behind a filter that may be
slow, so they have more time. Saturated samples do not count: they have their own check.

Noise is compared with a healthy sensor although the sensor may move and touch things: docs/report.md says
how. The range of the cubics of force and torque tells contacts and quick motion; if the accelerometer shows
that the sensor was shaken even in the calm windows, vibration cannot be told from noise. A median misses
intermittent noise, so every window is also judged by its second differences, which motion hardly affects.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final, NamedTuple, cast

import numpy as np

from bota_clients.numbers import count, figure, listing, seconds
from bota_clients.recording.columns import Bools, Floats
from bota_clients.report.series import CHANNELS, Samples, Series, Subject
from bota_ethercat.health.judge import SATURATIONS, Observation, judge
from bota_ethercat.health.limits import LIMITS, Level
from bota_ethercat.pdo import STANDARD_GRAVITY

_WINDOW_S: Final = 0.5
_FEWEST_SAMPLES: Final = 32  # in a window
_FEWEST_WINDOWS: Final = 8  # to judge by
_ORDER: Final = 3
# A window above this multiple of the limit is noisy; one of few samples needs more, to allow for chance.
_NOISY: Final = 1.5
_CONTACT_S: Final = 0.1  # a contact builds up in no less, which second differences of slow samples show, too
_TO_DEVIATION: Final = 1.4826 / math.sqrt(6)  # median size of second differences of white noise to its std
_MOST_WINDOWS: Final = 8192  # remembered: those of an hour, and one of some of a longer recording
_LONGEST_WINDOW: Final = 1 << 18  # samples, of a clock that stands
_FILLED: Final = 0.8  # share of its samples that a window must have


class Noise:
    """Noise of the 12 channels, as standard deviations, in the windows of samples, which come in time.

    Attributes:
        deviation: (12,) in the calm windows; NaN if unknown.
        limit: (12,) of a healthy sensor; NaN where there is none: raw counts, an unknown SINC length, an IMU
            that is off.
        windows: how many there are.
        calm: how many of them are used.
        window_s: how long one is.
        noisy: (12,) windows that are clearly above the limit, of all.
        worst: (12,) standard deviation in the worst of these.
    """

    def __init__(self, series: Series) -> None:
        length = series.subject.sinc_length if series.subject.settings.get("calibration_matrix") else None
        has_none = [series.imu_off if channel.group.is_imu else length is None for channel in CHANNELS]
        self.limit = np.where(has_none, np.nan, [channel.limit(length or 1) for channel in CHANNELS])
        self.window_s = max(_WINDOW_S, _FEWEST_SAMPLES * series.period)
        self.windows = self.calm = 0
        self.deviation = np.full(len(CHANNELS), np.nan)
        self.noisy, self.worst = np.zeros(len(CHANNELS), np.int64), np.zeros(len(CHANNELS))
        self._period = series.period
        self._fewest = max(_FEWEST_SAMPLES // 2, int(_FILLED * self.window_s / series.period))
        # Time, values and usable of the window that goes on.
        self._rest: Sequence[Any] = np.zeros(0), np.zeros((0, 12)), np.zeros((0, 12), bool)
        self._every = 1  # one of so many windows is remembered
        self._kept = list[Floats]()  # (2, 12): deviation, range

    def add(self, samples: Samples) -> None:
        """The next ones."""
        self._rest = [np.concatenate(each) for each in zip(self._rest, samples[:3], strict=True)]
        number = np.floor(self._rest[0] / self.window_s)
        # A clock that jumps back must not join samples that are far apart.
        edges = [0, *(np.flatnonzero(np.diff(number) != 0) + 1).tolist()]
        if len(number) - edges[-1] > _LONGEST_WINDOW:
            edges.append(len(number))
        self._measure(edges)

    def end(self) -> None:
        """There are no more: choose the calm windows."""
        self._measure([0, len(self._rest[0])])
        if self.windows < _FEWEST_WINDOWS:
            return
        deviations, ranges = np.array(self._kept).transpose(1, 0, 2)
        # A window in which a channel is unusable counts as the least calm.
        reaches = np.where(np.isfinite(ranges), ranges, np.inf)[:, :6]
        usual = np.median(reaches, axis=0)
        known = (usual > 0) & np.isfinite(usual)
        unrest = (reaches[:, known] / usual[known]).max(axis=1, initial=0.0)
        calm = deviations[np.argsort(unrest, kind="stable")[: max(_FEWEST_WINDOWS, len(unrest) // 2)]]
        measured = np.sum(np.isfinite(calm), axis=0) >= _FEWEST_WINDOWS // 2
        self.deviation[measured] = np.nanmedian(calm[:, measured], axis=0)
        self.calm = max(_FEWEST_WINDOWS, self.windows // 2)

    def _measure(self, edges: Sequence[int]) -> None:
        """The windows between these samples."""
        for begin, end in itertools.pairwise(edges):
            if end - begin < self._fewest:
                continue
            deviation, reach, rough = _window(*(each[begin:end] for each in self._rest))
            if _is_shaken(deviation, self.limit):
                rough = np.full(len(CHANNELS), np.nan)
            touched = reach * (self._period / _CONTACT_S) ** 2
            noisy = rough > self.limit * max(_NOISY, 1 + 5 / math.sqrt(end - begin)) + touched
            self.noisy += noisy
            self.worst = np.fmax(self.worst, np.where(noisy, rough, 0.0))
            if self.windows % self._every == 0:
                self._kept.append(np.array([deviation, reach]))
                if len(self._kept) > _MOST_WINDOWS:
                    self._kept, self._every = self._kept[::2], 2 * self._every
            self.windows += 1
        self._rest = [each[edges[-1] :] for each in self._rest]


class Run(NamedTuple):
    """Samples of a channel in a row with the same value."""

    value: float
    begin_s: float
    end_s: float
    samples: int

    @property
    def seconds(self) -> float:
        return self.end_s - self.begin_s


class _Runs:
    """Finds the longest run of each channel."""

    def __init__(self) -> None:
        nothing = Run(math.nan, 0.0, -1.0, 0)
        self.longest, self._latest = [nothing] * len(CHANNELS), [nothing] * len(CHANNELS)
        self._is_usable = np.zeros((1, len(CHANNELS)), bool)

    def add(self, samples: Samples) -> None:
        usable, values, time = samples.usable, samples.values, samples.time
        # Values that are saturated or not finite belong to other checks: each is a run of its own.
        apart = ~usable | ~np.concatenate([self._is_usable, usable])[:-1]
        before = np.concatenate([[[run.value for run in self._latest]], values])[:-1]
        changed = (values != before) | apart | (samples.interval_ns <= 0)[:, np.newaxis]
        until_s = np.append(self._latest[0].end_s, time)  # of the sample before each, and of the last
        for channel, latest in enumerate(self._latest):
            starts = np.flatnonzero(changed[:, channel])
            # Of the run that goes on and those that begin: the first sample, and the one behind the last.
            begins, ends = np.append(-latest.samples, starts), np.append(starts, len(time))
            begins_s, ends_s = np.append(latest.begin_s, time[starts]), until_s[ends]
            for at in (int(np.argmax(ends_s - begins_s)), len(starts)):
                value = float(values[begins[at], channel]) if at else latest.value
                run = Run(value, float(begins_s[at]), float(ends_s[at]), int(ends[at] - begins[at]))
                self.longest[channel] = max(self.longest[channel], run, key=lambda run: run.seconds)
            self._latest[channel] = run
        self._is_usable = np.concatenate([self._is_usable, usable])[-1:]


def _is_shaken(deviation: Floats, limit: Floats) -> bool:
    """Whether at least two axes of the accelerometer are above their limit: that is motion."""
    return int(np.sum(deviation[6:9] > limit[6:9])) >= 2


def _window(time: Floats, values: Floats, usable: Bools) -> Floats:
    """(3, 12): standard deviation about the cubic, its range, and the deviation by second differences."""
    middle, half = (time[0] + time[-1]) / 2, max((time[-1] - time[0]) / 2, 1e-12)
    basis = np.polynomial.legendre.legvander((time - middle) / half, _ORDER)
    good = usable.all(axis=0)
    values = np.where(good, values, 0.0)
    basis = np.linalg.qr(basis)[0]
    trend = basis @ (basis.T @ values)
    deviation = np.sqrt(np.sum((values - trend) ** 2, axis=0) / (len(time) - _ORDER - 1))
    deviation[(values == values[0]).all(axis=0)] = 0.0  # the fit leaves rounding errors
    bends = np.sort(np.abs(np.diff(values, 2, axis=0)).T)  # a median along rows takes five times as long
    rough = bends[:, [(bends.shape[1] - 1) // 2, bends.shape[1] // 2]].mean(axis=1) * _TO_DEVIATION
    return np.where(good, [deviation, np.ptp(trend, axis=0), rough], np.nan)


class Check(NamedTuple):
    """The outcome of one check. Texts are plain: to be escaped where they are shown."""

    found: str  # with figures
    level: Level = Level.GOOD
    remedy: str = ""  # what to do; empty where nothing is wrong
    matters: str = ""  # why it matters; empty where nothing is wrong
    name: str = ""


class Examination:
    """One sensor, examined: what was measured, each check, and what they come to."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.series = Series(subject)
        self.noise, runs = Noise(self.series), _Runs()
        for samples in self.series.read():
            self.noise.add(samples)
            runs.add(samples)
        self.noise.end()
        self.runs = runs.longest
        # Of the judge of all programs; the checks beyond it are this report's own.
        self.stream = judge(_observe(self.series))
        self.checks = [check for each in _CHECKS if (check := _made(each, self)) is not None]
        self.level, self.sentence = verdict(self.checks)
        is_open = self.level is Level.NOT_POSSIBLE
        self.headline = "Not conclusive" if is_open else self.level.words.capitalize()


def verdict(checks: Sequence[Check]) -> tuple[Level, str]:
    """The worst check decides; only a sensor that could be checked completely is healthy."""

    def names(*levels: Level) -> list[str]:
        return [check.name.lower().replace("imu", "IMU") for check in checks if check.level in levels]

    wrong, unchecked = names(Level.LOOK, Level.TROUBLE), ", ".join(names(Level.NOT_POSSIBLE))
    not_checked = f" It could not be checked: {unchecked}." if unchecked else ""
    worst = max(check.level for check in checks)
    if wrong:
        found = f"{len(wrong)} of {len(checks)} checks found something: {', '.join(wrong)}."
        return worst, found + not_checked
    if unchecked:
        return worst, f"Nothing wrong was found, but not everything was checked.{not_checked}"
    if left_out := ", ".join(names(Level.NOT_APPLICABLE)):
        return Level.GOOD, f"All applicable checks passed. Not applicable: {left_out}."
    return Level.GOOD, "All checks passed."


class _Kind(NamedTuple):
    """A check as a row of the table."""

    name: str
    keys: Collection[str]  # of the findings of the judge of streams that belong to it
    fewest: int  # samples that it needs
    # Adds to what the judge found, or checks by itself.
    make: Callable[[Examination], Check] | None
    matters: str = ""  # why it matters if something is found
    remedy: str = ""
    good: str = ""  # the outcome if nothing is found; "": then there is no such check, or `make` has it


def _made(kind: _Kind, examination: Examination) -> Check | None:
    series = examination.series
    findings = [finding for finding in examination.stream.findings if finding.key in kind.keys]
    if not (kind.make or kind.good or findings):
        return None
    if series.count < kind.fewest and not (findings and kind.fewest == 1):  # of a sensor that sends none
        findings, result = [], _too_few(series.count)
    elif kind.make is None:
        result = Check("" if findings else kind.good)
    else:
        result = kind.make(examination)
    level = max([result.level, *(finding.level for finding in findings)])
    found = " ".join([*(f"{finding.found}." for finding in findings), result.found]).rstrip()
    is_wrong = level >= Level.LOOK
    own = result.remedy or (kind.remedy if is_wrong else "")
    remedy = " ".join(dict.fromkeys([*(f"{finding.remedy}." for finding in findings), own])).rstrip()
    return Check(found, level, remedy, kind.matters if is_wrong else "", kind.name)


def _not_possible(found: str, remedy: str) -> Check:
    return Check(found, Level.NOT_POSSIBLE, remedy)


def _too_few(samples: int) -> Check:
    found = f"There {'is' if samples == 1 else 'are'} only {count(samples, 'sample')}."
    return _not_possible(found if samples else "There are no samples.", "Record for at least 10 s.")


def _stamps(examined: Examination) -> Check:
    series = examined.series
    off = [max(each, 1e-7) for each in (series.usual_deviation, *series.deviations[3:])]
    found = [
        f"95 % of the intervals are within {seconds(off[0])} of {seconds(series.period)}, all within "
        f"{seconds(off[-1])}."
    ]
    remedies = []
    if series.backwards:
        found.append(f"{count(series.backwards, 'stamp')} not later than the one before.")
        remedies.append("Was the server's machine restarted? Record without interruption.")
    if series.clock_steps:
        times, biggest = count(series.clock_steps, "time"), figure(series.largest_step)
        found.append(f"The system clock was adjusted {times}, by up to {biggest} s.")
        remedies.append("Wait for chrony or NTP to converge before recording.")
    return Check(" ".join(found), Level.LOOK if remedies else Level.GOOD, " ".join(remedies))


def _rate(examined: Examination) -> Check:
    series = examined.series
    if series.nominal_period is None:
        return _not_possible("Neither settings nor rate are known.", "Record the settings too.")
    rate, wanted = 1 / series.mean_period, 1 / series.nominal_period
    ppm = (rate / wanted - 1) * 1e6
    return Check(f"{rate:.3f} Hz; the settings say {wanted:.3f} Hz ({ppm:+.0f} ppm).")


def _force_torque(examined: Examination) -> Check:
    series = examined.series
    if series.subject.sinc_length is None:
        found = "The SINC length is not known, so no limit is known."
        return _not_possible(found, "Record the settings too.")
    if not series.subject.settings.get("calibration_matrix"):
        found = (
            "Force and torque are raw counts (the calibration matrix is off), and the limits are in N and Nm."
        )
        return _not_possible(found, "Enable calibration_matrix and record again.")
    return _noise(examined.noise, range(6))


def _imu(examined: Examination) -> Check:
    if examined.series.imu_off:
        return Check("The IMU is off.", level=Level.NOT_APPLICABLE)
    return _noise(examined.noise, range(6, 12))


_VERY_NOISY: Final = 4.0  # times the limit
_FEWEST_NOISY: Final = 2  # windows: one may be a knock


def _noise(noise: Noise, indices: range) -> Check:
    if noise.calm == 0:
        found = f"Only {noise.windows} windows of {figure(noise.window_s, 2)} s could be used"
        needed = f"{found}; {_FEWEST_WINDOWS} are needed."
        return _not_possible(needed, "Record for at least 10 s without interruption.")
    ratio, times = noise.deviation / noise.limit, noise.worst / noise.limit

    def told(n: int, size: Floats, times: Floats) -> str:
        limit = f"{figure(times[n], 2)} times the limit of {figure(noise.limit[n])}"
        return f"{figure(size[n])} {CHANNELS[n].group.unit}, {limit}"

    if above := [n for n in indices if ratio[n] > 1]:
        if _is_shaken(noise.deviation, noise.limit):  # even in the calm windows
            shaken = "The sensor was shaken all the time (the accelerometer shows it)"
            found = f"{shaken}, so noise cannot be told from vibration."
            return _not_possible(found, "Record again with the sensor stationary.")
        texts = [f"{CHANNELS[n].title} has a noise of {told(n, noise.deviation, ratio)}" for n in above]
        return Check(f"{listing(texts)}.", Level.TROUBLE)
    if noisy := [n for n in indices if noise.noisy[n] >= _FEWEST_NOISY]:
        of = f"of {noise.windows} windows of {figure(noise.window_s, 2)} s, at worst"
        texts = [
            f"{CHANNELS[n].title} is noisy in {noise.noisy[n]} {of} {told(n, noise.worst, times)}"
            for n in noisy
        ]
        level = Level.TROUBLE if max(times[noisy]) > _VERY_NOISY else Level.LOOK
        return Check(f"{listing(texts)}.", level)
    if unknown := [CHANNELS[n].title for n in indices if not np.isfinite(ratio[n])]:
        found = f"It could not be measured for {listing(unknown)}: too often saturated or not a number."
        return _not_possible(found, "Fix that first, then record again.")
    worst = max(indices, key=lambda n: float(ratio[n]))
    what = f"{CHANNELS[worst].title}: {figure(noise.deviation[worst])} {CHANNELS[worst].group.unit}"
    return Check(f"At most {figure(100 * ratio[worst], 2)} % of a healthy sensor's limit ({what}).")


_LONGEST_S: Final = 0.1
_LONGEST_SAMPLES: Final = 16
_IMU_LONGEST_S: Final = 5.0
_WHOLE: Final = 0.9  # a channel that is constant for this share of a short recording is stuck too
_SHORTEST_S: Final = 1.0  # shorter recordings say nothing about the IMU


def _stuck(examined: Examination) -> Check:
    series = examined.series
    if series.duration < _SHORTEST_S:
        found = f"The recording is only {seconds(series.duration)} long."
        return _not_possible(found, "Record for at least 10 s.")
    imu_longest_s = min(_IMU_LONGEST_S, max(_WHOLE * series.duration, _SHORTEST_S))
    stuck, longest = [], 0
    for channel, run in zip(CHANNELS, examined.runs, strict=True):
        span, samples = run.seconds, run.samples
        if channel.group.is_imu:
            is_stuck = span > imu_longest_s and not series.imu_off
        else:
            is_stuck, longest = samples > _LONGEST_SAMPLES and span > _LONGEST_S, max(longest, samples)
        if is_stuck:
            stuck.append(
                f"{channel.title} was constant at {figure(run.value, 5)} {channel.group.unit} for "
                f"{seconds(span)} ({samples} samples) from {seconds(run.begin_s)} on"
            )
    if stuck:
        return Check(f"{listing(stuck)}.", Level.TROUBLE)
    run_text = count(longest, "sample")
    return Check(f"No channel is stuck; the longest constant run of a force or torque is {run_text}.")


_GRAVITY_TOLERANCE: Final = 1.0  # m/s²: an accelerometer's offset is well below it


def _gravity(examined: Examination) -> Check:
    usual, g = examined.series.gravity, STANDARD_GRAVITY
    if examined.series.imu_off:
        return Check("The IMU is off.", level=Level.NOT_APPLICABLE)
    if usual is None:
        return _too_few(0)
    found = f"The accelerometer measures {figure(usual)} m/s² (median of the norm); {g} is one g."
    if abs(usual - g) <= _GRAVITY_TOLERANCE:
        return Check(found)
    remedy = "If the sensor was stationary: check acceleration_range_g and the acceleration offset (0x8001)."
    if abs(usual / g - g) < _GRAVITY_TOLERANCE:
        remedy = "This firmware sends SI units: use --imu-raw-units si (ROS node: imu_raw_units)."
    elif abs(usual * g - g) < _GRAVITY_TOLERANCE:
        remedy = "This firmware sends g: omit --imu-raw-units si."
    return Check(found, Level.LOOK, remedy)


def _temperature(examined: Examination) -> Check:
    known = examined.series.temperatures
    return Check(f"{figure(known[0])} to {figure(known[1])} °C.") if known else _too_few(0)


_FEWEST: Final = 100  # samples to judge their intervals by
_SATURATED: Final = {f"warning {int(row.flag)}" for row in SATURATIONS}
_CHECKS: Final = (
    _Kind("Lost samples", ["lost"], _FEWEST, None,
          "A controller acts on stale data; derivatives are wrong there.", good="None."),
    _Kind("Silent or stuck sensor", ["silence", "invalid", "repeated"], 1, None,
          "What is published in the meantime is stale.", good="The sensor sent new samples all the time."),
    _Kind("Stuck values", [], 1, _stuck, "The channel does not measure.",
          "Power-cycle the sensor. If it persists, it needs repair."),
    _Kind("Noise of force and torque", [], 0, _force_torque,
          "Small forces are hidden by it, and a controller reacts to it.",
          "Record again with the sensor stationary and unloaded. If it persists, check cable, shield and "
          "supply, then contact the manufacturer."),
    _Kind("Noise of the IMU", [], 0, _imu, "Gravity compensation and the like become noisy.",
          "Record again with the sensor stationary. If it persists, contact the manufacturer."),
    _Kind("Saturation", _SATURATED, 1, None, "The measured values are less than the real ones.",
          "If it is unloaded, it may have been damaged by overload: tare it and compare.",
          "No channel was saturated."),
    _Kind("Warnings", {f"warning {1 << bit}" for bit in range(32)} - _SATURATED, 1, None,
          "The sensor reports it.", good="The sensor reported no other."),
    _Kind("Numbers", ["not_finite"], 1, None, "A single one of them corrupts every sum and filter.",
          good="Every value is a finite number."),
    _Kind("Stamps", ["clock"], _FEWEST, _stamps, "Sensor fusion and derivatives suffer."),
    _Kind("Sampling rate", ["rate"], _FEWEST, _rate),
    _Kind("Gravity", [], 0, _gravity, "Gravity compensation subtracts the wrong weight."),
    _Kind("Temperature", ["temperature"], 0, _temperature),
    _Kind("Settings", ["calibration_matrix", "coordinate_system"], 0, None),
)  # fmt: skip


def _observe(series: Series) -> Observation:
    """The whole stream."""
    counts, nominal = series.counts, series.nominal_period
    judged = series.count >= _FEWEST
    coldest, hottest = series.temperatures or (0.0, None)
    return Observation(
        seconds=series.duration,
        samples=series.count,
        lost=max(series.lost, counts.missing),
        repeated=counts.repeated,
        invalid=counts.invalid,
        silent_s=series.longest_silence,
        rate_hz=1 / series.mean_period if judged else None,
        nominal_hz=1 / nominal if nominal else 0.0,
        not_finite=series.not_finite,
        **cast(Any, series.bits),
        temperature=coldest if coldest < LIMITS.coldest else hottest,
        # Whether the stamps are not those of a clock that is followed.
        locked=False if judged and series.usual_deviation > LIMITS.irregular * series.period else None,
        lost_because=series.subject.lost_because,
        settings=series.subject.settings,
    )
