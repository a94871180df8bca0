"""Faults on command: what each does to the frames, and how bad commands are answered."""

import json
import struct
from statistics import stdev
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.pdo import STANDARD_GRAVITY, Sample, SampleDecoder
from bota_ethercat.sensor.warnings_register import WarningFlag
from ethercat_server.ethercat.wire import Command
from ethercat_server.virtual_sensor.faults import COMMANDS, obey
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.signals import CONSTANT
from scripts.benchmarks.records import decode_clock
from tests.virtual_sensor.raw_master import INIT, OP, PREOP, SAFEOP, Abort, RawMaster, chain, do

PERIOD = 1_250_000
RAW = SampleDecoder(61)
PING = (Command.BRD, 0, 0x0130, bytes(2))


def answering(master: RawMaster) -> int:
    """How many slaves answer a broadcast; 0 if the frame is lost."""
    answer = master.frame(PING)
    return 0 if answer is None else answer[0][1]


def stats(master: RawMaster) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(do(master, "stats"))
    return found


def clock_of(master: RawMaster) -> int:
    return decode_clock(struct.unpack_from("<4f", master.inputs(), 5)).number


def test_lost_frames() -> None:
    master = RawMaster()
    for line, wait, answers in (
        ("lose 3", 0, [0, 0, 0, 1, 1]), ("deaf-after 1", 0, [1, 0]), ("hear", 10**12, [1]),
        ("deaf 0.5", 0, [0]), ("stats", 500_000_000, [1]), ("deaf", 10**12, [0]), ("hear", 0, [1]),
    ):  # fmt: skip
        do(master, line)
        master.wait(wait)
        assert [answering(master) for _ in answers] == answers, line
    assert stats(master)["frames_lost"] == 3 + 1 + 1 + 1


def test_power_off_errors_and_another_sensor_in_a_chain() -> None:
    master = RawMaster(*chain(3, eeprom_ms=0)).go(OP)
    do(master, "power off @1")
    assert answering(master) == 1, "those behind are cut off"
    assert master.read16(0x0110) & 0x0C00 == 0x0400, "port 1 closed"
    do(master, "@1 power on")
    assert answering(master) == 3
    assert master.read16(0x0110) & 0x0C00 == 0x0800
    assert [master.read16(0x0130, n) for n in range(3)] == [OP, INIT, OP]
    assert master.read16(0x0800, 1) == 0, "registers are gone"
    do(master, "safeop 0x1B @2")
    assert (master.read16(0x0130, 2), master.read16(0x0134, 2)) == (SAFEOP | 0x10, 0x1B)
    do(master, "error 0x8001")
    assert (master.read16(0x0130), master.read16(0x0134)) == (OP | 0x10, 0x8001)
    do(master, "swap BFT-MEDS-ECAT-M8 4711 @1")
    assert master.read16(0x0130, 1) == INIT
    master.set_up_mailbox(1)
    master.request(PREOP, 1)
    assert master.upload(0x1008, 0, position=1).rstrip(b"\0") == b"BFT-MEDS-ECAT-M8"
    assert master.upload(0x1018, 4, position=1) == struct.pack("<I", 4711)
    master.write(0x0502, struct.pack("<HI", 0x0100, 0x0E), 1)
    assert master.read(0x0508, 4, 1) == struct.pack("<I", 4711)


def test_power_cycle_ends_by_itself() -> None:
    master = RawMaster(SensorOptions(signal="clock")).go(OP)
    do(master, "power cycle 2")
    for ns in (0, 1_900_000_000):
        master.wait(ns)
        assert answering(master) == 0
    master.wait(200_000_000)
    assert master.read16(0x0130) == INIT
    master.go(OP)
    assert clock_of(master) < 100, "sample numbers start afresh"
    do(master, "power cycle 0.5")
    master.wait(1_401_000_000)
    assert stats(master)["sensors"][0]["sample"] == 720, "0.9 s: power returns at its own instant"


