"""The object dictionary of one sensor: values, access rules, ranges, PDO mapping, and the flash.

The rows are those of `ethercat_server.sensor.objects.dictionary`, plus the objects of the PDO mapping.
That is of the dump of a real Rokubi (see `bota_ethercat.pdo`).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Final

from bota_ethercat.pdo import INPUT_OBJECT, LAYOUTS
from bota_ethercat.settings import SettingValue, sampling_rate_hz
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.coe import AbortCode
from ethercat_server.ethercat.slave.sii import MailboxProtocol
from ethercat_server.sensor import models
from ethercat_server.sensor.objects import dictionary as table
from ethercat_server.virtual_sensor.device import Device, Pdo, entries_of
from ethercat_server.virtual_sensor.mailbox import Address, ObjectTable, TransferRefusedError
from ethercat_server.virtual_sensor.options import SensorOptions

_STRING_SIZES: Final = {0x1008: 20, 0x1009: 12, 0x100A: 13}  # declared; padded with NUL
_BUSY: Final = 0xFF  # status while a save is under way
# What the SINC length reads back, times the sampling rate: 768 at 400 Hz, 2048 at 150 Hz (real sensors).
_SINC_UNIT: Final = 307_200
# Objects stored by the save command; the factory calibration is stored at once.
_SAVED: Final = range(0x8000, 0x8011)
_REPETITION_NS: Final = 300_000_000


class Flash:
    """The sensor's flash, entries by address, and the process of saving to it. Times are in ns."""

    def __init__(self) -> None:
        self.entries: dict[Address, bytes] = {}
        self.seconds = 0.0  # duration of a save
        self.result = 0  # status at the end of a save; 0 is success, with any other nothing is stored
        # Number of entries, in order of address, after which the next save loses power; the action for it.
        self.cut: tuple[int, Callable[[], None]] | None = None
        self._saving: Mapping[Address, bytes] = {}
        self._ends = 0.0

    def save(self, values: Mapping[Address, bytes], now: int) -> None:
        if self.cut is not None:
            (count, cut_power), self.cut = self.cut, None
            self.entries.update(sorted(values.items())[:count])
            cut_power()
            return
        self.status(now)
        self._saving, self._ends = values, now + self.seconds * 1e9

    def status(self, now: int) -> int:
        """Value of object 0x8030:2 for the last save."""
        if now < self._ends:
            return _BUSY
        if not self.result:
            self.entries.update(self._saving)
        self._saving = {}
        return self.result

    def power_cut(self, now: int) -> None:
        """Drop what is not saved yet."""
        self.status(now)
        self._saving, self._ends = {}, 0.0


def sensor_device(model: str, serial: int, pdo_size: int) -> Device:
    """A sensor with `pdo_size` bytes of inputs."""
    output = table.BY_ADDRESS[0x7000, 0]
    inputs = tuple(table.BY_ADDRESS[INPUT_OBJECT, field.subindex] for field in LAYOUTS[pdo_size].fields)
    return Device(
        model, "Force/torque sensors", models.VENDOR_ID, models.PRODUCT_CODE, models.REVISION, serial,
        (Pdo(0x1600, "Outputs", (output,)),),
        (Pdo(0x1A00, "Inputs", inputs),),
        MailboxProtocol.CoE | MailboxProtocol.FoE,
    )  # fmt: skip


def sensor_entries(pdo_size: int) -> dict[Address, table.ObjectEntry]:
    """Every entry of a sensor with `pdo_size` bytes of process data, in order of address."""
    mapped = {field.subindex for field in LAYOUTS[pdo_size].fields}
    rows = [row for row in table.OBJECTS if row.index != INPUT_OBJECT or row.subindex in mapped]
    return entries_of(sensor_device("", 0, pdo_size), rows)


def _initial(row: table.ObjectEntry) -> bytes:
    if row.index == table.FACTORY_CALIBRATION and row.subindex:
        # A recognizable value.
        return row.type.pack(row.subindex / 64 if row.type is table.ObjectType.REAL32 else row.subindex)
    data = row.type.pack(row.default)
    return data.ljust(_STRING_SIZES.get(row.index, len(data)), b"\0")


OnWrite = Callable[[int, int, bytes, AlState, int], None]


