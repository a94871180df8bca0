"""The object dictionary, SDO transfers, and work on a sensor in steps: a tare, its settings."""

from __future__ import annotations

import contextlib
import itertools
import logging
import random
import struct
from collections.abc import Iterator
from typing import Any, cast

import pytest

from bota_ethercat.control import ErrorCode
from bota_ethercat.errors import RequestError
from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.settings import SETTINGS
from ethercat_server.acquisition.acyclic import Acyclic
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.errors import BusError, SdoAbortError, SetUpError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.datagrams import Steps, T, finish
from ethercat_server.ethercat.slave.al import AlStatus
from ethercat_server.ethercat.slave.coe import Emergencies, Emergency, MailboxSdo, _answer
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sensor.objects.access import write
from ethercat_server.sensor.objects.dictionary import (
    BY_ADDRESS,
    BY_SETTING,
    FACTORY_CALIBRATION,
    KNOWN_OBJECTS,
    OBJECTS,
    Access,
    ObjectType,
    find_objects,
    full_name,
    similar_names,
)
from ethercat_server.sensor.sensor import Identity, Sensor, SensorState
from ethercat_server.sensor.set_up import read_offset, read_settings, write_offset
from ethercat_server.sensor.tare import tare
from tests.simulation import ManualClock

# Names of objects in Bota's manual, and in the script that read them all.
IN_THE_MANUAL = (
    (0x2000, 0, "Calibration"), (0x6000, 0, "Sensor Data"), (0x7000, 0, "Digital Output"),
    (0x8000, 0, "Force/Torque Offset"), (0x8001, 0, "Acceleration Offset"),
    (0x8002, 0, "Angular Velocities Offset"), (0x8003, 0, "Force/Torque Range"),
    (0x8004, 0, "Acceleration Range"), (0x8005, 0, "Angular Velocities Range"),
    (0x8006, 0, "Force/Torque Filter"), (0x8006, 1, "SINC Length"), (0x8006, 2, "FIR disable"),
    (0x8006, 3, "FAST enable"), (0x8006, 4, "CHOP enable"), (0x8007, 0, "Acceleration Filter"),
    (0x8008, 0, "Angular Velocities Filter"), (0x8010, 0, "Device configuration"),
    (0x8010, 1, "Calibration Matrix Active"), (0x8010, 1, "Force/Torque Calibration Matrix Active"),
    (0x8010, 2, "Temperature Compensation Active"), (0x8010, 2, "Temperature Compensation"),
    (0x8010, 3, "IMU Active"), (0x8010, 4, "Coordinate System Cong. Active"),
    (0x8010, 5, "Inertia and Gravity Comp. Active"), (0x8010, 6, "Orientation Estimation Active"),
    (0x8011, 0, "Sampling Rate"), (0x8030, 0, "Control"), (0x8030, 1, "Command"), (0x8030, 2, "Status"),
)  # fmt: skip


def test_values_and_defaults_are_the_notes() -> None:
    assert BY_ADDRESS[0x8004, 0].allowed == {0: "±2 g", 1: "±4 g", 2: "±8 g", 3: "±16 g"}
    assert BY_ADDRESS[0x8005, 0].allowed == {0: "±250 °/s", 1: "±500 °/s", 2: "±1000 °/s", 3: "±2000 °/s"}
    assert BY_ADDRESS[0x8006, 2].allowed == {0: "FIR on: lower cut-off, more delay", 1: "FIR off"}
    assert BY_ADDRESS[0x8006, 1].allowed == range(32, 2049)
    assert BY_ADDRESS[0x8030, 1].allowed == {1: "save the parameters"}
    assert BY_ADDRESS[0x8000, 1].allowed is None
    defaults = {(0x8006, 1): 0x40, (0x8006, 2): 1, (0x8006, 3): 0, (0x8006, 4): 0, (0x8011, 0): 0x320}
    assert {address: BY_ADDRESS[address].default for address in defaults} == defaults


