"""The backend on pysoem: scan, SDO, mapping, states up to OP. The only file that knows pysoem.

What pysoem raises is translated here, and its traps end here: the descriptor that a failed open leaks, the
close that must happen once, the scan that may take minutes, the error ring that hands one call's error to the
next.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from typing import Any, Final

import pysoem

from ethercat_server.errors import BusError, SdoAbortError
from ethercat_server.ethercat.backend import CheckInterrupt, SlaveIdentity
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.nic.interface import check_present, why_silent
from ethercat_server.ethercat.raw_socket import RawSocket, packet_sockets
from ethercat_server.ethercat.slave.al import AlState, AlStatus

_SDO_ATTEMPTS: Final = 3
_OP_TIMEOUT_S: Final = 10.0
_SCAN_TIMEOUT_S: Final = 15.0
_STATE_ATTEMPTS: Final = {AlState.PREOP: 80, AlState.SAFEOP: 200}
"""Of 50 ms each."""
_PYSOEM_ERRORS: Final = (
    pysoem.SdoError,
    pysoem.Emergency,
    pysoem.MailboxError,
    pysoem.PacketError,
    pysoem.WkcError,
    pysoem.ConfigMapError,
    pysoem.NetworkInterfaceNotOpenError,
)
log = logging.getLogger(__name__)


class SoemBackend:
    """See `Backend`: pysoem on a network interface, which `nic.claim.claimed` has checked beforehand."""

    def __init__(self, ifname: str) -> None:
        self.ifname = ifname
        self.clock = SYSTEM_CLOCK
        self._ifindex = 0
        self._master: Any = pysoem.Master()
        self._slaves: list[Any] = []
        self._opened = False
        self._scanned = False
        """The slaves' states are this master's business from here on."""
        self._abandoned = False
        """A thread that never ended still uses the socket: it must not be closed."""
        self._socket: RawSocket

    def open(self) -> None:
        """See `Backend`."""
        before = packet_sockets()
        try:
            self._master.open(self.ifname)
        except ConnectionError:
            for fd in packet_sockets() - before:
                os.close(fd)
            raise BusError(
                f"cannot open {self.ifname} for EtherCAT: it went away or may not be opened; "
                "check 'ip link' and the permissions"
            ) from None
        self._opened = True
        self._socket = RawSocket((packet_sockets() - before).pop())
        try:
            self._ifindex = socket.if_nametoindex(self.ifname)
        except OSError:
            raise BusError(f"the interface {self.ifname} went away: connect it and start again") from None
        # Until SOEM had bound it to the interface, it received the EtherCAT frames of all others.
        self._socket.discard()

    def send(self, frame: bytes | bytearray) -> None:
        """See `Backend`."""
        self._socket.send(frame)

    def receive(self, timeout_s: float) -> bytes | None:
        """See `Backend`."""
        return self._socket.receive(timeout_s)

    def check_present(self) -> None:
        """See `Backend`."""
        check_present(self.ifname, self._ifindex)

    def why_silent(self) -> str:
        """See `Backend`."""
        return why_silent(self.ifname)

    def scan(self, check_interrupt: CheckInterrupt) -> list[SlaveIdentity]:
        """See `Backend`."""
        if self._config_init(check_interrupt) <= 0:
            raise BusError(
                f"no EtherCAT slave answers on {self.ifname}: check the cable, that the sensor has power and "
                "that this is the interface it is connected to"
            )
        self._slaves = list(self._master.slaves)
        for slave in self._slaves:
            slave.add_emergency_callback(_log_emergency)
        return [SlaveIdentity(s.man, s.id, s.rev, _name(s)) for s in self._slaves]

    def _config_init(self, check_interrupt: CheckInterrupt) -> int:
        # SOEM tries every byte of the SII for long if a slave goes away meanwhile, two minutes in all, and no
        # signal is noticed before it returns. So it runs in a thread, which can be left behind.
        counts: list[int] = []
        thread = threading.Thread(
            target=lambda: counts.append(self._master.config_init(release_gil=True)), daemon=True
        )
        thread.start()
        deadline = time.monotonic() + _SCAN_TIMEOUT_S
        self._scanned = True
        try:
            while thread.is_alive():
                thread.join(0.05)
                check_interrupt()
                if time.monotonic() > deadline:
                    raise BusError(
                        f"the scan of {self.ifname} does not end: a slave stopped answering in its middle, "
                        "or its EEPROM does not answer; check cable and power, then start again"
                    )
        finally:
            self._abandoned = thread.is_alive()
        return counts[0] if counts else 0

    def check_preop(self, check_interrupt: CheckInterrupt) -> None:
        """See `Backend`."""
        self._wait_state(AlState.PREOP, check_interrupt)

    def sdo_read(self, slave: int, index: int, subindex: int) -> bytes:
        """See `Backend`."""
        what = f"reading object 0x{index:04X}:{subindex}"
        data: bytes = self._sdo(slave, index, subindex, what, None)
        return data

    def sdo_write(self, slave: int, index: int, subindex: int, data: bytes) -> None:
        """See `Backend`."""
        self._sdo(slave, index, subindex, f"writing {data.hex()} to object 0x{index:04X}:{subindex}", data)

    def map_process_data(self) -> list[int]:
        """See `Backend`."""
        try:
            self._master.config_map()
        except pysoem.ConfigMapError as error:
            raise BusError(
                f"the process data of {self.ifname} cannot be mapped: {_texts(error.error_list)}; "
                "power the sensor off and on, then start again"
            ) from None
        except _PYSOEM_ERRORS as error:
            raise BusError(f"the process data of {self.ifname} cannot be mapped: {_texts([error])}") from None
        for slave in self._slaves:
            slave.output = bytes(len(slave.output))
        return [len(slave.input) for slave in self._slaves]

    def go_operational(self, check_interrupt: CheckInterrupt) -> None:
        """See `Backend`."""
        self._wait_state(AlState.SAFEOP, check_interrupt)
        self._master.state = pysoem.OP_STATE
        self._master.write_state()
        deadline = time.monotonic() + _OP_TIMEOUT_S
        while time.monotonic() < deadline:
            check_interrupt()
            for _ in range(5):
                self._master.send_processdata()
                self._master.receive_processdata(2000)
            if self._master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE:
                self._socket.set_blocking(False)
                return
        raise BusError(self._state_complaint(AlState.OP))

    def close(self) -> None:
        """See `Backend`. Slaves that were never scanned are left in the state they are in."""
        if not self._opened or self._abandoned:
            return
        self._opened = False
        with contextlib.suppress(*_PYSOEM_ERRORS):
            self._socket.set_blocking(True)
            if self._scanned:
                self._master.state = pysoem.INIT_STATE
                self._master.write_state()
        self._socket.close()
        self._master.close()

    def _sdo(self, slave: int, index: int, subindex: int, what: str, data: bytes | None) -> Any:
        target, last = self._slaves[slave], "no answer"
        for _ in range(_SDO_ATTEMPTS):
            try:
                if data is None:
                    return target.sdo_read(index, subindex)
                return target.sdo_write(index, subindex, data)
            except pysoem.SdoError as error:
                # Another object's abort is a stale entry of the error ring, not an answer to this call.
                if (error.index, error.subindex) == (index, subindex):
                    code = error.abort_code & 0xFFFFFFFF
                    text = f"sensor {slave} refused {what}: {error.desc.strip()} (abort 0x{code:08X})"
                    raise SdoAbortError(text, code) from None
                last = "an answer about another object"
            except Exception as error:
                # pysoem raises a plain Exception for an entry of its error ring that it does not know.
                if not isinstance(error, _PYSOEM_ERRORS) and type(error) is not Exception:
                    raise
                last = _texts([error])
        raise BusError(f"sensor {slave} did not answer {what}: {last}; check cable and power")

    def _wait_state(self, state: AlState, check_interrupt: CheckInterrupt) -> None:
        for _ in range(_STATE_ATTEMPTS[state]):
            check_interrupt()
            if self._master.state_check(int(state), 50_000) == state:
                return
            # state_check wants the state itself; a slave that is above it is fine as well.
            self._master.read_state()
            if any(_al_status(s).error or s.state == pysoem.NONE_STATE for s in self._slaves):
                break
        raise BusError(self._state_complaint(state))

    def _state_complaint(self, state: AlState) -> str:
        self._master.read_state()
        for position, slave in enumerate(self._slaves):
            if slave.state != state:
                return (
                    f"sensor {position} does not reach {state.name}: it stays in {_al_status(slave)}; "
                    "power it off and on, then start again"
                )
        return f"the bus on {self.ifname} does not reach {state.name}: start again"


def _name(slave: Any) -> str:
    try:
        return str(slave.name)
    except UnicodeDecodeError:  # a name in another encoding than pysoem's UTF-8
        return ""


def _al_status(slave: Any) -> AlStatus:
    return AlStatus.of(slave.state, slave.al_status)


def _log_emergency(emergency: Any) -> None:
    log.warning(
        "sensor %d reports an emergency: error code 0x%04X", emergency.slave_pos - 1, emergency.error_code
    )


def _texts(errors: list[Any]) -> str:
    texts = [str(getattr(error, "desc", None) or error).strip() for error in errors]
    meant = [text for text in texts if text and text != "No error"]
    return "; ".join(dict.fromkeys(meant)) or "no answer"
