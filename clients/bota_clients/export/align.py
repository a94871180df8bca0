"""What `ethercat-export align` does: the offset between the server's clock and a robot's, by how both turned.

The angular rates of two bodies that are mounted on each other are the same but for a rotation. The offset is
first looked for by the magnitude of the rates, which needs no rotation, then improved by least squares together
with the drift, the rotation and the gyroscope's offset. Its interval is by how much eight parts of the recording
disagree, which covers what the model leaves out.
"""

from __future__ import annotations

import json
import sys
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.export.cli import PROGRAM, AlignOptions
from bota_clients.export.robot_motion import Array, angular_rates
from bota_clients.identify.program import choose
from bota_clients.numbers import moment
from bota_clients.program import interrupt_on_signals, say
from bota_clients.recording.columns import decode
from bota_clients.recording.reader import open_recording
from bota_ethercat.sensor.response import angular_rate_response
from bota_ethercat.settings import known_settings
from ft_compensation.identification.delay import at_times, hann_window, smoothed

_GRID_S: Final = 0.01
_SMOOTH_S: Final = 0.1
_COARSE: Final = 5  # grid steps between looks of the first search
_CANDIDATES: Final = 4
_APART_S: Final = 0.5  # offsets so far apart are different ones
_MOST_DRIFT: Final = 200e-6
_PARTS: Final = 8
_T_95: Final = 2.447  # Student's t for as many parts, less two
_SHORTEST_S: Final = 10.0
_LONGEST_GAP_S: Final = 0.1
_LEAST_RATE: Final = 0.05  # rad/s, root mean square
_EXPLAINED: Final = 0.5
_OTHER: Final = 0.9  # another offset explains less than this part of what the best one does
_WIDEST_S: Final = 0.005
_ITERATIONS: Final = 8


class ClockOffset(NamedTuple):
    """One clock by another: x = y + offset + drift (y - at)."""

    at_s: float  # y
    offset_s: float
    offset_interval_s: float  # half of the 95 % interval
    drift: float
    drift_interval: float
    explained: float  # part of the variance of the rates, 0 to 1


class _Motion:
    """Angular rates on an even grid, smoothed."""

    def __init__(self, times: Array, rates: Array) -> None:
        self.begin, self.end = float(times[0]), float(times[-1])
        self._stamps = times
        period = float(np.median(np.diff(times)))
        self._times = np.arange(times[0], times[-1], period)
        self._rates = smoothed(at_times(self._times, times, rates), hann_window(_SMOOTH_S, period))
        self._slopes = np.gradient(self._rates, period, axis=0)

    def covers(self, looks: Array) -> npt.NDArray[np.bool_]:
        """Where there are samples near, and all that the smoothing takes in."""
        after = np.clip(np.searchsorted(self._stamps, looks), 1, len(self._stamps) - 1)
        near = self._stamps[after] - self._stamps[after - 1] <= _LONGEST_GAP_S
        return near & (looks > self.begin + _SMOOTH_S) & (looks < self.end - _SMOOTH_S)

    def rates(self, looks: Array) -> Array:
        return at_times(looks, self._times, self._rates)

    def slopes(self, looks: Array) -> Array:
        return at_times(looks, self._times, self._slopes)


class _Look(NamedTuple):
    """Of one offset and drift."""

    explained: float
    rest: Array  # (n, 3) of the sensor's rates, rad/s
    slopes: Array  # (n, 3) what a later instant would change, rad/s²
    since: Array  # (n,) s