def test_warnings_and_process_data_that_stays() -> None:
    master = RawMaster(SensorOptions(signal="clock")).go(OP)

    def warnings() -> int:
        value: int = struct.unpack_from("<I", master.inputs(), 1)[0]
        master.wait(PERIOD)
        return value

    assert clock_of(master) < 10
    do(master, "warn 0x22 3")
    assert [warnings() for _ in range(6)] == [0, 0x22, 0x22, 0x22, 0, 0]
    do(master, "warn 1")
    master.wait(1000 * PERIOD)
    assert warnings() == 1
    do(master, "warn 0")
    master.wait(PERIOD)
    assert warnings() == 0
    do(master, "stick")
    stuck = master.inputs()
    master.wait(1000 * PERIOD)
    assert master.inputs() == stuck
    do(master, "unstick")
    assert clock_of(master) >= 2000


def samples(master: RawMaster, count: int) -> list[Sample]:
    """The next samples, one each period."""
    found = []
    for _ in range(count):
        master.wait(PERIOD)
        found.append(RAW.decode(master.inputs()))
    return found


def test_noise_on_one_channel_only() -> None:
    master = RawMaster(SensorOptions(signal="constant", last_bit=False)).go(OP)
    do(master, "noise torque.y 0.5")
    found = samples(master, 2000)
    torque = [sample.torque for sample in found]
    assert stdev(t[1] for t in torque) == pytest.approx(0.5, rel=0.1)
    assert {(t[0], t[2]) for t in torque} == {(CONSTANT[3], CONSTANT[5])}
    assert {sample.force for sample in found} == {CONSTANT[:3]}
    do(master, "noise torque.y 0")
    assert {sample.torque for sample in samples(master, 10)} == {CONSTANT[3:]}


def test_a_channel_saturates_before_the_offset_is_added() -> None:
    master = RawMaster(SensorOptions(signal="constant", last_bit=False)).go(OP)
    master.download(0x8000, 3, struct.pack("<f", 100.0))
    for limit in ("force.z 4", "torque.x 4", "acceleration.z 0.5"):
        do(master, f"limit {limit}")
    [sample] = samples(master, 1)
    assert (*sample.force, *sample.torque) == (*CONSTANT[:2], -4 + 100, *CONSTANT[3:])
    assert sample.acceleration[2] == STANDARD_GRAVITY / 2
    saturated = sample.force_torque_saturated, sample.acceleration_saturated, sample.angular_rate_saturated
    assert saturated == (0b000100, 0b100, 0)
    assert sample.warnings == WarningFlag.FORCE_TORQUE_SATURATED | WarningFlag.ACCELERATION_SATURATED
    do(master, "limit force.z off", "limit acceleration.z off")
    [sample] = samples(master, 1)
    assert (sample.force[2], sample.warnings) == (CONSTANT[2] + 100, 0)


def test_a_channel_freezes_and_thaws_and_faults_are_gone_with_the_power() -> None:
    master = RawMaster(SensorOptions(signal="clock")).go(OP)

    def different(axis: int) -> int:
        return len({sample.force[axis] for sample in samples(master, 50)})

    do(master, "freeze force.x")
    frozen = samples(master, 1)[0].force[0]
    do(master, "freeze force.x")
    assert (different(0), different(2), samples(master, 1)[0].force[0]) == (1, 50, frozen)
    do(master, "thaw force.x")
    assert different(0) == 50
    for line in ("noise force.y 1", "limit force.z 0", "freeze force.x", "skip 50", "power off", "power on"):
        do(master, line)
    master.go(OP)
    assert different(0) == 50
    assert all(s.force[1].is_integer() and s.warnings == 0 for s in samples(master, 50))


def test_skipped_samples_never_show() -> None:
    master = RawMaster(SensorOptions(signal="clock")).go(OP)
    master.wait(100 * PERIOD)
    before = clock_of(master)
    do(master, "skip 20")
    assert clock_of(master) == before, "the newest sample stays as it is"
    seen = []
    for _ in range(5000):
        master.wait(PERIOD - 2000)
        seen.append(clock_of(master))
        assert seen[-1] == clock_of(master), "a microsecond later"
    assert sorted(seen) == seen
    assert len(set(seen)) / 5000 == pytest.approx(0.8, abs=0.03)
    do(master, "skip 0")
    master.wait(PERIOD - 2000)
    assert clock_of(master) == before + 5001


