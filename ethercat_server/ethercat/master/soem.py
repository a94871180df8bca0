"""The backend and the master on pysoem: scan, SDO, mapping, states up to OP. The only file that knows pysoem.

What pysoem raises is translated here, and its traps end here: the descriptor that a failed open leaks, the
close that must happen once, the scan that may take minutes, the error ring that hands one call's error to the
next.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import pysoem

from ethercat_server.errors import BusError, SetUpError
from ethercat_server.ethercat.backend import CheckInterrupt, Master
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.mailbox.emergency import Emergency
from ethercat_server.ethercat.nic.interface import check_present, why_silent
from ethercat_server.ethercat.raw_socket import RawSocket, packet_sockets
from ethercat_server.ethercat.slave import times
from ethercat_server.ethercat.slave.abort_codes import abort_meaning, refused
from ethercat_server.ethercat.slave.al import AlState, AlStatus

_SDO_ATTEMPTS: Final = 3
_MOST_WAITING: Final = 16
"""Emergencies of a sensor that are taken before the mapping, or that an SDO survives."""
_SCAN_TIMEOUT_S: Final = 15.0
_STATE_CHECK_S: Final = 0.05
_IMAGE_BYTES: Final = 4096
"""Of pysoem's process image, whose end nothing checks."""
_PYSOEM_ERRORS: Final = (
    pysoem.SdoError,
    pysoem.Emergency,
    pysoem.MailboxError,
    pysoem.PacketError,
    pysoem.WkcError,
    pysoem.ConfigMapError,
    pysoem.NetworkInterfaceNotOpenError,
    AssertionError,  # an entry of the error ring about another slave
)
_UNEXPECTED: Final = "unexpected error"
"""What pysoem makes of entries of its error ring that it does not expect after a mapping."""


