"""What `ethercat-export align` does: the offset between the server's clock and a robot's, by how both turned.

The angular rates of two bodies that are mounted on each other are the same but for a rotation. The offset is
first looked for by their cross-correlation, then in each of eight parts by least squares together with the
rotation and the gyroscope's offset. A line through the eight has the drift, and how far they are off it tells
the interval, which so covers residuals that are correlated; it is found twice, the second time with the drift
of the first taken out of each part.

Two clocks may not be straight against each other: one is slewed or set, or warms up. Then a polynomial or a
step fits halves of the parts better than the line by more than noise explains (F test), and by how much the
two differ is part of the interval.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.export.cli import PROGRAM
from bota_clients.export.dataset import MOST_LEFT_OUT, ForeignClock, messages
from bota_clients.identify.program import choose
from bota_clients.numbers import count
from bota_clients.program import interrupt_on_signals, say
from bota_clients.recording.asked import Asked
from bota_clients.recording.columns import Ints
from bota_clients.recording.order import TimeAxis, in_order
from bota_clients.recording.reader import open_recording
from bota_ethercat.sensor.response import angular_rate_response
from bota_ft_compensation.identification.delay import lowest
from bota_ft_compensation.identification.resampling import at_times, hann_window, resampled, smoothed

Array = npt.NDArray[np.float64]
_SMOOTH_S: Final = 0.1
_STEP_S: Final = 0.02
_AROUND_S: Final = 0.4  # of a part: what a drift of 200 ppm in an hour takes
_PARTS: Final = 8
_T_95: Final = 2.447  # Student's t for as many parts, less two
_SHORTEST_S: Final = 10.0
_LONGEST: Final = 8  # stretches without a gap, of which the first offset is found
_LEAST_RATE: Final = 0.05  # rad/s, root mean square
_EXPLAINED: Final = 0.5
_APART_S: Final = 0.5
_OTHER: Final = 0.9  # of the highest correlation: another so far apart may be right, too
_WIDEST_S: Final = 0.005
_MOST_NAMED: Final = 40  # links
_MOST: Final = 1_500_000  # samples or messages: of a longer recording each second, third, ... is taken
_AT_ONCE: Final = 65_536  # poses
# What a clock's course is compared with: polynomials by their degree, and a step wherever it fits best; with
# the 99.7 % quantiles of F for 16 offsets.
_BENDING: Final = {2: 13.2, 3: 9.8, 5: 8.5}
_STEPPING: Final = 25.0


def find_offset(
    times_ns: Ints, rates: Array, robot_ns: Ints, robot_rates: Array
) -> tuple[ForeignClock, dict[str, float]]:
    """From (n,), (n, 3) rad/s of the sensor and (m,), (m, 3) of the robot, each by its own clock.

    The robot's clock, half of the 95 % intervals, and `bend_ms`, by how much the clocks are off the line if
    they are not straight against each other, else 0. RecordingError if the motion does not show it.
    """
    stretches = _smooth("sensor", times_ns, rates), _smooth("robot", robot_ns, robot_rates)
    sensor, robot = (
        (np.concatenate([x for x, _ in each]), np.concatenate([y for _, y in each])) for each in stretches
    )

    def residual(instants: Array, offset: float | Array) -> float:
        """The squares of the sensor's rates that no rotation of the robot's explains, (rad/s)²."""
        basis = np.linalg.qr(np.column_stack([at_times(instants, *robot), np.ones(len(instants))]))[0]
        felt = at_times(instants + offset, *sensor)
        return float(((felt - basis @ (basis.T @ felt)) ** 2).sum())

    lags, agree = _correlated(*stretches)
    best = int(np.argmax(agree))
    coarse = float(lags[best]) * _STEP_S
    instants = _shared(*stretches, coarse)
    rest = 1.0
    if len(instants) * _STEP_S / 2 > _SHORTEST_S / 2 - 2 * _AROUND_S:
        rest = residual(instants, coarse) / float(
            len(instants) * at_times(instants + coarse, *sensor).var(axis=0).sum()
        )
    if rest > 1 - _EXPLAINED:
        raise RecordingError(
            f"the robot's motion explains only {100 * (1 - rest):.0f} % of the sensor's: record both "
            "at the same time, of one body that turns about several axes"
        )
    if agree[abs(lags - lags[best]) * _STEP_S > _APART_S].max() > _OTHER * agree[best]:
        raise RecordingError("the motion repeats itself, so several offsets fit: move without a rhythm")
    middle, line = float(instants.mean()), np.array([0.0, coarse])

    def offsets_of(parts: int, around: Array) -> tuple[Array, Array, Array]:
        """Of so many parts: instants, offsets from the line, and weights, each (count,)."""
        rows = []
        for part in np.array_split(instants, parts):
            expected = np.polyval(line, part - middle)

            def missed(offset: float, part: Array = part, expected: Array = expected) -> float:
                return residual(part, expected + offset)

            fits = lowest(missed, min(around.tolist(), key=missed), _STEP_S)
            curve = missed(fits - _STEP_S) - 2 * missed(fits) + missed(fits + _STEP_S)
            rows.append((part.mean() - middle, fits, max(curve, 1e-12) ** 0.5))
        at, offsets, weights = np.array(rows).T
        return at, offsets, weights

    for around in (np.arange(-_AROUND_S, _AROUND_S, _STEP_S), np.zeros(1)):
        at, offsets, weights = offsets_of(_PARTS, around)
        change, covariance = np.polyfit(at, offsets, 1, w=weights, cov=True)
        line = line + change
    drift_interval, interval = (_T_95 * np.sqrt(np.diag(covariance))).tolist()
    if not interval < _WIDEST_S:
        raise RecordingError(
            f"the motion is too slow to tell (± {interval * 1e3:.0f} ms): turn faster, and about several axes"
        )
    bend = _bend(*offsets_of(2 * _PARTS, np.zeros(1)))
    interval, drift_interval = interval + bend, drift_interval + 2 * bend / (at[-1] - at[0])
    stamp_ns, monotonic_ns = (round(at_s * 1e9) for at_s in (middle, middle + line[1]))
    clock = ForeignClock(int(robot_ns[0]) + stamp_ns, int(times_ns[0]) + monotonic_ns, float(line[0]) * 1e6)
    intervals = {"interval_ms": interval * 1e3, "drift_interval_ppm": drift_interval * 1e6}
    return clock, intervals | {"bend_ms": bend * 1e3}


def _bend(at: Array, offsets: Array, weights: Array) -> float:
    """By how much the clocks are off a line, s; 0 if noise explains that."""
    basis = np.polynomial.legendre.legvander(at / np.abs(at).max(), max(_BENDING))
    others = [(basis[:, : degree + 1], quantile) for degree, quantile in _BENDING.items()]
    for first in range(2, len(at) - 1):
        others.append((np.column_stack([basis[:, :2], np.arange(len(at)) >= first]), _STEPPING))

    def fitted(rows: Array) -> tuple[Array, float]:
        """The offsets as these explain them, and the squares that they leave."""
        found = rows @ np.linalg.lstsq(rows * weights[:, None], offsets * weights, rcond=None)[0]
        return found, float((((offsets - found) * weights) ** 2).sum())

    (line, straight), bend = fitted(basis[:, :2]), 0.0
    for rows, quantile in others:
        course, rest = fitted(rows)
        more = rows.shape[1] - 2
        if (straight - rest) / more > quantile * rest / (len(at) - 2 - more):
            bend = max(bend, float(np.abs(course - line).max()))
    return bend


Stretches = list[tuple[Array, Array]]


def _correlated(sensor: Stretches, robot: Stretches) -> tuple[Ints, Array]:
    """Lags in steps, ascending, and how well the rates agree at each, whatever the rotation."""
    lags, spectra = list[Ints](), list[tuple[Any, Any]]()
    both = []
    for each in (sensor, robot):
        longest = sorted(each, key=lambda part: -len(part[0]))[:_LONGEST]
        grids = [np.arange(np.ceil(times[0] / _STEP_S), times[-1] / _STEP_S) for times, _ in longest]
        turned = [at_times(grid * _STEP_S, *part) for grid, part in zip(grids, longest, strict=True)]
        mean = np.concatenate(turned).mean(axis=0)
        both.append([(int(grid[0]), columns - mean) for grid, columns in zip(grids, turned, strict=True)])
    for (felt_at, felt), (turned_at, turned) in itertools.product(*both):
        size = len(felt) + len(turned)
        spectra.append((np.fft.rfft(felt, size, axis=0), np.fft.rfft(turned, size, axis=0).conj()))
        lags.append((np.arange(size) + len(turned)) % size - len(turned) + felt_at - turned_at)
    steps, of = np.unique(np.concatenate(lags), return_inverse=True)
    agree = np.zeros(len(steps))
    for axis, another in itertools.product(range(3), repeat=2):  # one by one: they are long
        pairs = zip(spectra, lags, strict=True)
        found = [np.fft.irfft(own[:, axis] * other[:, another], len(at)) for (own, other), at in pairs]
        agree += np.bincount(of, np.concatenate(found)) ** 2
    return steps, agree


def _shared(sensor: Stretches, robot: Stretches, offset_s: float) -> Array:
    """Instants of the robot's at which both are known, and around them."""
    begins, ends = (np.array([times[at] for times, _ in sensor]) - offset_s for at in (0, -1))
    found = []
    for times, _ in robot:
        instants = np.arange(times[0] + _AROUND_S, times[-1] - _AROUND_S, _STEP_S / 2)
        of = np.maximum(np.searchsorted(begins, instants, "right") - 1, 0)
        is_inside = (instants > begins[of] + _AROUND_S) & (instants < ends[of] - _AROUND_S)
        found.append(instants[is_inside])
    return np.concatenate(found)