def test_abort_once() -> None:
    master = RawMaster().go(PREOP)
    do(master, "abort 0x8010 3 0x08000000", "abort 0x8006 1 0x06040043")
    with pytest.raises(Abort, match="0x8000000"):
        master.upload(0x8010, 3)
    assert master.upload(0x8010, 3) == b"\1"
    for _ in range(2):  # its answer could have been lost on the way
        with pytest.raises(Abort, match="0x6040043"):
            master.download(0x8006, 1, b"\x40\0")
    master.download(0x8006, 1, b"\x80\0")
    master.wait(300_000_000)
    master.download(0x8006, 1, b"\x40\0")


def test_a_command_waits_for_a_write() -> None:
    master = RawMaster(SensorOptions(serial=1), SensorOptions(serial=2)).go(PREOP)
    do(master, "on-write 0x8010 3 error 0x1B")
    master.download(0x8010, 2, b"\1")
    assert [row["al_error"] for row in stats(master)["sensors"]] == [False, False]
    master.download(0x8010, 3, b"\1")
    assert [row["al_error"] for row in stats(master)["sensors"]] == [True, False]
    do(master, "mute-mailbox 1")
    assert master.send_mailbox(3, struct.pack("<HBHBI", 0x2000, 0x40, 0x1000, 0, 0)) == 1
    assert master.fetch_mailbox() is None
    assert len(master.upload(0x1000, 0)) == 4
    for line in ("on-write 0x8010 3", "on-write 0x8010 3 dance", "on-write 0x8010 3 lose"):
        assert obey(master.bus, line).startswith("error: ")


def test_a_save_takes_its_time_and_is_lost_with_the_power() -> None:
    master = RawMaster().go(PREOP)
    for milliseconds, status, kept in ((200, b"\xff", b"\0"), (371, b"\0", b"\1")):
        do(master, "saving 0.37")
        master.download(0x8006, 4, b"\1")
        master.download(0x8030, 1, b"\1")
        master.wait(milliseconds * 1_000_000)
        assert master.upload(0x8030, 2) == status
        do(master, "power off", "power on")
        master.go(PREOP)
        assert master.upload(0x8006, 4) == kept


