"""The seam between the server and an EtherCAT bus: what is needed of one, whatever answers on it.

Two backends have it: `master.soem.SoemBackend`, a network interface opened by pysoem, and
`simulation.backend.MemoryBackend`, in which the virtual sensor answers without sockets, processes or
real time. Two masters set the sensors up: pysoem where there are only sensors, and
`master.datagrams.DatagramMaster` where they share the wire. Everything above runs on any of these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from ethercat_server.ethercat.clock import Clock

CheckInterrupt = Callable[[], None]
"""Called while something takes long; may raise to give it up."""


class Master(Protocol):
    """Takes the sensors to OP. They are numbered from 0; the master writes to no other slave.

    Errors are BusErrors, each one sentence. Used by one thread.
    """

    def scan(self, positions: Sequence[int], check_interrupt: CheckInterrupt, /) -> None:
        """Give a station address to the sensors, which are at these positions on the wire."""
        ...

    def enter_preop(self, check_interrupt: CheckInterrupt, /) -> None:
        """Take every sensor to PREOP; BusError names one that does not go there."""
        ...

    def sdo_read(self, number: int, index: int, subindex: int, /) -> bytes:
        """Upload an object; SdoAbortError if the sensor refuses, BusError if it does not answer."""
        ...

    def sdo_write(self, number: int, index: int, subindex: int, data: bytes, /) -> None:
        """Download an object; raises as `sdo_read`."""
        ...

    def map_process_data(self, check_interrupt: CheckInterrupt, /) -> list[int]:
        """Map the process data and request SAFEOP; returns each sensor's input size in bytes."""
        ...

    def go_operational(self, check_interrupt: CheckInterrupt, /) -> None:
        """Take every sensor to OP, exchanging process data; BusError names one that refuses."""
        ...

    def release(self) -> None:
        """Take the sensors to INIT, if they were scanned."""
        ...


class Backend(Protocol):
    """One wire: frames and time. Errors are BusErrors, each one sentence. Used by one thread."""

    ifname: str

    @property
    def master(self) -> Master | None:
        """A master of its own, which may be used where there are sensors only; None if it has none."""
        ...

    @property
    def clock(self) -> Clock:
        """The time that passes on it."""
        ...

    def open(self) -> None:
        """Open the wire. BusError if that fails."""
        ...

    def close(self) -> None:
        """Close the wire. May be called any number of times."""
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

    def arrived_ns(self) -> int:
        """CLOCK_MONOTONIC when the frame that was received last had arrived; 0 or wrong if unknown."""
        ...
