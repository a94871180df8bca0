"""The EtherCAT bus in OP: exchanges, and single datagrams between them. How it gets there is in `soem.py`.

SOEM's traps on the way are kept in here: its receive whose timeout the kernel rounds up to a jiffy, and which
takes an older exchange's frame for this one's.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Final

from ethercat_server.errors import BusError
from ethercat_server.raw_socket import APRD, APWR, BRD, FPRD, FPWR, SOEM_INDICES
from ethercat_server.soem import Master

_DATAGRAM_TIMEOUT_S: Final = 0.002
_PATIENT_TIMEOUT_S: Final = 0.02
_LEAST_TIMEOUT_S: Final = 0.0003
_ANSWER_ATTEMPTS: Final = 3
_MOST_DOUBTS: Final = 4
_COLLECT_US: Final = 100


class Bus(Master):
    """An EtherCAT bus on one network interface. Used by one thread."""

    def __init__(self, ifname: str) -> None:
        super().__init__(ifname)
        self._careful = True
        """The last answer did not come in time, so an older frame may be on its way."""
        self._index: int | None = None
        """SOEM's number of the last exchange's frame, if it is known."""
        self._doubts = 0
        self._datagram_timeout_s = _PATIENT_TIMEOUT_S

    def send(self) -> None:
        """Send the process data; `receive` must follow. Only after `go_operational`."""
        self._master.send_processdata()

    def receive(self, timeout_s: float) -> int:
        """Wait at most `timeout_s` for the process data to come back; returns the working counter.

        -1 if the frame did not come back.
        """
        # SOEM's own wait ignores timeouts shorter than a jiffy, so wait here and let it only collect.
        self._socket.wait(timeout_s)
        if self._careful:
            return self._collect_carefully(timeout_s)
        if self._index is not None:
            self._index = (self._index + 1) % SOEM_INDICES
        wkc: int = self._master.receive_processdata(_COLLECT_US)
        self._careful = wkc < 0
        return wkc

    def _collect_carefully(self, timeout_s: float) -> int:
        """Collect this exchange's frame when an older one may come before it.

        Taken for this exchange's, an older one would make its own come too late for the next: every exchange
        would meet its predecessor's. Frames are told apart by SOEM's index; while that is not known, a
        failure waits until nothing is on its way any more.
        """
        if self._index is not None:
            self._index = (self._index + 1) % SOEM_INDICES
        found = self._socket.find(self._index, timeout_s)
        wkc: int = self._master.receive_processdata(_COLLECT_US)
        if wkc >= 0 and found is not None:
            self._index, self._careful, self._doubts = found, False, 0
        elif found is None and self._index is not None:
            # Its own did not come. Once it may be late itself; more often, the count is wrong.
            self._doubts += 1
            if self._doubts >= _MOST_DOUBTS:
                self._index = None
        elif wkc < 0:
            self._index = None
        if wkc < 0 and self._index is None:
            self._socket.drop(timeout_s)
        return wkc

    def working_counter(self, slave: int) -> int:
        """What `slave` adds to the working counter of an exchange: 2 for its outputs, 1 for its inputs."""
        return 2 * bool(self._slaves[slave].output) + bool(self._slaves[slave].input)

    def process_data(self, slave: int) -> bytes:
        """The inputs of `slave` as of the last exchange, byte for byte."""
        data: bytes = self._slaves[slave].input
        return data

    def be_patient(self, patient: bool) -> None:
        """Whether single datagrams may take long: no sensor is left that would have to wait for them."""
        self._datagram_timeout_s = _PATIENT_TIMEOUT_S if patient else _DATAGRAM_TIMEOUT_S

    def read_register(self, slave: int, address: int, size: int) -> bytes | None:
        """Read ESC registers or a mailbox of `slave` with one datagram; None if it did not do it."""
        wkc, data = self._datagram(FPRD, slave, address, bytes(size))
        return data if wkc == 1 else None

    def write_register(self, slave: int, address: int, data: bytes) -> bool:
        """Write ESC registers or a mailbox of `slave` with one datagram; False if it did not do it."""
        return self._datagram(FPWR, slave, address, data)[0] == 1

    def count_slaves(self, size: int, timeout_s: float) -> int:
        """How many slaves answer a broadcast read of `size` bytes from register 0 on; -1 if it is lost.

        Needs no scan and changes nothing, so it also tells how long a frame of that size takes.
        """
        answer = self._socket.datagram(BRD, 0, 0, bytes(size), timeout_s)
        return -1 if answer is None else answer[0]

    def read_at(self, place: int, address: int, size: int) -> bytes | None:
        """Read ESC registers of the slave at `place` on the bus, scanned or not; None if it did not do it."""
        answer = self._socket.datagram(APRD, -place & 0xFFFF, address, bytes(size), _PATIENT_TIMEOUT_S)
        return answer[1] if answer is not None and answer[0] == 1 else None

    def write_at(self, place: int, address: int, data: bytes) -> bool:
        """Write ESC registers of the slave at `place` on the bus, scanned or not; False if it did not."""
        answer = self._socket.datagram(APWR, -place & 0xFFFF, address, data, _PATIENT_TIMEOUT_S)
        return answer is not None and answer[0] == 1

    def _datagram(self, command: int, slave: int, address: int, data: bytes) -> tuple[int, bytes]:
        station = self._stations[slave]
        answer = self._socket.datagram(command, station, address, data, self._datagram_timeout_s)
        if answer is None:
            self._careful = True  # it may still come
            return -1, b""
        return answer

    def check_answers(self, slave: int) -> None:
        """BusError if `slave` does not answer any more."""
        if all(self.read_register(slave, 0, 1) is None for _ in range(_ANSWER_ATTEMPTS)):
            raise BusError(f"sensor {slave} stopped answering while it was set up: check cable and power")

    @contextlib.contextmanager
    def in_time(self, until_ns: int) -> Iterator[None]:
        """Within it, single datagrams wait no longer than until then: an exchange is due."""
        usual, left_s = self._datagram_timeout_s, (until_ns - time.monotonic_ns()) * 1e-9
        self._datagram_timeout_s = min(usual, max(_LEAST_TIMEOUT_S, left_s))
        try:
            yield
        finally:
            self._datagram_timeout_s = usual

    def reclaim(self, slave: int) -> bool:
        """Give a slave that lost its station address (its power was cut) the address back.

        True if the slave at that place now has it. SOEM checks vendor, product and revision; who the
        sensor is remains to be asked.
        """
        self._careful, self._index = True, None
        self._socket.set_blocking(True)  # SOEM waits by itself
        recovered = self._slaves[slave].recover(int(self._datagram_timeout_s * 1e6)) > 0
        self._socket.set_blocking(False)
        return bool(recovered)