def test_another_signal_begins_with_the_next_sample_and_outlasts_a_power_cycle() -> None:
    master = RawMaster(SensorOptions(signal="clock")).go(OP)
    master.wait(7 * PERIOD + PERIOD // 2)
    before = master.inputs()
    do(master, "signal poses")
    assert master.inputs() == before, "what was given away does not change"
    master.wait(PERIOD)
    for _ in range(2):
        weight = RAW.decode(master.inputs()).force[2]
        assert weight == pytest.approx(-0.8 * 9.80665, abs=1.5), "the first pose, from its beginning"
        master.wait(3_500 * 1_000_000)
        assert RAW.decode(master.inputs()).angular_rate[0] > 0.1, "moving to the second one"
        do(master, "power cycle 0")
        master.wait(10**6)
        master.go(OP)


@pytest.mark.parametrize(
    "line",
    [
        "", "jump", "lose", "lose x", "lose -1", "lose 1 2", "power", "power maybe", "power cycle", "safeop",
        "safeop 0x10000", "deaf nan", "deaf -1", "ppm inf", "signal noise", "warn 1 0", "swap A", "swap é 1",
        "stick @1", "stick @x", "stick @0 @0", "abort 1 2", "abort 0x8000 256 0",
        "noise force 1", "noise force.w 1", "noise force.x -1", "noise force.x", "limit force.x",
        "limit force.x nan", "freeze", "freeze orientation.x", "thaw temperature",
        "skip 91", "skip -1", "skip nan",
        "dc lat 5", "dc none", "dc late", "dc stuck 5", "dc ppm fast",
    ],
)  # fmt: skip
def test_bad_commands_are_answered_with_a_sentence(line: str) -> None:
    answer = obey(RawMaster().bus, line)
    assert answer.startswith("error: ")
    assert len(answer) > 20
    assert "\n" not in answer


def test_commands_that_cannot_be_executed_now() -> None:
    master = RawMaster(SensorOptions(signal="clock"))
    do(master, "power off")
    for line in ("safeop 1", "stick", "warn 1", "abort 1 1 1", "mute-mailbox 1", "noise force.x 1"):
        assert "power on" in obey(master.bus, line)
    text = do(master, "ppm 5", "stats", "help")
    assert "\n" not in text
    assert all(command.usage in text for command in COMMANDS)
    do(master, "quit")
    assert master.bus.quit


@given(st.text(max_size=60))
def test_any_line_gets_one_line(line: str) -> None:
    if line.split()[:1] != ["quit"]:
        answer = obey(RawMaster().bus, line)
        assert answer.startswith(("ok", "error: "))
        assert "\n" not in answer


def counters(master: RawMaster, position: int = 0) -> dict[str, tuple[int, int]]:
    """What the controller at `position` has counted, at port 0 and at port 1, but zeros."""
    found = master.read(0x0300, 0x14, position)
    assert not any(found[4:8] + found[10:16] + found[18:20]), "no ports 2 and 3, no other errors"
    counted = {
        "invalid": (found[0], found[2]),
        "physical": (found[1], found[3]),
        "forwarded": (found[8], found[9]),
        "lost links": (found[16], found[17]),
    }
    return {name: ports for name, ports in counted.items() if any(ports)}


NOTE = (Command.BWR, 0, 0x0F80, b"!")


def noted(master: RawMaster) -> list[bytes]:
    return [master.read(0x0F80, 1, position) for position in range(3)]


def test_a_damaged_frame_is_lost_and_counted_where_it_was_damaged() -> None:
    master = RawMaster(*chain(3))
    do(master, "damage 2 @1")
    assert [answering(master) for _ in range(4)] == [0, 0, 3, 3]
    assert stats(master)["frames_lost"] == 2
    assert [counters(master, n) for n in range(3)] == [
        {"forwarded": (0, 2)},  # on its way back
        {"invalid": (2, 0), "physical": (2, 0), "forwarded": (0, 2)},
        {"forwarded": (2, 0)},  # the end of the line
    ]
    do(master, "damage 1 @1")
    assert master.frame(NOTE) is None
    assert noted(master) == [b"!", b"\0", b"\0"], "it reached only those before the damage"


def test_a_link_that_flaps_is_counted_at_both_ends() -> None:
    master = RawMaster(*chain(2))

    def lost_links() -> list[tuple[int, int]]:
        return [counters(master, n).get("lost links", (0, 0)) for n in range(2)]

    do(master, "flap")
    assert lost_links() == [(1, 0), (0, 0)]
    do(master, "flap @1")
    assert lost_links() == [(1, 1), (1, 0)]
    do(master, "power off @1")
    assert counters(master)["lost links"] == (1, 2)


def test_error_counters_stop_at_255_and_a_write_clears_their_group() -> None:
    master = RawMaster(*chain(2))
    do(master, "damage 300 @1", "flap @1")
    assert sum(answering(master) == 0 for _ in range(310)) == 300
    assert counters(master, 1)["invalid"] == (255, 0)
    assert master.write(0x0303, b"\x55", 1) == 1
    assert counters(master, 1) == {"lost links": (1, 0)}
    assert master.write(0x0310, b"\0", 1) == 1
    assert counters(master, 1) == {}
    assert counters(master, 0)["forwarded"] == (0, 255)
    assert master.write(0x030E, b"\0\0", 1) == 0, "nothing there"


def test_hear_ends_damage() -> None:
    master = RawMaster(*chain(2))
    do(master, "damage 5", "hear")
    assert answering(master) == 2
    do(master, "power off @1", "damage 1 @1")
    assert answering(master) == 1, "nobody there to find it damaged"
