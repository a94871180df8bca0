"""What is left in motion with nothing touching the tool; and where gravity points by orientations.

Rigid-body motion and the sensor's filters are those of `motion`; seeds are fresh in long runs.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.response import imu_noise
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.alignment import Alignment, Array, align
from bota_ft_compensation.bias import TareBasis, estimate_bias
from bota_ft_compensation.bounds import Bounds
from bota_ft_compensation.compensator import Compensator
from bota_ft_compensation.imu import ImuSource
from bota_ft_compensation.quantities import (
    DEFAULT_GRAVITY,
    EXACT,
    NO_PAYLOAD,
    STILL,
    ZERO,
    Accelerometer,
    Payload,
    Wrench,
)
from bota_ft_compensation.specific_force import ImuSpecificForce, QuaternionGravity
from bota_ft_compensation.stationary import StationaryMeans, triple
from tests.compensation import motion
from tests.compensation.making import SEED, sample
from tests.compensation.motion import Felt, Imperfection, imperfect, left_over, settings
from tests.simulation import more_if_long

HEAVY = Payload(2.0, (0.004, -0.006, 0.08))
RATE_HZ = 800.0
SENSOR_NOISE_N = 0.17  # of the whole vector, with the default filters


def tool_of(seed: int) -> Payload:
    """From 0.7 to 2.1 kg."""
    draw = np.random.default_rng([seed, 1])
    x, y, z = draw.uniform((-0.02, -0.02, 0.02), (0.02, 0.02, 0.1)).tolist()
    return Payload(draw.uniform(0.7, 2.1), (x, y, z))


@pytest.mark.parametrize("seed", more_if_long([0], range(6)))
@pytest.mark.parametrize("name", motion.moves(0))
def test_with_the_default_filters_moves_leave_little(name: str, seed: int) -> None:
    """An identified IMU with offset, scale and crossed axes; of the sensor's noise what the table has."""
    seed += 1000 * SEED
    tool, imu, chosen = tool_of(seed), imperfect(seed), settings()
    felt = motion.filtered(motion.moves(seed)[name], tool, 4.0, chosen, seed=seed, imu=imu)
    left = left_over(felt, tool, align(chosen, RATE_HZ), imu.known, settling_s=1.0)
    assert len(left.times) == 3 * RATE_HZ, "nothing is withheld"
    assert math.hypot(left.rms, SENSOR_NOISE_N) < 0.35
    assert math.hypot(left.percentile(0.99), 2 * SENSOR_NOISE_N) < 1.0
    assert float(np.linalg.norm(left.torque, axis=1).max()) < 0.15


@pytest.mark.parametrize(
    ("sinc_length", "fir"),
    more_if_long([(64, True), (512, False)], itertools.product((32, 51, 64, 128, 205, 512), (False, True))),
)
def test_at_every_filter_they_leave_less_than_the_bias_alone(sinc_length: int, fir: bool) -> None:
    seed, chosen = 21 + 1000 * SEED, settings(sinc_length, fir)
    for name, path in motion.moves(seed).items():
        felt = motion.filtered(path, HEAVY, 2.0, chosen)
        left = left_over(felt, HEAVY, align(chosen, 51200 / sinc_length), settling_s=0.5)
        alone = felt.force - felt.force.mean(axis=0)
        assert left.rms < min(0.4, 0.1 * math.sqrt(float((alone**2).sum(axis=1).mean()))), name
        assert left.percentile(0.99) < 0.8


@pytest.mark.parametrize("seed", more_if_long([7], range(7, 13)))
@pytest.mark.parametrize(("sinc_length", "most"), [(32, 0.36), (64, 0.3), (512, 0.2)])
def test_polishing_and_vibration_leave_what_the_noise_allows(
    sinc_length: int, most: float, seed: int
) -> None:
    """1.5 kg. At SINC 32 noise alone is 0.31 N: 0.26 of the sensor, and of the IMU, which must look ahead."""
    seed, chosen, tool = seed + 1000 * SEED, settings(sinc_length), Payload(1.5, (0.01, -0.01, 0.06))
    sensor, imu = SENSOR_NOISE_N * (sinc_length / 64) ** -0.62, Imperfection(*imu_noise(chosen))
    for name in ("polishing", "vibration"):
        felt = motion.filtered(motion.moves(seed)[name], tool, 3.0, chosen, seed=seed, imu=imu)
        left = left_over(felt, tool, align(chosen, 51200 / sinc_length), settling_s=0.5)
        assert math.hypot(left.rms, sensor) < most, name


