"""The interface between the server and an EtherCAT bus.

Two backends implement it: `soem.SoemBackend`, a network interface opened by pysoem, and
`simulation.backend.MemoryBackend`, in which the virtual sensor answers without sockets, processes or
real time. pysoem scans and maps the sensors where it can, `mapping` in memory and where they share
the wire. Everything above runs on any of these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from ethercat_server.ethercat.clock import Clock

CheckInterrupt = Callable[[], None]  # called during long operations; may raise to abort them


class Master(Protocol):
    """The backend's own master, for a bus of sensors only: it writes to every slave.

    Errors are BusErrors, each one sentence. Used by one thread.
    """

    def scan(self, positions: Sequence[int], check_interrupt: CheckInterrupt, /) -> None:
        """Give station addresses and mailboxes to the sensors, which are at these positions on the wire."""

    def map_process_data(self, check_interrupt: CheckInterrupt, /) -> None:
        """Write sync managers and FMMUs of the sensors, which are in PREOP."""


class Backend(Protocol):
    """One wire: frames and time. Errors are BusErrors, each one sentence. Used by one thread."""

    @property
    def ifname(self) -> str:
        """Name of the interface, for people; it may be renamed."""

    @property
    def master(self) -> Master | None:
        """The backend's own master; None if it has none."""

    @property
    def clock(self) -> Clock:
        """The clock of this bus."""

    def open(self) -> None:
        """Open the wire. BusError if that fails."""

    def close(self) -> None:
        """Close the wire. May be called any number of times."""

    def check_present(self) -> None:
        """InterfaceError if the network interface has been removed."""

    def why_silent(self) -> str:
        """The interface's part in frames not coming back, and what to do: part of a sentence."""

    def send(self, frame: bytes | bytearray, /) -> None:
        """Send an Ethernet frame; one that cannot be sent is lost."""

    def receive(self, timeout_s: float, /) -> bytes | None:
        """The next EtherCAT frame from any sender; None if none arrives within `timeout_s`."""

    def arrived_ns(self) -> int:
        """CLOCK_MONOTONIC_RAW when the frame received last had arrived; 0 or wrong if unknown."""