class Dictionary(ObjectTable):
    """Values of all entries of one sensor.

    `process_data` returns the newest process data (for 0x6000), `now` the time in ns. `on_write` is called
    for every SDO write: index, sub-index, data, AL state, abort code or 0. The next transfer of an entry in
    `aborts` is aborted with the code there.
    """

    def __init__(
        self,
        options: SensorOptions,
        flash: Flash,
        process_data: Callable[[], bytes],
        now: Callable[[], int],
        on_write: OnWrite,
    ) -> None:
        entries = sensor_entries(options.pdo_size)
        super().__init__(entries, {address: _initial(row) for address, row in entries.items()})
        self.changed: Callable[[], None] = lambda: None  # called after a write
        self.aborts: dict[Address, int] = {}
        # Code and until when, by write.
        self._aborted: dict[tuple[Address, bytes | None], tuple[int | None, int]] = {}
        self._flash, self._process_data, self._now, self._on_write = flash, process_data, now, on_write
        self._layout = LAYOUTS[options.pdo_size]
        self._saved = False  # the last command was a save: the flash has its status
        self.values[table.DEVICE_NAME] = options.model.encode("ascii").ljust(
            _STRING_SIZES[table.DEVICE_NAME[0]], b"\0"
        )
        self.values[table.SERIAL_NUMBER] = struct.pack("<I", options.serial)
        self.values.update(flash.entries)
        self.let_chop_divide(options.chop_divides)

    def _check_abort(self, address: Address, data: bytes | None = None) -> None:
        code, until = self._aborted.get((address, data), (None, 0))
        if self._now() >= until:
            code = self.aborts.pop(address, None)
            if code is not None and data is not None:  # if it is repeated soon after, its answer was lost
                self._aborted = {(address, data): (code, self._now() + _REPETITION_NS)}
        if code is not None:
            raise TransferRefusedError(code)

    def read(self, index: int, subindex: int) -> bytes:
        self._check_abort((index, subindex))
        row = self.entry(index, subindex)
        if index == INPUT_OBJECT and subindex:
            field = next(f for f in self._layout.fields if f.subindex == subindex)
            start = self._layout.offsets[field.name]
            return self._process_data()[start : start + field.type.size]
        if row.setting == "sinc_length":
            return row.type.pack(round(_SINC_UNIT / sampling_rate_hz(int(self.number(row.address)))))
        if row.address == table.CONTROL_STATUS and self._saved:
            return bytes([self._flash.status(self._now())])
        return self.values[row.address]

    def write(self, index: int, subindex: int, data: bytes, state: AlState) -> None:
        abort = 0
        try:
            self._check_abort((index, subindex), data)
            row = self.entry(index, subindex)
            self.check_write(row, len(data), state)
            if row.setting is not None:
                _check_range(row, data)
        except TransferRefusedError as error:
            abort = error.code
            raise
        else:
            self._store(row, data)
        finally:
            self._on_write(index, subindex, data, state, abort)

    def _store(self, row: table.ObjectEntry, data: bytes) -> None:
        self.values[row.address] = data
        if row.index == table.FACTORY_CALIBRATION:
            self._flash.entries[row.address] = data
        if row.address == table.CONTROL_COMMAND:
            self._command(data[0])
        self._follow_sinc()
        self.changed()

    def settings(self) -> dict[str, SettingValue]:
        return {name: row.decode_setting(self.values[row.address]) for name, row in table.BY_SETTING.items()}

    def offsets(self, index: int) -> tuple[float, ...]:
        return tuple(self.number((index, sub)) for sub in range(1, 7))

    def let_chop_divide(self, by: int) -> None:
        self._chop_divides = by
        self._follow_sinc()

    @property
    def sinc_in_effect(self) -> int:
        """The SINC length whose rate it samples at."""
        chop = self.number(table.BY_SETTING["chop"].address)
        return int(self.number(table.BY_SETTING["sinc_length"].address)) * (self._chop_divides if chop else 1)

    def _follow_sinc(self) -> None:
        self.values[table.SAMPLING_RATE] = struct.pack("<H", sampling_rate_hz(self.sinc_in_effect))

    def _command(self, command: int) -> None:
        self._saved = command == table.SAVE_PARAMETERS
        if self._saved:
            self._flash.save({a: v for a, v in self.values.items() if a[0] in _SAVED}, self._now())
        self.values[table.CONTROL_STATUS] = b"\0"
        self.values[table.CONTROL_COMMAND] = b"\0"


def _check_range(row: table.ObjectEntry, data: bytes) -> None:
    value, allowed = int.from_bytes(data, "little"), row.allowed or ()
    if value > max(allowed):
        raise TransferRefusedError(AbortCode.TOO_HIGH)
    if value < min(allowed):
        raise TransferRefusedError(AbortCode.TOO_LOW)
    if value not in allowed:
        raise TransferRefusedError(AbortCode.INVALID_VALUE)
