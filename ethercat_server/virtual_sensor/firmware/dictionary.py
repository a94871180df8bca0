"""The object dictionary of one sensor: values, access rules, ranges, and the flash.

The rows are those of `ethercat_server.sensor.objects.dictionary`, plus the objects of the PDO mapping.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Final

from ethercat_server.ethercat.slave.abort_codes import AbortCode, abort_meaning
from ethercat_server.sensor.objects.dictionary import (
    BY_SETTING,
    CONTROL_COMMAND,
    CONTROL_STATUS,
    DEVICE_NAME,
    FACTORY_CALIBRATION,
    OBJECTS,
    SAMPLING_RATE,
    SAVE_PARAMETERS,
    SERIAL_NUMBER,
    Access,
    ObjectEntry,
    ObjectType,
)
from ethercat_server.sensor.objects.search import TITLES
from ethercat_server.virtual_sensor.firmware.al import AlState
from ethercat_server.virtual_sensor.firmware.flash import Address, Flash
from ethercat_server.virtual_sensor.firmware.layout import RXPDO, SYNC_MANAGERS, TXPDO
from protocol.pdo import INPUT_OBJECT, LAYOUTS
from protocol.settings import SETTINGS, SettingValue, sampling_rate_hz

STRING_SIZES: Final = {0x1008: 20, 0x1009: 12, 0x100A: 13}
"""Declared length of each string; padded with NUL."""
OBJECT_NAMES: Final = {
    **TITLES,
    0x1600: "Outputs mapping",
    0x1A00: "Inputs mapping",
    0x1C00: "Sync manager communication type",
    0x1C12: "Outputs assignment",
    0x1C13: "Inputs assignment",
}
_UNKNOWN_COMMAND = 1
_SAVED = range(0x8000, 0x8011)
"""Objects stored by the save command; the factory calibration is stored at once."""


class SdoAbortError(Exception):
    """The sensor aborts the SDO transfer with `code`."""

    def __init__(self, code: int) -> None:
        super().__init__(abort_meaning(code))
        self.code = code


def _mapping_rows(pdo_size: int) -> list[ObjectEntry]:
    ro, u8, u16, u32 = Access.RO, ObjectType.U8, ObjectType.U16, ObjectType.U32
    rows = [
        ObjectEntry(0x1C00, n, f"Sync manager {n - 1}", u8, ro, row.kind)
        for n, row in enumerate(SYNC_MANAGERS, 1)
    ]
    for assignment, pdo in ((0x1C12, RXPDO), (0x1C13, TXPDO[pdo_size])):
        rows.append(ObjectEntry(assignment, 1, "PDO 1", u16, ro, pdo.index))
        for n, entry in enumerate(pdo.entries, 1):
            mapped = entry.index << 16 | entry.subindex << 8 | entry.type.size * 8
            rows.append(ObjectEntry(pdo.index, n, f"Entry {n}", u32, ro, mapped))
    return rows


def entries_of(pdo_size: int) -> dict[Address, ObjectEntry]:
    """Every entry of a sensor with `pdo_size` bytes of process data, in order of address."""
    mapped = {field.subindex for field in LAYOUTS[pdo_size].fields}
    rows = [row for row in OBJECTS if row.index != INPUT_OBJECT or row.subindex in mapped]
    rows += _mapping_rows(pdo_size)
    highest: dict[int, int] = {}
    for row in rows:
        if row.subindex:
            highest[row.index] = max(row.subindex, highest.get(row.index, 0))
    rows += [
        ObjectEntry(index, 0, "Highest sub-index", ObjectType.U8, Access.RO, last)
        for index, last in highest.items()
    ]
    return {row.address: row for row in sorted(rows, key=lambda row: row.address)}


class Dictionary:
    """Values of all entries of one sensor.

    `process_data` returns the newest process data (for 0x6000); `changed` is called after a write; `now`
    returns the time in ns.
    """

    def __init__(
        self,
        model: str,
        serial: int,
        pdo_size: int,
        flash: Flash,
        process_data: Callable[[], bytes],
        changed: Callable[[], None],
        now: Callable[[], int],
    ) -> None:
        self.entries: Mapping[Address, ObjectEntry] = entries_of(pdo_size)
        self._flash = flash
        self._layout = LAYOUTS[pdo_size]
        self._process_data = process_data
        self._changed = changed
        self._now = now
        self._saved = False
        """The last command was a save: the flash has its status."""
        self._values = {address: self._initial(row) for address, row in self.entries.items()}
        self._values[DEVICE_NAME] = model.encode("ascii").ljust(STRING_SIZES[DEVICE_NAME[0]], b"\0")
        self._values[SERIAL_NUMBER] = struct.pack("<I", serial)
        self._values.update(flash.entries)
        self._follow_sinc()

    @staticmethod
    def _initial(row: ObjectEntry) -> bytes:
        if row.index == FACTORY_CALIBRATION and row.subindex:
            return struct.pack("<f", row.subindex / 64)  # a recognizable value
        data = row.type.pack(row.default)
        return data.ljust(STRING_SIZES.get(row.index, len(data)), b"\0")

    def size(self, row: ObjectEntry) -> int:
        """Bytes of the entry `row`."""
        return row.type.size or len(self._values[row.address])

    def entry(self, index: int, subindex: int) -> ObjectEntry:
        """The entry at an address; SdoAbortError if there is none."""
        row = self.entries.get((index, subindex))
        if row is None:
            exists = any(known == index for known, _ in self.entries)
            raise SdoAbortError(AbortCode.NO_SUBINDEX if exists else AbortCode.NO_OBJECT)
        return row

    def read(self, index: int, subindex: int) -> bytes:
        """The bytes of an entry; SdoAbortError if it cannot be read."""
        row = self.entry(index, subindex)
        if index == INPUT_OBJECT and subindex:
            field = next(f for f in self._layout.fields if f.subindex == subindex)
            start = self._layout.offsets[field.name]
            return self._process_data()[start : start + field.type.size]
        if row.address == CONTROL_STATUS and self._saved:
            return bytes([self._flash.status(self._now())])
        return self._values[row.address]

    def write(self, index: int, subindex: int, data: bytes, state: AlState) -> None:
        """Write an entry as a master does in the AL state `state`; SdoAbortError if it cannot be."""
        row = self.entry(index, subindex)
        self.check_write(row, len(data), state)
        if row.setting is not None:
            _check_range(row, data)
        self._values[row.address] = data
        if index == FACTORY_CALIBRATION:
            self._flash.entries[row.address] = data
        if row.address == CONTROL_COMMAND:
            self._command(data[0])
        self._follow_sinc()
        self._changed()

    def check_write(self, row: ObjectEntry, length: int, state: AlState) -> None:
        """SdoAbortError if `length` bytes cannot be written to `row` in `state`, whatever they are."""
        if row.access is Access.RO:
            raise SdoAbortError(AbortCode.READ_ONLY)
        if row.access is Access.RW_PREOP and state is not AlState.PREOP:
            raise SdoAbortError(AbortCode.NOT_IN_THIS_STATE)
        if length > self.size(row):
            raise SdoAbortError(AbortCode.TOO_LONG)
        if length < self.size(row):
            raise SdoAbortError(AbortCode.TOO_SHORT)

    def set_output(self, data: bytes) -> None:
        """Process data outputs, as the master sent them."""
        at = 0
        for entry in RXPDO.entries:
            self._values[entry.address] = data[at : at + entry.type.size]
            at += entry.type.size

    def number(self, address: Address) -> float:
        """The number that an entry holds."""
        value = self.entries[address].type.unpack(self._values[address])
        assert not isinstance(value, str)
        return value

    def settings(self) -> dict[str, SettingValue]:
        """Every setting in force."""
        return {
            name: row.decode_setting(self._values[row.address], SETTINGS[name].is_bool)
            for name, row in BY_SETTING.items()
        }

    def offsets(self, index: int) -> tuple[float, ...]:
        """The six offsets of an offset object."""
        return tuple(self.number((index, sub)) for sub in range(1, 7))

    def set_sinc_length(self, sinc_length: int) -> None:
        """Set the SINC length as if it had been saved before power-on."""
        address = BY_SETTING["sinc_length"].address
        self._values[address] = self._flash.entries[address] = struct.pack("<H", sinc_length)
        self._follow_sinc()

    _chop_divides = 1

    def let_chop_divide(self, by: int) -> None:
        """Have CHOP divide the sampling rate."""
        self._chop_divides = by
        self._follow_sinc()

    @property
    def sinc_in_effect(self) -> int:
        """The SINC length whose rate it samples at."""
        chop = self.number(BY_SETTING["chop"].address)
        return int(self.number(BY_SETTING["sinc_length"].address)) * (self._chop_divides if chop else 1)

    def _follow_sinc(self) -> None:
        self._values[SAMPLING_RATE] = struct.pack("<H", sampling_rate_hz(self.sinc_in_effect))

    def _command(self, command: int) -> None:
        self._saved = command == SAVE_PARAMETERS
        if self._saved:
            self._flash.save({a: v for a, v in self._values.items() if a[0] in _SAVED}, self._now())
        status = 0 if command in (0, SAVE_PARAMETERS) else _UNKNOWN_COMMAND
        self._values[CONTROL_STATUS] = bytes([status])
        self._values[CONTROL_COMMAND] = b"\0"


def _check_range(row: ObjectEntry, data: bytes) -> None:
    assert row.setting is not None
    setting = SETTINGS[row.setting]
    allowed: list[int]
    if row.codes is not None:
        allowed = list(row.codes.values())
    elif setting.is_bool:
        allowed = [0, 1]
    else:
        allowed = list(setting.choices or ())
    value = int.from_bytes(data, "little")
    if value > max(allowed):
        raise SdoAbortError(AbortCode.TOO_HIGH)
    if value < min(allowed):
        raise SdoAbortError(AbortCode.TOO_LOW)
    if value not in allowed:
        raise SdoAbortError(AbortCode.INVALID_VALUE)
