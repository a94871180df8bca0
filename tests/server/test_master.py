"""The master in this process, where an interface has to go away at one certain moment."""

from __future__ import annotations

import contextlib
from typing import Any

import pytest

from ethercat_server.bus import Bus
from ethercat_server.errors import BusError
from ethercat_server.interface import claimed
from ethercat_server.raw_socket import packet_sockets
from tests.server.running import Veth, needs_bus, server, virtual_sensor
from tests.tool.running import one_sentence, tool

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


def test_whoever_was_first_keeps_all_others_out_before_it_has_opened_the_bus() -> None:
    with virtual_sensor("--signal", "rest") as (veth, _):
        with claimed(veth.near):
            said = one_sentence(tool("objects", veth.near, code=1))
            assert f"{veth.near} is in use by another EtherCAT master" in said
        with server(veth.near) as running:
            running.process.kill()
            running.wait()
            with server(veth.near):
                pass
        assert tool("objects", veth.near).code == 0
