"""The lag between force and accelerometer, found from a recording of a sensor that was shaken by hand."""

from __future__ import annotations

import numpy as np
import pytest

from bota_ethercat.sensor.response import acceleration_response, force_torque_response
from bota_ethercat.settings import SettingValue
from ft_compensation.identification.delay import Lag, find_lag
from ft_compensation.quantities import CompensationError, Payload
from tests.compensation import motion
from tests.compensation.motion import Felt
from tests.simulation import more_if_long

TOOL = Payload(0.7, (0.0, 0.01, 0.04))
GYROSCOPE_S = 0.0029 - 0.00194


def settings(sinc_length: int, fir: bool) -> dict[str, SettingValue]:
    return {"sinc_length": sinc_length, "fir": fir, "acceleration_filter": 1, "angular_rate_filter": 3}


def shaken(seed: int) -> motion.Path:
    return motion.guided(seed, metres=0.06, radians=0.3, hertz=(1.5, 4.0))


def lag_of(felt: Felt, noise: float = 0.3) -> Lag:
    force = felt.force + np.random.default_rng(5).normal(0, noise, felt.force.shape)
    return find_lag(felt.times, force, felt.acceleration, felt.rate, GYROSCOPE_S)


@pytest.mark.parametrize(
    ("sinc_length", "fir"), [(32, False), (64, False), (64, True), (512, False), (512, True)]
)
@pytest.mark.parametrize("seed", more_if_long([1], range(1, 6)))
def test_the_lag_is_found(sinc_length: int, fir: bool, seed: int) -> None:
    chosen = settings(sinc_length, fir)
    truth = (force_torque_response(chosen).delay_s or 0) - (acceleration_response(chosen).delay_s or 0)
    found = lag_of(motion.filtered(shaken(seed), TOOL, 10.0, chosen, seed=seed))
    assert found.seconds == pytest.approx(truth, abs=max(2 * found.interval_s, 1e-4))
    assert found.interval_s < 2e-3
    assert found.explained > 0.95


@pytest.mark.parametrize(
    ("path", "tool", "seconds", "why"),
    [
        (shaken(1), TOOL, 2.0, "too few"),
        (shaken(1), Payload(0.001), 10.0, "explains only"),
        (motion.guided(1, hertz=(0.02, 0.05)), TOOL, 10.0, "too slow"),
    ],
    ids=["short", "no tool", "slow"],
)
def test_what_shows_nothing_is_refused(path: motion.Path, tool: Payload, seconds: float, why: str) -> None:
    felt = motion.filtered(path, tool, seconds, settings(64, False))
    with pytest.raises(CompensationError, match=why):
        lag_of(felt)


def test_samples_of_two_servers_are_refused() -> None:
    felt = motion.filtered(shaken(1), TOOL, 5.0, settings(64, False))
    with pytest.raises(CompensationError, match="order of their times"):
        lag_of(felt._replace(times=np.where(felt.times < 2.5, felt.times, felt.times - 1.0)))