def test_the_inertia_of_a_tool_is_subtracted_too() -> None:
    """A bar of 2 kg and 0.3 m."""
    tool = HEAVY._replace(inertia=(0.015, 0.015, 0.001, 0.002, -0.001, 0.0005))
    felt = motion.feel(motion.moves(8)["fast"], tool, 4.0, imu=motion.PERFECT)
    left, point = (left_over(felt, each, align({}, RATE_HZ), settling_s=0.1) for each in (tool, HEAVY))
    assert np.abs(left.torque).max() < 0.25 * np.abs(point.torque).max()
    assert np.abs(left.torque).max() < 0.15
    assert left.force == pytest.approx(point.force)
    spun = Compensator(tool._replace(inertia=(1.0, 2.0, 3.0, 0.0, 0.0, 0.0), mass=0.0))
    stages = spun.compensate(ZERO, ZERO, ZERO, ((0.0, 1.0, 1.0), (1.0, 0.0, 0.0)))
    assert stages.tool.torque == pytest.approx((-1.0 - 1.0, 0.0, 0.0)), "J alpha + omega x J omega"


# -- what happens to samples


def cut(felt: Felt, kept: Callable[[float], bool], shift: Callable[[float], float] = float) -> Felt:
    """Only some samples, with other times."""
    chosen = np.array([kept(time_s) for time_s in felt.times.tolist()])
    times = np.array([shift(time_s) for time_s in felt.times[chosen].tolist()])
    return Felt(times, *(part[chosen] for part in felt[1:]))


def every_fifth_lost(time_s: float) -> bool:
    return round(time_s * RATE_HZ) % 5 > 0


@pytest.mark.parametrize(
    ("kept", "shift"),
    [
        (lambda t: not 1.1 < t < 1.6, float),
        (lambda t: not 1.1 < t < 1.13, float),
        (every_fifth_lost, float),
        (lambda t: True, lambda t: t if t < 1.2 else t - 1e4),
        (lambda t: True, lambda t: t if t < 1.2 else t + 3600.0),
    ],
    ids=["stall of 0.5 s", "24 lost in a row", "every fifth lost", "clock set back", "clock set on"],
)
@pytest.mark.parametrize("fir", [False, True], ids=["FIR off", "FIR on"])
@pytest.mark.parametrize("seed", more_if_long([0, 1_192_001], [*range(8), 1_192_001]))
def test_gaps_and_clock_steps_bring_no_error_above_the_bound(
    kept: Callable[[float], bool], shift: Callable[[float], float], fir: bool, seed: int
) -> None:
    """The first samples after a gap are withheld: they do not tell how fast it spins up."""
    seed, chosen = seed + 1000 * SEED, settings(fir=fir)
    felt = cut(motion.filtered(motion.moves(seed)["fast"], HEAVY, 3.0, chosen), kept, shift)
    left = left_over(felt, HEAVY, align(chosen, RATE_HZ))
    assert len(felt.times) - len(left.times) <= 2 * (16 if fir else 4)
    assert left.size.max() < 1.0
    assert left.percentile(0.99) < 1.0


@pytest.mark.parametrize("fir", [False, True], ids=["FIR off", "FIR on"])
@pytest.mark.parametrize("seed", more_if_long([0], range(4)))
@pytest.mark.parametrize("sinc_length", more_if_long([32, 64], [32, 64, 128]))
def test_after_a_gap_noise_is_not_taken_for_spinning_up(sinc_length: int, seed: int, fir: bool) -> None:
    """By the IMU's own noise: of two samples it made 4 N. Beside what is there without a gap."""
    rate_hz, chosen = 51200 / sinc_length, settings(sinc_length, fir)
    imu, aligned = Imperfection(*imu_noise(chosen)), align(chosen, rate_hz)
    for path in (motion.moves(seed)["fast"], motion.turned(seed)):
        felt = motion.filtered(path, HEAVY, 2.0, chosen, seed=seed, imu=imu)
        usual = left_over(felt, HEAVY, aligned)
        for at_s in np.arange(0.3, 1.9, 0.2).tolist():
            for lost_s in (0.012, 0.03, 0.06):
                end_s = at_s + lost_s
                near = (felt.times > at_s - 0.1) & (felt.times < end_s + 0.06)
                near &= (felt.times < at_s) | (felt.times > end_s)
                kept = Felt(*(part[near] for part in felt))
                left = left_over(kept, HEAVY, aligned, settling_s=end_s)
                beside = np.isin(usual.times, left.times)
                assert (left.size - usual.size[beside]).max() < 0.8


