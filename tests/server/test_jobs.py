"""Work on a sensor in steps, against a scripted sensor that answers wrongly, or with a fault of its own."""

from __future__ import annotations

import contextlib
import itertools
import random
import struct
import time
from collections.abc import Iterator
from typing import Any, cast

import pytest

from bota_ethercat.control import ErrorCode
from bota_ethercat.errors import RequestError
from bota_ethercat.pdo import LAYOUTS
from ethercat_server.acquisition.exchange_timing import ExchangeTiming
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.errors import BusError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.slave.coe import MailboxSdo, Steps, finish
from ethercat_server.sensor.objects.access import write
from ethercat_server.sensor.objects.dictionary import BY_SETTING
from ethercat_server.sensor.sensor import Identity, Sensor, SensorState
from ethercat_server.sensor.set_up import read_offset, read_settings, write_offset
from ethercat_server.sensor.tare import tare

IMU = BY_SETTING["imu_active"].address


class NoBus:
    """Whatever is done on it has no time to be in time for."""

    clock = SYSTEM_CLOCK

    @contextlib.contextmanager
    def in_time(self, _until_ns: int) -> Iterator[None]:
        yield


class ScriptedSdo:
    """A sensor that holds what was written, and else zeros of the right size."""

    clock = SYSTEM_CLOCK

    def __init__(self) -> None:
        self.held: dict[tuple[int, int], bytes] = {}
        self.written: list[tuple[int, int, bytes]] = []

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        yield from ()
        size = 4 if index == 0x8000 else 1
        return self.held.get((index, subindex), bytes(size))

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        yield from ()
        self.written.append((index, subindex, data))
        self.held[index, subindex] = data


def new_sensor() -> Sensor:
    sensor = Sensor(0, Identity("BFT-SENS-ECAT-M8", 1, "", ""), {"sinc_length": 64}, pdo_size=61)
    sensor.enter(SensorState.STREAMING)
    return sensor


def run_job(steps: Steps[Any]) -> tuple[Any, RequestError | None]:
    """What whoever asked for `steps` is told."""
    jobs = Jobs(cast(Bus, NoBus()), [new_sensor()])
    told: list[tuple[Any, RequestError | None]] = []
    jobs.start(0, steps, lambda result, error: told.append((result, error)))
    while jobs.waiting:
        jobs.step(time.monotonic_ns() + 1_000_000_000)
    return told[0]


def test_a_fault_of_the_program_fails_the_request_alone(caplog: pytest.LogCaptureFixture) -> None:
    def steps() -> Steps[None]:
        yield
        raise ZeroDivisionError("an odd request")

    _, error = run_job(steps())
    assert error is not None
    assert error.code == ErrorCode.INTERNAL
    assert "ZeroDivisionError: an odd request" in caplog.text, "the log has where it was"


def test_a_setting_of_another_size_means_nothing(caplog: pytest.LogCaptureFixture) -> None:
    sdo, sensor = ScriptedSdo(), new_sensor()
    sdo.held[IMU] = b"\1\0"
    finish(read_settings(sdo, sensor))
    assert "imu_active" not in sensor.settings
    assert "fir" in sensor.settings
    assert "0x8010:3 holds 0100, which is no BIT8" in caplog.text
    assert finish(write(sdo, sensor, *IMU, b"\2\0"))["hex"] == "0200"
    assert "imu_active" not in sensor.wanted


def test_an_offset_of_another_size_is_told() -> None:
    sdo = ScriptedSdo()
    sdo.held[0x8000, 2] = b"\1\0"
    with pytest.raises(BusError, match="the offset Fy offset is 0100, which is no REAL32"):
        finish(read_offset(sdo))


def test_of_six_offsets_none_is_written_if_one_is_too_large() -> None:
    sdo = ScriptedSdo()
    with pytest.raises(ValueError, match="larger than a REAL32"):
        finish(write_offset(sdo, (0, 0, 3.5e38, 0, 0, 0)))
    assert sdo.written == []


def run_tare(
    sdo: ScriptedSdo, samples: int, target: list[float], force: Iterator[float], rate_dps: float = 0.0
) -> dict[str, Any]:
    """Tare a sensor whose Fx, without offset, is the next of `force` with every step; it turns about z."""
    stream, layout = SensorStream(0, 1_250_000, ExchangeTiming()), LAYOUTS[61]
    steps = tare(sdo, new_sensor(), stream, samples, target)
    while True:
        values = list(layout.struct.unpack(bytes(layout.size)))
        values[2] = next(force) + struct.unpack("<f", sdo.held.get((0x8000, 1), bytes(4)))[0]
        values[15] = rate_dps
        stream.process_data = layout.struct.pack(*values)
        stream.sequence += 1
        try:
            next(steps)
        except StopIteration as stop:
            found: dict[str, Any] = stop.value
            return found


def test_a_tare_whose_sum_is_too_large_is_refused_before_it_writes() -> None:
    sdo = ScriptedSdo()
    with pytest.raises(RequestError, match="larger than a REAL32") as refused:
        run_tare(sdo, 20, [3e38, 0, 0, 0, 0, 0], itertools.repeat(-3e38))
    assert refused.value.code == ErrorCode.BAD_REQUEST
    assert sdo.written == []


@pytest.mark.parametrize("size", [0, 113])
def test_what_does_not_fit_the_mailbox_is_not_sent(size: int) -> None:
    sdo = MailboxSdo(cast(Bus, NoBus()), 0, ((0x1000, 128), (0x1080, 128)))
    with pytest.raises(BusError, match=f"1 to 112 bytes fit its mailbox, not {size}"):
        finish(sdo.write(0x1008, 0, bytes(size)))


def noise(seed: int, deviation: float) -> Iterator[float]:
    gauss = random.Random(seed).gauss
    while True:
        yield gauss(0.0, deviation)


def test_fewer_samples_than_show_rest_are_not_taken() -> None:
    force = iter(range(1000))
    with pytest.raises(RequestError, match="Fx varies by"):
        run_tare(ScriptedSdo(), 1, [0.0] * 6, (float(n) for n in force))
    assert next(force) >= 20


def test_a_load_that_creeps_is_not_rest_and_noise_is() -> None:
    with pytest.raises(RequestError, match=r"Fx changes by 1\.2 N"):
        run_tare(ScriptedSdo(), 400, [0.0] * 6, (n * 0.006 for n in itertools.count()))
    with pytest.raises(RequestError, match="Fx changes by"):
        run_tare(ScriptedSdo(), 400, [0.0] * 6, (n * 0.007 + x for n, x in enumerate(noise(1, 0.3))))
    for seed in range(100):
        tared = run_tare(ScriptedSdo(), 20, [0.0] * 6, noise(seed, 0.6))
        assert abs(tared["residual"][0]) < 1


def test_a_sensor_that_turns_fast_is_not_at_rest_however_steadily() -> None:
    with pytest.raises(RequestError, match="it turns by 30 deg/s"):
        run_tare(ScriptedSdo(), 100, [0.0] * 6, itertools.repeat(1.0), rate_dps=30.0)
    tared = run_tare(ScriptedSdo(), 100, [0.0] * 6, itertools.repeat(1.0), rate_dps=20.0)
    assert tared["residual"] == [0.0] * 6
