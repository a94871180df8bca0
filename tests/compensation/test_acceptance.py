"""What has to hold on the virtual sensor with its noise; only the accelerometer tells the orientation.

All of it at simulated time: through the virtual sensor's own code, and through the whole server.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from bota_ethercat.pdo import Sample, SampleDecoder
from ethercat_server.virtual_sensor.measurement import scene
from ethercat_server.virtual_sensor.measurement.motion import TURN_LENGTH
from ethercat_server.virtual_sensor.options import SensorOptions
from ft_compensation.bias import estimate_bias
from ft_compensation.compensator import Compensator
from ft_compensation.identification.payload import Identified, identify
from ft_compensation.quantities import Payload, Wrench
from ft_compensation.specific_force import ImuSpecificForce
from ft_compensation.stationary import NotStationaryError, StationaryMeans, StationaryWindow
from tests.compensation.streaming import (
    OFFSET,
    POSES_TAKE,
    SINC,
    STILL,
    Stream,
    contact,
    deviations,
    samples,
    take_poses,
)
from tests.simulation import Simulation, fresh

Rows = NDArray[np.float64]
TOOL = Payload(scene.TOOL_MASS, scene.TOOL_CENTRE)
SHAKEN = 128
"""SINC length where the wrist sways: what compensation does not know of that is below this noise."""
RATE_HZ = 51200 / SHAKEN
WITHIN_3_SIGMA = 0.9973
"""The share of pure noise that lies within three standard deviations."""


def compensated(stream: Stream, payload: Payload, bias: Wrench) -> tuple[Rows, Rows]:
    """Times (n,) and what compensation leaves (n, 6)."""
    imu, compensator = ImuSpecificForce(payload.center), Compensator(payload, bias)
    times, rows = [], []
    for time_s, sample in stream:
        felt = imu.follow(sample.acceleration, sample.angular_rate, time_s)
        assert felt is not None
        times.append(time_s)
        rows.append(compensator.compensate(sample.force, sample.torque, felt).final.values)
    return np.array(times), np.array(rows)


def within_three_sigma(left: Rows, sinc: int = SINC) -> Rows:
    """The share of samples within three standard deviations of the sensor's noise, (6,)."""
    share: Rows = (np.abs(left) <= 3.0 * np.array(deviations(sinc))).mean(axis=0)
    return share


def truth(times: Rows) -> Rows:
    """What the tool of `scene` is touched with, (n, 6)."""
    return np.array([contact(float(time_s)) for time_s in times])


def smooth(left: Rows, count: int = 40) -> Rows:
    """Means over 400 ms, which show what is not noise."""
    whole = len(left) // count * count
    means: Rows = left[:whole].reshape(-1, count, 6).mean(axis=1)
    return means


@pytest.fixture(scope="module")
def identified() -> Identified:
    return identify(take_poses(samples("poses", POSES_TAKE, part=STILL)))


@pytest.fixture(scope="module")
def touched() -> Stream:
    """Three contacts."""
    return list(samples("scene", 20.0, seed=4, sinc=SHAKEN))


def bias_of(means: StationaryMeans) -> Wrench:
    return estimate_bias(means, TOOL, means.acceleration)


def check_identified(found: Identified) -> None:
    assert found.coverage.poses >= 6
    assert found.payload.mass == pytest.approx(TOOL.mass, rel=0.01)
    assert math.dist(found.payload.center, TOOL.center) < 0.002


@pytest.mark.parametrize(("seed", "sinc"), [(0, SINC), (1, 51)])
def test_six_poses_give_mass_within_one_percent_and_centre_within_two_millimetres(
    seed: int, sinc: int
) -> None:
    found = identify(take_poses(samples("poses", POSES_TAKE, seed, sinc, STILL)))
    check_identified(found)
    assert found.bias.force == pytest.approx(OFFSET[:3], abs=0.1)
    assert found.bias.torque == pytest.approx(OFFSET[3:], abs=0.002)
    assert abs(found.payload.mass - TOOL.mass) < 3 * found.mass_interval
    assert found.notes == ()


