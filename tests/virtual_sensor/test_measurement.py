"""Samples: the clock, the formulas, the scene's physics, and what settings do to them."""

import cmath
import math
import statistics
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY, SampleDecoder, encode
from bota_ethercat.sensor.filters import ACCELERATION_FILTERS, ANGULAR_RATE_FILTERS, ImuFilter
from bota_ethercat.sensor.frames import IMU_HEIGHTS
from bota_ethercat.sensor.response import fir_gain, fir_taps, force_torque_response, sinc_gain
from bota_ethercat.sensor.warnings_register import WarningFlag
from bota_ethercat.world import Felt
from ethercat_server.virtual_sensor import signals
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.sampler import SamplingClock
from ethercat_server.virtual_sensor.signals import (
    CONSTANT,
    World,
    carry,
    poses,
    scene,
    sway,
)
from tests.compensation import motion
from tests.virtual_sensor.motions import measured, turning
from tests.virtual_sensor.raw_master import OP, PREOP, RawMaster, do

ZERO = (0.0, 0.0, 0.0)
PERIOD = 1_250_000  # 64 / 51200 s in ns
RAW = SampleDecoder(61)


def load(data: bytes) -> tuple[float, ...]:
    values: tuple[float, ...] = struct.unpack_from("<6f", data, 5)
    return values


@pytest.mark.parametrize("ppm", [0.0, 150.0, -300.0, 1234.5678])
@pytest.mark.parametrize("sinc", [32, 51, 64, 341])
def test_numbers_and_instants_agree(ppm: float, sinc: int) -> None:
    clock = SamplingClock(1_000_000_007, sinc, ppm)
    for number in (*range(0, 3000, 7), 10**9):
        instant = clock.instant(number)
        assert clock.number_at(instant) == number
        assert clock.number_at(instant - 1) == max(number - 1, 0)
    length = (clock.instant(10**6) - clock.instant(0)) / 1e6
    assert length == pytest.approx(sinc / 51200 * 1e9 / (1 + ppm * 1e-6), rel=1e-9)


def test_a_change_of_rate_neither_skips_nor_repeats() -> None:
    clock = SamplingClock(0, 64)
    now = 3 * PERIOD + 400
    clock.change(now, ppm=100_000.0)
    assert clock.number_at(now) == 3
    assert clock.instant(3) == 3 * PERIOD
    assert clock.instant(4) == 3 * PERIOD + int(PERIOD / 1.1)
    clock.change(clock.instant(10), sinc_length=128)
    assert clock.number_at(clock.instant(11)) == 11


def test_the_same_sample_is_the_same_bytes_also_if_computed_ahead() -> None:
    plain, ahead = (RawMaster(SensorOptions(noise=False)).go(OP) for _ in range(2))
    life = ahead.bus.sensors[0].life
    assert life is not None
    for step in (PERIOD, PERIOD - 40_000, PERIOD // 4, 2 * PERIOD):
        for number in range(20):
            plain.wait(step)
            ahead.wait(step)
            made = life.sampler.made
            assert plain.inputs() == ahead.inputs()
            assert number < 2 or life.sampler.made == made, "nothing is left to compute for an answer"
            ahead.bus.prepare()
    for noise in (True, False):  # of a healthy sensor, or of the last bit
        noisy = [RawMaster(SensorOptions(seed=seed, noise=noise)).go(OP) for seed in (4, 4, 5)]
        one, again, other = (master.inputs() for master in noisy)
        assert one == again != other, "a seed gives the same noise again"
        assert noisy[0].inputs() == one


def test_formulas() -> None:
    master = RawMaster(SensorOptions(signal="rest", last_bit=False)).go(OP)
    for _ in range(30):
        master.wait(37 * PERIOD)
        k = (master.now - 5_000_000_123) // PERIOD
        sample = RAW.decode(master.inputs())
        assert (*sample.force, *sample.torque) == CONSTANT
        assert sample.temperature == 32 + k / 2**18
    master = RawMaster(SensorOptions(signal="constant", pdo_size=77, last_bit=False)).go(OP)
    fields = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")
    values = {**dict(zip(fields, CONSTANT, strict=True)), "acceleration.z": 1.0, "temperature": 35.0}
    assert master.inputs() == encode(77, values), "byte for byte"


TIMES = [0.0, 0.3, 1.0, 4.9, 5.3, 12.25, 100.0, 5000.5]


def rotate(q: tuple[float, ...], v: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z, w = q
    a, b, c = v
    t = (2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a))
    u = (y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0])
    return a + w * t[0] + u[0], b + w * t[1] + u[1], c + w * t[2] + u[2]


