"""Samples: the clock, the formulas, the scene's physics, and what settings do to them."""

import itertools
import math
import struct

import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY, SampleDecoder, encode
from bota_ethercat.sensor.warnings_register import WarningFlag
from ethercat_server.virtual_sensor.measurement import scene
from ethercat_server.virtual_sensor.measurement.clock import SampleClock
from ethercat_server.virtual_sensor.measurement.motion import (
    MOTIONS,
    MOVE_LENGTH,
    POSE_LENGTH,
    POSES,
    TURN_LENGTH,
    Motion,
    Posing,
    Swaying,
    Turning,
    to_sensor,
)
from ethercat_server.virtual_sensor.measurement.signals import CONSTANT, decode_clock
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.virtual_sensor.raw_master import OP, PREOP, RawMaster

PERIOD = 1_250_000  # 64 / 51200 s in ns
RAW = SampleDecoder(61)


def load(data: bytes) -> tuple[float, ...]:
    values: tuple[float, ...] = struct.unpack_from("<6f", data, 5)
    return values


@pytest.mark.parametrize("ppm", [0.0, 150.0, -300.0, 1234.5678])
@pytest.mark.parametrize("sinc", [32, 51, 64, 341])
def test_numbers_and_instants_agree(ppm: float, sinc: int) -> None:
    clock = SampleClock(1_000_000_007, sinc, ppm)
    for number in (*range(0, 3000, 7), 10**9):
        instant = clock.instant(number)
        assert clock.number_at(instant) == number
        assert clock.number_at(instant - 1) == max(number - 1, 0)
    length = (clock.instant(10**6) - clock.instant(0)) / 1e6
    assert length == pytest.approx(sinc / 51200 * 1e9 / (1 + ppm * 1e-6), rel=1e-9)


def test_a_change_of_rate_neither_skips_nor_repeats() -> None:
    clock = SampleClock(0, 64)
    now = 3 * PERIOD + 400
    clock.change(now, ppm=100_000.0)
    assert clock.number_at(now) == 3
    assert clock.instant(3) == 3 * PERIOD
    assert clock.instant(4) == 3 * PERIOD + int(PERIOD / 1.1)
    clock.change(clock.instant(10), sinc_length=128)
    assert clock.number_at(clock.instant(11)) == 11


def test_the_newest_sample_is_what_a_frame_carries() -> None:
    master = RawMaster(SensorOptions(signal="clock", sinc_length=64)).go(OP)
    previous = -1
    for step in (700_000, 10_000, PERIOD, 5 * PERIOD, 333, 90_000_000):
        master.wait(step)
        number, instant = decode_clock(load(master.inputs()))
        assert instant <= master.now < instant + PERIOD
        assert instant == 5_000_000_123 + number * PERIOD
        assert number >= previous
        previous = number


def test_polling_at_the_nominal_rate_sees_the_beat_of_two_clocks() -> None:
    master = RawMaster(SensorOptions(signal="clock", ppm=300.0)).go(OP)
    seen = []
    for _ in range(8000):
        master.wait(PERIOD - 1000)
        seen.append(decode_clock(load(master.inputs())).number)
    steps = {b - a for a, b in itertools.pairwise(seen)}
    assert steps == {1, 2}
    assert seen[-1] - seen[0] - 7999 in (2, 3), "300 ppm of 8000"


def test_the_same_sample_is_the_same_bytes() -> None:
    master = RawMaster(SensorOptions(signal="scene")).go(OP)
    first = master.inputs()
    second = master.inputs()
    master.wait(PERIOD)
    assert first == second != master.inputs()


