"""What has to hold on the virtual sensor with its noise; only the accelerometer tells the orientation.

The long signals run at simulated time through the virtual sensor's own code, the short ones for real.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ethercat_server.virtual_sensor.measurement import scene
from ethercat_server.virtual_sensor.measurement.motion import TURN_LENGTH
from ft_compensation.bias import estimate_bias
from ft_compensation.compensator import Compensator
from ft_compensation.identification.payload import Identified
from ft_compensation.orientation import AccelerometerGravity
from ft_compensation.quantities import Payload, Wrench
from ft_compensation.still import NotStillError, StillWindow
from protocol.client import Client, connect
from protocol.pdo import Sample
from tests.compensation.streaming import (
    OFFSET,
    POSES_TAKE,
    SINC,
    Stream,
    contact,
    deviations,
    samples,
    take_poses,
)
from tests.server.running import Server, needs_bus

Rows = NDArray[np.float64]
TOOL = Payload(scene.TOOL_MASS, scene.TOOL_CENTRE)
SIGMA = np.array(deviations())
SINC_OVER_TCP = 64
WITHIN_3_SIGMA = 0.9973
"""The share of pure noise that lies within three standard deviations."""


def compensated(
    stream: Stream, payload: Payload, bias: Wrench, *, inertia: bool = False, gyroscope: bool = True
) -> tuple[Rows, Rows]:
    """Times (n,) and what compensation leaves (n, 6)."""
    source = AccelerometerGravity(gyroscope=gyroscope)
    compensator = Compensator(payload, bias, inertia=inertia)
    times, rows = [], []
    for time_s, sample in stream:
        source.update(sample.acceleration, sample.angular_rate, time_s)
        gravity = source.gravity(time_s)
        if gravity is not None:
            stages = compensator.compensate(
                sample.force, sample.torque, gravity, sample.acceleration, sample.angular_rate
            )
            times.append(time_s)
            rows.append(stages.final.values)
    return np.array(times), np.array(rows)


def within_three_sigma(left: Rows, sinc: int = SINC) -> Rows:
    """The share of samples within three standard deviations of the sensor's noise, (6,)."""
    share: Rows = (np.abs(left) <= 3.0 * np.array(deviations(sinc))).mean(axis=0)
    return share


def truth(times: Rows) -> Rows:
    """What the tool of `scene` is touched with, (n, 6)."""
    return np.array([contact(float(time_s)) for time_s in times])


def smooth(left: Rows, count: int = 40) -> Rows:
    """Means over 100 ms, which show what is not noise."""
    whole = len(left) // count * count
    means: Rows = left[:whole].reshape(-1, count, 6).mean(axis=1)
    return means


@pytest.fixture(scope="module")
def identified() -> Identified:
    return take_poses(samples("poses", POSES_TAKE)).solve()


def check_identified(found: Identified) -> None:
    assert found.coverage.poses >= 6
    assert found.payload.mass == pytest.approx(TOOL.mass, rel=0.01)
    assert math.dist(found.payload.center, TOOL.center) < 0.002


# At simulated time.


@pytest.mark.parametrize(("seed", "sinc"), [(0, 64), (1, 51), (2, 256)])
def test_six_poses_give_mass_within_one_percent_and_centre_within_two_millimetres(
    seed: int, sinc: int
) -> None:
    found = take_poses(samples("poses", POSES_TAKE, seed, sinc)).solve()
    check_identified(found)
    assert found.bias.force == pytest.approx(OFFSET[:3], abs=0.1)
    assert found.bias.torque == pytest.approx(OFFSET[3:], abs=0.002)
    assert abs(found.payload.mass - TOOL.mass) < 3 * found.mass_interval
    assert found.notes == ()


def test_through_a_slow_full_turn_only_noise_is_left(identified: Identified) -> None:
    _, left = compensated(samples("turn", TURN_LENGTH, seed=3), identified.payload, identified.bias)
    # What is left of the noise in a mean of 40, and a fifth of its standard deviation for everything else.
    assert (np.abs(smooth(left)) <= 4.0 * SIGMA / 40**0.5 + 0.2 * SIGMA).all()
    assert within_three_sigma(left).min() > WITHIN_3_SIGMA - 0.002


def test_without_the_gyroscope_the_filter_lags_and_that_shows(identified: Identified) -> None:
    """Why the gyroscope is on by default: same signal, same filter, without it."""
    _, left = compensated(
        samples("turn", TURN_LENGTH / 3, seed=3), identified.payload, identified.bias, gyroscope=False
    )
    assert within_three_sigma(left).min() < 0.9