def test_what_may_be_written_in_which_state() -> None:
    assert BY_ADDRESS[0x8006, 1].access.write_states == ("PREOP",)
    assert BY_ADDRESS[0x8000, 1].access.write_states == ("PREOP", "SAFEOP", "OP")
    assert BY_ADDRESS[0x8011, 0].access.write_states == ()
    for name, row in BY_SETTING.items():
        assert SETTINGS[name].preop_only == (row.access is Access.RW_PREOP), name


def test_no_setting_is_held_by_the_factory_calibration() -> None:
    assert not [row for row in OBJECTS if row.index == FACTORY_CALIBRATION and row.setting]


def test_objects_have_every_name_that_people_know_them_by() -> None:
    for index, subindex, name in IN_THE_MANUAL:
        found = [row.address for row in find_objects(name)]
        assert (index, subindex) in found, name
        assert find_objects(name.upper().replace(" ", "_")) == find_objects(name)
    for name, row in BY_SETTING.items():
        assert find_objects(name) == [row]
    assert [row.subindex for row in find_objects("Force/Torque Offset")] == list(range(7))
    assert [row.address for row in find_objects("Status")] == [(0x6000, 1), (0x8030, 2)], "two are called so"
    for row in KNOWN_OBJECTS:
        assert find_objects(full_name(row)) == [row]
        assert find_objects(f"0x{row.index:04X}:{row.subindex}") == [row]


def test_what_no_object_is_called() -> None:
    assert find_objects("colour") == find_objects("") == find_objects("0x8006:256") == []
    assert similar_names("sampling rte") == ["Sampling rate"]
    (unknown,) = find_objects("0x1C12:1")
    assert (unknown.address, unknown.type) == ((0x1C12, 1), ObjectType.OCTETS)


# -- SDO transfers by single datagrams, with a mailbox whose answers are given; AL status codes in words

MAILBOXES = ((0x1000, 128), (0x1080, 128))
READ, WRITTEN, ABORTED = 0x43, 0x60, 0x80
PROBED = 0x1000  # the device type, which is read to find out which counter the slave takes


class GivenBus:
    """A sensor that puts these answers into its mailbox once it is asked: command, index, data."""

    clock = SYSTEM_CLOCK

    def __init__(self, *answers: tuple[int, int, bytes]) -> None:
        self.answers = list(answers)
        self.asked, self.requests = 0, list[bytes]()

    def read_register(self, slave: int, address: int, size: int) -> Steps[bytes]:
        yield from ()
        if not (self.asked and self.answers):
            return b""
        command, index, data = self.answers.pop(0)
        service = 2 if command == ABORTED else 3
        body = struct.pack("<HBHB", service << 12, command, index, index != PROBED) + data
        return (struct.pack("<HHBB", len(body), 0, 0, 3) + body).ljust(size, b"\0")

    def write_register(self, slave: int, address: int, data: bytes) -> Steps[bool]:
        yield from ()
        if data[9:11] == PROBED.to_bytes(2, "little"):
            self.answers.insert(0, (READ, PROBED, bytes(4)))
        self.asked += 1
        self.requests.append(data)
        return True


def run(bus: GivenBus, steps: Steps[T]) -> T:
    done = finish(steps)
    assert bus.asked == 2, "once, after the probe"
    assert not bus.answers
    return done


def mailbox(bus: GivenBus) -> MailboxSdo:
    return MailboxSdo(cast(Bus, bus), 0, MAILBOXES)


def test_the_late_answer_to_a_repeated_transfer_is_left_alone() -> None:
    """Of a write when the next one reads, and the other way round."""
    bus = GivenBus((WRITTEN, 0x8001, bytes(4)), (READ, 0x8001, b"abcd"))
    assert run(bus, mailbox(bus).read(0x8001, 1)) == b"abcd"
    bus = GivenBus((READ, 0x8001, b"abcd"), (WRITTEN, 0x8001, bytes(4)))
    run(bus, mailbox(bus).write(0x8001, 1, b"efgh"))


