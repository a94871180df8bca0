"""AL states: transitions, error codes, acknowledge, the watchdog."""

import struct

import pytest

from ethercat_server.ethercat.slave.registers import pack_sync_manager as sync_manager
from tests.virtual_sensor.raw_master import ACK, BOOT, INIT, OP, PREOP, SAFEOP, RawMaster, do

ERROR = 0x10
MS = 1_000_000


def al(master: RawMaster) -> tuple[int, int]:
    """AL status and AL status code."""
    return master.read16(0x0130), master.read16(0x0134)


@pytest.mark.parametrize(
    ("at", "wanted", "code"),
    [
        (INIT, SAFEOP, 0x0011), (INIT, OP, 0x0011), (PREOP, OP, 0x0011), (INIT, 5, 0x0012),
        (PREOP, 0, 0x0012), (OP, 0x0F, 0x0012), (INIT, BOOT, 0x0013), (PREOP, BOOT, 0x0013),
    ],
)  # fmt: skip
def test_refused_requests(at: int, wanted: int, code: int) -> None:
    master = RawMaster()
    if at != INIT:
        master.go(at)
    assert master.request(wanted) == (at | ERROR, code)
    assert master.request(at | ACK) == (at, 0)


def test_an_error_has_to_be_acknowledged_but_on_the_way_down() -> None:
    master = RawMaster().go(OP)
    do(master, "safeop 0x1B")
    assert master.cycle()[1] == 1, "it shows in the working counter"
    for state in (OP, SAFEOP):
        assert master.request(state) == (SAFEOP | ERROR, 0x001B)
    assert master.request(SAFEOP | ACK) == (SAFEOP, 0)
    assert master.cycle()[1] == 3
    assert master.request(OP) == (OP, 0)
    do(master, "safeop 0x8000")
    assert master.request(PREOP) == (PREOP, 0)
    other = RawMaster()
    assert other.request(SAFEOP) == (INIT | ERROR, 0x0011)
    assert other.request(INIT) == (INIT, 0)


def inactive(manager: bytes) -> bytes:
    return manager[:6] + bytes(2)


OUT, IN = sync_manager(0x1000, 128, 0x26), sync_manager(0x1080, 128, 0x22)
OUTPUTS, INPUTS = sync_manager(0x1100, 1, 0x64), sync_manager(0x1180, 61, 0x20)


@pytest.mark.parametrize(
    ("state", "managers", "code"),
    [
        *((PREOP, managers, 0x0016) for managers in (
            bytes(16), OUT, OUT + sync_manager(0x1080, 64, 0x22), sync_manager(0x1000, 128, 0x22) + IN,
            OUT + inactive(IN), sync_manager(0x1200, 128, 0x26) + IN,
        )),
        *((SAFEOP, managers + INPUTS, 0x001D) for managers in (
            sync_manager(0x1100, 2, 0x64), inactive(OUTPUTS), sync_manager(0x1100, 1, 0x20),
        )),
        *((SAFEOP, OUTPUTS + managers, 0x001E) for managers in (
            sync_manager(0x1180, 60, 0x20), sync_manager(0x1180, 77, 0x20), inactive(INPUTS),
        )),
    ],
)  # fmt: skip
def test_a_wrong_configuration_of_sync_managers(state: int, managers: bytes, code: int) -> None:
    master, before = RawMaster(), INIT
    if state == SAFEOP:
        master.go(before := PREOP)
    master.write(0x0800 if state == PREOP else 0x0810, managers)
    assert master.request(state) == (before | ERROR, code)


def test_the_watchdog_bites_when_outputs_stay_away() -> None:
    master = RawMaster().go(OP)
    master.wait(10_000 * MS)
    assert master.read16(0x0130) == OP, "not before the first output"
    master.cycle()
    master.wait(99 * MS)
    master.cycle()
    master.wait(99 * MS)
    assert (master.read16(0x0130), master.read16(0x0440)) == (OP, 1)
    master.wait(2 * MS)
    assert al(master) == (SAFEOP | ERROR, 0x001B)
    assert master.read(0x0442, 1) == b"\1"
    assert master.read16(0x0440) == 0, "expired"
    master.write(0x0442, b"\0")
    assert master.read(0x0442, 1) == b"\0"
    assert master.request(SAFEOP | ACK) == (SAFEOP, 0)
    assert master.read16(0x0440) == 0, "not before the next output"
    master.cycle()
    assert master.read16(0x0440) == 1
    master.request(OP)
    master.cycle()
    for _ in range(120):  # also while other frames come
        master.now += MS
        master.read(0x0130, 2)
        master.bus.prepare()
    assert master.read16(0x0134) == 0x001B


@pytest.mark.parametrize(("register", "value"), [(0x0420, 0), (0x0420, 65535), (0x0814, 0x24)])
def test_the_watchdog_can_be_set_or_left_out(register: int, value: int) -> None:
    master = RawMaster().go(PREOP)
    master.set_up_process_data()
    if register == 0x0814:
        master.write(0x0816, b"\0")
        master.write(0x0810, sync_manager(0x1100, 1, value))
    else:
        master.write(register, struct.pack("<H", value))
    assert master.request(SAFEOP) == (SAFEOP, 0)
    assert master.request(OP) == (OP, 0)
    master.cycle()
    master.wait(1000 * MS)
    assert master.read16(0x0130) == OP
