"""The master in this process, where an interface has to go away at one certain moment."""

from __future__ import annotations

import contextlib
from typing import Any

import pytest

from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.daemon.options import ServerOptions
from ethercat_server.errors import BusError, StopRequestedError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import claimed
from ethercat_server.ethercat.raw_socket import packet_sockets
from ethercat_server.ethercat.soem import SoemBackend
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
        backend = SoemBackend(veth.near)
        backend._master = Gone(backend._master, veth)
        with (
            contextlib.closing(backend),
            pytest.raises(BusError, match=f"the interface {veth.near} went away"),
        ):
            backend.open()
        assert packet_sockets() == before


class Asked(SoemBackend):
    """A bus that the start is to give up on after a certain transfer."""

    def __init__(self, ifname: str, last: str) -> None:
        super().__init__(ifname)
        self.last = last
        self.transfers: list[str] = []

    def sdo_read(self, slave: int, index: int, subindex: int) -> bytes:
        self.transfers.append("read")
        return super().sdo_read(slave, index, subindex)

    def sdo_write(self, slave: int, index: int, subindex: int, data: bytes) -> None:
        self.transfers.append("write")
        super().sdo_write(slave, index, subindex, data)

    def check_interrupt(self) -> None:
        if self.last in self.transfers:
            raise StopRequestedError("asked to stop while starting")


@pytest.mark.parametrize("last", ["read", "write"])
def test_a_start_is_given_up_between_two_transfers(last: str) -> None:
    with virtual_sensor() as (veth, _), contextlib.closing(Asked(veth.near, last)) as backend:
        backend.open()
        options = ServerOptions(veth.near, 1, assigned_settings={"fir": True})
        with pytest.raises(StopRequestedError):
            bring_up(Bus(backend), options, backend.check_interrupt)
        assert backend.transfers.index(last) == len(backend.transfers) - 1, "nothing after it"


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