def _look(sensor: _Motion, robot: _Motion, looks: Array, offset: float, drift: float, at: float) -> _Look:
    """The sensor's rates less what a rotation of the robot's explains."""
    instants = looks + offset + drift * (looks - at)
    used = sensor.covers(instants) & robot.covers(looks)
    looks, instants = looks[used], instants[used]
    if len(looks) * (looks[1] - looks[0] if len(looks) > 1 else 0.0) < _SHORTEST_S:
        return _Look(-1.0, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    basis = np.linalg.qr(np.column_stack([robot.rates(looks), np.ones(len(looks))]))[0]
    rates = sensor.rates(instants)
    rest, slopes = (rows - basis @ (basis.T @ rows) for rows in (rates, sensor.slopes(instants)))
    total = float(((rates - rates.mean(axis=0)) ** 2).sum())
    return _Look(1.0 - float((rest**2).sum()) / total if total else 0.0, rest, slopes, looks - at)


def find_offset(times: Array, rates: Array, other_times: Array, other_rates: Array) -> ClockOffset:
    """From (n,) s, (n, 3) rad/s of the sensor and (m,), (m, 3) of the robot, each by its own clock.

    RecordingError if the motion does not show it.
    """
    for which, each, begin_end in (("sensor", rates, times), ("robot", other_rates, other_times)):
        if begin_end[-1] - begin_end[0] < _SHORTEST_S:
            raise RecordingError(f"the {which} was recorded for less than {_SHORTEST_S:g} s: record a minute")
        if np.sqrt(((each - each.mean(axis=0)) ** 2).sum(axis=1).mean()) < _LEAST_RATE:
            raise RecordingError(f"the {which} hardly turned: turn the sensor about several axes")
    sensor, robot = _Motion(times, rates), _Motion(other_times, other_rates)
    looks = np.arange(robot.begin, robot.end, _GRID_S)
    at = 0.5 * (robot.begin + robot.end)
    coarse, length = looks[::_COARSE], robot.end - robot.begin
    # As many drifts as it takes to stay near at both ends.
    steps = round(_MOST_DRIFT * length / _SMOOTH_S)
    tried = [
        (_look(sensor, robot, coarse, offset, drift, at).explained, offset, float(drift))
        for offset in _candidates(sensor, robot)
        for drift in _MOST_DRIFT / max(steps, 1) * np.arange(-steps, steps + 1)
    ]
    explained, offset, drift = max(tried)
    others = [each for each, other, _ in tried if abs(other - offset) > _APART_S]
    if max(others, default=0.0) > max(_OTHER * explained, _EXPLAINED):
        raise RecordingError("the motion repeats itself, so several offsets fit: move without a rhythm")
    for _ in range(_ITERATIONS):
        look = _look(sensor, robot, looks, offset, drift, at)
        if not len(look.since):
            break
        pace = np.column_stack([look.slopes.ravel(), (look.slopes * look.since[:, np.newaxis]).ravel()])
        change = -np.linalg.lstsq(pace, look.rest.ravel(), rcond=None)[0]
        offset, drift = offset + float(change[0]), drift + float(change[1])
    if look.explained < _EXPLAINED:
        raise RecordingError(
            f"the robot's motion explains only {100 * max(look.explained, 0):.0f} % of the sensor's: record "
            "both at the same time, of one body that turns about several axes"
        )
    # Of each part the lag that fits best; a line through them has the lag at the middle, and the drift.
    parts = np.array_split(np.arange(len(look.since)), _PARTS)
    weights = np.array([(look.slopes[part] ** 2).sum() for part in parts])
    fitted = np.array([-(look.slopes[part] * look.rest[part]).sum() for part in parts])
    lags, since = fitted / np.maximum(weights, 1e-30), np.array([look.since[part].mean() for part in parts])
    middle = float((weights * since).sum() / weights.sum())
    off = since - middle
    line = [(weights * lags).sum() / weights.sum(), (weights * off * lags).sum() / (weights * off**2).sum()]
    scatter = float((weights * (lags - line[0] - line[1] * off) ** 2).sum()) / (_PARTS - 2)
    interval, drift_interval = (
        _T_95 * float(np.sqrt(scatter / total)) for total in (weights.sum(), (weights * off**2).sum())
    )
    if not interval < _WIDEST_S:
        raise RecordingError(
            f"the motion is too slow to tell (± {interval * 1e3:.0f} ms): turn the sensor faster, and about "
            "several axes"
        )
    return ClockOffset(at + middle, offset + drift * middle, interval, drift, drift_interval, look.explained)


def _candidates(sensor: _Motion, robot: _Motion) -> list[float]:
    """The offsets at which the magnitudes of the rates agree best, s."""
    step = _GRID_S * _COARSE
    turned = []
    for motion in (sensor, robot):
        size = np.linalg.norm(motion.rates(np.arange(motion.begin, motion.end, step)), axis=1)
        turned.append(size - size.mean())
    size = len(turned[0]) + len(turned[1])
    spectra = [np.fft.rfft(each, size) for each in turned]
    found = np.fft.irfft(spectra[0] * spectra[1].conj(), size)
    offsets = []
    apart = round(_APART_S / step)
    for _ in range(_CANDIDATES):
        best = int(np.argmax(found))
        lag = best if best < len(turned[0]) else best - size
        offsets.append(sensor.begin - robot.begin + lag * step)
        found[np.arange(best - apart, best + apart + 1) % size] = -np.inf
    return offsets


def run(options: AlignOptions) -> int:
    """Find it; returns the exit code."""
    interrupt_on_signals()
    with open_recording(options.recording) as recording:
        sensor = choose(recording, options.sensor)
        rows = []
        for settings, frames in recording.batches(sensor.sensor):
            table = decode(frames, options.imu_units)
            table = table.where(table.fresh & np.isfinite(table.angular_rate).all(axis=1))
            delay_s = angular_rate_response(known_settings(settings.values)).delay_s or 0.0
            later_ns = round(delay_s * 1e9)
            rows.append((table.stamp_ns - later_ns, table.monotonic_ns - later_ns, table.angular_rate))
    stamps, instants, rates = map(np.concatenate, zip(*rows, strict=True))
    robot_stamps, robot_rates = angular_rates(options.bag, options.topic, options.urdf, options.link)
    try:
        if (np.diff(instants) <= 0).any():
            raise RecordingError("the server's machine was restarted during the recording: record again")
        found = find_offset(
            (instants - instants[0]) * 1e-9, rates, (robot_stamps - robot_stamps[0]) * 1e-9, robot_rates
        )
    except RecordingError as refusal:
        if options.json:
            sys.stdout.write(json.dumps({"ok": False, "error": str(refusal)}, indent=1) + "\n")
        say(PROGRAM, f"{options.recording}, {options.topic}: {refusal}")
        return 1
    stamp_ns = int(robot_stamps[0]) + round(found.at_s * 1e9)
    monotonic_ns = int(instants[0]) + round((found.at_s + found.offset_s) * 1e9)
    # The offset between the server's clocks is that of the nearest sample.
    nearest = min(int(np.searchsorted(instants, monotonic_ns)), len(instants) - 1)
    offset_ms = (monotonic_ns + int(stamps[nearest] - instants[nearest]) - stamp_ns) * 1e-6
    interval_ms, drift_ppm, drift_interval_ppm = (
        found.offset_interval_s * 1e3, found.drift * 1e6, found.drift_interval * 1e6,
    )  # fmt: skip
    if options.json:
        values = {
            "ok": True, "stamp_ns": stamp_ns, "monotonic_ns": monotonic_ns, "offset_ms": offset_ms,
            "interval_ms": interval_ms, "drift_ppm": drift_ppm, "drift_interval_ppm": drift_interval_ppm,
            "explained": found.explained,
        }  # fmt: skip
        sys.stdout.write(json.dumps(values, indent=1) + "\n")
    else:
        sys.stdout.write(
            f"to stamps of {options.topic} add {offset_ms:+.2f} ms (± {interval_ms:.2f} ms, 95 %) at "
            f"{moment(stamp_ns)}, and {drift_ppm:+.1f} ppm (± {drift_interval_ppm:.1f}) of the time since "
            "then: that is the server's CLOCK_REALTIME\n"
        )
    return 0
