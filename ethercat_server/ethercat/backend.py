"""The seam between the server and an EtherCAT bus: what is needed of one, whatever answers on it.

Two backends have it: `soem.SoemBackend`, pysoem on a network interface, and
`simulation.backend.MemoryBackend`, in which the virtual sensor answers without sockets, processes or
real time. Everything above runs on either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from ethercat_server.ethercat.clock import Clock

CheckInterrupt = Callable[[], None]
"""Called while something takes long; may raise to give it up."""


class SlaveIdentity(NamedTuple):
    """What the SII of a slave says; zeros, and no name, if it cannot be read."""

    vendor: int
    product: int
    revision: int
    name: str


class Backend(Protocol):
    """An EtherCAT master on one wire: frames and time; and until OP, slaves by their number, from 0.

    Errors are BusErrors, each one sentence. Used by one thread.
    """

    ifname: str

    @property
    def clock(self) -> Clock:
        """The time that passes on it."""
        ...

    def open(self) -> None:
        """Open the wire. BusError if that fails."""
        ...

    def close(self) -> None:
        """Take the slaves to INIT if they were scanned, and close. May be called any number of times."""
        ...

    def check_present(self) -> None:
        """InterfaceError if the network interface is gone for good."""
        ...

    def why_silent(self) -> str:
        """Why no frame comes back, as far as the interface knows, and what to do: part of a sentence."""
        ...

    def send(self, frame: bytes | bytearray, /) -> None:
        """Send an Ethernet frame; one that cannot be sent is lost."""
        ...

    def receive(self, timeout_s: float, /) -> bytes | None:
        """The next EtherCAT frame from any sender; None if none arrives within `timeout_s`."""
        ...

    def scan(self, check_interrupt: CheckInterrupt, /) -> list[SlaveIdentity]:
        """Find the slaves, number them and request PREOP; BusError if none answers."""
        ...

    def check_preop(self, check_interrupt: CheckInterrupt, /) -> None:
        """Wait until every slave is in PREOP or above; BusError names one that is not."""
        ...

    def sdo_read(self, slave: int, index: int, subindex: int, /) -> bytes:
        """Upload an object; SdoAbortError if the slave refuses, BusError if it does not answer."""
        ...

    def sdo_write(self, slave: int, index: int, subindex: int, data: bytes, /) -> None:
        """Download an object; raises as `sdo_read`."""
        ...

    def map_process_data(self) -> list[int]:
        """Map the process data, request SAFEOP; returns each slave's input size in bytes."""
        ...

    def go_operational(self, check_interrupt: CheckInterrupt, /) -> None:
        """Take every slave to OP, exchanging process data; BusError names one that refuses."""
        ...
