"""What `ethercat-export align` does: the offset between the server's clock and a robot's, by how both turned.

The angular rates of two bodies that are mounted on each other are the same but for a rotation. The offset is
first looked for by the magnitude of the rates, which needs no rotation, then in each of eight parts by least
squares together with the rotation and the gyroscope's offset. A line through the eight has the drift, and how
far they are off it tells the interval, which so covers what the model leaves out.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.export.cli import PROGRAM, Options
from bota_clients.export.frame_times import messages, stamp_ns
from bota_clients.identify.program import choose
from bota_clients.numbers import moment
from bota_clients.program import interrupt_on_signals, say
from bota_clients.recording.columns import Ints, decode
from bota_clients.recording.reader import open_recording
from bota_ethercat.sensor.response import angular_rate_response
from bota_ethercat.settings import known_settings
from ft_compensation.identification.delay import at_times, hann_window, lowest, smoothed

Array = npt.NDArray[np.float64]
_GRID_S: Final = 0.01
_SMOOTH_S: Final = 0.1
_STEP_S: Final = 0.02  # of the search in a part, and so far ...
_AROUND_S: Final = 0.4  # ... which a drift of 200 ppm in an hour takes
_PARTS: Final = 8
_T_95: Final = 2.447  # Student's t for as many parts, less two
_SHORTEST_S: Final = 10.0
_LEAST_RATE: Final = 0.05  # rad/s, root mean square
_EXPLAINED: Final = 0.5
_CANDIDATES: Final = 4
_APART_S: Final = 0.5  # one from the other
_OTHER: Final = 0.9  # of what the best candidate explains: another that does as much may be right, too
_WIDEST_MS: Final = 5.0


class ClockOffset(NamedTuple):
    """One clock, x, by another, y: x = y + offset + drift (y - at)."""

    at_s: float  # y
    offset_s: float
    interval_ms: float  # half of the 95 % interval, as drift_interval_ppm
    drift_ppm: float
    drift_interval_ppm: float


def find_offset(times: Array, rates: Array, other_times: Array, other_rates: Array) -> ClockOffset:
    """From (n,) s, (n, 3) rad/s of the sensor and (m,), (m, 3) of the robot, each by its own clock.

    RecordingError if the motion does not show it.
    """
    sensor, robot = _smooth("sensor", times, rates), _smooth("robot", other_times, other_rates)

    def looks_at(offset: float, step_s: float, margin_s: float = 0.0) -> Array:
        begin, end = max(robot[0][0], sensor[0][0] - offset), min(robot[0][-1], sensor[0][-1] - offset)
        return np.arange(begin + margin_s, end - margin_s, step_s)

    tried = [
        (1.0 - float(np.divide(*_rest(sensor, robot, looks, offset))), offset)
        for offset in _candidates(sensor, robot)
        if len(looks := looks_at(offset, _STEP_S)) * _STEP_S > _SHORTEST_S
    ]
    (explained, coarse), (other, _) = [*sorted(tried, reverse=True), (0.0, 0.0), (0.0, 0.0)][:2]
    if not explained > _EXPLAINED:
        raise RecordingError(
            f"the robot's motion explains only {100 * max(explained, 0):.0f} % of the sensor's: record both "
            "at the same time, of one body that turns about several axes"
        )
    if other > _OTHER * explained:
        raise RecordingError("the motion repeats itself, so several offsets fit: move without a rhythm")
    rows = []
    for looks in np.array_split(looks_at(coarse, _GRID_S, _AROUND_S), _PARTS):

        def left(offset: float, looks: Array = looks) -> float:
            return float(_rest(sensor, robot, looks, offset)[0])

        around = coarse + np.arange(-_AROUND_S, _AROUND_S, _STEP_S)
        best = lowest(left, float(around[np.argmin([left(offset) for offset in around])]), _STEP_S)
        curve = left(best - _STEP_S) - 2 * left(best) + left(best + _STEP_S)
        rows.append((looks.mean(), best, max(curve, 1e-12)))
    at, offsets, weights = np.array(rows).T
    middle = float(np.average(at, weights=weights))
    off, offset = at - middle, float(np.average(offsets, weights=weights))
    weight, lever = float(weights.sum()), float((weights * off**2).sum())
    drift = float((weights * off * offsets).sum()) / lever
    scatter = float((weights * (offsets - offset - drift * off) ** 2).sum()) / (_PARTS - 2)
    interval_ms, drift_interval_ppm = (
        _T_95 * float(np.sqrt(scatter / total)) * scale for total, scale in ((weight, 1e3), (lever, 1e6))
    )
    if not interval_ms < _WIDEST_MS:
        raise RecordingError(
            f"the motion is too slow to tell (± {interval_ms:.0f} ms): turn faster, and about several axes"
        )
    return ClockOffset(middle, offset, interval_ms, drift * 1e6, drift_interval_ppm)


def _smooth(which: str, times: Array, rates: Array) -> tuple[Array, Array]:
    """Even times, and the rates at these; RecordingError if they are too few or too small."""
    if times[-1] - times[0] < _SHORTEST_S:
        raise RecordingError(f"the {which} was recorded for less than {_SHORTEST_S:g} s: record a minute")
    if np.linalg.norm(rates.std(axis=0)) < _LEAST_RATE:
        raise RecordingError(f"the {which} hardly turned: turn it about several axes")
    period = float(np.median(np.diff(times)))
    even = np.arange(times[0], times[-1], period)
    return even, smoothed(at_times(even, times, rates), hann_window(_SMOOTH_S, period))


def _rest(sensor: tuple[Array, Array], robot: tuple[Array, Array], looks: Array, offset: float) -> Array:
    """What no rotation of the robot's rates explains of the sensor's, and all of theirs, (rad/s)²."""
    basis = np.linalg.qr(np.column_stack([at_times(looks, *robot), np.ones(len(looks))]))[0]
    felt = at_times(looks + offset, *sensor)
    return np.array([((felt - basis @ (basis.T @ felt)) ** 2).sum(), felt.var(axis=0).sum() * len(looks)])


def _candidates(sensor: tuple[Array, Array], robot: tuple[Array, Array]) -> list[float]:
    """The offsets at which the magnitudes of the rates agree best, s."""
    sizes = [
        np.linalg.norm(at_times(np.arange(even[0][0], even[0][-1], _STEP_S), *even), axis=1)
        for even in (sensor, robot)
    ]
    size = sum(map(len, sizes))
    spectra = [np.fft.rfft(each - each.mean(), size) for each in sizes]
    found, offsets = np.fft.irfft(spectra[0] * spectra[1].conj(), size), list[float]()
    apart = round(_APART_S / _STEP_S)
    for _ in range(_CANDIDATES):
        best = int(np.argmax(found))
        lag = best if best < len(sizes[0]) else best - size
        offsets.append(float(sensor[0][0] - robot[0][0]) + lag * _STEP_S)
        found[np.arange(best - apart, best + apart + 1) % size] = -np.inf
    return offsets


def _robot_rates(options: Options) -> tuple[Ints, Array]:
    """Stamps (n,), ns, and angular rates (n, 3), rad/s: as an IMU has them, or of a link in its own frame."""
    path, topic = options.bag, options.topic or ""
    joints = [] if options.urdf is None else _chain(options.urdf, options.link)
    turning = [name for name, _, axis in joints if axis.any()]
    stamps, rows = list[int](), list[list[float]]()
    for message in messages(path, topic):
        if hasattr(message, "angular_velocity"):
            rate, joints = message.angular_velocity, []
            rows.append([rate.x, rate.y, rate.z])
        elif not joints or not hasattr(message, "position"):
            raise RecordingError(f"{topic} is no sensor_msgs/Imu, and no JointState with --urdf and --link")
        elif set(turning) <= set(message.name):  # else of another part of the robot, a gripper say
            at = dict(zip(message.name, message.position, strict=True))
            rows.append([at[name] for name in turning])
        else:
            continue
        stamps.append(stamp_ns(message, topic))
    if len(stamps) < 2 or (np.diff(stamps) <= 0).any():
        raise RecordingError(
            f"the messages of {topic} in {path} are too few, or not in the order of their stamps"
        )
    times, values = np.array(stamps, np.int64), np.array(rows)
    if not joints:
        return times, values
    pose: Any = np.eye(3)[np.newaxis]  # (n, 3, 3) of the link
    for name, origin, axis in joints:
        pose = pose @ origin
        if axis.any():
            pose = pose @ _turned(axis, values[:, turning.index(name)])
    step, passed = pose[:-1].swapaxes(1, 2) @ pose[1:], np.diff(times)
    twice = step - step.swapaxes(1, 2)  # the sine of a small angle
    rates = twice[:, (2, 0, 1), (1, 2, 0)] / (2e-9 * passed[:, np.newaxis])
    return times[:-1] + passed // 2, np.asarray(rates)


def _chain(urdf: Path, link: str | None) -> list[tuple[str, Array, Array]]:
    """Name, rotation and axis of each joint from the root to `link`; no axis (zeros): it does not turn."""
    try:
        joints = [*ElementTree.parse(urdf).getroot().iterfind("joint")]  # noqa: S314 - a file of the user's
    except (OSError, ElementTree.ParseError) as error:
        raise RecordingError(f"{urdf} cannot be read as URDF: {error}") from None

    def given(joint: ElementTree.Element, tag: str, key: str, default: str = "") -> str:
        found = joint.find(tag)
        return default if found is None else found.get(key, default)

    above, chain, at = {given(joint, "child", "link"): joint for joint in joints}, [], link or ""
    while (joint := above.pop(at, None)) is not None:
        at = given(joint, "parent", "link")
        angles = np.array(given(joint, "origin", "rpy", "0 0 0").split(), float)
        roll, pitch, yaw = (_turned(axis, angles[[n]])[0] for n, axis in enumerate(np.eye(3)))
        axis = np.array(given(joint, "axis", "xyz", "1 0 0").split(), float)
        axis *= joint.get("type") in ("revolute", "continuous")
        chain.append((joint.get("name", ""), yaw @ pitch @ roll, axis))
    if not any(axis.any() for _, _, axis in chain):
        raise RecordingError(f"{urdf} has no joint that turns link {link}")
    return chain[::-1]


def _turned(axis: Array, angles: Array) -> Array:
    """(n, 3, 3) rotations about an axis, rad."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross))


