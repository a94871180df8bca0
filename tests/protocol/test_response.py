"""Delay and magnitude of the sensor's filters against what is published of them."""

from __future__ import annotations

import math

import pytest

from bota_ethercat.sensor.filters import FORCE_TORQUE_FILTERS
from bota_ethercat.sensor.response import (
    DelaySource,
    acceleration_response,
    angular_rate_response,
    delays_ms,
    fir_gain,
    fir_taps,
    force_torque_response,
    noise_bandwidth,
    sinc_gain,
)
from bota_ethercat.settings import start_up_defaults


@pytest.mark.parametrize("fir", [False, True])
@pytest.mark.parametrize("length", list(FORCE_TORQUE_FILTERS))
def test_the_magnitude_is_3_db_down_at_the_published_cut_off(length: int, fir: bool) -> None:
    row = FORCE_TORQUE_FILTERS[length]
    share = row.cutoff_hz(fir) / row.rate_hz
    assert 20 * math.log10(sinc_gain(share) * (fir_gain(share) if fir else 1.0)) == pytest.approx(
        -3, abs=0.25
    )


def test_the_stop_band_is_that_of_the_same_converter_elsewhere() -> None:
    """Beckhoff's IP3102: 64.5 dB from 43008 / 307200 of the rate on."""
    worst = max(sinc_gain(share / 1000) * fir_gain(share / 1000) for share in range(140, 1000))
    assert 20 * math.log10(worst) < -64.5


def test_the_noise_that_passes() -> None:
    """In closed form: the integral of sinc to the sixth power, and the energy of the impulse response."""
    assert noise_bandwidth(False) == pytest.approx(11 / 40, rel=1e-4)
    spline = {0: 11 / 20, 1: 13 / 60, 2: 1 / 120}  # of the sinc filter with itself, some periods later
    energy = sum(
        a * b * spline.get(abs(i - k), 0) for i, a in enumerate(fir_taps()) for k, b in enumerate(fir_taps())
    )
    assert noise_bandwidth(True) == pytest.approx(energy / 2, rel=1e-4)


@pytest.mark.parametrize("fir", [False, True])
def test_the_delay_is_the_filters_own(fir: bool) -> None:
    """A third-order sinc filter is three moving averages over a period each."""
    steps, impulse = 64, [1.0]
    stages = [[1 / steps] * steps] * 3
    if fir:
        stages.append([tap for each in fir_taps() for tap in [each, *[0.0] * (steps - 1)]])
    for taps in stages:
        impulse = [
            sum(taps[at - k] * value for k, value in enumerate(impulse) if 0 <= at - k < len(taps))
            for at in range(len(impulse) + len(taps) - 1)
        ]
    center = sum(at * value for at, value in enumerate(impulse)) / steps
    found = force_torque_response({"sinc_length": 64, "fir": fir})
    assert found.delay_s == pytest.approx((center + 1.5 / steps) / 800)
    assert found.phase_deg(10) == pytest.approx(360 * 10 * (12 if fir else 1.5) / 800)
    assert sum(impulse) == pytest.approx(1)


def test_of_what_is_not_known_no_delay_is_made_up() -> None:
    known = {"sinc_length": 64, "fir": True, "fast": False, "chop": False}
    assert delays_ms(start_up_defaults()) == {"force_torque": 1.88, "acceleration": 1.94, "angular_rate": 2.9}
    assert delays_ms(known)["force_torque"] == 15
    assert delays_ms(known, 400)["force_torque"] == 30
    for settings, source in (
        ({**known, "fast": True}, DelaySource.FAST),
        ({**known, "chop": True}, DelaySource.CHOP),
        ({"sinc_length": 64}, DelaySource.UNKNOWN),
        ({}, DelaySource.UNKNOWN),
    ):
        found = force_torque_response(settings)
        assert (found.delay_s, found.delay_ms, found.phase_deg(1), found.source) == (None, None, None, source)
    assert acceleration_response({}).delay_s is angular_rate_response({}).delay_s is None