def test_of_a_ramp_it_gives_the_value_of_the_forces_instant() -> None:
    """Of acceleration and angular rate, and the slope of the rate, at every filter."""
    for sinc_length, fir in ((32, False), (64, False), (128, False), (256, False), (256, True), (64, True)):
        rate_hz, chosen = 51200 / sinc_length, settings(sinc_length, fir)
        imu = ImuSpecificForce(ZERO, alignment=align(chosen, rate_hz))
        for number in range(120):
            t = number / rate_hz
            found = imu.follow((t - 0.00194, 0.0, 1.0), (0.01 * (t - 0.0029), 0.0, 0.0), t)
        assert found is not None
        instant = t - (12 if fir else 1.5) / rate_hz
        assert found == pytest.approx((instant, 0.0, 1.0), abs=1.5e-4)
        assert imu.turning[0][0] == pytest.approx(0.01 * instant, abs=1e-5)
        assert imu.turning[1] == pytest.approx((0.01, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("name", ["acceleration_filter", "angular_rate_filter"])
def test_what_a_slow_filter_shows_late_is_not_made_of_noise(name: str) -> None:
    """Of 65 ms, 2 are extrapolated: noise at most doubles."""
    for profile in range(1, 9) if name == "acceleration_filter" else range(3, 10):
        alignment = align({**settings(), name: profile}, RATE_HZ)
        assert np.linalg.norm(alignment.taps[:2], axis=1).max() < 2.0, profile
    assert np.linalg.norm(align(settings(), RATE_HZ, lag_s=-0.05).taps[0]) < 2.0


def test_what_is_unknown_is_used_as_it_comes() -> None:
    for chosen in ({}, settings(64, fir=True, fast=True), settings(128, chop=True)):
        alignment = align(chosen, RATE_HZ)
        assert alignment.lag_s is None
        assert alignment.taps[0, -1] == 1.0
        assert not alignment.taps[0, :-1].any()
    value = align(settings(128, chop=True), 400.0, lag_s=0.01).taps[0, ::-1]
    assert (value.sum(), value @ np.arange(len(value)) / 400.0) == pytest.approx((1.0, 0.01))


class Slowly:
    """`ImuSpecificForce` as a list of samples that is looked through for each."""

    def __init__(self, lever: Vector3, known: Accelerometer, gyroscope: Array, alignment: Alignment) -> None:
        self.lever, self.known, self.gyroscope, self.alignment = np.array(lever), known, gyroscope, alignment
        self.rows, self.since, self.moved, self.last_s = np.zeros((0, 15)), 0, False, -math.inf

    def follow(self, row: Array, time_s: float) -> Array | None:
        size, lead = self.alignment.taps.shape[1], self.alignment.lead
        if not np.isfinite(row).all():
            self.last_s = -math.inf
            return None
        row = np.concatenate([row, np.outer(row[3:], row[3:]).ravel()])
        periods = round((time_s - self.last_s) / self.alignment.period_s) if self.last_s > -math.inf else 0
        if 0.0 < time_s - self.last_s <= self.alignment.gap_s:
            missing = np.linspace(self.rows[-1], row, max(periods, 1) + 1)[1:]
            before, self.since = self.since, self.since + len(missing)
            self.rows = np.vstack([self.rows, missing])
            if before < lead <= self.since:  # what was before is on the line through them
                known, ago = self.rows[-min(self.since, size) :], np.arange(size)[:, np.newaxis]
                slope, first = np.polyfit(np.arange(len(known)), known, 1)
                self.rows = np.vstack([first - (ago[::-1] + 1) * slope, known])
        else:
            if self.since:
                fastest = np.linalg.norm(self.rows[-size:, 3:6], axis=1).max()
                pushed = np.linalg.norm(self.rows[-1, :3] - row[:3])
                self.moved = bool(fastest > 0.05 or pushed > 0.5)
            self.rows, self.since = np.tile(row, (size, 1)), 1
        self.last_s = time_s
        if self.since < lead and self.lever.any() and (self.moved or np.linalg.norm(row[3:6]) > 0.05):
            return None
        felt, rates, slopes = self.alignment.taps @ self.rows[-size:]
        rate, spin = self.gyroscope @ rates[3:6], self.gyroscope @ slopes[3:6]
        products = self.gyroscope @ rates[6:].reshape(3, 3) @ self.gyroscope.T
        if not self.alignment.settings["fir"]:
            products = np.outer(rate, rate)
        arm = np.cross(spin, self.lever) + products @ self.lever - np.trace(products) * self.lever
        return np.concatenate([self.known.correct(tuple(felt[:3])) + arm, rate, spin])


@pytest.mark.parametrize("seed", range(16))
def test_the_specific_force_is_that_of_the_aligned_samples_also_around_gaps(seed: int) -> None:
    """Of a tool at rest, pushed, turned slowly or fast, with samples that are lost, late or no numbers."""
    draw, chosen = np.random.default_rng(seed), settings((64, 32, 128)[seed % 3], fir=bool(seed % 2))
    aligned = align(chosen, 51200 / chosen["sinc_length"])
    lever: Vector3 = (ZERO, (0.03, -0.02, 0.1), (0.0, 0.0, -0.2), (0.0, 0.1, 0.0), (0.2, 0.0, 0.0))[seed % 5]
    gyroscope = np.eye(3) + 0.1 * draw.normal(size=(3, 3))
    known = imperfect(seed).known
    found = ImuSpecificForce(lever, known, None, tuple(gyroscope.ravel().tolist()))
    found.align(aligned)
    expected, time_s, row, withheld = Slowly(lever, known, gyroscope, aligned), 10.0, np.zeros(6), 0
    for number in range(600):
        if number % 40 == 0:  # at rest, or not
            row = draw.normal(size=6) * ([3.0] * 3 + [draw.choice((0.0, 0.03, 1.0))] * 3)
        if number == 400:
            aligned = align(settings(64), RATE_HZ)
            found.align(aligned)
            expected = Slowly(lever, known, gyroscope, aligned)
        chance = draw.random()
        lost = draw.integers(1, 4) if chance < 0.03 else draw.integers(20, 60) if chance < 0.06 else 0
        time_s += (1 + lost + draw.uniform(-0.2, 0.2)) * aligned.period_s - 3600.0 * (chance > 0.995)
        sent = row + ([0.15] * 3 + [0.0] * 3) * draw.normal(size=6)
        if chance > 0.99:
            sent[draw.integers(6)] = draw.choice((math.nan, math.inf))
        given: Any = sent.tolist()
        got, wanted = found.follow(tuple(given[:3]), tuple(given[3:]), time_s), expected.follow(sent, time_s)
        assert (got is None) == (wanted is None), number
        if got is not None and wanted is not None:
            assert [*got, *found.turning[0], *found.turning[1]] == pytest.approx(wanted, abs=1e-8)
        withheld += got is None and bool(np.isfinite(sent).all())
    assert (withheld > 5) is any(lever)


def test_many_samples_are_taken_as_one_by_one_to_the_bit() -> None:
    """With gaps, clocks that go back, values that are none, and an accelerometer that is off."""
    draw, count = np.random.default_rng(SEED), 4000
    times = np.cumsum(draw.choice([1.0, 2.0, 6.0, 40.0, -3.0], count, p=[0.97, 0.01, 0.01, 0.005, 0.005]))
    rows = draw.normal(size=(count, 6))
    rows[:1000, 3:] *= 0.001
    rows[draw.random(count) < 0.003, 4] = math.nan
    rows[draw.random(count) < 0.003, :3] = 0.0
    for chosen in (settings(), settings(512, fir=True)):
        known = Accelerometer((0.1, 0.0, -0.2), (1.01, 0.99, 1.0))
        one, many = (ImuSource((0.01, -0.02, 0.1), accelerometer=known) for _ in range(2))
        for source in (one, many):
            source.configure(InForce(SensorInfo(0, rate_hz=RATE_HZ, settings=chosen)))
        begin = 0
        while begin < count:
            part = slice(begin, begin := min(begin + int(draw.integers(1, 300)), count))
            felt, turned = many.follow_all(rows[part, :3], rows[part, 3:], times[part] / RATE_HZ)
            for row, time_s, *found in zip(rows[part], times[part] / RATE_HZ, felt.T, turned.T, strict=True):
                now = sample(acceleration=triple(row[:3]), angular_rate=triple(row[3:]))
                expected = one.specific_force(now, float(time_s), 0.0)
                assert found[0].tolist() == [*expected] if expected else np.isnan(found[0]).all()
                assert tuple(map(tuple, found[1].T.tolist())) == one.turning
            assert (many.felt, many.turning) == (one.felt, one.turning)


# -- tare and bound


def at_rest(up: Vector3, tool: Payload, imu: Imperfection, bias: Wrench) -> StationaryMeans:
    """What a sensor in this pose reads, for ever: the first sample of a path that goes nowhere."""
    angles = np.array([0.0, math.atan2(-up[0], math.hypot(up[1], up[2])), math.atan2(up[1], up[2])])
    still = lambda t: (np.zeros((len(t), 3)), np.tile(angles, (len(t), 1)))  # noqa: E731
    quiet = imu._replace(acceleration_noise=0.0, rate_noise=0.0, rate_offset=0.0)
    felt = motion.feel(still, tool, 0.002, imu=quiet)
    force, torque, acceleration = (
        tuple(part[0].tolist()) for part in (felt.force, felt.torque, felt.acceleration)
    )
    return StationaryMeans(Wrench(force, torque).plus(bias), acceleration, ZERO, ZERO, 800)


@pytest.mark.parametrize("seed", more_if_long([0], range(10)))
def test_a_tare_in_any_pose_is_right_in_all_poses_and_with_every_tool(seed: int) -> None:
    """The accelerometer is identified; the tool is changed after the tare, and told."""
    seed += 1000 * SEED
    draw, imu = np.random.default_rng([seed, 2]), imperfect(seed)
    bias = Wrench.of(draw.normal(size=6).tolist())
    first, second = tool_of(seed), tool_of(seed + 1)

    def up() -> Vector3:
        x, y, z = draw.normal(size=3).tolist()
        return x, y, z

    means = at_rest(up(), first, imu, bias)
    tared = estimate_bias(means, first, imu.known.correct(means.acceleration))
    assert tared.values == pytest.approx(bias.values, abs=2e-3)
    for tool in (first, second):
        for _ in range(10):
            now = at_rest(up(), tool, imu, bias)
            felt = imu.known.correct(now.acceleration)
            left = Compensator(tool, tared).compensate(*now.wrench, felt, STILL).final
            assert math.hypot(*left.force) < 0.01
    # Its parameters were wrong during the tare, and were put right later.
    again = estimate_bias(means, second, imu.known.correct(means.acceleration))
    change, _ = TareBasis(second, imu.known.correct(means.acceleration)).for_payload(first)
    assert again.plus(change).values == pytest.approx(tared.values)


NO_ERRORS = EXACT._replace(
    offset_interval=(0.0,) * 3, scale_interval=(0.0,) * 3, cross_axis_interval=(0.0,) * 6
)


@pytest.mark.parametrize("is_tared", [False, True])
@pytest.mark.parametrize(
    "known",
    [
        EXACT,
        Accelerometer(
            offset_interval=(0.02,) * 3, scale_interval=(0.001,) * 3, cross_axis_interval=(0.002,) * 6
        ),
    ],
)
def test_the_bound_covers_the_accelerometers_errors_in_95_percent(
    known: Accelerometer, is_tared: bool
) -> None:
    """In any pose, any tool, with an accelerometer as identification expects it, or as it has found it.

    A tare, in any pose too, takes off what the accelerometer's errors make there.
    """
    draw, held, draws = np.random.default_rng([7, SEED]), 0, 4000
    for _ in range(draws):
        tool, up = Payload(draw.uniform(0.1, 5.0)), draw.normal(size=(2, 3))
        pose, of_tare = STANDARD_GRAVITY * up / np.linalg.norm(up, axis=1, keepdims=True)
        taken = TareBasis(NO_PAYLOAD, triple(of_tare), known) if is_tared else None
        matrix = np.diag(draw.normal(1.0, np.array(known.scale_interval) / 1.96))
        matrix[~np.eye(3, dtype=bool)] = draw.normal(0.0, np.array(known.cross_axis_interval) / 1.96)
        offset = draw.normal(0.0, np.array(known.offset_interval) / 1.96)
        off, off_at_tare = (matrix @ truth + offset - truth for truth in (pose, of_tare))
        left = tool.mass * float(np.linalg.norm(off - is_tared * off_at_tare))
        rows = (
            Bounds(tool, each, align({}, RATE_HZ), ZERO, taken and taken._replace(accelerometer=each)).at(
                pose
            )
            for each in (known, NO_ERRORS)
        )
        whole, noise = (force for force, _ in rows)
        held += left**2 <= whole**2 - noise**2
    assert 0.93 <= held / draws <= 0.97


# -- orientations


def rotated(vector: Array, by: Array) -> Array:
    """By a rotation vector, rad; Rodrigues."""
    angle = float(np.linalg.norm(by))
    axis = by / (angle or 1.0)
    along = axis * (axis @ vector) * (1 - math.cos(angle))
    return np.asarray(vector * math.cos(angle) + np.cross(axis, vector) * math.sin(angle) + along)


@pytest.mark.parametrize("seed", range(12))
def test_gravity_is_that_of_the_newest_orientation_turned_on_by_the_rates_since(seed: int) -> None:
    """Between two samples, late, ahead of them or stale; over gaps, set clocks and bad rates it is held."""
    draw, source, stale_s = np.random.default_rng(seed), QuaternionGravity(stale_after_s=0.125), 0.125
    time_s, newest_s, rate = 100.0, -math.inf, 0.5 * draw.normal(size=3)
    known: list[tuple[float, Array]] = []  # rates since they began anew
    told: tuple[float, Array] | None = None  # the orientation, as gravity; and what has turned it since
    turns: list[Array] = []
    for _ in range(400):
        chance = draw.random()
        steps = draw.choice((128, 129, -20, -(2**20))) if chance < 0.06 else draw.integers(8, 13)
        time_s += int(steps) / 1024
        rate = 0.95 * rate + 0.15 * draw.normal(size=3)
        sent = rate * (math.nan if 0.06 < chance < 0.08 else 1.0)
        source.add_rate(triple(sent), time_s)
        if known and not 0.0 <= time_s - known[-1][0] <= stale_s:
            known = []
        known = [*known, (time_s, sent)] if np.isfinite(sent).all() else []
        if told is not None and len(known) > 1:
            (before_s, before), (after_s, after) = known[-2:]
            if told[0] > after_s:
                before_s, before = told[0], after
            turns.append(-(after_s - max(before_s, told[0])) * (before + after) / 2)
            told = after_s, told[1]
        if draw.random() < 0.3:
            at_s = time_s + int(draw.choice((-51, -13, 0, 4))) / 1024
            x, y, z, w = draw.normal(size=4).tolist()
            size = math.sqrt(x * x + y * y + z * z + w * w)
            is_old = 0.0 < newest_s - at_s <= stale_s
            assert source.update((x / size, y / size, z / size, w / size), at_s) is not is_old
            if not is_old:
                axis, turned = (
                    np.array([x, y, z]) / math.hypot(x, y, z),
                    2 * math.atan2(math.hypot(x, y, z), w),
                )
                newest_s, turns = at_s, []
                told = at_s, rotated(np.array(DEFAULT_GRAVITY), -turned * axis)
                since = [each for each in known if each[0] <= at_s][-1:]
                if since and since[0] is known[-1]:
                    turns.append((at_s - since[0][0]) * since[0][1])
                since += [each for each in known if each[0] > at_s]
                for (before_s, before), (after_s, after) in pairwise(since):
                    turns.append(-(after_s - max(before_s, at_s)) * (before + after) / 2)
                told = since[-1][0] if since else at_s, told[1]
        elif draw.random() < 0.02:
            source.reset()
            newest_s, told, turns, known = -math.inf, None, [], []
        now_s = time_s + int(draw.choice((0, 5, 51, 128, 129))) / 1024
        assert source.age_s(now_s) == abs(now_s - newest_s)
        found = source.gravity(now_s)
        if told is None or abs(now_s - newest_s) > stale_s:
            assert found is None
            continue
        expected = told[1]
        for each in turns:
            expected = rotated(expected, each)
        assert found == pytest.approx(tuple(expected.tolist()), abs=2e-3)
