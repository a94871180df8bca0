"""What `ethercat-export align` does: the offset between the server's clock and a robot's, by how both turned.

The angular rates of two bodies that are mounted on each other are the same but for a rotation. The offset is
first looked for by the magnitude of the rates, which needs no rotation, then in each of eight parts by least
squares together with the rotation and the gyroscope's offset. A line through the eight has the drift, and how
far they are off it tells the interval, which so covers residuals that are correlated; it is found twice, the
second time with the drift of the first taken out of each part.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.export.cli import PROGRAM
from bota_clients.export.frame_times import Clock, messages, stamp_ns
from bota_clients.identify.program import choose
from bota_clients.numbers import moment
from bota_clients.program import interrupt_on_signals, say
from bota_clients.recording.columns import Ints, decode
from bota_clients.recording.reader import open_recording
from bota_ethercat.sensor.response import angular_rate_response
from bota_ethercat.settings import known_settings
from ft_compensation.identification.delay import at_times, hann_window, lowest, smoothed

Array = npt.NDArray[np.float64]
_SMOOTH_S: Final = 0.1
_STEP_S: Final = 0.02
_AROUND_S: Final = 0.4  # of a part: what a drift of 200 ppm in an hour takes
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

    def looks_at(offset: float) -> Array:
        begin, end = max(robot[0][0], sensor[0][0] - offset), min(robot[0][-1], sensor[0][-1] - offset)
        return np.arange(begin + _AROUND_S, end - _AROUND_S, _STEP_S / 2)

    def left(looks: Array, offset: float | Array) -> float:
        """The part of the sensor's rates that no rotation of the robot's explains."""
        basis = np.linalg.qr(np.column_stack([at_times(looks, *robot), np.ones(len(looks))]))[0]
        felt = at_times(looks + offset, *sensor)
        return float(((felt - basis @ (basis.T @ felt)) ** 2).sum() / (felt.var(axis=0).sum() * len(looks)))

    tried = [
        (left(looks, offset), offset)
        for offset in _candidates(sensor, robot)
        if len(looks := looks_at(offset)) * _STEP_S / 2 > _SHORTEST_S - 4 * _AROUND_S
    ]
    (rest, coarse), (other, _) = [*sorted(tried), (1.0, 0.0), (1.0, 0.0)][:2]
    if rest > 1 - _EXPLAINED:
        raise RecordingError(
            f"the robot's motion explains only {100 * (1 - rest):.0f} % of the sensor's: record both "
            "at the same time, of one body that turns about several axes"
        )
    if 1 - other > _OTHER * (1 - rest):
        raise RecordingError("the motion repeats itself, so several offsets fit: move without a rhythm")
    looks = looks_at(coarse)
    middle, line = float(looks.mean()), np.array([0.0, coarse])
    for around in (np.arange(-_AROUND_S, _AROUND_S, _STEP_S), np.zeros(1)):
        rows = []
        for part in np.array_split(looks, _PARTS):
            at, expected = part - middle, np.polyval(line, part - middle)

            def missed(offset: float, part: Array = part, expected: Array = expected) -> float:
                return left(part, expected + offset)

            best = lowest(missed, min(around.tolist(), key=missed), _STEP_S)
            curve = missed(best - _STEP_S) - 2 * missed(best) + missed(best + _STEP_S)
            rows.append((at.mean(), best, max(curve, 1e-12) ** 0.5))
        at, offsets, weights = np.array(rows).T
        change, covariance = np.polyfit(at, offsets, 1, w=weights, cov=True)
        line = line + change
    drift_interval, interval = _T_95 * np.sqrt(np.diag(covariance))
    if not interval * 1e3 < _WIDEST_MS:
        raise RecordingError(
            f"the motion is too slow to tell (± {interval * 1e3:.0f} ms): turn faster, and about several axes"
        )
    drift, offset = line.tolist()
    return ClockOffset(middle, offset, float(interval) * 1e3, drift * 1e6, float(drift_interval) * 1e6)


def _smooth(which: str, times: Array, rates: Array) -> tuple[Array, Array]:
    """Even times, and the rates at these; RecordingError if they are too few or too small."""
    if times[-1] - times[0] < _SHORTEST_S:
        raise RecordingError(f"the {which} was recorded for less than {_SHORTEST_S:g} s: record a minute")
    if np.linalg.norm(rates.std(axis=0)) < _LEAST_RATE:
        raise RecordingError(f"the {which} hardly turned: turn it about several axes")
    period = float(np.median(np.diff(times)))
    even = np.arange(times[0], times[-1], period)
    return even, smoothed(at_times(even, times, rates), hann_window(_SMOOTH_S, period))


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


def _robot_rates(path: Path, topic: str, urdf: Path | None, link: str) -> tuple[Ints, Array]:
    """Stamps (n,), ns, and angular rates (n, 3), rad/s: as an IMU has them, or of a link in its own frame."""
    joints = [] if urdf is None else _chain(urdf, link)
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
    angles = dict(zip(turning, values.T, strict=True))
    pose = np.eye(3)
    for name, origin, axis in joints:
        pose = pose @ origin @ _turned(np.outer(angles.get(name, 0.0), axis))
    step, passed = pose[:-1].swapaxes(1, 2) @ pose[1:], np.diff(times)
    twice = step - step.swapaxes(1, 2)  # the sine of a small angle
    return times[:-1] + passed // 2, twice[:, (2, 0, 1), (1, 2, 0)] / (2e-9 * passed[:, np.newaxis])


def _chain(urdf: Path, link: str) -> list[tuple[str, Array, Array]]:
    """Name, rotation (3, 3) and axis of each joint from the root to `link`; axis zeros: it does not turn."""
    chain = list[tuple[str, Array, Array]]()
    try:
        joints: Any = ElementTree.parse(urdf).iterfind("joint")  # noqa: S314 - a file of the user's
        above, at = {joint.find("child").get("link"): joint for joint in joints}, link
        while (joint := above.pop(at, None)) is not None:
            at = joint.find("parent").get("link")
            tags = {each.tag: each for each in joint}
            rpy, axis = (
                np.array(tags[tag].get(key, given).split() if tag in tags else given.split(), float)
                for tag, key, given in (("origin", "rpy", "0 0 0"), ("axis", "xyz", "1 0 0"))
            )
            roll, pitch, yaw = _turned(np.diag(rpy))
            turns = joint.get("type") in ("revolute", "continuous")
            chain.insert(0, (joint.get("name"), yaw @ pitch @ roll, turns * axis / np.linalg.norm(axis)))
    except (OSError, ElementTree.ParseError, AttributeError, ValueError) as error:
        raise RecordingError(f"{urdf} cannot be read as URDF: {error}") from None
    if not any(axis.any() for _, _, axis in chain):
        raise RecordingError(f"{urdf} has no joint that turns link {link}")
    return chain


def _turned(vectors: Array) -> Array:
    """(n, 3, 3) rotations by rotation vectors (n, 3), rad."""
    angle = np.linalg.norm(vectors, axis=1)[:, np.newaxis, np.newaxis] / np.pi
    cross = np.cross(vectors[:, np.newaxis], np.eye(3)).swapaxes(1, 2)
    return np.asarray(np.eye(3) + np.sinc(angle) * cross + np.sinc(angle / 2) ** 2 / 2 * (cross @ cross))


def run(options: argparse.Namespace) -> int:
    """Find it; returns the exit code. RecordingError."""
    interrupt_on_signals()
    with open_recording(options.recording) as recording:
        rows = []
        for settings, frames in recording.batches(choose(recording, options.sensor).sensor):
            table = decode(frames, options.imu_units)
            table = table.where(table.fresh & np.isfinite(table.angular_rate).all(axis=1))
            delay_s = angular_rate_response(known_settings(settings.values)).delay_s or 0.0
            rows.append((table.monotonic_ns - round(delay_s * 1e9), table.angular_rate))
    instants, rates = map(np.concatenate, zip(*rows, strict=True))
    if (np.diff(instants) <= 0).any():
        raise RecordingError("the server's machine was restarted during the recording: record again")
    stamps, robot_rates = _robot_rates(options.bag, options.topic, options.urdf, options.link)
    found = find_offset((instants - instants[0]) * 1e-9, rates, (stamps - stamps[0]) * 1e-9, robot_rates)
    at_ns, offset_ns = round(found.at_s * 1e9), round(found.offset_s * 1e9)
    clock = Clock(int(stamps[0]) + at_ns, int(instants[0]) + at_ns + offset_ns, found.drift_ppm)
    # The server's clocks are as far apart as at the end of the recording.
    apart_ns = frames[-1].stamp_ns - frames[-1].monotonic_ns
    values = clock._asdict() | {"offset_ms": (clock.monotonic_ns + apart_ns - clock.stamp_ns) * 1e-6}
    values |= {"interval_ms": found.interval_ms, "drift_interval_ppm": found.drift_interval_ppm}
    text = (
        "to stamps of {topic} add {offset_ms:+.2f} ms (± {interval_ms:.2f} ms, 95 %) at {when}, and "
        "{drift_ppm:+.1f} ppm (± {drift_interval_ppm:.1f}) of the time since then: that is the server's "
        "CLOCK_REALTIME"
    )
    say(PROGRAM, text.format(topic=options.topic, when=moment(clock.stamp_ns), **values))
    sys.stdout.write(json.dumps(values, indent=1) + "\n")
    return 0