def test_through_a_slow_full_turn_only_noise_is_left(identified: Identified) -> None:
    _, left = compensated(samples("turn", TURN_LENGTH, seed=3), identified.payload, identified.bias)
    sigma = np.array(deviations())
    # What is left of the noise in a mean of 40, and a fifth of its standard deviation for everything else.
    assert (np.abs(smooth(left)) <= 4.0 * sigma / 40**0.5 + 0.2 * sigma).all()
    # The accelerometer's noise on this tool comes on top.
    assert within_three_sigma(left).min() > WITHIN_3_SIGMA - 0.03


def test_contacts_of_the_scene_show_up_undistorted(identified: Identified, touched: Stream) -> None:
    times, left = compensated(touched, identified.payload, identified.bias)
    touch = truth(times)
    error = left - touch
    assert within_three_sigma(error, SHAKEN).min() > WITHIN_3_SIGMA - 0.004
    touching = np.abs(touch[:, 2]) > 1.0
    assert touching.sum() > 300
    for axis in (0, 1, 2, 3, 4):
        real = touch[touching, axis]
        scale = float(left[touching, axis] @ real / (real @ real))
        assert scale == pytest.approx(1.0, abs=0.05), f"axis {axis} is scaled by {scale:.3f}"


def test_the_bias_can_be_taken_with_the_tool_on_in_any_pose_and_not_while_it_sways() -> None:
    window = StationaryWindow(1.0)
    for time_s, sample in samples("poses", 2.0):
        if window.add(sample, time_s):
            break
    assert bias_of(window.means()).force == pytest.approx(OFFSET[:3], abs=0.05)
    window = StationaryWindow(1.0)
    for time_s, sample in samples("scene", 2.0):
        if window.add(sample, time_s):
            break
    with pytest.raises(NotStationaryError, match=r"not stationary|turns"):
        window.means()


# Through the whole server, with the stamps that it gives.


class Bench:
    """A server and its client, in simulated time, and a virtual sensor whose signal can be changed."""

    def __init__(self) -> None:
        self._simulation = Simulation(SensorOptions(signal="poses"), settings={"sinc_length": SHAKEN})
        self._client = self._simulation.connect()
        self._client.ask("subscribe")

    def stream(self, signal: str, seconds: float) -> Iterator[tuple[float, Sample]]:
        """The samples of `seconds` of a signal, with their times since it began."""
        begin_ns, decode = self._simulation.clock.now_ns, SampleDecoder(61).decode
        self._simulation.command(f"signal {signal}")
        while True:
            self._client.frames.clear()
            self._simulation.run(0.2)
            for frame in fresh(self._client.frames):
                if (passed_ns := frame.monotonic_ns - begin_ns) >= seconds * 1e9:
                    return
                if passed_ns >= 0:
                    yield passed_ns * 1e-9, decode(frame.process_data)


def check_contact(bench: Bench, payload: Payload, bias: Wrench) -> None:
    times, left = compensated(bench.stream("scene", 6.0), payload, bias)
    assert len(left) == pytest.approx(6.0 * RATE_HZ, rel=0.1)
    assert within_three_sigma(left - truth(times), SHAKEN).min() > WITHIN_3_SIGMA - 0.005
    assert left[:, 2].min() == pytest.approx(scene.CONTACT_FORCE[2], abs=4 * deviations(SHAKEN)[2])


def check_turn(bench: Bench, payload: Payload, bias: Wrench, seconds: float) -> None:
    _, left = compensated(bench.stream("turn", seconds), payload, bias)
    assert len(left) == pytest.approx(seconds * RATE_HZ, rel=0.1)
    assert within_three_sigma(left, SHAKEN).min() > WITHIN_3_SIGMA - 0.005


def test_through_the_server_bias_contact_and_the_beginning_of_a_turn() -> None:
    bench, window = Bench(), StationaryWindow(1.0)
    for time_s, sample in bench.stream("poses", 2.5):
        if window.add(sample, time_s):
            break
    bias = bias_of(window.means())
    assert bias.values == pytest.approx([0.0] * 6, abs=0.1), "this sensor's offset is zero, its tool is not"
    check_turn(bench, TOOL, bias, 2.0)
    check_contact(bench, TOOL, bias)


@pytest.mark.long
def test_through_the_server_identification_contact_and_a_full_turn() -> None:
    bench = Bench()
    found = identify(take_poses(bench.stream("poses", POSES_TAKE)))
    check_identified(found)
    check_turn(bench, found.payload, found.bias, TURN_LENGTH)
    check_contact(bench, found.payload, found.bias)