def run(options: Options) -> int:
    """Find it; returns the exit code."""
    interrupt_on_signals()
    with open_recording(options.recording) as recording:
        rows = []
        for settings, frames in recording.batches(choose(recording, options.sensor).sensor):
            table = decode(frames, options.imu_units)
            table = table.where(table.fresh & np.isfinite(table.angular_rate).all(axis=1))
            delay_s = angular_rate_response(known_settings(settings.values)).delay_s or 0.0
            rows.append((table.monotonic_ns - round(delay_s * 1e9), table.angular_rate))
    instants, rates = map(np.concatenate, zip(*rows, strict=True))
    robot_stamps, robot_rates = _robot_rates(options)
    try:
        if (np.diff(instants) <= 0).any():
            raise RecordingError("the server's machine was restarted during the recording: record again")
        since, robot_since = instants - instants[0], robot_stamps - robot_stamps[0]
        found = find_offset(since * 1e-9, rates, robot_since * 1e-9, robot_rates)
    except RecordingError as refusal:
        if options.json:
            sys.stdout.write(json.dumps({"ok": False, "error": str(refusal)}, indent=1) + "\n")
        say(PROGRAM, f"{options.recording}, {options.topic}: {refusal}")
        return 1
    robot_ns = int(robot_stamps[0]) + round(found.at_s * 1e9)
    monotonic_ns = int(instants[0]) + round((found.at_s + found.offset_s) * 1e9)
    # The server's clocks are as far apart as at the end of the recording.
    offset_ms = (monotonic_ns + frames[-1].stamp_ns - frames[-1].monotonic_ns - robot_ns) * 1e-6
    values = {"ok": True, "stamp_ns": robot_ns, "monotonic_ns": monotonic_ns, "offset_ms": offset_ms}
    values |= dict(zip(found._fields[2:], found[2:], strict=True))
    text = (
        "to stamps of {topic} add {offset_ms:+.2f} ms (± {interval_ms:.2f} ms, 95 %) at {when}, and "
        "{drift_ppm:+.1f} ppm (± {drift_interval_ppm:.1f}) of the time since then: that is the server's "
        "CLOCK_REALTIME\n"
    ).format(topic=options.topic, when=moment(robot_ns), **values)
    sys.stdout.write(json.dumps(values, indent=1) + "\n" if options.json else text)
    return 0
