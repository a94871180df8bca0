"""The backend and the master on pysoem: socket, scan, mapping. The only file that knows pysoem.

What pysoem raises is translated here, and its traps end here: the descriptor that a failed open leaks, the
close that must happen once, the scan that may take minutes, the mapping's error ring. SOEM waits for single
datagrams in jiffies, and exchanges one frame at a time; so the server's own frames use its AF_PACKET socket
directly, with indices that SOEM does not use and discards.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import pysoem

from ethercat_server.errors import BusError, InterfaceError, SetUpError
from ethercat_server.ethercat import nic
from ethercat_server.ethercat.backend import CheckInterrupt, Master
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.slave.coe import abort_meaning

_LONGEST_FRAME: Final = 1514
_DONT_WAIT: Final = int(socket.MSG_DONTWAIT)
_SCAN_TIMEOUT_S: Final = 15.0
_IMAGE_BYTES: Final = 4096  # of pysoem's process image, which pysoem does not check
_PYSOEM_ERRORS: Final = (
    pysoem.SdoError,
    pysoem.Emergency,
    pysoem.MailboxError,
    pysoem.PacketError,
    pysoem.WkcError,
    pysoem.ConfigMapError,
    pysoem.NetworkInterfaceNotOpenError,
)
# How pysoem reports unexpected entries of its error ring after a mapping.
_UNEXPECTED: Final = "unexpected error"


class SoemBackend:
    """See `Backend` and `Master`: pysoem on an interface that `nic.claimed` has checked."""

    def __init__(self, ifname: str) -> None:
        self._ifname = ifname  # any of its names, and then the last that it had
        self.clock = SYSTEM_CLOCK
        self.master: Master | None = self
        self._ifindex = 0
        self._master: Any = pysoem.Master()
        self._opened = False
        self._abandoned = False  # a thread that never ended still uses the socket: it must not be closed
        self._fd: int  # SOEM's AF_PACKET socket, and a second handle to it
        self._socket: socket.socket

    @property
    def ifname(self) -> str:
        """The name that it has now."""
        if self._ifindex:
            self._ifname = nic.own_name(self._ifindex, self._ifname)
        return self._ifname

    def open(self) -> None:
        before, flags = packet_sockets(), nic.IFF_PROMISC
        with contextlib.suppress(InterfaceError):  # it cannot be opened either
            flags = nic.change_flags(nic.look_up(self._ifname).ifindex)
        try:
            self._master.open(nic.own_name(self._ifname))
        except ConnectionError:
            for fd in packet_sockets() - before:
                os.close(fd)
            raise BusError(
                f"cannot open {self.ifname} for EtherCAT: it went away or may not be opened; "
                "check 'ip link' and the permissions"
            ) from None
        self._opened = True
        self._fd = (packet_sockets() - before).pop()
        self._socket = socket.socket(fileno=os.dup(self._fd))
        try:
            self._ifindex = nic.look_up(self._ifname).ifindex
        except InterfaceError:
            raise BusError(f"the interface {self.ifname} went away: connect it and start again") from None
        if not flags & nic.IFF_PROMISC:  # SOEM would leave it so, and all that is for us is broadcast
            nic.change_flags(self._ifindex, off=nic.IFF_PROMISC)
        # Until SOEM had bound it to the interface, it received the EtherCAT frames of all others.
        while self.receive(0) is not None:
            pass

    def send(self, frame: bytes | bytearray) -> None:
        try:
            self._socket.send(frame, _DONT_WAIT)
        except OSError:  # the link is down: it is lost
            return

    def receive(self, timeout_s: float) -> bytes | None:
        try:
            # SO_RCVTIMEO is rounded up to jiffies, the time-out of `socket` to milliseconds; this is not.
            if timeout_s <= 0 or select.select((self._fd,), (), (), timeout_s)[0]:
                return self._socket.recv(_LONGEST_FRAME, _DONT_WAIT)
        except OSError:  # there is none, or the link is down
            return None
        return None

    def arrived_ns(self) -> int:
        return nic.arrived_ns(self._fd)

    def check_present(self) -> None:
        nic.check_present(self._ifindex, self._ifname)

    def why_silent(self) -> str:
        return nic.why_silent(self.ifname)

    def scan(self, positions: Sequence[int], check_interrupt: CheckInterrupt) -> None:
        # If a slave disappears during the scan, SOEM retries every byte of its SII, for two minutes, and no
        # signal is noticed before it returns. So it runs in a thread, which can be abandoned.
        counts: list[int] = []
        thread = threading.Thread(
            target=lambda: counts.append(self._master.config_init(release_gil=True)), daemon=True
        )
        thread.start()
        deadline = time.monotonic() + _SCAN_TIMEOUT_S
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
        count = max(counts, default=0)
        if count != len(positions):
            raise SetUpError(
                f"{max(count, 0)} of {len(positions)} slaves on {self.ifname} answered the scan: check cable "
                "and power"
            )

    def map_process_data(self, check_interrupt: CheckInterrupt) -> None:
        """SOEM requests SAFEOP, too."""
        check_interrupt()
        try:
            mapped = self._master.config_map()
        except pysoem.ConfigMapError as error:
            raise self._unmapped(_texts(error.error_list)) from None
        except _PYSOEM_ERRORS as error:
            raise self._unmapped(_texts([error])) from None
        if mapped > _IMAGE_BYTES:
            raise self._unmapped(f"its slaves say that they have {mapped} bytes")

    def _unmapped(self, why: str) -> SetUpError:
        return SetUpError(
            f"the process data of {self.ifname} cannot be mapped: {why}; power the sensor off and on, then "
            "start again"
        )

    def close(self) -> None:
        if not self._opened or self._abandoned:
            return
        self._opened = False
        self._socket.close()
        self._master.close()


@contextlib.contextmanager
def open_bus(ifname: str, *, allow_ip: bool) -> Iterator[Bus]:
    """The open bus on `ifname`; its sensors go to INIT at the end. Errors as `claimed`."""
    with nic.claimed(ifname, allow_ip=allow_ip):
        backend = SoemBackend(ifname)
        with contextlib.closing(Bus(backend)) as bus:
            backend.open()
            yield bus


def _texts(errors: list[Any]) -> str:
    texts = [_text(error) for error in errors]
    meant = [text for text in texts if text and text != "No error"]
    return "; ".join(dict.fromkeys(meant)) or "no answer"


def _text(error: Any) -> str:
    if isinstance(error, pysoem.SdoError):
        return abort_meaning(error.abort_code & 0xFFFFFFFF)
    if str(error) == _UNEXPECTED:
        return "an emergency, or another message besides the answers, arrived"
    return str(getattr(error, "desc", None) or error).strip()


def packet_sockets() -> set[int]:
    """Descriptors of this process that are AF_PACKET sockets."""
    targets = {f"socket:[{row.inode}]" for row in nic.packet_sockets()}
    found = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # that of the listing itself
            if str(descriptor.readlink()) in targets:
                found.add(int(descriptor.name))
    return found
