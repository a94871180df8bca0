"""The master in this process, on a real interface: what pysoem makes of odd slaves, and of its interface."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.errors import BusError, StopRequestedError
from ethercat_server.ethercat import soem
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import claimed
from ethercat_server.ethercat.raw_socket import packet_sockets
from ethercat_server.ethercat.soem import SoemBackend
from ethercat_server.sensor.sensor import Sensor
from protocol.settings import SettingValue
from tests.server.commands import command, stats
from tests.server.running import (
    ATTEMPTS,
    Program,
    Veth,
    needs_bus,
    server,
    starved,
    virtual_sensor,
    wait_until,
)
from tests.simulation import Asked
from tests.tool.running import one_sentence, tool

pytestmark = [pytest.mark.bus, needs_bus]
Bench = tuple[Veth, Program]


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with virtual_sensor(module="tests.server.odd_sensor") as found:
        yield found


def started(
    ifname: str,
    check_interrupt: CheckInterrupt = lambda: None,
    settings: Mapping[str, SettingValue] = {},
    backend: type[SoemBackend] = SoemBackend,
) -> list[Sensor]:
    """Start and end; again where the sensor's process had to wait for too long."""
    for attempt in range(ATTEMPTS):
        with contextlib.closing(backend(ifname)) as opened:
            opened.open()
            try:
                return bring_up(Bus(opened), Asked(settings), check_interrupt)
            except BusError as error:
                if attempt == ATTEMPTS - 1 or not starved(str(error)):
                    raise
    raise AssertionError("unreachable")


def complaint(ifname: str, settings: Mapping[str, SettingValue] = {}) -> str:
    """Why a start fails."""
    with pytest.raises(BusError) as info:
        started(ifname, settings=settings)
    return str(info.value)


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


@pytest.mark.parametrize("how", ["error", pytest.param("busy", marks=pytest.mark.long)])
def test_an_eeprom_that_cannot_be_read(bench: Bench, how: str) -> None:
    """SOEM has time-outs of its own: 2 s if each read ends with an error, 11 s if each stays busy."""
    veth, sensor = bench
    command(sensor, f"sii {how}")
    said = complaint(veth.near)
    command(sensor, "sii ok")
    assert f"the SII (EEPROM) of the slave at position 0 of {veth.near} cannot be read" in said


def test_a_name_that_is_no_utf_8_and_a_slave_without_a_mailbox(bench: Bench) -> None:
    """pysoem raises UnicodeDecodeError for the one, and for the other what it finds in its error ring."""
    veth, sensor = bench
    command(sensor, "eeprom latin")
    assert [found.identity.name for found in started(veth.near)] == ["BFT-SENS-ECAT-M8"]
    command(sensor, "eeprom no-mailbox")
    said = complaint(veth.near)
    command(sensor, "eeprom ok")
    assert f"sensor 0 on {veth.near} has no CoE mailbox, and so no objects to set it up by" in said


def test_an_object_that_aborts_is_named(bench: Bench) -> None:
    """An SDO abort as pysoem raises it; INIT as it asks for it."""
    veth, sensor = bench
    command(sensor, "abort 0x8006 1 0x06090030")
    said = complaint(veth.near, {"sinc_length": 128})
    assert "sinc_length = 128 did not take" in said
    assert "0x06090030" in said
    wait_until(lambda: stats(sensor)["al_state"] == "INIT", "INIT")


def test_a_slave_that_vanishes_during_the_scan_does_not_hang_the_server(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SOEM would try on for two minutes, in its thread, until the slave is there again."""
    veth, sensor = bench
    threads = threading.active_count()
    monkeypatch.setattr(soem, "_SCAN_TIMEOUT_S", 1.0)
    with contextlib.closing(SoemBackend(veth.near)) as backend:
        backend.open()
        for _ in range(ATTEMPTS):
            command(sensor, "hear")
            command(sensor, "deaf-after 40")  # in the middle of reading the SII
            with pytest.raises(BusError) as info:
                backend.scan(lambda: None)
            if "no EtherCAT slave answers" not in str(info.value):
                break
        assert f"the scan of {veth.near} does not end: a slave stopped answering" in str(info.value)
        backend.close()  # not from under SOEM
        command(sensor, "hear")
        wait_until(lambda: threading.active_count() == threads, "the end of SOEM's scan")
        backend._abandoned = False


@pytest.mark.parametrize("state", [2, 4, 8])
def test_a_start_is_given_up_while_a_sensor_does_not_change_its_state(bench: Bench, state: int) -> None:
    """Without waiting until the sensor has had its time and is blamed."""
    veth, sensor = bench
    before, threads, sockets = len(sensor.said()), threading.active_count(), packet_sockets()
    command(sensor, f"ignore {state}")

    def check_interrupt() -> None:
        if "ignored" in sensor.said()[before:] and threading.active_count() == threads:  # the scan has ended
            raise StopRequestedError

    try:
        with pytest.raises(StopRequestedError):
            started(veth.near, check_interrupt)
    finally:
        command(sensor, "ignore 0")
    assert packet_sockets() == sockets
    wait_until(lambda: stats(sensor)["al_state"] == "INIT", "INIT")


@pytest.mark.parametrize("last", ["read", "write"])
def test_a_start_is_given_up_between_two_transfers(bench: Bench, last: str) -> None:
    transfers: list[str] = []

    class Noted(SoemBackend):
        def sdo_read(self, slave: int, index: int, subindex: int) -> bytes:
            transfers.append("read")
            return super().sdo_read(slave, index, subindex)

        def sdo_write(self, slave: int, index: int, subindex: int, data: bytes) -> None:
            transfers.append("write")
            super().sdo_write(slave, index, subindex, data)

    def check_interrupt() -> None:
        if last in transfers:
            raise StopRequestedError("asked to stop while starting")

    with pytest.raises(StopRequestedError):
        started(bench[0].near, check_interrupt, {"fir": True}, Noted)
    assert transfers.index(last) == len(transfers) - 1, "nothing after it"


def test_whoever_was_first_keeps_all_others_out_before_it_has_opened_the_bus(bench: Bench) -> None:
    veth, _ = bench
    with claimed(veth.near):
        said = one_sentence(tool("objects", veth.near, code=1))
        assert f"{veth.near} is in use by another EtherCAT master" in said
    with server(veth.near) as running:
        running.process.kill()
        running.wait()
        with server(veth.near):
            pass
    assert tool("objects", veth.near).code == 0
