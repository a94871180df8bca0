"""The seam between the server and an EtherCAT bus: what is needed of one, whatever answers on it.

Two backends have it: `soem.SoemBackend`, a network interface opened by pysoem, and
`simulation.backend.MemoryBackend`, in which the virtual sensor answers without sockets, processes or
real time. pysoem scans and maps the sensors where it can, `mapping` in memory and where they share
the wire. Everything above runs on any of these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from ethercat_server.ethercat.clock import Clock

CheckInterrupt = Callable[[], None]  # called while something takes long; may raise to give it up


class Master(Protocol):
    """A master of the backend's own, for a wire with nothing but sensors: it writes to every slave.

    Errors are BusErrors, each one sentence. Used by one thread.
    """

    def scan(self, positions: Sequence[int], check_interrupt: CheckInterrupt, /) -> None:
        """Give station addresses and mailboxes to the sensors, which are at these positions on the wire."""

    def map_process_data(self, check_interrupt: CheckInterrupt, /) -> None:
        """Write sync managers and FMMUs of the sensors, which are in PREOP."""


class Backend(Protocol):
    """One wire: frames and time. Errors are BusErrors, each one sentence. Used by one thread."""

    ifname: str

    @property
    def master(self) -> Master | None:
        """None if it has none."""

    @property
    def clock(self) -> Clock:
        """The time that passes on it."""

    def open(self) -> None:
        """Open the wire. BusError if that fails."""

    def close(self) -> None:
        """Close the wire. May be called any number of times."""

    def check_present(self) -> None:
        """InterfaceError if the network interface is gone for good."""

    def why_silent(self) -> str:
        """Why no frame comes back, as far as the interface knows, and what to do: part of a sentence."""

    def send(self, frame: bytes | bytearray, /) -> None:
        """Send an Ethernet frame; one that cannot be sent is lost."""

    def receive(self, timeout_s: float, /) -> bytes | None:
        """The next EtherCAT frame from any sender; None if none arrives within `timeout_s`."""

    def arrived_ns(self) -> int:
        """CLOCK_MONOTONIC when the frame that was received last had arrived; 0 or wrong if unknown."""
