"""The bias: taken only at rest, pose-aware, ramped, undone."""

from __future__ import annotations

import contextlib
import math
import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY, Sample, Vector3
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.rest import StationaryLimits
from bota_ethercat.sensor.warnings_register import WarningFlag
from bota_ethercat.stream.timeline import InForce
from bota_ft_compensation.bias import BiasRamp, TareBasis, check_at_rest, estimate_bias
from bota_ft_compensation.imu import IMU_IS_OFF, ImuSource, Source, imu_position
from bota_ft_compensation.own_offset import OwnOffset
from bota_ft_compensation.quantities import (
    NO_PAYLOAD,
    NO_WRENCH,
    ZERO,
    CompensationError,
    Payload,
    Wrench,
)
from bota_ft_compensation.stationary import (
    NotStationaryError,
    StationaryMeans,
    StationaryWindow,
    stationary_means,
)
from bota_ft_compensation.stream import CompensatedStream, Plan, obstacle
from tests.compensation import motion
from tests.compensation.making import AXES, BIAS, TOOL, gravity_for, load, noisy, sample

RATE = 800


def window(
    make: Callable[[int], Sample], seconds: float = 1.0, limits: StationaryLimits | None = None
) -> StationaryWindow:
    collected = StationaryWindow(seconds, limits)
    for number in range(100_000):
        if collected.add(make(number), number / RATE):
            return collected
    raise AssertionError("the window never ended")


def at_rest(up: tuple[float, float, float] = (0, 0, 1), seed: int = 0, **changed: Any) -> StationaryMeans:
    noise = random.Random(seed)
    wrench = load(up)
    return window(lambda _: noisy(noise, wrench, up, **changed)).means()


# Rest.


def test_the_latest_of_a_window_is_its_last_quarter_and_its_time_its_middle() -> None:
    noise = random.Random(1)
    means = window(lambda n: noisy(noise, Wrench((0.1 * (n > 0.75 * RATE), 0.0, 0.0), ZERO))).means()
    assert means.time_s == pytest.approx(0.5, abs=0.01)
    assert means.latest.force[0] == pytest.approx(0.1, abs=0.06)
    assert means.wrench.force[0] == pytest.approx(0.025, abs=0.03)


def test_a_window_at_rest() -> None:
    means = at_rest()
    assert means.samples == RATE + 1
    assert means.wrench.values == pytest.approx(load((0, 0, 1)).values, abs=0.05)
    assert max(means.force_spread) == pytest.approx(0.3, rel=0.15)
    assert max(means.torque_spread) == pytest.approx(0.007, rel=0.15)
    noise = random.Random(1)
    limits = StationaryLimits(angular_rate=0.3)
    window(lambda _: noisy(noise, BIAS, angular_rate=(0.0, 0.0, 0.2)), limits=limits).means()
    warm = sample(warnings=int(WarningFlag.OVERTEMPERATURE))
    assert window(lambda _: warm).means().samples == RATE + 1


@pytest.mark.parametrize("seconds", [0.1, 1.0])
def test_noise_of_a_healthy_sensor_is_rest(seconds: float) -> None:
    """Not one false alarm in ten windows, at the rate and noise of SINC 51."""
    for noise in map(random.Random, range(10)):
        window(partial(lambda noise, _: noisy(noise, BIAS), noise), seconds).means()


Moved = Callable[[float, random.Random], dict[str, Any]]


@pytest.mark.parametrize(
    ("moved", "message"),
    [
        (lambda t, n: {"force": (1.3 * math.sin(9 * t), 0.0, 0.0)}, r"force x moved by \d.* N .*is 0.8 N"),
        (lambda t, n: {"torque": (0.0, 0.1 * math.sin(9 * t), 0.0)}, r"torque y moved by 0\.0\d+ Nm"),
        (lambda t, n: {"force": (0.0, n.gauss(0, 0.3), t)}, r"force z drifted by 0\.\d+ N within"),
        (lambda t, n: {"torque": (0.03 * t, 0.0, 0.0)}, r"torque x drifted by 0\.02\d* Nm"),
        (lambda t, n: {"acceleration": (math.sin(30 * t), 0.0, 9.8)}, r"acceleration x moved by 0\.\d+ m/s²"),
        (lambda t, n: {"acceleration": (0.2 * t, 0.0, 9.8)}, r"acceleration x drifted by"),
        (lambda t, n: {"angular_rate": (0.0, 0.0, 0.2)}, r"turns: its mean angular rate is 0\.2 rad/s"),
        (lambda t, n: {"angular_rate": (0.0, 0.1 * math.sin(30 * t), 0.0)}, r"rate y moved by 0\.0\d+"),
    ],
)  # fmt: skip
def test_a_refusal_says_what_moved_by_how_much_and_what_the_limit_is(moved: Moved, message: str) -> None:
    noise = random.Random(1)
    collected = window(lambda k: noisy(noise, BIAS, **moved(k / RATE, noise)))
    with pytest.raises(NotStationaryError, match=message):
        collected.means()


