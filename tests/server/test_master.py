"""The master in this process, where an interface has to go away at one certain moment."""

from __future__ import annotations

import contextlib
from typing import Any

import pytest

from ethercat_server.bus import Bus
from ethercat_server.errors import BusError
from ethercat_server.raw_socket import packet_sockets
from tests.server.running import Veth, needs_bus

pytestmark = [pytest.mark.bus, needs_bus]


class Gone:
    """SOEM, whose interface is taken away the moment it is open."""

    def __init__(self, master: Any, veth: Veth) -> None:
        self._master, self._veth = master, veth

    def open(self, ifname: str) -> None:
        self._master.open(ifname)
        self._veth.ip("link", "del", ifname)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._master, name)


def test_an_interface_that_goes_away_while_it_is_opened() -> None:
    with Veth() as veth:
        before = packet_sockets()
        bus = Bus(veth.near)
        bus._master = Gone(bus._master, veth)
        with contextlib.closing(bus), pytest.raises(BusError, match=f"the interface {veth.near} went away"):
            bus.open()
        assert packet_sockets() == before