def _smooth(which: str, stamps_ns: Ints, rates: Array) -> Stretches:
    """Even times of each stretch, s since the first stamp, and the rates at these.

    RecordingError if they are too few or too small.
    """
    times = (stamps_ns - stamps_ns[0]) * 1e-9
    period, parts = resampled(times, rates, 2 * _AROUND_S)
    if sum(float(even[-1] - even[0]) for even, _ in parts) < _SHORTEST_S - 2 * period:
        raise RecordingError(f"the {which} was recorded for less than {_SHORTEST_S:g} s: record a minute")
    if np.linalg.norm(rates.std(axis=0)) < _LEAST_RATE:
        raise RecordingError(f"the {which} hardly turned: turn it about several axes")
    window = hann_window(_SMOOTH_S, period)
    return [(even, smoothed(columns, window)) for even, columns in parts]


def _robot_rates(path: Path, topic: str, urdf: Path | None, link: str) -> tuple[Ints, Array, int]:
    """Stamps (n,), ns, and angular rates (n, 3), rad/s: as an IMU has them, or of a link in its own frame.

    Also how many messages were left out, because they do not tell that.
    """
    joints = [] if urdf is None else _chain(urdf, link)
    turning = list(dict.fromkeys(joint.follows for joint in joints if joint.axis.any()))
    stamps, rows, left_out = array("q"), array("d"), 0
    for stamp, message in messages(path, topic, _MOST):
        if hasattr(message, "angular_velocity"):
            rate, joints = message.angular_velocity, []
            row = [rate.x, rate.y, rate.z] if message.angular_velocity_covariance[0] != -1 else []
        elif not joints or not hasattr(message, "position"):
            raise RecordingError(f"{topic} is no sensor_msgs/Imu, and no JointState with --urdf and --link")
        else:
            if not {*turning} & {*message.name}:
                continue  # of another part of the robot, a gripper say
            # Positions may be left out, of all joints.
            at = dict(zip(message.name, message.position, strict=False))
            row = [at[name] for name in turning if name in at]
        if len(row) == (len(turning) if joints else 3) and np.isfinite(row).all():
            stamps.append(stamp)
            rows.extend(row)
        else:
            left_out += 1
    times = np.frombuffer(stamps, np.int64)
    kept = in_order(times)
    if len(times) < 2 or (~kept).mean() > MOST_LEFT_OUT:
        which = f", but for {left_out} that do not tell how the link turned," if left_out else ""
        raise RecordingError(
            f"the messages of {topic} in {path}{which} are too few, or not in the order of their stamps"
        )
    values = np.array(rows).reshape(len(times), -1)[kept]
    times, left_out = times[kept], left_out + int((~kept).sum())
    if not joints:
        return times, values, left_out
    ends = [(begin, begin + _AT_ONCE + 1) for begin in range(0, len(times) - 1, _AT_ONCE)]
    rates = [_link_rates(joints, times[slice(*each)], turning, values[slice(*each)]) for each in ends]
    return times[:-1] + np.diff(times) // 2, np.concatenate(rates), left_out


