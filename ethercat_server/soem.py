"""The EtherCAT master from power-on to OP: scan, SDO, mapping, states. The only file that knows pysoem.

Everything pysoem raises is translated here, and its traps are kept in here: the descriptor it leaks on a
failed open, its close that must happen once, its scan that may take minutes, and its error ring, which can
hand one call's error to the next. Those of its exchange are kept in `bus.py`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import pysoem

from ethercat_server.al import AlState, AlStatus
from ethercat_server.errors import BusError, SdoAbortError
from ethercat_server.raw_socket import RawSocket, packet_sockets

_SDO_ATTEMPTS: Final = 3
_OP_TIMEOUT_S: Final = 10.0
_STATION_ADDRESS: Final = 0x0010
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


class SlaveIdentity(NamedTuple):
    """What the SII of a slave says; zeros, and no name, if it cannot be read."""

    vendor: int
    product: int
    revision: int
    name: str


class Master:
    """An EtherCAT bus on one network interface, until it is in OP. Used by one thread."""

    def __init__(self, ifname: str) -> None:
        self.ifname = ifname
        self.ifindex = 0
        self.expected_wkc = 0
        self._master: Any = pysoem.Master()
        self._slaves: list[Any] = []
        self._opened = False
        self._scanned = False
        """The slaves' states are this master's business from here on."""
        self._abandoned = False
        """A thread that never ended still uses the socket: it must not be closed."""
        self._stations: list[int] = []
        self._socket: RawSocket

    def open(self) -> None:
        """Open the raw socket. BusError if that fails; `interface.claimed` says why beforehand."""
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
            self.ifindex = socket.if_nametoindex(self.ifname)
        except OSError:
            raise BusError(f"the interface {self.ifname} went away: connect it and start again") from None
        # Until SOEM had bound it to the interface, it took in the EtherCAT frames of all others.
        self._socket.set_blocking(False)
        self._socket.drop(0)
        self._socket.set_blocking(True)

    def scan(self, check_interrupt: Callable[[], None]) -> list[SlaveIdentity]:
        """Find the slaves and take them to PREOP; BusError if none answers.

        `check_interrupt` is called while waiting and may raise to give up.
        """
        if self._config_init(check_interrupt) <= 0:
            raise BusError(
                f"no EtherCAT slave answers on {self.ifname}: check the cable, that the sensor has power and "
                "that this is the interface it is connected to"
            )
        self._slaves = list(self._master.slaves)
        for slave in self._slaves:
            slave.add_emergency_callback(_log_emergency)
        try:
            self._stations = [int.from_bytes(s._fprd(_STATION_ADDRESS, 2), "little") for s in self._slaves]
        except pysoem.WkcError:
            raise BusError(
                f"a slave on {self.ifname} stopped answering in the middle of the scan: check cable and power"
            ) from None
        return [SlaveIdentity(s.man, s.id, s.rev, _name(s)) for s in self._slaves]

    def _config_init(self, check_interrupt: Callable[[], None]) -> int:
        # SOEM tries every byte of the SII for long if a slave goes away meanwhile, two minutes in all, and no
        # signal is noticed before it returns. So it runs in a thread, which can be left behind.
        counts: list[int] = []
        thread = threading.Thread(
            target=lambda: counts.append(self._master.config_init(release_gil=True)), daemon=True
        )
        thread.start()
        deadline = time.monotonic() + _SCAN_TIMEOUT_S
        self._abandoned = self._scanned = True
        while thread.is_alive():
            thread.join(0.05)
            check_interrupt()
            if time.monotonic() > deadline:
                raise BusError(
                    f"the scan of {self.ifname} does not end: a slave stopped answering in its middle, or "
                    "its EEPROM does not answer; check cable and power, then start again"
                )
        self._abandoned = False
        return counts[0] if counts else 0

    def check_preop(self, check_interrupt: Callable[[], None]) -> None:
        """Wait until every slave is in PREOP or above; BusError names one that is not. See `scan`."""
        self._wait_state(AlState.PREOP, check_interrupt)

    def sdo_read(self, slave: int, index: int, subindex: int) -> bytes:
        """Upload an object; SdoAbortError if the sensor refuses, BusError if it does not answer."""
        what = f"reading object 0x{index:04X}:{subindex}"
        data: bytes = self._sdo(slave, index, subindex, what, None)
        return data

    def sdo_write(self, slave: int, index: int, subindex: int, data: bytes) -> None:
        """Download an object; SdoAbortError if the sensor refuses, BusError if it does not answer."""
        self._sdo(slave, index, subindex, f"writing {data.hex()} to object 0x{index:04X}:{subindex}", data)

    def map_process_data(self) -> list[int]:
        """Map the process data and take the slaves to SAFEOP; returns each slave's input size in bytes."""
        try:
            self._master.config_map()
        except pysoem.ConfigMapError as error:
            raise BusError(
                f"the process data of {self.ifname} cannot be mapped: {_texts(error.error_list)}; "
                "power the sensor off and on, then start again"
            ) from None
        except _PYSOEM_ERRORS as error:
            raise BusError(f"the process data of {self.ifname} cannot be mapped: {_texts([error])}") from None
        self.expected_wkc = self._master.expected_wkc
        for slave in self._slaves:
            slave.output = bytes(len(slave.output))
        return [len(slave.input) for slave in self._slaves]

    def go_operational(self, check_interrupt: Callable[[], None]) -> None:
        """Take every slave to OP, exchanging process data all the while; BusError names one that refuses.

        See `scan`.
        """
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
        """Take the slaves to INIT and close the socket. May be called at any time, any number of times.

        Slaves that were never scanned are left in the state they are in.
        """
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

    def _wait_state(self, state: AlState, check_interrupt: Callable[[], None]) -> None:
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
        for place, slave in enumerate(self._slaves):
            if slave.state != state:
                return (
                    f"sensor {place} does not reach {state.name}: it stays in {_al_status(slave)}; "
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