@pytest.mark.parametrize("axis", range(12))
def test_each_limit_of_rest_is_where_it_is_said(axis: int) -> None:
    """From both sides: of the deviation, of the drift beyond what chance makes, of the mean angular rate."""
    limits, chance = StationaryLimits(), 5.0
    still, signs = np.tile((*[0.0] * 8, 9.8, *[0.0] * 3), (800, 1)), np.resize((1.0, -1.0), 800)
    for share in (0.99, 1.01):
        noise, turned, drifted = still.copy(), still.copy(), still.copy()
        noise[:, axis] += share * limits.deviations[axis] * math.sqrt(799 / 800) * signs
        turned[:, 9:] = share * limits.angular_rate * np.roll((0.6, -0.8, 0.0), axis)
        windows = [noise, turned]
        if axis < 9:
            deviation = limits.deviations[axis] / 4
            drifted[:, axis] += deviation * math.sqrt(199 / 200) * signs
            drifted[600:, axis] += share * (limits.drifts[axis] + chance * deviation / math.sqrt(200))
            windows.append(drifted)
        for rows in windows:
            with contextlib.nullcontext() if share < 1 else pytest.raises(NotStationaryError):
                stationary_means(rows, limits)


@pytest.mark.parametrize(("fir", "count"), [(False, 8000), (True, 8000), (False, 100), (True, 100)])
def test_it_is_measured_how_alike_filters_make_samples(fir: bool, count: int) -> None:
    """By the sinc filter a mean varies 120 / 66 times as much as that of as many independent samples; by both
    12.2 times: the square of the sum of their taps, by the sum of the squares.
    """
    rows = np.tile((*[0.0] * 8, 9.8, *[0.0] * 3), (8000, 1))
    rows[:, :6] += 1e-3 * motion.noise_like(motion.settings(fir=fir), (8000, 6), 5)
    rows[:, 6:] += 1e-3 * np.random.default_rng(5).normal(size=(8000, 6))
    parts = np.split(rows, 8000 // count)
    found = [stationary_means(part, StationaryLimits()) for part in parts]
    assert np.mean([each.alike for each in found]) == pytest.approx(12.2 if fir else 120 / 66, rel=0.2)
    errors = [part[:, :6] - each.wrench.values for part, each in zip(parts[1:], found, strict=False)]
    told = np.square([each.noise for each in found]).mean()
    assert not errors or 0.97 < math.sqrt(told / np.square(errors).mean()) < 1.15


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"force": (math.nan, 0.0, 0.0)}, "not finite"),
        ({"temperature": math.inf}, "not finite"),
        ({"force_torque_saturated": 4}, "saturated or out of range"),
        ({"warnings": int(WarningFlag.FORCE_TORQUE_OUT_OF_RANGE)}, "saturated or out of range"),
        (
            {"warnings": int(WarningFlag.ADC_OUT_OF_SYNC)},
            "not finite, or of a sensor that reports a fault",
        ),
        ({"warnings": int(WarningFlag.ACCELERATION_SATURATED)}, "acceleration was saturated or out of range"),
        ({"acceleration_saturated": 1}, "acceleration was saturated or out of range"),
        ({"angular_rate_saturated": 1}, "angular rate was saturated or out of range"),
    ],
)
def test_one_bad_sample_spoils_the_window(bad: dict[str, Any], message: str) -> None:
    collected = StationaryWindow(1.0)
    for number in range(30):
        assert not collected.add(sample(), number / RATE)
    assert collected.add(sample(**bad), 30 / RATE), "a spoiled window is complete"
    assert collected.add(sample(), 31 / RATE), "and stays so"
    with pytest.raises(NotStationaryError, match=f"spoiled: .*{message}"):
        collected.means()


