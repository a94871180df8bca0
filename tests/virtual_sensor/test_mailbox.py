"""The mailbox: handshake, duplicates, lost replies, protocols that are not there."""

import struct

from ethercat_server.ethercat.wire import Command
from tests.virtual_sensor.raw_master import INIT, MAILBOX, PREOP, RawMaster

READ_NAME = struct.pack("<HBHBI", 0x2000, 0x40, 0x1008, 0, 0)
READ_TYPE = struct.pack("<HBHBI", 0x2000, 0x40, 0x1000, 0, 0)


def test_reading_an_empty_mailbox_counts_nothing() -> None:
    master = RawMaster().go(PREOP)
    assert master.one(Command.APRD, 0, 0x1080, b"\xaa" * MAILBOX) == (b"\xaa" * MAILBOX, 0)


def test_a_mailbox_is_full_until_its_last_byte_is_read() -> None:
    master = RawMaster().go(PREOP)
    assert master.send_mailbox(3, READ_NAME) == 1
    assert master.mailbox_full()
    assert master.one(Command.APRD, 0, 0x1090, bytes(4))[1] == 0, "not before the first byte"
    assert master.one(Command.APRD, 0, 0x1080, bytes(16))[1] == 1
    assert master.mailbox_full()
    assert master.one(Command.APRD, 0, 0x1090, bytes(MAILBOX - 16))[1] == 1
    assert not master.mailbox_full()


def test_a_request_counts_when_its_last_byte_is_written() -> None:
    master = RawMaster().go(PREOP)
    message = struct.pack("<HHBB", len(READ_NAME), 0, 0, 0x13) + READ_NAME
    assert master.write(0x1004, message[4:]) == 0, "not before the first byte"
    assert master.write(0x1000, message) == 1
    assert not master.mailbox_full()
    assert master.write(0x1000 + MAILBOX - 1, b"\0") == 1
    assert master.mailbox_full()


def test_a_full_write_mailbox_refuses_and_keeps_what_it_has() -> None:
    master = RawMaster().go(PREOP)
    assert master.send_mailbox(3, READ_NAME) == 1
    assert master.send_mailbox(3, READ_TYPE) == 1, "waits until the first reply is read"
    assert master.read(0x0805, 1)[0] & 8
    assert master.send_mailbox(3, READ_NAME) == 0
    first, second = master.fetch_mailbox(), master.fetch_mailbox()
    assert first is not None
    assert second is not None
    assert b"BFT-SENS" in first[1]
    assert second[1][3:5] == b"\x00\x10"
    assert master.fetch_mailbox() is None


def test_the_same_counter_again_is_a_duplicate() -> None:
    master = RawMaster().go(PREOP)
    assert master.send_mailbox(3, READ_NAME, counter=3) == 1
    assert master.fetch_mailbox() is not None
    assert master.send_mailbox(3, READ_NAME, counter=3) == 1
    assert master.fetch_mailbox() is None
    for _ in range(2):
        assert master.send_mailbox(3, READ_NAME, counter=0) == 1, "0 is not counted"
        assert master.fetch_mailbox() is not None


def test_counting_starts_afresh_after_init() -> None:
    master = RawMaster().go(PREOP)
    master.send_mailbox(3, READ_NAME, counter=3)
    master.request(INIT)
    assert master.request(PREOP) == (PREOP, 0)
    assert not master.mailbox_full()
    master.send_mailbox(3, READ_NAME, counter=3)
    assert master.mailbox_full()


def test_a_lost_reply_can_be_had_again() -> None:
    master = RawMaster().go(PREOP)
    master.send_mailbox(3, READ_NAME)
    first = master.fetch_mailbox()
    for toggle in (2, 0):
        master.write(0x080E, bytes([1 | toggle]))
        assert master.read(0x080F, 1)[0] & 2 == toggle
        assert master.fetch_mailbox() == first
    assert master.fetch_mailbox() is None


def test_unknown_protocols_get_a_mailbox_error() -> None:
    master = RawMaster().go(PREOP)
    for kind in (1, 2, 5, 15):
        master.send_mailbox(kind, b"hello")
        assert master.fetch_mailbox() == (0, struct.pack("<HH", 1, 2))


def test_lengths_that_lie() -> None:
    master = RawMaster().go(PREOP)
    master.write(0x1000, struct.pack("<HHBB", 2000, 0, 0, 0x13).ljust(MAILBOX, b"\0"))
    assert master.fetch_mailbox() == (0, struct.pack("<HH", 1, 8))
    master.send_mailbox(3, b"\0", counter=0)
    assert master.fetch_mailbox() == (0, struct.pack("<HH", 1, 6))
    master.send_mailbox(3, READ_NAME[:6], counter=0)
    assert master.fetch_mailbox() == (0, struct.pack("<HH", 1, 6))


def test_foe_is_refused() -> None:
    master = RawMaster().go(PREOP)
    master.send_mailbox(4, struct.pack("<BBI", 1, 0, 0) + b"firmware")
    reply = master.fetch_mailbox()
    assert reply is not None
    assert reply[0] == 4
    assert reply[1][0] == 5


def test_no_mailbox_in_init() -> None:
    master = RawMaster()
    master.set_up_mailbox()
    master.request(PREOP)
    master.request(INIT)
    assert master.send_mailbox(3, READ_NAME) == 0