@pytest.mark.parametrize(
    ("command", "answer", "value"),
    [
        (0x43, b"abcd", b"abcd"),
        (0x47, b"abcd", b"abc"),
        (0x4B, b"abcd", b"ab"),
        (0x4F, b"abcd", b"a"),
        (0x42, b"abcd", b"abcd"),
        (0x41, b"\6\0\0\0abcdef", b"abcdef"),
        (0x41, b"\3\0\0\0abcdef", b"abc"),
        (0x41, b"\7\0\0\0abcdef", None),
    ],
)
def test_what_is_read_is_as_long_as_the_answer_says(command: int, answer: bytes, value: bytes | None) -> None:
    bus = GivenBus((command, 0x8001, answer))
    if value is not None:
        assert run(bus, mailbox(bus).read(0x8001, 1)) == value
        return
    with pytest.raises(BusError) as error:
        run(bus, mailbox(bus).read(0x8001, 1))
    assert str(error.value) == (
        "sensor 0 did not answer reading object 0x8001:1: its 7 bytes do not fit the mailbox"
    )


@pytest.mark.parametrize(
    ("size", "command"), [(1, 0x2F), (2, 0x2B), (3, 0x27), (4, 0x23), (5, 0x21), (112, 0x21)]
)
def test_what_is_written_says_how_long_it_is(size: int, command: int) -> None:
    bus, data = GivenBus((WRITTEN, 0x8001, bytes(4))), bytes(range(1, size + 1))
    run(bus, mailbox(bus).write(0x8001, 1, data))
    told = data.ljust(4, b"\0") if size <= 4 else struct.pack("<I", size) + data
    body = struct.pack("<HBHB", 0x2000, command, 0x8001, 1) + told
    assert bus.requests[1] == (struct.pack("<HHBB", len(body), 0, 0, 0x33) + body).ljust(128, b"\0")


class SilentBus(GivenBus):
    """One that loses what is sent at first, and answers nothing; when it was sent, and with which counter."""

    def __init__(self) -> None:
        super().__init__()
        self.clock = ManualClock()
        self.sent = list[tuple[int, int]]()

    def write_register(self, slave: int, address: int, data: bytes) -> Steps[bool]:
        yield from ()
        self.sent.append((self.clock.monotonic_ns(), data[5] >> 4))
        return len(self.sent) > 2


