"""The mailbox: handshake, duplicates, lost replies, protocols that are not there."""

import struct

from ethercat_server.ethercat.wire import Command
from ethercat_server.virtual_sensor.faults import obey
from ethercat_server.virtual_sensor.options import parse_chain, slaves_in
from tests.virtual_sensor.raw_master import INIT, MAILBOX, PREOP, RawMaster, do

READ_NAME = struct.pack("<HBHBI", 0x2000, 0x40, 0x1008, 0, 0)
READ_TYPE = struct.pack("<HBHBI", 0x2000, 0x40, 0x1000, 0, 0)


def test_a_mailbox_is_full_until_it_is_read_as_a_whole() -> None:
    master = RawMaster().go(PREOP)
    assert master.one(Command.APRD, 0, 0x1080, b"\xaa" * MAILBOX) == (b"\xaa" * MAILBOX, 0), "it is empty"
    assert master.send_mailbox(3, READ_NAME) == 1
    for start, size, counter, full in ((0x1080, 16, 0, True), (0x1080, MAILBOX, 1, False)):
        assert master.mailbox_full()
        assert master.one(Command.APRD, 0, start, bytes(size))[1] == counter
        assert master.mailbox_full() == full


def test_the_same_counter_again_is_a_duplicate() -> None:
    master = RawMaster().go(PREOP)
    assert master.send_mailbox(3, READ_NAME, counter=3) == 1
    assert master.fetch_mailbox() is not None
    assert master.send_mailbox(3, READ_NAME, counter=3) == 1
    assert master.fetch_mailbox() is None
    for _ in range(2):
        assert master.send_mailbox(3, READ_NAME, counter=0) == 1, "0 is not counted"
        assert master.fetch_mailbox() is not None
    master.send_mailbox(3, READ_NAME, counter=3)
    master.request(INIT)
    assert master.send_mailbox(3, READ_NAME) == 0, "no mailbox in INIT"
    assert master.request(PREOP) == (PREOP, 0)
    assert not master.mailbox_full()
    master.send_mailbox(3, READ_NAME, counter=3)
    assert master.mailbox_full(), "counting starts afresh"


def test_a_lost_reply_can_be_had_again() -> None:
    master = RawMaster().go(PREOP)
    master.send_mailbox(3, READ_NAME)
    first = master.fetch_mailbox()
    for toggle in (2, 0):
        master.write(0x080E, bytes([1 | toggle]))
        assert master.read(0x080F, 1)[0] & 2 == toggle
        assert master.fetch_mailbox() == first
    assert master.fetch_mailbox() is None


def test_requests_that_get_a_mailbox_error() -> None:
    master = RawMaster().go(PREOP)
    for kind in (1, 2, 4, 5, 15):
        master.send_mailbox(kind, b"hello")
        assert master.fetch_mailbox() == (0, struct.pack("<HH", 1, 2)), "an unknown protocol"
    master.write(0x1000, struct.pack("<HHBB", 2000, 0, 0, 0x13).ljust(MAILBOX, b"\0"))
    assert master.fetch_mailbox() == (0, struct.pack("<HH", 1, 8)), "a length that lies"
    for short in (b"\0", READ_NAME[:6]):
        master.send_mailbox(3, short, counter=0)
        assert master.fetch_mailbox() == (0, struct.pack("<HH", 1, 6))


def emergency_of(message: tuple[int, bytes] | None) -> tuple[int, int, bytes]:
    assert message is not None
    kind, body = message
    assert kind == 3
    service, code, register = struct.unpack_from("<HHB", body)
    assert service == 1 << 12
    return code, register, body[5:]


def test_an_emergency_comes_before_an_answer_that_is_not_read_yet() -> None:
    master = RawMaster().go(PREOP)
    master.send_mailbox(3, READ_TYPE)
    do(master, "emergency 0x1000")
    messages = [master.one(Command.APRD, 0, 0x1080, bytes(MAILBOX))[0] for _ in range(2)]
    assert [message[5] >> 4 for message in messages] == [1, 2], "numbered as they go out"
    assert [message[7] >> 4 for message in messages] == [1, 3], "emergency, SDO response"
    assert master.fetch_mailbox() is None


def test_emergencies_that_cannot_be_sent() -> None:
    master = RawMaster()
    assert obey(master.bus, "emergency 0x8130").startswith("error: its mailbox is off")
    master.go(PREOP)
    for wrong in ("emergency 0x10000", "emergency 1 256", "emergency 1 0 xy", "emergency 1 0 010203040506"):
        assert obey(master.bus, wrong).startswith("error: ")
    assert master.fetch_mailbox() is None
    foreign = RawMaster(*slaves_in(parse_chain("EK1100,DRIVE:OP")))
    do(foreign, "emergency 0x3210 #1")
    assert emergency_of(foreign.fetch_mailbox(1))[0] == 0x3210
    assert obey(foreign.bus, "emergency 0x3210 #0").startswith("error: ")
