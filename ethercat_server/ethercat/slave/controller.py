"""The slave controller of a sensor, or a terminal: AL states, mailbox, and the registers that it needs in OP.

At the start and when a sensor comes back the same steps take it to OP.
Source: ETG.1000.4 and ETG.1000.6.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

from ethercat_server.errors import BusError, SdoAbortError, SetUpError
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.datagrams import Datagrams, Steps, repeat
from ethercat_server.ethercat.exchange import Area
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import ACKNOWLEDGE_S, STATE_S, AlState, AlStatus
from ethercat_server.ethercat.slave.coe import Emergencies, MailboxSdo
from ethercat_server.ethercat.slave.sii import OF_FIRMWARE

_START_ATTEMPTS: Final = 20
_MOST_BYTES: Final = 1486  # of process data in a frame
_MAILBOXES_END: Final = 2 * reg.SYNC_MANAGER_SIZE
_HARDWARE: Final = struct.Struct("<BBxxH")  # numbers of FMMUs and of sync managers, features


class GoneError(SetUpError):
    """The slave stopped answering during an operation."""


class SlaveController:
    """The slave controller of slave `number` of a `Bus`.

    Attributes:
        number: of the sensor; terminals are numbered after all sensors.
        attempts: how often an unanswered datagram is sent; more than once only while nothing streams.
        sdo: its mailbox.
        areas: its process data in the logical address space, as `read_mapping` has found it.
        features: of the controller (register 0x0008), from then on.
    """

    def __init__(
        self, bus: Datagrams, number: int, mailboxes: Sequence[tuple[int, int]],
        emergencies: Emergencies | None = None, name: str = "",
    ) -> None:  # fmt: skip
        """`mailboxes`: offset and size of the one to the slave and of the one from it."""
        self._bus, self._name = bus, name or f"sensor {number}"
        self.number = number
        self.attempts = _START_ATTEMPTS
        out, back = mailboxes
        self.sdo = MailboxSdo(bus, number, (out, back), emergencies, self._name)
        self._mailboxes = reg.pack_sync_manager(*out, reg.SM_CONTROL_MAILBOX_OUT)
        self._mailboxes += reg.pack_sync_manager(*back, reg.SM_CONTROL_MAILBOX_IN)
        self.areas: list[Area] = []
        self.features = 0
        self._units = self._count = 0
        self._managers = self._fmmus = b""
        self._latch: tuple[int, bytes] | None = None

    def status(self) -> Steps[AlStatus | None]:
        """Its AL status; None if it does not answer."""
        read = self._bus.read_register
        data = yield from repeat(self.attempts, read, self.number, reg.AL_STATUS, reg.AL_STATUS_SIZE)
        return AlStatus.parse(data) if data else None

    def _read(self, address: int, size: int) -> Steps[bytes]:
        if data := (yield from repeat(self.attempts, self._bus.read_register, self.number, address, size)):
            return data
        raise self._gone()

    def write(self, address: int, data: bytes) -> Steps[None]:
        """Write registers; GoneError if it does not answer."""
        if not (yield from repeat(self.attempts, self._bus.write_register, self.number, address, data)):
            raise self._gone()

    def go(self, state: AlState) -> Steps[None]:
        """Request an AL state and wait for it; an error is acknowledged first. SetUpError if it fails."""
        status = yield from self.status()
        if status is not None and status.error:
            yield from self._acknowledge(status)
        yield from self.write(reg.AL_CONTROL, state.request())
        deadline = Deadline(self._bus.clock, STATE_S[state])
        while True:
            status = yield from self._next_status()
            if status.state is state and not status.error:
                return
            if status.error or deadline.passed:
                raise SetUpError(
                    f"{self._name} does not go to {state.name}: it is in {status}; power it off and on"
                )

    def enter_preop(self) -> Steps[None]:
        """Through INIT, clearing what another master has set up (FMMUs, sync managers, SYNC0)."""
        yield from self._enter_init()
        # A controller without DC refuses.
        yield from self._bus.write_register(self.number, reg.DC_ACTIVATION, b"\0\0")
        yield from self.write(
            reg.SYNC_MANAGER, self._mailboxes.ljust(self._count * reg.SYNC_MANAGER_SIZE, b"\0")
        )
        yield from self.write(reg.SII_OWNER, OF_FIRMWARE)  # a slave reads its SII on the way to PREOP
        yield from self.go(AlState.PREOP)

    def map_inputs(self, logical: int, inputs: Sequence[tuple[int, int, int, int]]) -> Steps[None]:
        """Map inputs from a logical address on, and nothing else: sync manager, its start, bytes, control.

        SetUpError if there are more of them than FMMUs.
        """
        if len(inputs) > self._units:
            raise SetUpError(f"{self._name} has {self._units} FMMUs for {len(inputs)} inputs: do not name it")
        units = b""
        for manager, start, size, control in inputs:
            at = reg.SYNC_MANAGER + manager * reg.SYNC_MANAGER_SIZE
            yield from self.write(at, reg.pack_sync_manager(start, size, control))
            units += reg.FMMU_LAYOUT.pack(logical, size, 0, 7, start, 0, reg.FMMU_READ, 1)
            logical += size
        yield from self.write(reg.FMMU, units)

    def leave(self, state: AlState) -> Steps[None]:
        """Go to INIT, or PREOP if it was found there, with nothing mapped and without a station address."""
        self.attempts = _START_ATTEMPTS
        if state >= AlState.PREOP:
            yield from self.enter_preop()
        else:
            yield from self._enter_init()
            yield from self.write(reg.SYNC_MANAGER, bytes(self._count * reg.SYNC_MANAGER_SIZE))
        yield from self.write(reg.STATION_ADDRESS, bytes(2))

    def _enter_init(self) -> Steps[None]:
        """Without FMMUs."""
        yield from self.go(AlState.INIT)
        yield from self._read_hardware()
        yield from self.write(reg.FMMU, bytes(self._units * reg.FMMU_SIZE))

    def mapped_size(self, assignment: int, in_sii: int) -> Steps[int]:
        """Bytes of process data by the PDOs that the object `assignment` lists; `in_sii` if there is none.

        BusError if it cannot be.
        """
        bits = 0
        try:
            for at in range(1, 1 + (yield from self._read_number(assignment, 0, 0xFF))):
                pdo = yield from self._read_number(assignment, at, 0xFFFF)
                for entry in range(1, 1 + (yield from self._read_number(pdo, 0, 0xFF))):
                    bits += (yield from self._read_number(pdo, entry, 0xFFFFFFFF)) & 0xFF
                    if bits > 8 * _MOST_BYTES:
                        raise BusError(
                            f"{self._name} maps more than {_MOST_BYTES} bytes of process data, which "
                            "fit no frame: power it off and on"
                        )
        except SdoAbortError:
            return in_sii
        return (bits + 7) // 8

    def _read_number(self, index: int, subindex: int, most: int) -> Steps[int]:
        if (value := int.from_bytes((yield from self.sdo.read(index, subindex)), "little")) > most:
            raise BusError(
                f"{self._name} has {value:#x} in object 0x{index:04X}:{subindex}, which cannot be: "
                "power it off and on"
            )
        return value

    def map(self, managers: bytes = b"", fmmus: bytes = b"") -> Steps[None]:
        """Write sync managers from the third on, and FMMUs: by default those that `read_mapping` has read."""
        yield from self.write(reg.SYNC_MANAGER + _MAILBOXES_END, managers or self._managers)
        yield from self.write(reg.FMMU, fmmus or self._fmmus)

    def read_mapping(self) -> Steps[int]:
        """Read back how a master has mapped the process data; returns the bytes of the inputs.

        SetUpError if something was not written: SOEM writes it once and does not verify it.
        """
        yield from self._read_hardware()
        self._fmmus = yield from self._read(reg.FMMU, self._units * reg.FMMU_SIZE)
        rows = reg.FMMU_LAYOUT.iter_unpack(self._fmmus)
        self.areas = [Area(row[0], row[0] + row[1], row[6]) for row in rows if row[7] & 1]
        data = yield from self._read(reg.SYNC_MANAGER, self._count * reg.SYNC_MANAGER_SIZE)
        used = {
            reg.FMMU_WRITE if control & reg.SM_WRITE else reg.FMMU_READ: at * reg.SYNC_MANAGER_SIZE
            for at, (_, length, control, _, active, _) in enumerate(reg.SYNC_MANAGER_LAYOUT.iter_unpack(data))
            if length and active & 1 and not control & reg.SM_MAILBOX
        }
        if {area.kind for area in self.areas} != used.keys():
            raise self.unmapped()
        if self.features & reg.DC_AVAILABLE and reg.FMMU_READ in used:
            at = used[reg.FMMU_READ] + reg.SM_ACTIVATE
            self._latch = reg.SYNC_MANAGER + at, bytes([data[at] | reg.SM_LATCH_PDI])
            data = data[:at] + self._latch[1] + data[at + 1 :]
        self._managers = data[_MAILBOXES_END:]
        return sum(area.end - area.start for area in self.areas if area.kind == reg.FMMU_READ)

    def latch_events(self) -> Steps[bool]:
        """Have the controller latch the times of new samples; False if it has no distributed clock.

        Another master may switch that off at any time.
        """
        if self._latch is None:
            return False
        yield from self.write(*self._latch)
        return True

    def enter_op(self) -> Steps[None]:
        """From PREOP, with the process data mapped and being exchanged."""
        yield from self.go(AlState.SAFEOP)
        yield from self.go(AlState.OP)

    def unmapped(self) -> SetUpError:
        """The error to be raised if its mapping cannot be."""
        return SetUpError(f"{self._name} did not answer when it was mapped: check cable and power")

    def _acknowledge(self, status: AlStatus) -> Steps[None]:
        # The next request must wait for the error to clear: the slave sees only the last write to AL control.
        yield from self.write(reg.AL_CONTROL, status.acknowledge())
        deadline = Deadline(self._bus.clock, ACKNOWLEDGE_S)
        while (now := (yield from self._next_status())).error:
            if deadline.passed:
                raise BusError(f"{self._name} keeps its error although it was acknowledged: it is in {now}")

    def _next_status(self) -> Steps[AlStatus]:
        yield None
        status = yield from self.status()
        if status is None:
            raise self._gone()
        return status

    def _gone(self) -> GoneError:
        return GoneError(f"{self._name} does not answer: check cable and power")

    def _read_hardware(self) -> Steps[None]:
        if not self._count:
            data = yield from self._read(reg.FMMU_AND_SM_COUNT, _HARDWARE.size)
            units, count, self.features = _HARDWARE.unpack(data)
            self._units, self._count = min(units, reg.MOST_FMMUS), min(count, reg.MOST_SYNC_MANAGERS)