def test_a_window_that_is_too_short_or_whose_clock_is_set_back() -> None:
    collected = StationaryWindow(1.0)
    with pytest.raises(NotStationaryError, match="only 0 new samples"):
        collected.means()
    taken = [collected.add(sample(), 0.1 * number) for number in range(20)]
    assert taken == [False] * 19 + [True]
    collected = StationaryWindow(1.0)
    for number in range(30):
        assert not collected.add(sample(), 100.0 + number / RATE)
    assert collected.add(sample(), 99.0)
    with pytest.raises(NotStationaryError, match="clock of the samples was set back"):
        collected.means()


# The estimate.


def felt(up: Sequence[float]) -> Vector3:
    x, y, z = gravity_for(up)
    return -x, -y, -z


def test_without_payload_everything_is_bias() -> None:
    means = at_rest()
    assert estimate_bias(means, NO_PAYLOAD, ZERO) == means.wrench
    with pytest.raises(CompensationError, match=r"reads 1\.00 m/s² where 9\.81 should be.*imu_raw_units"):
        check_at_rest((0.0, 0.0, 1.0), STANDARD_GRAVITY)
    check_at_rest((0.0, 0.0, 9.5), STANDARD_GRAVITY)


@pytest.mark.parametrize("up", AXES)
def test_with_the_tool_on_only_the_offset_is_taken_in_every_pose(up: tuple[float, float, float]) -> None:
    bias = estimate_bias(at_rest(up), TOOL, felt(up))
    assert bias.force == pytest.approx(BIAS.force, abs=0.05)
    assert bias.torque == pytest.approx(BIAS.torque, abs=0.002)


# Ramp and undo.

OLD, NEW = Wrench.of([0, 0, 0, 0, 0, 0]), Wrench.of([1, -2, 4, 0.5, 0, -1])


def test_the_ramp_is_straight_ends_exactly_and_does_not_jump_when_turned_round() -> None:
    ramp = BiasRamp(OLD).go(NEW, 10.0, seconds=2.0)
    assert ramp.at(10.0) == ramp.at(9.95) == OLD, "a sample that was on its way is as late"
    assert ramp.at(10.5).values == pytest.approx([0.25 * value for value in NEW.values])
    assert [ramp.arrived(now_s) for now_s in (9.95, 11.9, 12.0)] == [False, False, True]
    assert ramp.at(12.0) == ramp.at(1e9) == NEW
    for now_s in (9.0, -600.0):  # a clock that is set back does not bring the old bias back
        assert ramp.at(now_s) == NEW
        assert ramp.arrived(now_s)
    back = ramp.go(OLD, 10.7, seconds=1.0)
    assert back.at(10.7) == ramp.at(10.7)
    assert back.at(11.7) == OLD
    at_once = ramp.go(OLD, 20.0)
    assert at_once.at(20.0) == at_once.at(19.9) == OLD


def test_the_last_change_is_undone_once() -> None:
    with pytest.raises(CompensationError, match="no tare to undo"):
        BiasRamp().undone(0.0)
    undone = BiasRamp().go(NEW, 0.0, 1.0).go(BIAS, 5.0, 1.0).undone(10.0, 1.0)
    assert undone.target == NEW
    assert undone.at(10.0) == BIAS
    assert undone.at(11.0) == NEW
    with pytest.raises(CompensationError, match="no tare to undo"):
        undone.undone(20.0)


def test_a_shift_and_another_tool_change_both_biases() -> None:
    """The one in force was taken with gravity along -x, the one before along -z."""
    ramp = BiasRamp().go(load((0, 0, 1)), 0.0, 1.0, TareBasis(Payload(), felt((0, 0, 1))))
    ramp = ramp.go(load((1, 0, 0)), 5.0, 1.0, TareBasis(Payload(), felt((1, 0, 0)))).shifted(NEW)
    weighed = ramp.for_payload(TOOL)
    assert ramp.target == load((1, 0, 0)).plus(NEW), "it is another ramp"
    assert weighed.target.values == pytest.approx(BIAS.plus(NEW).values)
    started = load((0, 0, 1)).plus(NEW).plus(BIAS).plus(load((1, 0, 0)), -1.0)
    assert weighed.at(5.0).values == pytest.approx(started.values), "which jumps as much as the weight does"
    assert weighed.undone(10.0).target.values == pytest.approx(BIAS.plus(NEW).values)
    assert weighed.taken == TareBasis(TOOL, felt((1, 0, 0)))
    assert weighed.undone(10.0).taken == TareBasis(TOOL, felt((0, 0, 1)))
    assert BiasRamp().go(NEW, 0.0).shifted(NEW).undone(1.0).target == NO_WRENCH, "none stays none"