def _link_rates(joints: Sequence[_Joint], times: Ints, turning: Sequence[str], values: Array) -> Array:
    """Between the times (n,), rad/s (n - 1, 3), by the angles of the joints that turn (n, joints)."""
    angles, pose = dict(zip(turning, values.T, strict=True)), np.eye(3)
    for joint in joints:
        angle = joint.times * angles.get(joint.follows, 0.0) + joint.plus
        pose = pose @ joint.origin @ _turned(np.outer(angle, joint.axis))
    step, passed = pose[:-1].swapaxes(1, 2) @ pose[1:], np.diff(times)
    twice = step - step.swapaxes(1, 2)  # the sine of a small angle
    return np.asarray(twice[:, (2, 0, 1), (1, 2, 0)] / (2e-9 * passed[:, np.newaxis]))


class _Joint(NamedTuple):
    """One of a chain; its angle is that of the joint that it follows, itself or another, times and plus."""

    origin: Array  # (3, 3), rotation in its parent
    axis: Array  # (3,); zeros: it does not turn
    follows: str
    times: float
    plus: float  # rad


def _chain(urdf: Path, link: str) -> list[_Joint]:
    """Of each joint from the root to `link`; RecordingError."""
    try:
        root = ElementTree.parse(urdf).getroot()  # noqa: S314 - a file of the user's
        links = [each.get("name") for each in root.iterfind("{*}link")]
        if link not in links:
            there = ", ".join(map(str, links[:_MOST_NAMED])) or "none: expand it with xacro"
            raise RecordingError(f"{urdf} has no link {link!r}; it has {there}")
        joints: Any = {joint.get("name"): joint for joint in root.iterfind("{*}joint")}
        above = {joint.find("{*}child").get("link"): joint for joint in joints.values()}
        chain, at = list[_Joint](), link
        while (joint := above.pop(at, None)) is not None:
            at = joint.find("{*}parent").get("link")
            chain.insert(0, _joint(joint, joints))
    except (OSError, ElementTree.ParseError, AttributeError, ValueError) as error:
        raise RecordingError(f"{urdf} cannot be read as URDF, as xacro writes it: {error}") from None
    if not any(joint.axis.any() for joint in chain):
        raise RecordingError(f"{urdf} has no joint that turns link {link}")
    return chain