@pytest.mark.parametrize("seconds", TIMES)
@pytest.mark.parametrize("world", [scene, poses, turning])
def test_the_tool_is_a_rigid_body(world: World, seconds: float) -> None:
    """Force and torque are those of its mass and tensor where its center of gravity moves, not the IMU."""
    felt, step = world(seconds), 1e-5
    before, after = (np.array(world(seconds + by).angular_rate) for by in (-step, step))
    contact = np.array(signals.contact_force(seconds) if world is scene else ZERO)
    rate, spin, center = np.array(felt.angular_rate), (after - before) / (2 * step), signals.TOOL_CENTRE
    away = np.array(center) - (0.0, 0.0, IMU_HEIGHTS["SENS"])
    tensor = motion.tensor(signals.TOOL_INERTIA)
    at_center = felt.acceleration + np.cross(spin, away) + np.cross(rate, np.cross(rate, away))
    force = -signals.TOOL_MASS * at_center
    torque = np.cross(center, force) - tensor @ spin - np.cross(rate, tensor @ rate)
    assert felt.wrench[:3] == pytest.approx(force + contact, abs=1e-5)
    assert felt.wrench[3:] == pytest.approx(torque + np.cross(signals.CONTACT_POINT, contact), abs=1e-5)


@pytest.mark.parametrize("seconds", TIMES)
def test_orientation_agrees_with_the_accelerometer(seconds: float) -> None:
    orientation = measured().reading(0, 0, seconds).orientation
    assert math.hypot(*orientation) == pytest.approx(1)
    world = rotate(orientation, scene(seconds).acceleration)
    # What is left of the world's specific force without gravity is the wrist's own, small, acceleration.
    assert math.hypot(world[0], world[1], world[2] - STANDARD_GRAVITY) < 0.31
    gravity = carry((sway(seconds)[0], ZERO, ZERO)).acceleration
    assert rotate(orientation, gravity) == pytest.approx((0, 0, STANDARD_GRAVITY), abs=1e-8)


@pytest.mark.parametrize("seconds", [*TIMES[1:], 24.0])
@pytest.mark.parametrize("world", [scene, poses, turning])
def test_the_gyroscope_is_the_derivative_of_the_attitude(world: World, seconds: float) -> None:
    def orientation(seconds: float) -> tuple[float, ...]:
        attitude = world(seconds).attitude
        assert attitude is not None
        return signals.quaternion(attitude)

    step = 1e-5
    turned = zip(orientation(seconds - step), orientation(seconds + step), strict=True)
    x, y, z, w = orientation(seconds)
    dx, dy, dz = world(seconds).angular_rate
    twice = (
        w * dx + y * dz - z * dy,
        w * dy + z * dx - x * dz,
        w * dz + x * dy - y * dx,
        -x * dx - y * dy - z * dz,
    )
    assert [(after - before) / step for before, after in turned] == pytest.approx(twice, abs=1e-6)


def response_to(hz: float, channel: int, step_s: float, count: int, sinc: int, **changed: Any) -> complex:
    """What a channel makes of a sine, by so many samples in whole periods: magnitude, and phase.

    The sensor pitches by 0.01 rad; force along x, acceleration along x, and angular rate about y follow.
    """
    omega = math.tau * hz

    def pitching(t: float) -> Felt:
        pitch, rate = 0.01 * math.sin(omega * t), 0.01 * omega * math.cos(omega * t)
        return carry(((0.0, pitch, 0.0), (0.0, rate, 0.0), (0.0, -omega * omega * pitch, 0.0)))

    source, sums = measured(pitching, sinc, **changed), [0j, 0j]
    for number in range(count):
        seconds = 20.0 + number * step_s
        reading, felt = source.reading(number, 0, seconds), pitching(seconds)
        plain = (*(a / STANDARD_GRAVITY for a in felt.acceleration), *map(math.degrees, felt.angular_rate))
        for which, value in enumerate((reading.values[channel], (*felt.wrench, *plain)[channel])):
            sums[which] += value * cmath.exp(-1j * omega * seconds)
    return sums[0] / sums[1]


@pytest.mark.parametrize("fir", [False, True])
@pytest.mark.parametrize("sinc", [32, 64, 512])
def test_a_sine_of_force_is_late_by_the_filters_delay(sinc: int, fir: bool) -> None:
    rate = 51200 / sinc
    response = force_torque_response({"sinc_length": sinc, "fir": fir})
    # The last but one is about the cut-off frequency with FIR off.
    for cycles in (2, 8, 16, 105, 150):
        hz = cycles * rate / 400
        found = response_to(hz, 0, 1 / rate, 400, sinc, fir=fir)
        gain = sinc_gain(hz / rate) * (fir_gain(hz / rate) if fir else 1.0)
        assert abs(found) == pytest.approx(gain, abs=2e-3)
        if abs(found) > 0.1:
            assert response.delay_s is not None
            turned = found * cmath.exp(1j * math.tau * hz * response.delay_s)
            assert abs(math.degrees(cmath.phase(turned))) < 0.5


