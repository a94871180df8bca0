"""What is left in motion with nothing touching the tool; and where gravity points by orientations.

Rigid-body motion and the sensor's filters are those of `motion`; seeds are fresh in long runs.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.response import imu_noise
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.alignment import align
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
from tests.compensation.making import SEED
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


def test_another_rate_and_another_sensor_begin_anew() -> None:
    imu = ImuSpecificForce((0.1, 0.0, 0.0), alignment=align(settings(512, fir=True), 100.0))
    for number in range(50):
        imu.follow((5.0, 0.0, 9.8), ZERO, number / 100)
    imu.align(align(settings(), RATE_HZ))
    assert imu.follow((1.0, 0.0, 9.8), ZERO, 0.51) == pytest.approx((1.0, 0.0, 9.8))


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


def test_a_mass_off_the_axis_is_spun_up() -> None:
    """0.1 m off the axis, with 20 rad/s²: 4 N on 2 kg; after 4 ms."""
    imu, spin = ImuSpecificForce((0.1, 0.0, 0.0), alignment=align({}, RATE_HZ)), 20.0
    for number in range(80):
        t = 0.1 + number / RATE_HZ
        found = imu.follow((0.0, 0.0, STANDARD_GRAVITY), (0.0, 0.0, spin * t), t)
        assert (found is None) == (number < 4)
        assert found is None or found[1] == pytest.approx(spin * 0.1, rel=1e-3)
    assert found is not None
    assert found[0] == pytest.approx(-((spin * t) ** 2) * 0.1, rel=1e-3)


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_numbers_that_are_none_give_no_answer_and_do_no_lasting_harm(broken: float) -> None:
    imu = ImuSpecificForce((0.0, 0.0, 0.1))
    for number, rate in enumerate((0.0, broken, 0.0, 0.0)):
        found = imu.follow((0.0, 0.0, 9.8), (rate, 0.0, 0.0), number / RATE_HZ)
        assert (found is None) == (not math.isfinite(rate))
    assert found == pytest.approx((0.0, 0.0, 9.8))


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
                expected = one.follow(triple(row[:3]), triple(row[3:]), float(time_s))
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


ALIGNED = align({}, RATE_HZ)
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


# Orientations.


def quaternion_about(axis: Vector3, turned: float) -> tuple[float, float, float, float]:
    x, y, z = (math.sin(turned / 2) * part for part in axis)
    return x, y, z, math.cos(turned / 2)


def test_which_orientation_counts_and_for_how_long() -> None:
    source = QuaternionGravity(stale_after_s=0.1)
    source.update((0.0, 0.0, 0.0, 1.0), 1.0)
    assert not source.update((1.0, 0.0, 0.0, 0.0), 0.95)
    assert source.gravity(1.0) == pytest.approx(DEFAULT_GRAVITY)
    assert source.update((1.0, 0.0, 0.0, 0.0), 0.5), "unless the clock was set back"
    source.update(quaternion_about((1.0, 0.0, 0.0), math.pi / 2), 2.0)
    assert source.gravity(2.0) == pytest.approx((0.0, -STANDARD_GRAVITY, 0.0)), "its y axis points up"
    source = QuaternionGravity(stale_after_s=0.25)
    source.update((0.0, 0.0, 0.0, 1.0), 10.0)
    answers = [source.gravity(now) is not None for now in (10.0, 10.25, 10.26, 1000.0, 9.7)]
    assert answers == [True, True, False, False, False]
    assert source.age_s(10.2) == pytest.approx(0.2)


# Orientations that are older or newer than the sample.


AXIS = (0.6, -0.48, 0.64)


def arm(turned: float) -> tuple[float, float, float, float]:
    """The orientation of a sensor that has turned about an axis between its own by so much."""
    return quaternion_about(AXIS, turned)


def spun(rate: float) -> Vector3:
    x, y, z = (rate * part for part in AXIS)
    return x, y, z


@pytest.mark.parametrize("told_s", [1.0, 1.003, 1.0199, 1.024])
@pytest.mark.parametrize("late", [False, True])
def test_an_orientation_between_two_samples_is_turned_on_by_what_is_left(told_s: float, late: bool) -> None:
    source = QuaternionGravity()

    def at(time_s: float) -> tuple[float, float, float, float]:
        """Faster and faster, from 2 rad/s on."""
        return arm(2.0 * time_s + 0.05 * (time_s - 1.0) ** 2)

    for number in range(4):
        if number == 2 + late:
            source.update(at(told_s), told_s)
        if number < 3 or told_s < 1.02:
            source.add_rate(spun(2.0 + 0.001 * number), 1.0 + 0.01 * number)
    expected = QuaternionGravity()
    expected.update(at(1.03 if told_s < 1.02 else 1.02), told_s)
    assert source.gravity(told_s) == pytest.approx(expected.gravity(told_s), abs=1e-4)


def test_an_orientation_is_turned_on_from_the_first_two_rates_on() -> None:
    source = QuaternionGravity()
    assert source.update((0.0, 0.0, 0.0, 1.0), 0.0)
    source.add_rate(spun(2.0), 0.0)
    source.add_rate(spun(2.0), 0.01)
    expected = QuaternionGravity()
    expected.update(arm(0.02), 0.0)
    assert source.gravity(0.01) == pytest.approx(expected.gravity(0.0), abs=1e-4)


def test_an_orientation_is_held_where_the_gyroscope_is_of_no_use() -> None:
    source = QuaternionGravity()
    source.add_rate((2.0, 0.0, 0.0), 1.0)
    source.update(arm(0.0), 1.0)
    source.add_rate((math.nan, 0.0, 0.0), 1.01)
    assert source.gravity(1.05) == pytest.approx(DEFAULT_GRAVITY)
    for time_s in (1.02, 9.0, 1.0):  # a gap; and a clock that was set back
        source.add_rate((2.0, 0.0, 0.0), time_s)
    assert source.gravity(1.05) == pytest.approx(DEFAULT_GRAVITY)
