"""SDO: every access rule in every state, every abort code, transfers of every kind, SDO Information."""

import struct

import pytest

from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.settings import SETTINGS, sampling_rate_hz
from ethercat_server.sensor.objects.dictionary import BY_SETTING, OBJECTS, Access
from ethercat_server.virtual_sensor.dictionary import sensor_entries
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.virtual_sensor.raw_master import OP, PREOP, SAFEOP, Abort, RawMaster


def abort_of(master: RawMaster, index: int, subindex: int, data: bytes | None = None) -> int:
    try:
        if data is None:
            master.upload(index, subindex)
        else:
            master.download(index, subindex, data)
    except Abort as abort:
        return abort.code
    pytest.fail(f"0x{index:04X}:{subindex} was not refused")


def test_mapping() -> None:
    master = RawMaster(SensorOptions(pdo_size=77)).go(PREOP)
    count = master.upload(0x1A00, 0)[0]
    assert sum(master.upload(0x1A00, n)[0] for n in range(1, count + 1)) == 77 * 8
    assigned = [[master.upload(index, n) for n in (0, 1)] for index in (0x1C12, 0x1C13, 0x1600)]
    assert assigned == [[b"\1", b"\x00\x16"], [b"\1", b"\x00\x1a"], [b"\1", b"\x08\x00\x00\x70"]]
    assert [master.upload(0x1C00, n)[0] for n in range(5)] == [4, 1, 2, 3, 4]
    sizes = [len(master.upload(0x2000, n)) for n in range(1, master.upload(0x2000, 0)[0] + 1)]
    assert [n for n, size in enumerate(sizes, 1) if size == 1] == [0x2D, *range(0x52, 0x58)]
    assert len(sizes) == 0x57


@pytest.mark.parametrize("state", [PREOP, SAFEOP, OP])
@pytest.mark.parametrize("size", list(LAYOUTS))
def test_access_rules(state: int, size: int) -> None:
    master = RawMaster(SensorOptions(pdo_size=size, noise=False)).go(state)
    entries = sensor_entries(size)
    for address, row in ({(row.index, row.subindex): row for row in OBJECTS} | entries).items():
        if address not in entries:
            assert row.index == 0x6000, "its size decides which inputs there are"
            assert abort_of(master, row.index, row.subindex) == 0x06090011
            continue
        before = master.upload(row.index, row.subindex)
        assert len(before) == (row.type.size or len(before)), hex(row.index)
        if row.access is Access.RO:
            assert abort_of(master, row.index, row.subindex, before) == 0x06010002
        elif row.access is Access.RW_PREOP and state != PREOP:
            assert abort_of(master, row.index, row.subindex, before) == 0x08000022
        else:
            master.download(row.index, row.subindex, before)


def test_what_is_refused() -> None:
    master = RawMaster().go(PREOP)
    for index, subindex, data, code in (
        (0x8003, 1, None, 0x06020000), (0x5000, 0, b"\0", 0x06020000),
        (0x6000, 3, None, 0x06090011), (0x1000, 1, None, 0x06090011),
        (0x8006, 1, b"\x40", 0x06070013), (0x8006, 1, b"\x40\0\0\0", 0x06070012),
        (0x8000, 1, b"\0" * 9, 0x06070012), (0x8000, 1, b"\0" * 100, 0x06070012),
        (0x1018, 0, b"\4", 0x06010002), (0x7000, 0, b"\1", 0x06010002),
    ):  # fmt: skip
        assert abort_of(master, index, subindex, data) == code, hex(index)
    for request, code in (
        (b"\x60" + bytes(7), 0x05040001), (b"\x00" + bytes(7), 0x05040001),
        (b"\xa0" + bytes(7), 0x05040001), (struct.pack("<BHBI", 0x50, 0x1018, 1, 0), 0x06010000),
        (struct.pack("<BHBI", 0x21, 0x8000, 1, 4) + b"\0", 0x06070013),
    ):  # fmt: skip
        with pytest.raises(Abort, match=hex(code)):
            master.coe(request)


@pytest.mark.parametrize("name", list(SETTINGS))
def test_setting_ranges(name: str) -> None:
    master = RawMaster().go(PREOP)
    row, setting = BY_SETTING[name], SETTINGS[name]
    choices = tuple(setting.choices)
    for value in choices if len(choices) < 100 else (*choices[::50], choices[-1]):
        master.download(row.index, row.subindex, row.encode_setting(value))
        held = master.upload(row.index, row.subindex)
        if name == "sinc_length":
            rate = sampling_rate_hz(int(value))
            assert master.upload(0x8011, 0) == struct.pack("<H", rate)
            assert held == struct.pack("<H", round(307_200 / rate))
        else:
            assert held == row.encode_setting(value)
    too_high = b"\xff" * row.type.size
    assert abort_of(master, row.index, row.subindex, too_high) == 0x06090031
    if name in ("sinc_length", "acceleration_filter", "angular_rate_filter"):
        assert abort_of(master, row.index, row.subindex, bytes(row.type.size)) == 0x06090032


def test_object_lists() -> None:
    master = RawMaster().go(PREOP)
    expected = sorted({index for index, _ in sensor_entries(61)})
    fragments = master.information(1, struct.pack("<H", 1))
    assert [f[0] & 0x80 for f in fragments] == [0x80] * (len(fragments) - 1) + [0]
    assert [struct.unpack_from("<H", f, 2)[0] for f in fragments] == list(range(len(fragments)))[::-1]
    found = b"".join(f[4:] for f in fragments)
    assert found[:2] == b"\1\0"
    assert list(struct.unpack(f"<{len(found) // 2}H", found)[1:]) == expected
    [error] = master.information(1, struct.pack("<H", 9))
    assert error[0] == 7


def test_descriptions() -> None:
    master = RawMaster().go(PREOP)
    for asked, said, name in (
        ((3, struct.pack("<H", 0x8006)), (4, 0x8006, 4, 9), b"Force/torque filter"),  # a record of four
        ((3, struct.pack("<H", 0x1008)), (4, 0x1008, 0, 7), b"Device name"),
    ):
        [reply] = master.information(*asked)
        index, _, highest, code = struct.unpack_from("<HHBB", reply, 4)
        assert (reply[0], index, highest, code) == said
        assert reply[10:] == name
    [reply] = master.information(5, struct.pack("<HBB", 0x8006, 1, 0))
    assert struct.unpack_from("<HBBHHH", reply, 4) == (0x8006, 1, 0, 0x0006, 16, 0x0F)
    assert reply[14:] == b"SINC length"
    [reply] = master.information(5, struct.pack("<HBB", 0x8004, 0, 0))
    assert struct.unpack_from("<HH", reply, 8) == (0x0037, 8), "one-byte settings are BIT8"
    for request in ((3, struct.pack("<H", 0x5555)), (5, struct.pack("<HBB", 0x1018, 9, 0)), (9, b"")):
        [reply] = master.information(*request)
        assert reply[0] == 7
