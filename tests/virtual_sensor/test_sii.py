"""The SII: header, check sum, categories, and the registers it is read through."""

import struct

from ethercat_server.virtual_sensor.options import EEPROM_MS, SensorOptions
from tests.virtual_sensor.raw_master import RawMaster

MS = 1_000_000
BUSY = 0x8000


def read_words(master: RawMaster, word: int, command: int = 0x0100) -> tuple[int, bytes]:
    master.write(0x0502, struct.pack("<HI", command, word))
    while master.read16(0x0502) & BUSY:
        master.wait(MS)
    return master.read16(0x0502), master.read(0x0508, 8)


def test_it_cannot_be_written_nor_read_while_the_sensor_owns_it() -> None:
    master = RawMaster()
    before = read_words(master, 0x08)[1]
    master.write(0x0508, b"\xde\xad\xbe\xef")
    assert read_words(master, 0x08, command=0x0201)[0] & 0x2000
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
