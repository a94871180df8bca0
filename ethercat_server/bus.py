"""The EtherCAT bus: the only file that knows pysoem.

Everything pysoem raises is translated here, and its traps are kept in here: the descriptor it leaks on a
failed open, its close that must happen once, its receive whose timeout the kernel rounds up to a jiffy,
and its error ring, which can hand one call's error to the next.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import socket
import stat
import threading
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import pysoem

from ethercat_server.errors import BusError, SdoAbortError

_SDO_ATTEMPTS: Final = 3
_OP_TIMEOUT_S: Final = 10.0
_DATAGRAM_TIMEOUT_US: Final = 2000
_FRAME_INDICES: Final = 16
"""SOEM numbers its frames modulo this."""
_INDEX_OFFSET: Final = 17
"""Where a frame has its number: behind the Ethernet header (14), the EtherCAT header (2) and the command."""
_MOST_DOUBTS: Final = 4
_COLLECT_US: Final = 100
_SCAN_TIMEOUT_S: Final = 15.0
_STATE_ATTEMPTS: Final = {"PREOP": 80, "SAFEOP": 200}
"""Of 50 ms each."""
_PYSOEM_ERRORS: Final = (
    pysoem.SdoError,
    pysoem.Emergency,
    pysoem.MailboxError,
    pysoem.PacketError,
    pysoem.WkcError,
    pysoem.ConfigMapError,
    pysoem.EepromError,
    pysoem.NetworkInterfaceNotOpenError,
)
log = logging.getLogger(__name__)
_STATE_NAMES: Final = {0: "NONE", 1: "INIT", 2: "PREOP", 3: "BOOT", 4: "SAFEOP", 8: "OP"}


class SlaveIdentity(NamedTuple):
    """What the SII of a slave says."""

    vendor: int
    product: int
    revision: int
    name: str


class Bus:
    """An EtherCAT bus on one network interface. Used by one thread."""

    def __init__(self, ifname: str) -> None:
        self.ifname = ifname
        self.ifindex = 0
        self.expected_wkc = 0
        self._master: Any = pysoem.Master()
        self._slaves: list[Any] = []
        self._opened = False
        self._abandoned = False
        """A thread that never ended still uses the socket: it must not be closed."""
        self._fd = -1
        self._careful = True
        """The last answer did not come in time, so an older frame may be on its way."""
        self._index = 0
        """SOEM's number of the last frame sent; it counts every datagram it sends."""
        self._index_known = False
        self._doubts = 0

    def open(self) -> None:
        """Open the raw socket. BusError if that fails; `interface.check_interface` says why beforehand."""
        before = _packet_sockets()
        try:
            self._master.open(self.ifname)
        except ConnectionError:
            for fd in _packet_sockets() - before:
                os.close(fd)
            raise BusError(
                f"cannot open {self.ifname} for EtherCAT: it went away or may not be opened; "
                "check 'ip link' and the permissions"
            ) from None
        self._opened = True
        self.ifindex = socket.if_nametoindex(self.ifname)
        self._fd = (_packet_sockets() - before).pop()
        self._socket = socket.socket(fileno=os.dup(self._fd))
        # Until SOEM had bound it to the interface, it took in the EtherCAT frames of all others.
        self._set_blocking(False)
        self._drop_frames(0)
        self._set_blocking(True)

    def scan(self, check_interrupt: Callable[[], None]) -> list[SlaveIdentity]:
        """Find the slaves and take them to PREOP; BusError if none answers.

        `check_interrupt` is called while waiting and may raise to give up.
        """
        self._set_blocking(True)
        if self._config_init(check_interrupt) <= 0:
            raise BusError(
                f"no EtherCAT slave answers on {self.ifname}: check the cable, that the sensor has power and "
                "that this is the interface it is connected to"
            )
        self._slaves = list(self._master.slaves)
        for slave in self._slaves:
            slave.add_emergency_callback(_log_emergency)
        return [SlaveIdentity(s.man, s.id, s.rev, s.name) for s in self._slaves]

    def _config_init(self, check_interrupt: Callable[[], None]) -> int:
        # SOEM tries every byte of the SII for long if a slave goes away meanwhile, two minutes in all, and no
        # signal is noticed before it returns. So it runs in a thread, which can be left behind.
        counts: list[int] = []
        thread = threading.Thread(
            target=lambda: counts.append(self._master.config_init(release_gil=True)), daemon=True
        )
        thread.start()
        deadline = time.monotonic() + _SCAN_TIMEOUT_S
        self._abandoned = True
        while thread.is_alive():
            thread.join(0.05)
            check_interrupt()
            if time.monotonic() > deadline:
                raise BusError(
                    f"the scan of {self.ifname} does not end: a slave stopped answering in its middle; "
                    "check cable and power, then start again"
                )
        self._abandoned = False
        return counts[0] if counts else 0

    def check_preop(self) -> None:
        """Wait until every slave is in PREOP or above; BusError names one that is not."""
        self._wait_state(pysoem.PREOP_STATE, "PREOP")

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

    def check_answers(self, slave: int) -> None:
        """BusError if `slave` does not answer any more."""
        if all(self.read_register(slave, 0, 1) is None for _ in range(_SDO_ATTEMPTS)):
            raise BusError(f"sensor {slave} stopped answering while it was set up: check cable and power")

    def go_operational(self) -> None:
        """Take every slave to OP, exchanging process data all the while; BusError names one that refuses."""
        self._wait_state(pysoem.SAFEOP_STATE, "SAFEOP")
        self._master.state = pysoem.OP_STATE
        self._master.write_state()
        deadline = time.monotonic() + _OP_TIMEOUT_S
        while time.monotonic() < deadline:
            for _ in range(5):
                self._master.send_processdata()
                self._master.receive_processdata(2000)
            if self._master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE:
                self._set_blocking(False)
                return
        raise BusError(self._state_complaint(pysoem.OP_STATE, "OP"))

    def exchange(self, timeout_s: float) -> int:
        """Send the process data, wait at most `timeout_s` for it to come back; returns the working counter.

        -1 if the frame did not come back. Only after `go_operational`.
        """
        self._master.send_processdata()
        self._index = (self._index + 1) % _FRAME_INDICES
        # SOEM's own wait ignores timeouts shorter than a jiffy, so wait here and let it only collect.
        select.select((self._fd,), (), (), timeout_s)
        if self._careful:
            return self._collect_carefully(timeout_s)
        wkc: int = self._master.receive_processdata(_COLLECT_US)
        self._careful = wkc < 0
        return wkc

    def _collect_carefully(self, timeout_s: float) -> int:
        """Collect this exchange's frame when an older one may come before it.

        Taken for this exchange's, an older one would make its own come too late for the next: every exchange
        would meet its predecessor's. Frames are told apart by SOEM's index; while that is not known, a
        failure waits until nothing is on its way any more.
        """
        found = self._find_frame(timeout_s)
        wkc: int = self._master.receive_processdata(_COLLECT_US)
        if wkc >= 0 and found is not None:
            self._index, self._index_known, self._careful, self._doubts = found, True, False, 0
        elif wkc < 0 and (found is not None or not self._index_known):
            self._index_known = False
            self._drop_frames(timeout_s)
        return wkc

    def _find_frame(self, timeout_s: float) -> int | None:
        """The index of the frame that is next to be received, others than this exchange's dropped if known.

        Waits at most `timeout_s` for it; None if none comes.
        """
        deadline = time.monotonic() + timeout_s
        with contextlib.suppress(OSError):  # nothing there any more, or the link is down
            while True:
                head = self._socket.recv(_INDEX_OFFSET + 1, socket.MSG_PEEK)
                if len(head) > _INDEX_OFFSET and (
                    not self._index_known or head[_INDEX_OFFSET] == self._index
                ):
                    return head[_INDEX_OFFSET]
                self._socket.recv(1)
                left = deadline - time.monotonic()
                if left <= 0 or not select.select((self._fd,), (), (), left)[0]:
                    # Its own did not follow. Once it may be late itself; more often, the count is wrong.
                    self._doubts += 1
                    self._index_known = self._index_known and self._doubts < _MOST_DOUBTS
                    break
        return None

    def _drop_frames(self, quiet_s: float) -> None:
        """Drop everything that comes until nothing has come for `quiet_s`, within bounds."""
        with contextlib.suppress(OSError):
            for _ in range(_FRAME_INDICES):
                if not select.select((self._fd,), (), (), quiet_s)[0]:
                    break
                self._socket.recv(1)

    def working_counter(self, slave: int) -> int:
        """What `slave` adds to the working counter of an exchange: 2 for its outputs, 1 for its inputs."""
        return 2 * bool(self._slaves[slave].output) + bool(self._slaves[slave].input)

    def process_data(self, slave: int) -> bytes:
        """The inputs of `slave` as of the last exchange, byte for byte."""
        data: bytes = self._slaves[slave].input
        return data

    def read_register(self, slave: int, address: int, size: int) -> bytes | None:
        """Read ESC registers or a mailbox of `slave` with one datagram; None if it did not do it."""
        self._index = (self._index + 1) % _FRAME_INDICES
        try:
            data: bytes = self._slaves[slave]._fprd(address, size, _DATAGRAM_TIMEOUT_US)
        except pysoem.WkcError:
            self._careful = True  # it may still come
            return None
        return data

    def write_register(self, slave: int, address: int, data: bytes) -> bool:
        """Write ESC registers or a mailbox of `slave` with one datagram; False if it did not do it."""
        self._index = (self._index + 1) % _FRAME_INDICES
        try:
            self._slaves[slave]._fpwr(address, data, _DATAGRAM_TIMEOUT_US)
        except pysoem.WkcError:
            self._careful = True
            return False
        return True

    def reclaim(self, slave: int) -> bool:
        """Give a slave that lost its station address (its power was cut) the address back.

        True if the slave at that place now has it. SOEM checks vendor, product and revision; who the
        sensor is remains to be asked.
        """
        self._careful, self._index_known = True, False
        return bool(self._slaves[slave].recover(_DATAGRAM_TIMEOUT_US) > 0)

    def close(self) -> None:
        """Take the slaves to INIT and close the socket. May be called at any time, any number of times."""
        if not self._opened or self._abandoned:
            return
        self._opened = False
        with contextlib.suppress(*_PYSOEM_ERRORS):
            self._set_blocking(True)
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

    def _wait_state(self, state: int, name: str) -> None:
        for _ in range(_STATE_ATTEMPTS[name]):
            if self._master.state_check(state, 50_000) == state:
                return
            # state_check wants the state itself; a slave that is above it is fine as well.
            self._master.read_state()
            if any(s.state & pysoem.STATE_ERROR or s.state == pysoem.NONE_STATE for s in self._slaves):
                break
        raise BusError(self._state_complaint(state, name))

    def _state_complaint(self, state: int, name: str) -> str:
        self._master.read_state()
        for place, slave in enumerate(self._slaves):
            if slave.state != state:
                found = _STATE_NAMES.get(slave.state & 0x0F, f"state {slave.state}")
                why = ""
                if slave.state & pysoem.STATE_ERROR:
                    why = f" with AL status 0x{slave.al_status:04X} ("
                    why += pysoem.al_status_code_to_string(slave.al_status).strip() + ")"
                return (
                    f"sensor {place} does not reach {name}: it stays in {found}{why}; "
                    "power it off and on, then start again"
                )
        return f"the bus on {self.ifname} does not reach {name}: start again"

    def _set_blocking(self, blocking: bool) -> None:
        # Blocking for SOEM's own waits, which would otherwise spin; non-blocking for `exchange`.
        os.set_blocking(self._fd, blocking)


def _log_emergency(emergency: Any) -> None:
    log.warning(
        "sensor %d reports an emergency: error code 0x%04X", emergency.slave_pos - 1, emergency.error_code
    )


def _packet_sockets() -> set[int]:
    """Descriptors of this process that are AF_PACKET sockets."""
    found = set()
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - plain descriptor numbers
        fd = int(name)
        try:
            if not stat.S_ISSOCK(os.fstat(fd).st_mode):
                continue
        except OSError:
            continue  # the descriptor of the listing itself
        with socket.socket(fileno=os.dup(fd)) as duplicate:
            if duplicate.family == socket.AF_PACKET:
                found.add(fd)
    return found


def _texts(errors: list[Any]) -> str:
    texts = [str(getattr(error, "desc", None) or error).strip() for error in errors]
    meant = [text for text in texts if text and text != "No error"]
    return "; ".join(dict.fromkeys(meant)) or "no answer"