def test_without_an_answer_it_asks_less_and_less_often_and_gives_up() -> None:
    bus = SilentBus()
    with pytest.raises(SetUpError) as error:
        finish(mailbox(bus).read(0x8001, 1), bus.clock)
    assert str(error.value) == "sensor 0 did not answer reading object 0x8001:1: no answer"
    pauses = [(after - before) * 1e-6 for (before, _), (after, _) in itertools.pairwise(bus.sent)]
    assert pauses == pytest.approx([0, 0, 80, 160, 320, 640, 700], abs=3)
    assert 2.1 < (bus.clock.monotonic_ns() - bus.sent[0][0]) * 1e-9 < 2.81
    assert [counter for _, counter in bus.sent] == [2, 2, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize(("later_s", "asked"), [(0.0, 3), (0.09, 3), (0.11, 4)])
def test_the_mailbox_is_in_step_for_a_while(later_s: float, asked: int) -> None:
    bus = GivenBus((READ, 0x8001, b"abcd"))
    bus.clock, sdo = ManualClock(), mailbox(bus)
    sdo.clock = bus.clock
    assert finish(sdo.read(0x8001, 1), bus.clock) == b"abcd"
    bus.clock.sleep(later_s)
    bus.answers.append((READ, 0x8001, b"efgh"))
    assert finish(sdo.read(0x8001, 1), bus.clock) == b"efgh"
    assert bus.asked == asked


class CountingSlave:
    """Does one request after the other, in so many seconds, and drops one with the counter of the last.

    An object's value is the number of requests that were done.
    """

    def __init__(self, reading_s: float, writing_s: float) -> None:
        self.clock = ManualClock()
        self.takes_s = {0x40: reading_s, 0x23: writing_s}
        self.counter = self.done = self._ready_ns = 0
        self.counters, self.written = list[int](), list[bytes]()
        self._request = self._answer = b""
        self._answers: list[bytes] = []

    def _work(self) -> None:
        if self._answer and self.clock.now_ns >= self._ready_ns:
            self._answers.append(self._answer)
            self._answer = b""
        if not self._request or self._answer:
            return
        request, self._request = self._request, b""
        if (counter := request[5] >> 4) == self.counter:
            return
        self.counter, self.done = counter, self.done + 1
        command, index, subindex = struct.unpack_from("<BHB", request, 8)
        if command == 0x23:
            self.written.append(request[12:16])
        answer, value = (READ, self.done) if command == 0x40 else (WRITTEN, 0)
        self._answer = struct.pack("<HHBBHBHBI", 10, 0, 0, 3, 0x3000, answer, index, subindex, value)
        self._ready_ns = self.clock.now_ns + round(self.takes_s[command] * 1e9)

    def read_register(self, _slave: int, _address: int, size: int) -> Steps[bytes]:
        yield from ()
        self._work()
        return self._answers.pop(0).ljust(size, b"\0") if self._answers else b""

    def write_register(self, _slave: int, _address: int, data: bytes) -> Steps[bool]:
        yield from ()
        self._work()
        if self._request:
            return False
        self._request = data
        self.counters.append(data[5] >> 4)
        return True


@pytest.mark.parametrize("seconds", [(0, 0), (0.03, 0.03), (0.4, 0.4), (0, 0.9)])
@pytest.mark.parametrize("before", range(1, 8))
def test_each_request_is_done_once_whatever_counter_another_master_left(
    before: int, seconds: tuple[float, float]
) -> None:
    """By a slow slave, too, which looks as if it dropped them; no read gets the answer to an earlier one."""
    slave = CountingSlave(*seconds)
    sdo = MailboxSdo(cast(Bus, slave), 0, MAILBOXES)
    for count in range(1, 4):
        slave.counter, began_ns = before, slave.clock.now_ns
        finish(sdo.write(0x8001, 1, b"efgh"), slave.clock)
        for _ in range(3):
            done = slave.done
            assert int.from_bytes(finish(sdo.read(0x8001, 1), slave.clock), "little") > done
        assert slave.written == [b"efgh"] * count
        assert any(seconds) or slave.clock.now_ns - began_ns < 100_000_000
        slave.clock.sleep(1)
        finish(sdo.drain(10), slave.clock)  # what another master does
    assert set(slave.counters) == set(range(2, 8)), "SOEM's mapping begins with 1, where the bus comes up"


def test_the_answer_to_a_read_that_was_given_up_is_not_that_to_the_next() -> None:
    slave = CountingSlave(0.0, 0.0)
    sdo = MailboxSdo(cast(Bus, slave), 0, MAILBOXES)
    for reading_s in (0.0, 3.0):
        slave.takes_s[0x40] = reading_s
        with pytest.raises(SetUpError) if reading_s else contextlib.nullcontext():
            finish(sdo.read(0x8001, 1), slave.clock)
    slave.takes_s[0x40], done = 0.0, slave.done
    assert int.from_bytes(finish(sdo.read(0x8001, 1), slave.clock), "little") > done


def test_one_transfer_waits_for_the_other() -> None:
    slave, read = CountingSlave(0.01, 0.01), list[int]()
    sdo = MailboxSdo(cast(Bus, slave), 0, MAILBOXES)
    under_way = [sdo.read(0x8001, 1), sdo.read(0x8002, 1), sdo.read(0x8003, 1)]
    while under_way:
        for steps in [*under_way]:
            try:
                next(steps)
            except StopIteration as ended:
                read.append(int.from_bytes(ended.value, "little"))
                under_way.remove(steps)
        slave.clock.sleep(0.001)
    assert (read, len(slave.counters)) == ([2, 3, 4], 4), "after one probe"


def test_a_lost_datagram_does_not_have_a_write_done_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a slow slave, whose answer is still to come."""
    slave, lost = CountingSlave(0.0, 0.03), [True]
    sdo, read_register = MailboxSdo(cast(Bus, slave), 0, MAILBOXES), slave.read_register

    def losing(*where: int) -> Steps[bytes | None]:
        answer = yield from read_register(*where)
        return None if slave.written and lost and lost.pop() else answer

    monkeypatch.setattr(slave, "read_register", losing)
    finish(sdo.read(0x8001, 1), slave.clock)
    finish(sdo.write(0x8001, 1, b"efgh"), slave.clock)
    assert (slave.written, lost) == ([b"efgh"], [])


@pytest.mark.parametrize(
    ("service", "command", "of", "size", "is_answer"),
    [
        (3, 0x43, (0x8001, 1), 10, True),
        (3, 0x43, (0x8001, 1), 9, False),
        (3, 0x41, (0x8001, 1), 14, True),
        (3, 0x60, (0x8001, 1), 10, False),
        (3, 0x43, (0x8001, 2), 10, False),
        (3, 0x43, (0x8002, 1), 10, False),
        (2, 0x43, (0x8001, 1), 10, False),
        (2, 0x80, (0x8001, 1), 10, True),
        (3, 0x80, (0x8001, 1), 10, True),
        (1, 0x43, (0x8001, 1), 10, False),
        (1, 0x80, (0x8001, 1), 10, False),
    ],
)
def test_which_message_is_the_answer(
    service: int, command: int, of: tuple[int, int], size: int, is_answer: bool
) -> None:
    data = bytes(range(1, 9))
    body = (struct.pack("<HBHB", service << 12 | 5, command, *of) + data)[:size]
    assert _answer(body, 0x8001, 1, 0x40) == ((command, data[: size - 6]) if is_answer else None)


def test_an_answer_about_another_object_is_left_alone_and_a_refusal_is_not() -> None:
    bus = GivenBus((READ, 0x8000, b"abcd"), (ABORTED, 0x8001, struct.pack("<I", 0x06090030)))
    with pytest.raises(SdoAbortError, match="refused reading object 0x8001:1: the value is out of range "):
        finish(mailbox(bus).read(0x8001, 1))


@pytest.mark.parametrize(("code", "words"), [(0x06020000, "does not exist"), (0x12345678, "does not define")])
def test_a_refusal_says_why_in_words_and_as_a_number(code: int, words: str) -> None:
    bus = GivenBus((ABORTED, 0x8001, struct.pack("<II", code, 7)))
    with pytest.raises(SdoAbortError, match=rf"sensor 0 refused writing .*{words} \(abort 0x{code:08X}\)"):
        finish(mailbox(bus).write(0x8001, 1, b"efgh"))


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x001B, "sync manager watchdog"),
        (0x0035, "distributed clock: invalid sync cycle time"),
        (0x8001, "the vendor's own code"),
        (0x0FFF, "reserved"),
    ],
)
def test_an_al_error_is_said_in_words(code: int, words: str) -> None:
    assert str(AlStatus.of(0x14, code)).startswith(f"SAFEOP with AL status 0x{code:04X} ({words}")


# -- work in steps, against a scripted sensor that answers wrongly, or with a fault of its own

IMU = BY_SETTING["imu_active"].address


class NoBus:
    """Each look at the exchanges finds one more."""

    clock = SYSTEM_CLOCK

    def __init__(self) -> None:
        self.process_data, self._answered = self, itertools.count()

    @property
    def answered(self) -> int:
        return next(self._answered)


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


def test_a_fault_of_the_program_fails_the_request_alone(caplog: pytest.LogCaptureFixture) -> None:
    def steps() -> Steps[None]:
        yield None
        raise ZeroDivisionError("an odd request")

    acyclic, told = Acyclic(cast(Bus, NoBus())), list[RequestError | None]()
    jobs = Jobs(acyclic, [new_sensor()])
    jobs.start(0, steps(), lambda _, error: told.append(error))
    while jobs.waiting:
        acyclic.run(0, 0)
    (error,) = told
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
    sensor, layout = new_sensor(), LAYOUTS[61]
    stream = SensorStream(sensor, RoundTrip())
    steps = tare(sdo, sensor, stream, samples, target)
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
    sdo = MailboxSdo(cast(Bus, NoBus()), 0, MAILBOXES)
    with pytest.raises(BusError, match=f"1 to 112 bytes fit its mailbox, not {size}"):
        finish(sdo.write(0x1008, 0, bytes(size)))


def noise(seed: int, deviation: float) -> Iterator[float]:
    gauss = random.Random(seed).gauss
    while True:
        yield gauss(0.0, deviation)


def test_fewer_samples_than_show_rest_are_not_taken() -> None:
    sdo, force = ScriptedSdo(), iter(range(1000))
    with pytest.raises(RequestError, match="sensor 0 is not at rest: Fx varies by") as refused:
        run_tare(sdo, 1, [0.0] * 6, (float(n) for n in force))
    assert (refused.value.code, sdo.written) == (ErrorCode.NOT_READY, [])
    assert next(force) >= 20


def test_a_load_that_creeps_is_not_rest_and_noise_is() -> None:
    with pytest.raises(RequestError, match=r"Fx changes by 1\.2 N"):
        run_tare(ScriptedSdo(), 400, [0.0] * 6, (n * 0.006 for n in itertools.count()))
    with pytest.raises(RequestError, match="Fx changes by"):
        run_tare(ScriptedSdo(), 400, [0.0] * 6, (n * 0.006 + x for n, x in enumerate(noise(1, 0.3))))
    for seed in range(100):
        tared = run_tare(ScriptedSdo(), 20, [0.0] * 6, noise(seed, 0.6))
        assert abs(tared["residual"][0]) < 1


def test_a_load_that_moves_by_more_than_the_limit_during_a_tare_is_noticed() -> None:
    """By 0.3 N, between the samples before the offset and those after it; the offset is taken back."""
    for change, refused in ((0.28, False), (0.32, True), (-0.28, False), (-0.32, True)):
        sdo = ScriptedSdo()
        force = itertools.chain(itertools.repeat(5.0, 22), itertools.repeat(5.0 + change))
        if not refused:
            assert run_tare(sdo, 20, [0.0] * 6, force)["residual"][0] == pytest.approx(change)
            continue
        with pytest.raises(RequestError, match="Fx"):
            run_tare(sdo, 20, [0.0] * 6, force)
        assert sdo.held[0x8000, 1] == bytes(4)


def test_a_sensor_that_turns_fast_is_not_at_rest_however_steadily() -> None:
    with pytest.raises(RequestError, match="it turns by 30 deg/s"):
        run_tare(ScriptedSdo(), 100, [0.0] * 6, itertools.repeat(1.0), rate_dps=30.0)
    tared = run_tare(ScriptedSdo(), 100, [0.0] * 6, itertools.repeat(1.0), rate_dps=20.0)
    assert tared["residual"] == [0.0] * 6


class FullBus(GivenBus):
    """A mailbox with these messages in it: protocol, CoE service, body."""

    def __init__(self, *messages: tuple[int, int, bytes]) -> None:
        super().__init__()
        self.clock, self.reads = ManualClock(), 0
        self.messages = [*messages]

    def read_register(self, slave: int, address: int, size: int) -> Steps[bytes]:
        yield from ()
        self.reads += 1
        if not self.messages:
            return b""
        protocol, service, body = self.messages.pop(0)
        coe = struct.pack("<H", service << 12) + body
        return (struct.pack("<HHBB", len(coe), 0, 0, protocol) + coe).ljust(size, b"\0")


def test_what_else_is_in_a_mailbox_is_left_alone_and_emergencies_are_noted() -> None:
    emergency, answer = (
        struct.pack("<HB", 0x4210, 1) + b"abcde",
        struct.pack("<BHB", READ, PROBED, 0) + b"efgh",
    )
    bus = FullBus((2, 3, answer), (3, 1, emergency), (4, 1, emergency), (3, 3, answer))
    known = Emergencies(bus.clock)
    sdo = MailboxSdo(cast(Bus, bus), 7, MAILBOXES, known)
    assert finish(sdo.read(PROBED, 0), bus.clock) == b"efgh"
    assert (known.status(7)["emergencies"], known.status(7)["emergency"]["data"]) == (1, b"abcde".hex())
    bus.messages = [(3, 1, emergency)] * 3
    finish(sdo.poll_mailbox(), bus.clock)
    assert (known.status(7)["emergencies"], len(bus.messages)) == (2, 2)
    sdo._in_use = True
    finish(sdo.poll_mailbox(), bus.clock)
    assert len(bus.messages) == 2, "the transfer reads them itself"
    for most, reads in ((1, 1), (5, 2)):
        bus.reads = 0
        finish(sdo.drain(most), bus.clock)
        assert bus.reads == reads
    assert known.status(7)["emergencies"] == 4


# -- emergencies


def test_emergencies_are_told_at_a_bounded_rate_and_all_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    """Five at once and one a second; the same one again after ten seconds; each sensor for itself."""
    caplog.set_level(logging.INFO)
    clock, told = ManualClock(), list[tuple[int, int, int]]()
    known = Emergencies(clock)
    known.note(0, Emergency(0x4210, 0, b""))
    assert known.status(1) == {"emergencies": 0, "emergency": None}
    known.tell = lambda number, emergency, count: told.append((number, emergency.code, count))

    def note(*codes: int, number: int = 1) -> list[tuple[int, int, int]]:
        told.clear()
        for code in codes:
            known.note(number, Emergency(code, 0x81, b"\1\2"))
        return told

    assert note(0x4210, 0x4210, 0x12, 0x4210) == [(1, 0x4210, 1), (1, 0x12, 3), (1, 0x4210, 4)]
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING", "INFO", "WARNING"]
    assert caplog.messages[-1] == (
        "sensor 1 reports emergency 0x4210 (temperature), error register 0x81, data 0102"
    )
    assert [code for _, code, _ in note(*range(0x5001, 0x5007))] == [0x5001, 0x5002]
    assert note(0x4210, number=2) == [(2, 0x4210, 1)]
    clock.sleep(0.999)
    assert note(0x5010) == []
    clock.sleep(0.001)
    assert note(0x5011, 0x5012) == [(1, 0x5011, 12)]
    clock.sleep(9.999)
    assert note(0x5011) == []
    clock.sleep(0.001)
    assert note(0x5011) == [(1, 0x5011, 15)]
    clock.sleep(100.0)
    assert len(note(*range(0x6000, 0x6009))) == 5
    texts = {
        0x00FF: "error reset, or no error", 0x5123: "hardware of the device", 0x8FFF: "monitoring",
        0x81FF: "communication", 0xFF07: "device-specific", 0xB001: "of no class that CiA 301 defines",
    }  # fmt: skip
    assert {code: Emergency(code, 0, b"").text for code in texts} == texts
    assert [code for code in texts if Emergency(code, 0, b"").is_reset] == [0x00FF]
    clock.sleep(1.2344)
    last = {"code": 0x6008, "text": "software of the device", "register": 0x81, "data": "0102"}
    assert known.status(1) == {"emergencies": 24, "emergency": {**last, "ago_s": 1.234}}
    assert note(0x6008) == [(1, 0x6008, 25)]
    clock.sleep(0.5)
    assert note(0x6008) == []
    assert known.status(1) == {"emergencies": 26, "emergency": {**last, "ago_s": 0.0}}