def test_working_ahead_changes_nothing() -> None:
    plain = RawMaster(SensorOptions(noise=False)).go(OP)
    ahead = RawMaster(SensorOptions(noise=False)).go(OP)
    for _ in range(50):
        plain.wait(PERIOD // 2)
        ahead.wait(PERIOD // 2)
        assert plain.inputs() == ahead.inputs()
        ahead.bus.prepare()


def test_formulas() -> None:
    ramp = RawMaster(SensorOptions(signal="ramp")).go(OP)
    sine = RawMaster(SensorOptions(signal="sine")).go(OP)
    amplitudes = (10.0, 20.0, 30.0, 1.0, 2.0, 3.0)
    for _ in range(30):
        for master in (ramp, sine):
            master.wait(37 * PERIOD)
        k = (ramp.now - 5_000_000_123) // PERIOD
        assert load(ramp.inputs()) == tuple(((k + 100 * i) % 1024) / 64 - 8 for i in range(6))
        k = (sine.now - 5_000_000_123) // PERIOD
        expected = [a * math.sin(2 * math.pi * (k / 1000 + i / 6)) for i, a in enumerate(amplitudes)]
        assert load(sine.inputs()) == pytest.approx(expected, abs=1e-4)
    constant = RawMaster(SensorOptions(signal="constant")).go(OP)
    assert load(constant.inputs()) == CONSTANT


def test_process_data_byte_for_byte() -> None:
    master = RawMaster(SensorOptions(signal="constant", pdo_size=77)).go(OP)
    fields = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")
    expected = encode(
        77, {**dict(zip(fields, CONSTANT, strict=True)), "acceleration.z": 1.0, "temperature": 35.0}
    )
    assert master.inputs() == expected


# The scene.

TIMES = [0.0, 0.3, 1.0, 4.9, 5.3, 12.25, 100.0, 5000.5]


def length(vector: tuple[float, ...]) -> float:
    return math.sqrt(sum(v * v for v in vector))


def rotate(q: tuple[float, float, float, float], v: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z, w = q
    a, b, c = v
    t = (2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a))
    u = (y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0])
    return a + w * t[0] + u[0], b + w * t[1] + u[1], c + w * t[2] + u[2]


@pytest.mark.parametrize("seconds", TIMES)
@pytest.mark.parametrize("name", MOTIONS)
def test_force_torque_and_acceleration_agree(name: str, seconds: float) -> None:
    reading = scene.Scene(0, noise=False, motion=MOTIONS[name]()).reading(0, 0, seconds)
    contact = scene.contact_force(seconds) if name == "scene" else (0.0, 0.0, 0.0)
    specific = [a * STANDARD_GRAVITY for a in reading.acceleration]
    weight = tuple(-scene.TOOL_MASS * f for f in specific)
    force, torque = reading.force_torque[:3], reading.force_torque[3:]
    assert force == pytest.approx([w + c for w, c in zip(weight, contact, strict=True)])
    of_weight = scene.cross(scene.TOOL_CENTRE, (weight[0], weight[1], weight[2]))
    of_contact = scene.cross(scene.CONTACT_POINT, contact)
    assert torque == pytest.approx([a + b for a, b in zip(of_weight, of_contact, strict=True)])


def test_at_rest_it_reads_one_g_upward_and_the_tool_pulls_down() -> None:
    reading = scene.Scene(0, noise=False).reading(0, 0, 0.0)
    assert reading.acceleration == pytest.approx((0, 0, 1))
    assert reading.force_torque[2] == pytest.approx(-scene.TOOL_MASS * STANDARD_GRAVITY)


@pytest.mark.parametrize("seconds", TIMES)
def test_orientation_agrees_with_the_accelerometer(seconds: float) -> None:
    reading = scene.Scene(0, noise=False).reading(0, 0, seconds)
    assert length(reading.orientation) == pytest.approx(1)
    world = rotate(reading.orientation, reading.acceleration)
    # What is left of the world's specific force without gravity is the wrist's own, small, acceleration.
    assert length((world[0], world[1], world[2] - 1)) * STANDARD_GRAVITY < 0.3
    gravity = to_sensor(Swaying().attitude(seconds)[0], (0.0, 0.0, 1.0))
    assert rotate(reading.orientation, gravity) == pytest.approx((0, 0, 1), abs=1e-9)


@pytest.mark.parametrize(("motion", "begin"), [(Swaying(), 0.0), (Posing(), 23.0), (Turning(), 7.0)])
def test_the_gyroscope_integrates_to_the_attitude(motion: Motion, begin: float) -> None:
    source = scene.Scene(0, noise=False, motion=motion)
    step = 1e-4
    q = source.reading(0, 0, begin).orientation
    for n in range(20_000):
        rate = source.reading(0, 0, begin + (n + 0.5) * step).angular_rate
        dx, dy, dz = (math.radians(r) * step / 2 for r in rate)
        x, y, z, w = q
        moved = (
            x + w * dx + y * dz - z * dy,
            y + w * dy + z * dx - x * dz,
            z + w * dz + x * dy - y * dx,
            w - x * dx - y * dy - z * dz,
        )
        size = length(moved)
        q = (moved[0] / size, moved[1] / size, moved[2] / size, moved[3] / size)
    wanted = source.reading(0, 0, begin + 20_000 * step).orientation
    sign = math.copysign(1.0, sum(a * b for a, b in zip(q, wanted, strict=True)))
    assert q == pytest.approx([sign * part for part in wanted], abs=1e-5)


def test_poses_are_held_still_with_each_axis_up_and_down() -> None:
    source = scene.Scene(0, noise=False, motion=Posing())
    ups = {f"{sign}{axis}": number for number, axis in enumerate("xyz") for sign in "+-"}
    assert sorted(name for name, _ in POSES) == sorted(ups)
    cycle = POSE_LENGTH + MOVE_LENGTH
    for number, (name, _) in enumerate(POSES * 2):
        for seconds in (0.0, 0.5 * POSE_LENGTH, POSE_LENGTH - 1e-6):
            reading = source.reading(0, 0, number * cycle + seconds)
            wanted = [0.0, 0.0, 0.0]
            wanted[ups[name]] = 1.0 if name[0] == "+" else -1.0
            assert reading.acceleration == pytest.approx(wanted, abs=1e-9)
            assert reading.angular_rate == (0.0, 0.0, 0.0)


def test_moves_between_poses_begin_and_end_at_rest_and_within_the_gyroscopes_range() -> None:
    source = scene.Scene(0, noise=False, motion=Posing())
    cycle = POSE_LENGTH + MOVE_LENGTH
    for number in range(len(POSES)):
        moving = [number * cycle + POSE_LENGTH + k * MOVE_LENGTH / 200 for k in range(200)]
        rates = [length(source.reading(0, 0, seconds).angular_rate) for seconds in moving]
        assert rates[0] == 0.0
        assert rates[-1] < 1.0
        assert 60.0 < max(rates) < 240.0


def test_the_turn_goes_all_the_way_round_slowly() -> None:
    source = scene.Scene(0, noise=False, motion=Turning())
    readings = [source.reading(0, 0, k * TURN_LENGTH / 100) for k in range(101)]
    assert readings[100].acceleration == pytest.approx(readings[0].acceleration)
    for axis in range(3):
        swept = [reading.acceleration[axis] for reading in readings]
        assert max(swept) - min(swept) > 0.9
    assert max(length(reading.angular_rate) for reading in readings) < 9.0


@pytest.mark.parametrize(
    ("sinc", "force", "torque"),
    [(51, (0.6, 0.6, 0.6), (0.014, 0.014, 0.005)), (1024, (0.1, 0.1, 0.08), (0.0015, 0.0015, 0.0007))],
)
def test_noise_is_that_of_a_healthy_sensor(
    sinc: int, force: tuple[float, ...], torque: tuple[float, ...]
) -> None:
    noisy, quiet = scene.Scene(1, noise=True), scene.Scene(1, noise=False)
    noisy.set_sinc_length(sinc)
    errors = []
    for n in range(1500):
        a, b = noisy.reading(n, 0, n * 1e-3), quiet.reading(n, 0, n * 1e-3)
        errors.append(
            [
                x - y
                for x, y in zip(
                    (*a.force_torque, *a.acceleration, *a.angular_rate),
                    (*b.force_torque, *b.acceleration, *b.angular_rate),
                    strict=True,
                )
            ]
        )
    limits = (*force, *torque, *(0.1,) * 6)
    for axis, limit in enumerate(limits):
        deviation = math.sqrt(sum(e[axis] ** 2 for e in errors) / len(errors))
        assert (limit / 5 if axis < 6 else 0) < deviation < limit


def test_a_seed_gives_the_same_noise_again() -> None:
    def some(seed: int) -> bytes:
        return RawMaster(SensorOptions(seed=seed)).go(OP).inputs()

    assert some(4) == some(4) != some(5)


# Settings.


def test_the_offset_is_added() -> None:
    master = RawMaster(SensorOptions(signal="constant")).go(OP)
    for axis, value in enumerate(CONSTANT):
        master.download(0x8000, axis + 1, struct.pack("<f", -value))
    master.wait(PERIOD)
    assert load(master.inputs()) == (0.0,) * 6


def test_ranges_saturate() -> None:
    master = RawMaster(SensorOptions(signal="constant")).go(OP)
    master.download(0x8001, 1, struct.pack("<f", -3.0))
    master.download(0x8002, 3, struct.pack("<f", 300.0))
    master.wait(PERIOD)
    sample = RAW.decode(master.inputs())
    assert sample.acceleration[0] == -2 * STANDARD_GRAVITY
    assert sample.acceleration_saturated == 0b001
    assert sample.angular_rate[2] == pytest.approx(math.radians(250))
    assert sample.angular_rate_saturated == 0b100
    assert sample.warnings == WarningFlag.ACCELERATION_SATURATED | WarningFlag.ANGULAR_RATE_SATURATED


def test_wider_ranges_do_not() -> None:
    master = RawMaster(SensorOptions(signal="constant")).go(PREOP)
    master.download(0x8004, 0, b"\1")
    master.go(OP)
    master.download(0x8001, 1, struct.pack("<f", -3.0))
    master.wait(PERIOD)
    assert RAW.decode(master.inputs()).warnings == 0


def test_imu_off_calibration_off_orientation_on() -> None:
    master = RawMaster(SensorOptions(noise=False, pdo_size=77)).go(OP)
    decoder = SampleDecoder(77)
    calibrated = decoder.decode(master.inputs())
    unknown = calibrated.orientation
    for subindex, value in ((1, 0), (3, 0), (6, 1)):
        master.download(0x8010, subindex, bytes([value]))
    master.wait(PERIOD)
    sample = decoder.decode(master.inputs())
    assert (*sample.acceleration, *sample.angular_rate) == (0.0,) * 6
    assert unknown is None
    assert sample.orientation
    assert sample.force[2] == pytest.approx(calibrated.force[2] * 10_000, rel=1e-2)
    assert sample.force[2].is_integer()


def test_sinc_changes_the_rate() -> None:
    master = RawMaster(SensorOptions(signal="clock")).go(PREOP)
    master.download(0x8006, 1, struct.pack("<H", 128))
    master.go(OP)
    first = decode_clock(load(master.inputs())).number
    master.wait(1_000_000_000)
    assert decode_clock(load(master.inputs())).number - first in (400, 401)