def _joint(joint: Any, joints: Any) -> _Joint:
    """Of its element; ValueError."""
    origin, axis = joint.find("{*}origin"), joint.find("{*}axis")
    roll, pitch, yaw = _turned(np.diag(_numbers("0 0 0" if origin is None else origin.get("rpy", "0 0 0"))))
    direction = np.zeros(3)
    if joint.get("type") in ("revolute", "continuous"):  # the axis of others may be zeros
        direction = _numbers("1 0 0" if axis is None else axis.get("xyz", "1 0 0"))
        if not direction.any():
            raise ValueError(f"the axis of joint {joint.get('name')} is zero")
        direction = direction / np.linalg.norm(direction)
    follows, times, plus = joint.get("name"), 1.0, 0.0
    for _ in joints:  # one that mimics another may be followed itself
        if (mimic := joints[follows].find("{*}mimic")) is None:
            break
        factor, offset = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
        follows, times, plus = mimic.get("joint"), times * factor, times * offset + plus
        if follows not in joints:
            raise ValueError(f"joint {joint.get('name')} follows {follows}, which is not there")
    return _Joint(yaw @ pitch @ roll, direction, follows, times, plus)


def _numbers(text: str) -> Array:
    """Three; ValueError."""
    found = np.array(text.split(), float)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError(f"{text!r} is not three numbers")
    return found


def _turned(vectors: Array) -> Array:
    """(n, 3, 3) rotations by rotation vectors (n, 3), rad."""
    angle = np.linalg.norm(vectors, axis=1)[:, np.newaxis, np.newaxis] / np.pi
    cross = np.cross(vectors[:, np.newaxis], np.eye(3)).swapaxes(1, 2)
    return np.asarray(np.eye(3) + np.sinc(angle) * cross + np.sinc(angle / 2) ** 2 / 2 * (cross @ cross))


def run(options: argparse.Namespace) -> int:
    interrupt_on_signals()
    with open_recording(options.recording, Asked.of(options)) as recording:
        rows, axis = [], TimeAxis()
        sensor = choose(recording, options.sensor)
        step, batches = 1 + sensor.frames // _MOST, recording.batches(sensor.sensor, options.imu_units)
        for in_force, frames in axis.batches(batches):
            table = frames.where(frames.fresh & np.isfinite(frames.angular_rate).all(axis=1))
            table = table.where(slice(None, None, step))
            delay_s = angular_rate_response(in_force.info.settings).delay_s or 0.0
            rows.append((table.monotonic_ns - round(delay_s * 1e9), table.angular_rate))
    instants, rates = map(np.concatenate, zip(*rows, strict=True))
    rows.clear()  # as much again
    for remark in axis.said:
        say(PROGRAM, f"{options.recording}: {remark}")
    stamps, robot_rates, left_out = _robot_rates(options.bag, options.topic, options.urdf, options.link)
    if left_out:
        say(
            PROGRAM, f"{count(left_out, 'message')} left out, without finite angles or rates, or out of order"
        )
    clock, intervals = find_offset(instants, rates, stamps, robot_rates)
    if bend_ms := intervals["bend_ms"]:
        say(
            PROGRAM,
            f"the two clocks are off a line by up to {bend_ms:.2g} ms, so one was set, slewed or warmed up: "
            "the interval includes that; align shorter recordings one by one",
        )
    # The server's clocks are as far apart as at the end of the recording.
    apart_ns = int(frames.stamp_ns[-1] - frames.monotonic_ns[-1])
    offset_ms = (clock.monotonic_ns + apart_ns - clock.stamp_ns) * 1e-6
    values = clock._asdict() | {"offset_ms": offset_ms} | intervals | {"left_out": left_out}
    sys.stdout.write(json.dumps(values, indent=1) + "\n")
    return 0
