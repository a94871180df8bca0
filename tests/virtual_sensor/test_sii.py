"""The SII: header, check sum, categories, and the registers it is read through."""

import struct

import pytest

from bota_ethercat.pdo import LAYOUTS
from ethercat_server.ethercat.slave.sii import checksum, decode
from ethercat_server.virtual_sensor.device import build_image
from ethercat_server.virtual_sensor.dictionary import sensor_device
from ethercat_server.virtual_sensor.options import EEPROM_MS, SensorOptions
from tests.virtual_sensor.raw_master import RawMaster

MS = 1_000_000
BUSY = 0x8000


def read_words(master: RawMaster, word: int, command: int = 0x0100) -> tuple[int, bytes]:
    master.write(0x0502, struct.pack("<HI", command, word))
    while master.read16(0x0502) & BUSY:
        master.wait(MS)
    return master.read16(0x0502), master.read(0x0508, 8)


def categories(image: bytes) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    at = 0x80
    while True:
        kind, words = struct.unpack_from("<HH", image, at)
        if kind == 0xFFFF:
            return found
        found[kind] = image[at + 4 : at + 4 + words * 2]
        at += 4 + words * 2


def test_identity_and_mailbox_words() -> None:
    master = RawMaster(SensorOptions(serial=0x12345678))
    status, data = read_words(master, 0x08)
    assert status & 0xE040 == 0x0040, "eight bytes at a time"
    assert data == struct.pack("<II", 0xB07A, 1)
    assert read_words(master, 0x0C)[1] == struct.pack("<II", 3, 0x12345678)
    assert read_words(master, 0x18)[1] == struct.pack("<HHHH", 0x1000, 128, 0x1080, 128)
    assert read_words(master, 0x1C)[1][:2] == b"\x0c\0"
    assert read_words(master, 0xFFFF)[1] == b"\xff" * 8, "beyond the end it is erased"
    image = build_image(sensor_device("BFT-SENS-ECAT-M8", 1, 61))
    assert image[14] == checksum(image[:14])
    # The usual example of ETG.2010's CRC-8: an all-zero area with start value 0xFF.
    assert checksum(b"") == 0xFF
    assert checksum(bytes(14)) != checksum(bytes(13))


@pytest.mark.parametrize("size", list(LAYOUTS))
def test_categories(size: int) -> None:
    image = build_image(sensor_device("BFT-ROKS-ECAT-M8", 7, size))
    found = categories(image)
    assert set(found) == {10, 30, 40, 41, 50, 51}
    assert found[10][1:18] == b"\x10BFT-ROKS-ECAT-M8"
    assert found[30][5] == 0x03, "SDO and SDO information, nothing else"
    assert found[40][:3] == b"\1\2\3"
    managers = list(struct.iter_unpack("<HHBBBB", found[41]))
    assert [(m[0], m[1], m[2], m[5]) for m in managers] == [
        (0x1000, 128, 0x26, 1), (0x1080, 128, 0x22, 2), (0x1100, 1, 0x24, 3), (0x1180, size, 0x20, 4),
    ]  # fmt: skip
    index, count, manager = struct.unpack_from("<HBB", found[50])
    assert (index, count, manager) == (0x1A00, len(LAYOUTS[size].fields), 3)
    bits = sum(found[50][8 + 8 * n + 5] for n in range(count))
    assert bits == size * 8
    output = {"index": 0x7000, "subindex": 0, "name": "Digital output", "type": 0x0002, "bits": 8}
    (outputs,) = decode(image)["rx_pdos"]
    assert outputs == {"index": 0x1600, "name": "Outputs", "sync_manager": 2, "entries": [output]}
    strings = found[10][0]
    assert all(1 <= found[50][8 + 8 * n + 3] <= strings for n in range(count))


def test_it_cannot_be_written_nor_read_while_the_sensor_owns_it() -> None:
    master = RawMaster()
    before = read_words(master, 0x08)[1]
    master.write(0x0508, b"\xde\xad\xbe\xef")
    for command, error in ((0x0201, 0x2000), (0x0200, 0x4000)):  # what masters look at; no write enable
        assert read_words(master, 0x08, command)[0] & 0x6000 == error
    assert read_words(master, 0x08) == (0x0040, before)
    for owner, error in ((1, 0x2000), (0, 0)):
        master.write(0x0500, bytes([owner]))
        assert read_words(master, 0x08)[0] & 0x2000 == error


def test_a_master_that_writes_control_and_two_address_bytes() -> None:
    master = RawMaster()
    assert master.write(0x0502, b"\x80\x01\x08\x00") == 1
    master.wait(3 * MS)
    data = master.read(0x0502, 10)
    assert data[1] & 0xA1 == 0
    assert data[6:10] == struct.pack("<I", 0xB07A)


def test_reading_takes_its_time() -> None:
    master = RawMaster()
    master.write(0x0502, struct.pack("<HI", 0x0100, 0x08))
    assert master.read16(0x0502) & BUSY
    master.wait(round(EEPROM_MS * MS) - 100_000)
    assert master.read16(0x0502) & BUSY
    master.write(0x0502, struct.pack("<HI", 0x0100, 0x0C))
    assert master.read16(0x0502) & BUSY, "it takes no other command meanwhile"
    master.wait(100_000)
    assert master.read(0x0502, 10)[2:] == struct.pack("<II", 0x08, 0xB07A)
    master.write(0x0502, struct.pack("<HI", 0x0100, 0x08))
    master.wait(3 * MS)  # nobody looks, and the next command is executed all the same
    master.write(0x0502, struct.pack("<HI", 0x0100, 0x0C))
    assert master.read16(0x0502) & BUSY
    master.wait(3 * MS)
    assert master.read(0x0502, 14)[6:] == struct.pack("<II", 3, 1)
    quick = RawMaster(SensorOptions(eeprom_ms=0))
    quick.write(0x0502, struct.pack("<HI", 0x0100, 0x08))
    assert quick.read(0x0502, 14)[6:] == struct.pack("<II", 0xB07A, 1)
