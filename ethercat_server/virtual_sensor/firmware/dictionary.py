"""The object dictionary of one sensor: values, access rules, ranges, and the flash.

The rows are those of `ethercat_server.sensor.objects.dictionary`, plus the objects of the PDO mapping.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final

from bota_ethercat.pdo import INPUT_OBJECT, LAYOUTS
from bota_ethercat.settings import SETTINGS, SettingValue, sampling_rate_hz
from ethercat_server.ethercat.slave.abort_codes import AbortCode
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
    ObjectEntry,
    ObjectType,
)
from ethercat_server.sensor.objects.search import TITLES
from ethercat_server.virtual_sensor.firmware.flash import Flash
from ethercat_server.virtual_sensor.firmware.layout import RXPDO, sensor_device
from ethercat_server.virtual_sensor.slave.al import AlState
from ethercat_server.virtual_sensor.slave.device import MAPPING_NAMES, by_address, mapping_rows
from ethercat_server.virtual_sensor.slave.objects import Address, ObjectTable, SdoAbortError

STRING_SIZES: Final = {0x1008: 20, 0x1009: 12, 0x100A: 13}
"""Declared length of each string; padded with NUL."""
OBJECT_NAMES: Final = {
    **TITLES,
    **MAPPING_NAMES,
}
_UNKNOWN_COMMAND = 1
_SINC_UNIT = 307_200
"""What the SINC length reads back, times the sampling rate: 768 at 400 Hz, 2048 at 150 Hz (real sensors)."""
_SAVED = range(0x8000, 0x8011)
"""Objects stored by the save command; the factory calibration is stored at once."""


def entries_of(pdo_size: int) -> dict[Address, ObjectEntry]:
    """Every entry of a sensor with `pdo_size` bytes of process data, in order of address."""
    mapped = {field.subindex for field in LAYOUTS[pdo_size].fields}
    rows = [row for row in OBJECTS if row.index != INPUT_OBJECT or row.subindex in mapped]
    return by_address(rows + mapping_rows(sensor_device("", 0, pdo_size)))


class Dictionary(ObjectTable):
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
        entries = entries_of(pdo_size)
        super().__init__(entries, {address: self._initial(row) for address, row in entries.items()})
        self._flash = flash
        self._layout = LAYOUTS[pdo_size]
        self._process_data = process_data
        self._changed = changed
        self._now = now
        self._saved = False
        """The last command was a save: the flash has its status."""
        self._values[DEVICE_NAME] = model.encode("ascii").ljust(STRING_SIZES[DEVICE_NAME[0]], b"\0")
        self._values[SERIAL_NUMBER] = struct.pack("<I", serial)
        self._values.update(flash.entries)
        self._follow_sinc()

    @staticmethod
    def _initial(row: ObjectEntry) -> bytes:
        if row.index == FACTORY_CALIBRATION and row.subindex:
            # A recognizable value.
            return row.type.pack(row.subindex / 64 if row.type is ObjectType.REAL32 else row.subindex)
        data = row.type.pack(row.default)
        return data.ljust(STRING_SIZES.get(row.index, len(data)), b"\0")

    def read(self, index: int, subindex: int) -> bytes:
        """The bytes of an entry; SdoAbortError if it cannot be read."""
        row = self.entry(index, subindex)
        if index == INPUT_OBJECT and subindex:
            field = next(f for f in self._layout.fields if f.subindex == subindex)
            start = self._layout.offsets[field.name]
            return self._process_data()[start : start + field.type.size]
        if row.setting == "sinc_length":
            return row.type.pack(round(_SINC_UNIT / sampling_rate_hz(int(self.number(row.address)))))
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