class SoemBackend:
    """See `Backend` and `Master`: pysoem on an interface that `nic.claim.claimed` has checked."""

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
        self._emergency_count = 0
        self.on_emergency: Callable[[int, Emergency], None] = lambda _number, _emergency: None
        """Told of each emergency of a sensor until OP."""

    @property
    def master(self) -> Master:
        """See `Backend`."""
        return self

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

    def arrived_ns(self) -> int:
        """See `Backend`."""
        return self._socket.arrived_ns()

    def check_present(self) -> None:
        """See `Backend`."""
        check_present(self.ifname, self._ifindex)

    def why_silent(self) -> str:
        """See `Backend`."""
        return why_silent(self.ifname)

    def scan(self, positions: Sequence[int], check_interrupt: CheckInterrupt) -> None:
        """See `Master`. SOEM takes every slave on the wire for its own."""
        count = self._config_init(check_interrupt)
        if count != len(positions):
            raise SetUpError(
                f"{max(count, 0)} of {len(positions)} slaves on {self.ifname} answered the scan: check cable "
                "and power"
            )
        self._slaves = list(self._master.slaves)
        for slave in self._slaves:
            slave.add_emergency_callback(self._take_emergency)

    def _take_emergency(self, emergency: Any) -> None:
        self._emergency_count += 1
        data = struct.pack("<BHH", emergency.b1, emergency.w1, emergency.w2)
        found = Emergency(emergency.error_code, emergency.error_reg, data)
        self.on_emergency(emergency.slave_pos - 1, found)

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

    def enter_preop(self, check_interrupt: CheckInterrupt) -> None:
        """See `Master`."""
        self._wait_state(AlState.PREOP, check_interrupt)

    def sdo_read(self, number: int, index: int, subindex: int) -> bytes:
        """See `Master`."""
        what = f"reading object 0x{index:04X}:{subindex}"
        data: bytes = self._sdo(number, index, subindex, what, None)
        return data

    def sdo_write(self, number: int, index: int, subindex: int, data: bytes) -> None:
        """See `Master`."""
        self._sdo(number, index, subindex, f"writing {data.hex()} to object 0x{index:04X}:{subindex}", data)

    def map_process_data(self, check_interrupt: CheckInterrupt) -> list[int]:
        """See `Master`."""
        check_interrupt()
        self._empty_mailboxes()
        try:
            mapped = self._master.config_map()
        except pysoem.ConfigMapError as error:
            raise self._unmapped(_texts(error.error_list)) from None
        except _PYSOEM_ERRORS as error:
            raise self._unmapped(_texts([error])) from None
        if mapped > _IMAGE_BYTES:
            raise self._unmapped(f"its slaves say that they have {mapped} bytes")
        for slave in self._slaves:
            slave.output = bytes(len(slave.output))
        return [len(slave.input) for slave in self._slaves]

    def _empty_mailboxes(self) -> None:
        """Take the emergencies that wait: pysoem takes one that it meets in the mapping for a failure."""
        for slave in self._slaves:
            for _ in range(_MOST_WAITING):
                before = self._emergency_count
                with contextlib.suppress(*_PYSOEM_ERRORS):
                    slave.mbx_receive()
                if self._emergency_count == before:
                    break

    def _unmapped(self, why: str) -> SetUpError:
        return SetUpError(
            f"the process data of {self.ifname} cannot be mapped: {why}; power the sensor off and on, then "
            "start again"
        )

    def go_operational(self, check_interrupt: CheckInterrupt) -> None:
        """See `Master`."""
        self._wait_state(AlState.SAFEOP, check_interrupt)
        self._master.state = pysoem.OP_STATE
        self._master.write_state()
        deadline = time.monotonic() + times.STATE_S[AlState.OP]
        while time.monotonic() < deadline:
            check_interrupt()
            for _ in range(5):
                self._master.send_processdata()
                self._master.receive_processdata(2000)
            if self._master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE:
                self._socket.set_blocking(False)
                return
        raise SetUpError(self._state_complaint(AlState.OP))

    def release(self) -> None:
        """See `Master`."""
        if not self._opened or self._abandoned or not self._scanned:
            return
        self._scanned = False
        with contextlib.suppress(*_PYSOEM_ERRORS):
            self._socket.set_blocking(True)
            self._master.state = pysoem.INIT_STATE
            self._master.write_state()

    def close(self) -> None:
        """See `Backend`."""
        if not self._opened or self._abandoned:
            return
        self._opened = False
        self._socket.close()
        self._master.close()

    def _sdo(self, number: int, index: int, subindex: int, what: str, data: bytes | None) -> Any:
        target, last, left = self._slaves[number], "no answer", _SDO_ATTEMPTS
        most_emergencies = self._emergency_count + _MOST_WAITING
        while left:
            emergencies = self._emergency_count
            try:
                if data is None:
                    return target.sdo_read(index, subindex)
                return target.sdo_write(index, subindex, data)
            except pysoem.SdoError as error:
                # Another object's abort is a stale entry of the error ring, not an answer to this call.
                if (error.index, error.subindex) == (index, subindex):
                    raise refused(number, what, error.abort_code & 0xFFFFFFFF) from None
                last = "an answer about another object"
            except Exception as error:
                # pysoem raises a plain Exception for an entry of its error ring that it does not know.
                if not isinstance(error, _PYSOEM_ERRORS) and type(error) is not Exception:
                    raise
                last = _texts([error])
            # An emergency in place of the answer is no failure, but a flood of them is.
            left -= not emergencies < self._emergency_count <= most_emergencies
        raise SetUpError(f"sensor {number} did not answer {what}: {last}; check cable and power")

    def _wait_state(self, state: AlState, check_interrupt: CheckInterrupt) -> None:
        for _ in range(round(times.STATE_S[state] / _STATE_CHECK_S)):
            check_interrupt()
            if self._master.state_check(int(state), round(_STATE_CHECK_S * 1e6)) == state:
                return
            # state_check wants the state itself; a slave that is above it is fine as well.
            self._master.read_state()
            if any(_al_status(s).error or s.state == pysoem.NONE_STATE for s in self._slaves):
                break
        raise SetUpError(self._state_complaint(state))

    def _state_complaint(self, state: AlState) -> str:
        self._master.read_state()
        for number, slave in enumerate(self._slaves):
            if slave.state != state:
                return (
                    f"sensor {number} does not reach {state.name}: it stays in {_al_status(slave)}; "
                    "power it off and on, then start again"
                )
        return f"the bus on {self.ifname} does not reach {state.name}: start again"


def _al_status(slave: Any) -> AlStatus:
    return AlStatus.of(slave.state, slave.al_status)


def _texts(errors: list[Any]) -> str:
    texts = [_text(error) for error in errors]
    meant = [text for text in texts if text and text != "No error"]
    return "; ".join(dict.fromkeys(meant)) or "no answer"


def _text(error: Any) -> str:
    if isinstance(error, pysoem.SdoError):
        return abort_meaning(error.abort_code & 0xFFFFFFFF)
    if str(error) == _UNEXPECTED:
        return "an emergency, or another message that was not asked for, came meanwhile"
    return str(getattr(error, "desc", None) or error).strip()
