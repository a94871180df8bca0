"""The specific force at the instant of force and torque, whatever the filters: on rigid-body motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bota_ethercat.settings import SettingValue
from ft_compensation.alignment import NOT_DELAYED, Alignment, alignment_taps
from ft_compensation.quantities import Payload
from ft_compensation.specific_force import ImuSpecificForce
from tests.compensation import motion
from tests.compensation.motion import IMU, Array, Felt

TOOL = Payload(2.0, (0.004, -0.006, 0.08))
SECONDS = 3.0
SETTLING_S = 0.5


def settings(sinc_length: int, fir: bool, **others: SettingValue) -> dict[str, SettingValue]:
    return {
        "sinc_length": sinc_length,
        "fir": fir,
        "acceleration_filter": 1,
        "angular_rate_filter": 3,
        **others,
    }


def left_over(felt: Felt, taps: tuple[float, ...]) -> Array:
    """Force that compensation leaves, (n,) N."""
    x, y, z = (center - imu for center, imu in zip(TOOL.center, IMU, strict=True))
    imu, alignment = ImuSpecificForce((x, y, z)), Alignment(taps, float(felt.times[1]))
    specific = []
    for time_s, acceleration, rate in zip(felt.times, felt.acceleration, felt.rate, strict=True):
        found = imu.follow((*acceleration,), (*rate,), time_s)
        assert found is not None
        specific.append(alignment.follow(found, time_s))
    left: Array = np.linalg.norm(felt.force + TOOL.mass * np.array(specific), axis=1)
    return left[felt.times > SETTLING_S]


def rms(values: Array) -> float:
    return math.sqrt(float((values**2).mean()))


@pytest.mark.parametrize("fir", [False, True], ids=["FIR off", "FIR on"])
@pytest.mark.parametrize("sinc_length", [32, 64, 128, 512])
def test_moves_leave_little_at_every_filter(sinc_length: int, fir: bool) -> None:
    """Never more than without it, and never more than the bias alone; the sensor's noise comes on top."""
    chosen = settings(sinc_length, fir)
    taps = alignment_taps(chosen, 51200 / sinc_length)
    for name, path in motion.moves(21).items():
        felt = motion.filtered(path, TOOL, SECONDS, chosen)
        left, without = left_over(felt, taps), left_over(felt, NOT_DELAYED)
        alone = np.linalg.norm(felt.force - felt.force.mean(axis=0), axis=1)
        most = 0.7 if (sinc_length, name) == (32, "vibration") else 0.45  # there the IMU is 1 ms late
        assert rms(left) < min(most, rms(without) + 0.02, rms(alone))
        assert float(np.quantile(left, 0.99)) < (0.7 if sinc_length == 64 else 1.2)


def test_a_vibration_under_a_long_filter_is_not_subtracted_twice() -> None:
    chosen = settings(512, False)
    felt = motion.filtered(motion.moves(3)["vibration"], TOOL, SECONDS, chosen)
    assert rms(left_over(felt, NOT_DELAYED)) > 3.0
    assert rms(left_over(felt, alignment_taps(chosen, 100))) < 0.4


def test_what_is_unknown_or_later_is_used_as_it_comes() -> None:
    assert alignment_taps(settings(64, False), 800) == NOT_DELAYED
    assert alignment_taps(settings(64, True, fast=True), 800) == NOT_DELAYED
    assert alignment_taps(settings(64, True, chop=True), 400) == NOT_DELAYED
    assert alignment_taps({}, 800) == NOT_DELAYED
    assert alignment_taps(settings(32, False), 1600) == NOT_DELAYED
    assert Alignment().follow((1.0, 2.0, 3.0), 0.0) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("fir", [False, True])
def test_of_a_ramp_it_gives_the_value_of_the_forces_instant(fir: bool) -> None:
    chosen = settings(256, fir)
    alignment = Alignment(alignment_taps(chosen, 200), 1 / 200)
    for number in range(100):
        found = alignment.follow((number / 200, 0.0, 1.0), number / 200)
    assert found == pytest.approx((99 / 200 - ((12 if fir else 1.5) / 200 - 0.00194), 0.0, 1.0), abs=1e-4)


@pytest.mark.parametrize("later_s", [0.5, -3.0, 3 / 200, 1 / 200])
def test_lost_samples_and_stalls_bring_nothing_old(later_s: float) -> None:
    alignment = Alignment(alignment_taps(settings(256, True), 200), 1 / 200)
    assert alignment.follow((9.0, 0.0, 0.0), 0.0) == pytest.approx((9.0, 0.0, 0.0)), (
        "the first is all there is"
    )
    for number in range(50):
        alignment.follow((1.0, 0.0, 0.0), (number + 1) / 200)
    found = [alignment.follow((2.0, 0.0, 0.0), 50 / 200 + later_s + number / 200)[0] for number in range(23)]
    assert found[-1] == pytest.approx(2.0)
    assert found[0] == pytest.approx(2.0 if later_s in {0.5, -3.0} else 1.0, abs=1e-2)
    assert found == pytest.approx(sorted(found))