COUNTS = "settings.calibration_matrix is off, so force and torque are counts and not N and Nm: switch it on"
ITSELF = (
    "settings.inertia_compensation is on, so the sensor takes gravity off itself: switch it off, or set "
    "tool_mass to 0"
)
TURNED = (
    "settings.coordinate_system is on, so the wrench is in a frame configured in the sensor, and the "
    "rotation from the IMU to it is unknown: switch it off, or take the orientation of that frame from the "
    "robot (gravity_source)"
)


@pytest.mark.parametrize(
    ("settings", "without_tool", "by_robot", "by_imu"),
    [
        ({}, "", "", ""),
        ({"calibration_matrix": False}, COUNTS, COUNTS, COUNTS),
        ({"inertia_compensation": True}, "", ITSELF, ITSELF),
        ({"coordinate_system": True}, "", "", TURNED),
        ({"imu_active": 0}, "", "", IMU_IS_OFF),
        ({"imu_active": 1, "calibration_matrix": True, "inertia_compensation": False}, "", "", ""),
    ],
)
def test_the_settings_with_which_nothing_can_be_compensated(
    settings: dict[str, Any], without_tool: str, by_robot: str, by_imu: str
) -> None:
    for expected, has_tool, is_imu in (
        (without_tool, False, False), (without_tool, False, True), (by_robot, True, False),
        (by_imu, True, True),
    ):  # fmt: skip
        assert obstacle(settings, has_tool=has_tool, by_imu=is_imu) == expected


# What holds up single samples.

BEING_CHANGED = "the sensor's own offset was being changed"
UNKNOWN = "the sensor's own offset is being changed, or is no longer known: if this lasts, tare"
APPEARED = "the sensor's own offset was unknown when the bias was taken: the bias may be wrong, tare"


def test_a_bias_goes_with_the_sensors_own_offset_as_long_as_that_is_known() -> None:
    own = OwnOffset()
    assert (own.follow(None), own.follow(OLD), own.doubt(None)) == (None, None, UNKNOWN)
    assert own.follow(NEW) == NO_WRENCH, "there is no bias to shift"
    own.begin(BIAS, OLD)
    assert (own.follow(OLD), own.doubt(OLD)) == (None, "")
    assert own.follow(NEW) == NEW
    assert (own.follow(NEW), own.doubt(NEW)) == (None, ""), "once"
    assert own.follow(None) is None
    assert own.follow(OLD) == NO_WRENCH.plus(NEW, -1.0)
    own.begin(NO_WRENCH, None)
    assert own.follow(OLD) is None
    assert own.doubt(OLD) == "", "what is no bias cannot be wrong"
    own.begin(NO_WRENCH, None, is_measured=True)
    assert own.follow(OLD) is None
    assert own.doubt(OLD) == own.doubt(None) == APPEARED
    own.begin(NO_WRENCH, OLD, is_measured=True)
    assert own.follow(NEW) == NEW
    assert own.doubt(NEW) == ""


def test_why_a_sample_may_not_be_used() -> None:
    stream = CompensatedStream(Plan(ImuSource(), TOOL))
    stream.feel(sample(), 1.0, 0.0)
    hot, saturated = sample(warnings=WarningFlag.OVERTEMPERATURE), sample(angular_rate_saturated=1)
    broken = sample(warnings=WarningFlag.ADC_OUT_OF_SYNC)
    faulty = "force or torque was not finite, or of a sensor that reports a fault"
    for use_saturated, told in (
        (True, ""), (False, "angular rate was saturated or out of range, and on_saturation is stop"),
    ):  # fmt: skip
        stream.use_saturated = use_saturated
        assert [stream.why_not(each) for each in (sample(), hot, saturated)] == ["", "", told]
        assert stream.why_not(broken) == faulty
    for plan in (Plan(payload=TOOL), Plan(ImuSource())):
        stream.plan = plan
        assert stream.why_not(saturated) == "", "the IMU is not needed"
    stream.forbidden = "for a reason"
    stream.check()
    assert stream.why_not(sample()) == "for a reason"