@pytest.mark.parametrize("inertia", [False, True])
def test_contacts_of_the_scene_show_up_undistorted(identified: Identified, inertia: bool) -> None:
    times, left = compensated(
        samples("scene", 27.0, seed=4), identified.payload, identified.bias, inertia=inertia
    )
    touch = truth(times)
    error = left - touch
    # The wrist shakes with up to 0.2 m/s²: 0.16 N on this tool, which only the inertial term takes off.
    assert within_three_sigma(error).min() > WITHIN_3_SIGMA - (0.002 if inertia else 0.05)
    touching = np.abs(touch[:, 2]) > 1.0
    assert touching.sum() > 400
    for axis in (0, 1, 2, 3, 4):
        real = touch[touching, axis]
        scale = float(left[touching, axis] @ real / (real @ real))
        assert scale == pytest.approx(1.0, abs=0.05), f"axis {axis} is scaled by {scale:.3f}"


def test_the_bias_can_be_taken_with_the_tool_on_in_any_pose_and_not_while_it_sways() -> None:
    window = StillWindow(1.0)
    for time_s, sample in samples("poses", 2.0):
        if window.add(sample, time_s):
            break
    assert estimate_bias(window.means(), TOOL).force == pytest.approx(OFFSET[:3], abs=0.05)
    window = StillWindow(1.0)
    for time_s, sample in samples("scene", 2.0):
        if window.add(sample, time_s):
            break
    with pytest.raises(NotStillError, match=r"not stationary|turns"):
        window.means()


# For real.


class Bench:
    """A server with a virtual sensor whose signal can be changed, and a client of it."""

    def __init__(self, client: Client, control: Path) -> None:
        self._client = client
        self._control = control

    def change(self, signal: str) -> float:
        """Measure another signal; returns when it begins, s on CLOCK_MONOTONIC."""
        with socket.socket(socket.AF_UNIX) as control:
            control.connect(str(self._control))
            control.sendall(f"signal {signal}\n".encode())
            assert control.recv(100) == b"ok\n"
        return time.monotonic()

    def stream(self, begin_s: float, seconds: float) -> Iterator[tuple[float, Sample]]:
        """The samples of `seconds` from `begin_s` on, with their times since then."""
        while True:
            for frame in self._client.receive(10.0):
                time_s = frame.monotonic_ns * 1e-9 - begin_s
                if time_s >= seconds:
                    return
                if time_s >= 0.0:
                    yield time_s, self._client.decode(frame)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    control = tmp_path / "control"
    server = Server("virtual", "--virtual", f"--control {control} --signal poses")
    try:
        server.wait_streaming()
        with connect(server.port) as client:
            yield Bench(client, control)
    finally:
        server.close()


def check_contact(bench: Bench, payload: Payload, bias: Wrench) -> None:
    begin_s = bench.change("scene")
    times, left = compensated(bench.stream(begin_s, 6.0), payload, bias, inertia=True)
    # When the scene began is known to a few ms only, more on a busy machine: where the contact fits best.
    near = (times > 4.5) & (times < 6.0)
    shifts = np.arange(-0.1, 0.1, 0.002)
    misfits = [np.square(left[near] - truth(times[near] + shift)).sum() for shift in shifts]
    error = left - truth(times + shifts[int(np.argmin(misfits))])
    assert within_three_sigma(error, SINC_OVER_TCP).min() > WITHIN_3_SIGMA - 0.01
    assert left[:, 2].min() == pytest.approx(scene.CONTACT_FORCE[2], abs=4 * deviations(SINC_OVER_TCP)[2])


def check_turn(bench: Bench, payload: Payload, bias: Wrench, seconds: float) -> None:
    begin_s = bench.change("turn")
    _, left = compensated(bench.stream(begin_s + 0.01, seconds), payload, bias)
    assert len(left) > 500 * seconds
    assert within_three_sigma(left, SINC_OVER_TCP).min() > WITHIN_3_SIGMA - 0.01


@needs_bus
@pytest.mark.bus
def test_over_tcp_bias_contact_and_the_beginning_of_a_turn(bench: Bench) -> None:
    begin_s = bench.change("poses")
    window = StillWindow(1.0)
    for time_s, sample in bench.stream(begin_s + 0.01, 2.5):
        if window.add(sample, time_s):
            break
    bias = estimate_bias(window.means(), TOOL)
    assert bias.values == pytest.approx([0.0] * 6, abs=0.1), "this sensor's offset is zero, its tool is not"
    check_turn(bench, TOOL, bias, 2.0)
    check_contact(bench, TOOL, bias)


@needs_bus
@pytest.mark.bus
@pytest.mark.long
@pytest.mark.timeout(300)
def test_over_tcp_identification_contact_and_a_full_turn(bench: Bench) -> None:
    begin_s = bench.change("poses")
    found = take_poses(bench.stream(begin_s, POSES_TAKE)).solve()
    check_identified(found)
    check_turn(bench, found.payload, found.bias, TURN_LENGTH)
    check_contact(bench, found.payload, found.bias)
