"""The master in this process, on a real interface: what pysoem makes of odd slaves, and of its interface."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.errors import BusError, StopRequestedError
from ethercat_server.ethercat import soem
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import claimed
from ethercat_server.ethercat.raw_socket import packet_sockets
from ethercat_server.ethercat.slave.sii import decode
from ethercat_server.ethercat.soem import SoemBackend
from ethercat_server.sensor.sensor import Sensor
from tests.server.commands import command, stats
from tests.server.running import (
    ATTEMPTS,
    PATIENCE_S,
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
LAST_READ = "0x8000 6"
"""The object that is read last before the mapping."""


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with virtual_sensor(module="tests.server.odd_sensor") as found:
        yield found


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan takes its time on a busy machine."""
    monkeypatch.setattr(soem, "_SCAN_TIMEOUT_S", PATIENCE_S)


@contextlib.contextmanager
def opened(ifname: str) -> Iterator[Bus]:
    """A bus, closed when SOEM does not use it any more."""
    threads = threading.active_count()
    backend = SoemBackend(ifname)
    bus = Bus(backend)
    backend.open()
    try:
        yield bus
    finally:
        bus.close()
        wait_until(lambda: threading.active_count() == threads, "the end of SOEM's scan")
        backend._abandoned = False
        backend.close()


def start(
    bench: Bench,
    *commands: str,
    complaint: str = "$^",
    check_interrupt: CheckInterrupt = lambda: None,
) -> list[Sensor]:
    """Start and end, after these commands.

    Again where the sensor's process had to wait for too long, which makes other complaints than `complaint`.
    """
    veth, sensor = bench
    for attempt in range(ATTEMPTS):
        for text in commands:
            command(sensor, text)
        with opened(veth.near) as bus:
            try:
                return bring_up(bus, Asked(), check_interrupt).sensors
            except BusError as error:
                expected = re.search(complaint, str(error)) or not starved(str(error))
                if expected or attempt == ATTEMPTS - 1:
                    raise
    raise AssertionError("unreachable")


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


@pytest.mark.parametrize("report", ["0x1008 0 6 0", f"{LAST_READ} 0 12", "0x1C12 0 1 0", "0x1C12 0 15 0"])
def test_emergencies_among_the_answers_are_no_failure_and_are_said_in_words(
    bench: Bench, caplog: pytest.LogCaptureFixture, report: str
) -> None:
    """0x1C12 is read by SOEM's mapping, and pysoem tells nothing of those: it costs a retry."""
    assert start(bench, f"report {report}")[0].pdo_size
    said = " ".join(record.getMessage() for record in caplog.records)
    by_soem = report.startswith("0x1C12")
    assert ("an emergency, or" if by_soem else "emergency 0x4210") in said
    assert ("trying again" in said) is by_soem, said
    assert "unexpected" not in said


def test_a_slave_that_vanishes_during_the_scan_does_not_hang_the_server(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SOEM would try on for two minutes, in its thread, until the slave is there again."""
    veth, sensor = bench
    monkeypatch.setattr(soem, "_SCAN_TIMEOUT_S", 1.0)
    with opened(veth.near) as bus:
        for _ in range(ATTEMPTS):
            command(sensor, "hear")
            command(sensor, "deaf-after 40")  # in the middle of reading the SII
            with pytest.raises(BusError) as info:
                bus.scan([0], [decode(bytes(256))], lambda: None)
            if "no EtherCAT slave answers" not in str(info.value):
                break
        bus.close()  # not from under SOEM
        command(sensor, "hear")
    assert f"the scan of {veth.near} does not end: a slave stopped answering" in str(info.value)


@pytest.mark.parametrize("state", [2, 4, 8])
def test_a_start_is_given_up_while_a_sensor_does_not_change_its_state(bench: Bench, state: int) -> None:
    """Without waiting until the sensor has had its time and is blamed."""
    _, sensor = bench
    before, threads, sockets = len(sensor.said()), threading.active_count(), packet_sockets()

    def check_interrupt() -> None:
        if "ignored" in sensor.said()[before:] and threading.active_count() == threads:  # the scan has ended
            raise StopRequestedError

    with pytest.raises(StopRequestedError):
        start(bench, f"ignore {state}", check_interrupt=check_interrupt)
    command(sensor, "ignore 0")
    assert packet_sockets() == sockets
    wait_until(lambda: stats(sensor)["al_state"] == "INIT", "INIT")


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