def test_after_a_change_of_its_own_offset_the_samples_on_their_way_are_in_doubt() -> None:
    """Two filters' lengths of a sample after the newest; the source has none of its own."""
    stream = CompensatedStream(Plan(ramp=BiasRamp(BIAS)))

    def told(offset: Wrench | None) -> Wrench | None:
        six = None if offset is None else offset.values
        stream.configure(InForce(SensorInfo(rate_hz=800.0, settings={"sinc_length": 64}, offset=six)))
        return stream.follow_offset()

    stream.own_offset.begin(BIAS, OLD)
    assert told(OLD) is None
    assert stream.feel(sample(), 10.0, 0.0) == ZERO
    assert stream.why_not(sample()) == ""
    assert told(NEW) == NEW
    assert stream.plan.ramp.target == BIAS.plus(NEW)
    after_s = stream.in_force.doubt_after_ns * 1e-9
    assert after_s > 1.25e-3
    for time_s, why in ((10.0, BEING_CHANGED), (10.0 + after_s, BEING_CHANGED), (10.0 + after_s + 1e-4, "")):
        stream.feel(sample(), time_s, 0.0)
        assert stream.why_not(sample()) == why
    assert told(None) is None
    assert stream.why_not(sample()) == stream.hold == UNKNOWN
    assert told(NEW) is None
    assert stream.why_not(sample()) == ""
    assert stream.feel(sample(), 20.0, 0.0, always=True) is None, "there is no source"


def test_where_the_sensors_own_imu_is() -> None:
    assert imu_position("BFT-SENS-ECAT-M8") == (0.0, 0.0, 0.0093 - 0.035)
    assert imu_position("BFT-LAXS-ECAT") == (0.0, 0.0, 0.01195 - 0.0445)
    assert imu_position("unheard of") == ZERO
    assert imu_position("BFT-SENS-ECAT-M8", (0.0, 0.01, 0.0)) == (0.0, 0.01, 0.0)
    source = ImuSource((0.01, 0.02, 0.03), (0.1, 0.2, 0.3))
    assert source.lever_of("BFT-SENS-ECAT-M8") == pytest.approx((-0.09, -0.18, -0.27))
    before = source._imu.alignment
    source.configure(InForce(SensorInfo(name="BFT-SENS-ECAT-M8")))
    assert source._imu.alignment is before, "settings and rate are the same"
    for settings, rate_hz in (({"sinc_length": 64}, None), ({"sinc_length": 64}, 800.0)):
        source.configure(InForce(SensorInfo(rate_hz=rate_hz or 0.0, settings=settings)))
        assert source._imu.alignment is not before
        before = source._imu.alignment


def test_why_there_is_no_specific_force() -> None:
    source, none = ImuSource(), Source("nobody tells")
    off, fast = sample(acceleration=ZERO), sample(acceleration=(math.nan, 0.0, 9.8))
    assert (source.why_none(sample(), 0.0), source.why_none(off, 0.0)) == ("", IMU_IS_OFF)
    assert source.why_none(fast, 0.0) == "the IMU sends NaN or infinity: see the status stream"
    moved = sample(acceleration=(1.0, 2.0, 9.0))
    assert source.specific_force(moved, 1.0, 0.0) == source.felt == pytest.approx((1.0, 2.0, 9.0))
    felt_before = source.felt
    assert source.specific_force(off, 1.01, 0.0) is None
    assert source.felt == felt_before, "of the latest sample in which something was felt"
    assert none.why_none(sample(), 0.0) == (
        "nobody tells, so the weight of the tool is not known: set gravity_source to a source, or set "
        "tool_mass to 0"
    )
    assert none.specific_force(sample(), 1.0, 0.0) is None
    assert (none.age_s(1.0), source.age_s(1.0)) == (math.inf, math.inf)
    assert (none.is_imu, source.is_imu, none.name, source.name) == (False, True, "none", "imu")