@pytest.mark.parametrize(
    ("channel", "setting", "rows"),
    [(6, "acceleration_filter", ACCELERATION_FILTERS), (10, "angular_rate_filter", ANGULAR_RATE_FILTERS)],
)
def test_a_sine_of_motion_is_late_by_the_profiles_delay(
    channel: int, setting: str, rows: Mapping[int, ImuFilter]
) -> None:
    for profile, row in rows.items():
        for share in (0.02, 0.2, 1.0):  # of the bandwidth
            hz = share * row.bandwidth_hz
            rest_s = row.delay_ms * 1e-3 - 1 / (math.tau * row.bandwidth_hz)
            expected = cmath.exp(-1j * math.tau * hz * rest_s) / (1 + 1j * share)
            found = response_to(hz, channel, 1 / (8 * hz), 8, 64, **{setting: profile})
            assert abs(found - expected) < 0.03 * share, (profile, share)


def test_what_is_not_read_does_not_change_what_is() -> None:
    """The filters look at samples that no master has read."""
    every, one = (measured(fir=True) for _ in range(2))
    read = [every.reading(number, 0, number / 800).values[:6] for number in range(60)]
    assert one.reading(59, 0, 59 / 800).values[:6] == pytest.approx(read[59])


def test_with_fir_on_there_is_less_noise() -> None:
    deviations = []
    for fir in (False, True):
        noisy = measured(lambda _: Felt((0.0,) * 6), seed=1, noise=True, fir=fir)
        forces = [noisy.reading(number, 0, number / 800).values[0] for number in range(2000)]
        deviations.append(statistics.pstdev(forces))
    assert deviations[0] == pytest.approx(noisy.deviations[0], rel=0.1)
    assert deviations[1] == pytest.approx(
        deviations[0] * sum(tap * tap for tap in fir_taps()) ** 0.5, rel=0.2
    )


@pytest.mark.parametrize(
    ("sinc", "force", "torque"),
    [(51, (0.6, 0.6, 0.6), (0.014, 0.014, 0.005)), (1024, (0.1, 0.1, 0.08), (0.0015, 0.0015, 0.0007))],
)
def test_noise_is_that_of_a_healthy_sensor(
    sinc: int, force: tuple[float, ...], torque: tuple[float, ...]
) -> None:
    noisy, still = measured(sinc=sinc, seed=1, noise=True), measured(sinc=sinc)
    squares = [0.0] * 12
    for n in range(500):
        values, exact = (source.reading(n, 0, n * sinc / 51200).values for source in (noisy, still))
        squares = [s + (x - y) ** 2 for s, x, y in zip(squares, values, exact, strict=True)]
    for axis, limit in enumerate((*force, *torque, *(0.1,) * 6)):
        assert (limit / 5 if axis < 6 else 0) < math.sqrt(squares[axis] / 500) < limit


def test_offsets_are_added_and_ranges_saturate_and_wider_ones_do_not() -> None:
    master = RawMaster(SensorOptions(signal="constant", last_bit=False)).go(OP)
    for axis, value in enumerate(CONSTANT, 1):
        master.download(0x8000, axis, struct.pack("<f", -value))
    master.download(0x8001, 1, struct.pack("<f", -3.0))
    master.download(0x8002, 3, struct.pack("<f", 300.0))
    master.wait(PERIOD)
    assert load(master.inputs()) == (0.0,) * 6
    sample = RAW.decode(master.inputs())
    assert (sample.acceleration[0], sample.acceleration_saturated) == (-2 * STANDARD_GRAVITY, 0b001)
    assert sample.angular_rate[2] == pytest.approx(math.radians(250))
    assert sample.angular_rate_saturated == 0b100
    assert sample.warnings == WarningFlag.ACCELERATION_SATURATED | WarningFlag.ANGULAR_RATE_SATURATED
    master.request(PREOP)
    for index in (0x8004, 0x8005):
        master.download(index, 0, b"\1")
    master.go(OP)
    master.wait(PERIOD)
    assert RAW.decode(master.inputs()).warnings == 0


def test_imu_off_calibration_off_orientation_on() -> None:
    master = RawMaster(SensorOptions(noise=False, pdo_size=77)).go(OP)
    decoder = SampleDecoder(77)
    calibrated = decoder.decode(master.inputs())
    unknown = calibrated.orientation
    do(master, "limit acceleration.z 0.5")
    for subindex, value in ((1, 0), (3, 0), (6, 1)):
        master.download(0x8010, subindex, bytes([value]))
    master.wait(PERIOD)
    sample = decoder.decode(master.inputs())
    assert (*sample.acceleration, *sample.angular_rate, sample.acceleration_saturated) == (0.0,) * 7
    assert unknown is None
    assert sample.orientation
    assert sample.force[2] == pytest.approx(calibrated.force[2] * 10_000, rel=1e-2)
    assert sample.force[2].is_integer()
