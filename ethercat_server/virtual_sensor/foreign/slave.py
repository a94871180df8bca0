"""A foreign slave, powered or not, and a record of all that was written to it."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from typing import Any, Final

from ethercat_server.virtual_sensor.esc.controller import Esc, Pdi
from ethercat_server.virtual_sensor.foreign.drive import CONTROLWORD, ENABLE, TARGET_VELOCITY, Drive
from ethercat_server.virtual_sensor.foreign.kinds import DRIVE, KINDS, objects_of
from ethercat_server.virtual_sensor.options import ForeignOptions
from ethercat_server.virtual_sensor.slave.al import AlState
from ethercat_server.virtual_sensor.slave.application import Application
from ethercat_server.virtual_sensor.slave.device import MAPPING_NAMES, Device, by_address, mapping_rows
from ethercat_server.virtual_sensor.slave.objects import Address, ObjectTable
from ethercat_server.virtual_sensor.slave.sdo_information import SdoInformation

_WRITES_REMEMBERED: Final = 1000
_VELOCITY_AT_WORK: Final = 1000

Record = Callable[[int, bytes], None]


class _RecordingEsc(Esc):
    """A controller that reports all that a master writes: address, data."""

    def __init__(self, pdi: Pdi, image: bytes, sii_read_ns: int, record: Record) -> None:
        super().__init__(pdi, image, sii_read_ns)
        self._record = record

    def write(self, address: int, data: bytes) -> bool:
        """See `Esc`."""
        self._record(address, data)
        return super().write(address, data)


class ForeignApplication(Application):
    """What a foreign slave does: see `foreign.kinds`."""

    def __init__(self, device: Device, clock: Callable[[], int], eeprom_ms: float, record: Record) -> None:
        entries = by_address(objects_of(device) + mapping_rows(device))
        self.objects = ObjectTable(entries, {a: row.type.pack(row.default) for a, row in entries.items()})
        self.drive = Drive(clock()) if device.name == DRIVE else None
        information = SdoInformation(self.objects, device, MAPPING_NAMES)
        super().__init__(
            device, clock, information, eeprom_ms, functools.partial(_RecordingEsc, record=record)
        )

    def inputs(self) -> bytes:
        """The process data."""
        return b"".join(self.read(*entry.address) for entry in self.device.input_entries)

    def prepare(self, expected: int) -> None:
        """Nothing takes long to compute."""

    def take_outputs(self, data: bytes) -> None:
        """The master wrote the outputs."""
        at = 0
        for entry in self.device.output_entries:
            self.objects.store(entry.address, data[at : at + entry.type.size])
            at += entry.type.size
        self._command()

    def state_changed(self) -> None:
        """The AL state has changed."""
        if self.drive is not None and self.al.state is not AlState.OP:
            self.drive.disconnect(self.al.error, self.clock())

    def work(self) -> None:
        """Be at work, if it is a drive in OP: the other master has enabled it, and it turns."""
        if self.drive is not None and self.al.state is AlState.OP:
            self.drive.command(ENABLE & ~1, 0, self.clock())
            for _ in range(2):
                self.drive.command(ENABLE, _VELOCITY_AT_WORK, self.clock())

    def _command(self) -> None:
        if self.drive is not None:
            controlword, velocity = (self._number(address) for address in (CONTROLWORD, TARGET_VELOCITY))
            self.drive.command(controlword, velocity, self.clock())

    def _number(self, address: Address) -> int:
        value = self.objects.entries[address].type.unpack(self.objects.load(address))
        assert isinstance(value, int)
        return value

    def read(self, index: int, subindex: int) -> bytes:
        """An SDO upload."""
        row = self.objects.entry(index, subindex)
        live = self.drive.values(self.clock()) if self.drive is not None else {}
        return row.type.pack(live[row.address]) if row.address in live else self.objects.load(row.address)

    def length(self, index: int, subindex: int) -> int:
        """Bytes of an entry."""
        return self.objects.size(self.objects.entry(index, subindex))

    def check_download(self, index: int, subindex: int, length: int) -> None:
        """Refuse a download of the wrong length before its data has come."""
        self.objects.check_write(self.objects.entry(index, subindex), length, self.al.state)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """An SDO download."""
        self.check_download(index, subindex, len(data))
        self.objects.store((index, subindex), data)
        self._command()


class ForeignSlave:
    """A foreign slave. `clock` gives the time in ns.

    Attributes:
        life: from power-on to power-off; None if switched off.
        writes: address and data of the latest register and memory writes that reached it.
        write_count: number of all.
    """

    def __init__(self, options: ForeignOptions, clock: Callable[[], int]) -> None:
        self.options = options
        self._clock = clock
        self.writes: deque[tuple[int, bytes]] = deque(maxlen=_WRITES_REMEMBERED)
        self.write_count = 0
        self.life: ForeignApplication | None = None
        self.power(True)

    def power(self, on: bool) -> None:
        """Switch it off or on; no effect if it already is."""
        if not on:
            self.life = None
        elif self.life is None:
            device = KINDS[self.options.kind]
            self.life = ForeignApplication(device, self._clock, self.options.eeprom_ms, self._remember)

    def _remember(self, address: int, data: bytes) -> None:
        self.writes.append((address, bytes(data)))
        self.write_count += 1

    def left_at_work(self) -> None:
        """Another master has left it in the AL state it is in: record from now on."""
        if self.life is not None:
            self.life.work()
        self.writes.clear()
        self.write_count = 0

    @property
    def turning(self) -> bool:
        """Whether it is a drive whose motor moves."""
        return self.life is not None and self.life.drive is not None and self.life.drive.turning

    def statistics(self) -> dict[str, Any]:
        """Its part of what the command `stats` reports."""
        life = self.life
        return {
            "kind": self.options.kind,
            "powered": life is not None,
            "al_state": life.al.state.name if life else None,
            "al_error": life is not None and life.al.error,
            "al_status_code": life.al.code if life else 0,
            "drive": life.drive.state.name if life and life.drive else None,
            "write_count": self.write_count,
        }
