"""Opens the bus on a network interface, through pysoem."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import claimed
from ethercat_server.ethercat.soem import SoemBackend


@contextlib.contextmanager
def open_bus(ifname: str, *, allow_ip: bool = False) -> Iterator[Bus]:
    """The open bus on `ifname`; its sensors go to INIT at the end. Errors as `claimed`."""
    with claimed(ifname, allow_ip=allow_ip):
        backend = SoemBackend(ifname)
        with contextlib.closing(Bus(backend)) as bus:
            backend.open()
            yield bus
