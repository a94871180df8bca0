"""What only a real interface, processes and signals show: pysoem, raw sockets, links that go down.

What the server does with samples and requests, and everything else about recovery, is tested in memory.
"""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.errors import BusError, StopRequestedError
from ethercat_server.ethercat import soem
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import claimed
from ethercat_server.ethercat.slave.sii import decode
from ethercat_server.ethercat.soem import SoemBackend, packet_sockets
from ethercat_server.ethercat.wire import Command, parse
from ethercat_server.sensor.sensor import Sensor
from tests.server.running import (
    ATTEMPTS,
    PATIENCE_S,
    SLOW,
    Client,
    Manager,
    Server,
    Veth,
    VirtualSensor,
    free_port,
    needs_bus,
    server,
    starved,
    virtual_sensor,
    wait_until,
)
from tests.simulation import asked, check_frames, reading
from tests.tool.running import one_sentence, tool

pytestmark = [pytest.mark.bus, needs_bus]

# -- one server for all of these, the last of which ends it


class Bench(NamedTuple):
    """A server on a veth pair, a virtual sensor that takes commands on its other end."""

    veth: Veth
    sensor: VirtualSensor
    running: Server


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with (
        virtual_sensor("--signal", "clock", "--ppm", "150") as (veth, sensor),
        server(veth.near, "--set", "acceleration_range_g=8") as running,
    ):
        yield Bench(veth, sensor, running)


@pytest.fixture
def client(bench: Bench) -> Iterator[Client]:
    with bench.running.connect() as client:
        client.ask("subscribe")
        client.fresh(50)
        client.events.clear()
        yield client


def pull_cable(bench: Bench, client: Client) -> None:
    bench.veth.ip("link", "set", bench.veth.far, "down")
    assert f"{bench.veth.near} has no carrier" in client.wait_event("sensor_lost")["reason"]
    bench.veth.ip("link", "set", bench.veth.far, "up")


def be_deaf(bench: Bench, client: Client) -> None:
    bench.sensor.command("deaf")
    client.wait_event("sensor_lost")
    bench.sensor.command("hear")


def cut_power(bench: Bench, client: Client) -> None:
    bench.sensor.command("power off")
    client.wait_event("sensor_lost")
    bench.sensor.command("power on")


def drop_to_safeop(bench: Bench, client: Client) -> None:
    bench.sensor.command("safeop 0x1B")
    client.wait_event("sensor_lost")


def stop_server(bench: Bench, _: Client) -> None:
    """The sensor falls to SAFEOP meanwhile; the server takes it back to OP."""
    bench.running.signal(signal.SIGSTOP)
    bench.sensor.command("safeop 0x1B")
    bench.running.signal(signal.SIGCONT)


@pytest.mark.parametrize("fault", [pull_cable, be_deaf, cut_power, drop_to_safeop, stop_server])
def test_samples_flow_again_on_the_same_connection(
    bench: Bench, client: Client, fault: Callable[[Bench, Client], None]
) -> None:
    """With the kernel's links and timers: a link that is down fails the sending, a process that was stopped
    finds frames of before."""
    fault(bench, client)
    assert client.wait_event("sensor_back")["settings"]["acceleration_range_g"] == 8
    instants = [reading(frame).instant_ns for frame in client.fresh(100)]
    assert instants == sorted(set(instants)), "nothing old as new"
    wait_until(lambda: client.ask("describe")["sensors"][0]["state"] == "OP", "OP")
    assert bench.sensor.stats()["calibration_writes"] == 0


def test_the_interface_is_not_left_promiscuous(bench: Bench, client: Client) -> None:
    """SOEM makes it so; whoever had it so before finds it as it was."""
    assert client.fresh(10)
    assert "promiscuity 0" in bench.veth.ip("-d", "link", "show", bench.veth.near)


def test_settings_change_by_way_of_preop(bench: Bench, client: Client) -> None:
    """The mailbox by single datagrams over the raw socket, while pysoem's own are not used any more."""
    for settings in ({"chop": True, "imu_active": 3}, {"chop": False, "imu_active": 1}):
        wait_until(lambda new=settings: client.ask("configure", settings=new)["ok"], "it takes")  # type: ignore[misc]
        assert settings.items() <= client.wait_event("reconfigured")["settings"].items()
    assert len(client.fresh(20)) == 20


def test_an_interface_that_disappears_ends_the_server_with_a_sentence(bench: Bench) -> None:
    """The kernel's error for a raw socket whose interface is gone."""
    veth, running = bench.veth, bench.running
    veth.ip("link", "del", veth.near)
    assert running.wait() == 1
    assert f"the interface {veth.near} has disappeared" in running.said()
    assert "Traceback" not in running.said()


# -- the computer's time is slewed: for this server only, others need theirs

SLEWED = """
import runpy, sys, time
now_ns, begun = time.monotonic_ns, time.monotonic_ns()

def slewed_ns():
    passed = now_ns() - begun
    rounds, into = divmod(passed, 2_000_000_000)
    return begun + passed + min(into, 2_000_000_000 - into) // 12

time.monotonic_ns = slewed_ns
sys.argv = sys.argv[3:]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("dc", ["none", "ppm=20"])
def test_a_slew_of_the_computers_time_costs_no_sample_untold(dc: str) -> None:
    with (
        virtual_sensor("--signal", "clock", "--dc", dc) as (veth, _),
        server(veth.near, under=[sys.executable, "-c", SLEWED]) as running,
        running.connect() as client,
    ):
        client.ask("subscribe")
        frames = client.fresh(4000)
    ahead = [frame.monotonic_ns - reading(frame).instant_ns for frame in frames]
    assert max(ahead) - min(ahead) > 70_000_000, "stamps follow it"
    check_frames(frames, complete=False)


# -- an interface has several names, and may get others


def test_a_server_outlives_losses_by_every_name_of_its_interface() -> None:
    """Names are the kernel's; one that is longer than its own may be, and given while all runs."""
    other, renamed = "alternative-name-of-the-interface", f"er{free_port()}"
    with virtual_sensor("--signal", "clock") as (veth, sensor):
        veth.ip("link", "property", "add", "dev", veth.near, "altname", other)
        with server(other, *SLOW) as running, running.connect() as client:
            assert client.ask("subscribe")["interface"] == veth.near
            assert f"streaming {veth.near} on port" in running.said()
            pull_cable(Bench(veth, sensor, running), client)
            client.wait_event("sensor_back")
            assert len(client.fresh(20)) == 20

            veth.ip("link", "set", veth.near, "down")
            assert f"{veth.near} is down" in client.wait_event("sensor_lost")["reason"]
            veth.ip("link", "set", veth.near, "name", renamed)
            was, veth.near = veth.near, renamed
            veth.ip("link", "set", renamed, "up")
            client.wait_event("sensor_back")
            assert len(client.fresh(20)) == 20
            assert client.ask("describe")["interface"] == renamed
            for name in (renamed, other):
                assert f"which uses {name}" in tool("eeprom", name).err
            assert f"no network interface {was!r}" in tool("eeprom", was, code=1).err
            pull_cable(Bench(veth, sensor, running), client)
            client.wait_event("sensor_back")
            running.signal(signal.SIGTERM)
            assert running.wait() == 0


# -- beside other devices


@pytest.mark.parametrize("text", ["EK1100,BOTA,EL3102,DRIVE", "DRIVE:PREOP,BOTA,BOTA"])
def test_sensors_among_other_devices(text: str) -> None:
    """The master by single datagrams on a raw socket that pysoem opened."""
    others = [at for at, kind in enumerate(text.split(",")) if kind != "BOTA"]
    with (
        virtual_sensor("--chain", text, "--signal", "clock") as (veth, sensor),
        server(veth.near, *SLOW) as running,
        running.connect() as client,
    ):
        assert [row["position"] for row in client.ask("subscribe")["others"]] == others
        assert len(client.fresh(50)) == 50
        before = [sensor.stats_of_foreign(at) for at in others]
        pull_cable(Bench(veth, sensor, running), client)
        client.wait_event("sensor_back")
        assert len(client.fresh(50)) == 50
        assert [sensor.stats_of_foreign(at) for at in others] == before
        assert {row["al_state"] for row in before} <= {"INIT", "PREOP"}


def test_without_soems_master_the_sensors_come_to_op_as_well() -> None:
    with (
        virtual_sensor("--serial", "1,2", "--signal", "clock") as (veth, sensor),
        claimed(veth.near),
        contextlib.closing(Bus(backend := SoemBackend(veth.near))) as bus,
    ):
        backend.open()
        backend.master = None
        sizes = [found.pdo_size for found in bring_up(bus, asked(), lambda: None).sensors]
        assert sizes == [61, 61]
        assert [sensor.stats(number)["al_state"] for number in range(2)] == ["OP", "OP"]
        assert bus.process_data.most_wkc == [6]


@pytest.mark.parametrize("arguments", ["--pdo 61", "--pdo 77", "--serial 1,2"])
def test_no_request_beside_soems_has_the_counter_of_the_one_before(arguments: str) -> None:
    """The slave would drop it."""
    with (
        virtual_sensor(*arguments.split()) as (veth, _),
        claimed(veth.near),
        contextlib.closing(Bus(backend := SoemBackend(veth.near))) as bus,
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3)) as capture,
    ):
        capture.bind((veth.near, 3))
        try:
            capture.setsockopt(socket.SOL_SOCKET, 33, 1 << 24)  # SO_RCVBUFFORCE
        except PermissionError:
            pytest.skip("it takes root outside of a user namespace: less would not hold all frames")
        backend.open()
        bring_up(bus, asked(), lambda: None)
        for slave in bus.slaves:
            bus.finish(slave.sdo.read(0x8011, 0))
        capture.setblocking(False)
        counters: dict[int, list[int]] = {}
        dropped = []
        with contextlib.suppress(BlockingIOError):
            while True:
                frame, address = capture.recvfrom(1514)
                for row in parse(frame, len(frame)) if address[2] == socket.PACKET_OUTGOING else ():
                    message = frame[row.data : row.data + row.length]
                    if (row.command, row.ado, row.length) != (Command.FPWR, 0x1000, 128):
                        continue
                    before = counters.setdefault(row.adp, [0])
                    before.append(message[5] >> 4)
                    if before[-1] == before[-2] and message[9:11] != b"\x00\x10":
                        dropped.append((row.adp, len(before)))
    assert len(counters) == len(arguments.split(","))
    assert all({1, 2, 3, 4, 5, 6, 7} <= {*found} for found in counters.values()), "SOEM's and the others"
    assert dropped == []


# -- a service on a chain of two sensors, with a configuration file; the last of these ends it

CONFIG = "[sensor]\nfir = true\nsinc_length = 512\n[sensor.1]\nsinc_length = 1024\n"
"""Low rates, which take little of the machine."""


def interface_exists(name: str) -> bool:
    return name in {name for _, name in socket.if_nameindex()}


class Shared(NamedTuple):
    running: Server
    manager: Manager
    config: Path


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    directory = tmp_path_factory.mktemp("service")
    config = directory / "chain.toml"
    config.write_text(CONFIG)
    arguments = ("--config", str(config), "--virtual", "--sensors 2 --signal clock --ppm 200,-300")
    with contextlib.closing(Manager(directory)) as manager, contextlib.ExitStack() as stack:
        with manager.environment():
            running = stack.enter_context(server("virtual", *arguments))
        yield Shared(running, manager, config)


def test_samples_of_a_chain_arrive_in_order_with_settings_of_their_own(shared: Shared) -> None:
    """Two slaves in one frame, as pysoem maps them."""
    with shared.running.connect() as client:
        described = client.ask("subscribe")["sensors"]
        assert [(s["sensor"], s["rate_hz"], s["pdo_size"]) for s in described] == [(0, 100, 61), (1, 50, 61)]
        assert [s["serial"] - 100 * shared.running.port for s in described] == [0, 1], "of this server alone"
        assert all(s["settings"]["fir"] and s["name"] == "BFT-SENS-ECAT-M8" for s in described)
        frames = client.collect(90)
        for _ in range(20):  # a starved sensor may be away for a moment
            if {frame.sensor for frame in frames if frame.wkc == 6} == {0, 1}:
                break
            frames += client.collect(30)
        else:
            pytest.fail("no frame with both sensors' data")
        for sensor in (0, 1):
            check_frames([frame for frame in frames if frame.sensor == sensor], complete=False)


def test_systemd_is_told_and_the_watchdog_is_fed(shared: Shared) -> None:
    """The process sends to the socket in its environment."""
    told, wait = shared.manager, shared.manager.wait
    wait("READY=1")
    assert "streaming" in shared.running.said(), "not before it streams"
    wait("STATUS=streaming 2 of 2 sensors; 0 clients")
    fed = told.told.count("WATCHDOG=1")
    wait_until(lambda: told.told.count("WATCHDOG=1") >= fed + 2, "the watchdog is fed on")
    with shared.running.connect():
        wait("1 clients")


def test_killed_and_started_again_at_once_on_the_same_port_beside_another(shared: Shared) -> None:
    """What the kernel does with the processes, interfaces and sockets that a killed server leaves."""
    with contextlib.ExitStack() as stack:
        bystander = stack.enter_context(shared.running.connect())
        bystander.ask("subscribe")
        killed = stack.enter_context(server("virtual", *SLOW))
        client = stack.enter_context(killed.connect())
        client.ask("subscribe")
        assert len(client.fresh(20)) == 20
        left = [stack.enter_context(socket.create_connection(("127.0.0.1", killed.port))) for _ in range(30)]
        for sock in left[:20]:
            sock.sendall(b'{"action":"describe"}')
            assert sock.recv(65536)
        killed.signal(signal.SIGKILL)
        killed.wait()
        client.receive_all()

        again = stack.enter_context(server("virtual", *SLOW, port=killed.port))
        wait_until(lambda: not interface_exists(killed.ifname), "the virtual bus to be gone")
        with Client(killed.port) as client:
            assert client.ask("subscribe")["ok"]
            assert len(client.fresh(20)) == 20
            assert len(client.ask("status")["clients"]) == 1
        assert interface_exists(again.ifname)
        with socket.create_connection(("127.0.0.1", again.port), timeout=30) as sock:
            sock.sendall(b'{"action": "shutdown"}')  # no newline, as the note's client does it
            said = json.loads(sock.recv(4096))
            assert said == {"reply": "shutdown", "ok": True}, "it knows whose connections these are"
        assert again.wait() == 0
        wait_until(lambda: not interface_exists(again.ifname), "the virtual bus to be gone")
        with socket.socket() as sock:
            assert sock.connect_ex(("127.0.0.1", again.port)) != 0
        assert len(bystander.fresh(20)) == 20


def test_sigterm_ends_it(shared: Shared) -> None:
    """A real signal and exit code; the last test of this server."""
    running = shared.running
    with running.connect() as client:
        assert client.ask("describe")["ok"]
        assert "STOPPING=1" not in shared.manager.told
        running.signal(signal.SIGTERM)
        shared.manager.wait("STOPPING=1")
        client.receive_all()
        assert [event["event"] for event in client.events] == ["shutting_down"]
    assert running.wait() == 0
    wait_until(lambda: not interface_exists(running.ifname), "the virtual bus to be gone")


# -- the master in this process: what pysoem makes of odd slaves, and of its interface

Odd = tuple[Veth, VirtualSensor]
LAST_READ = "0x8000 6"
"""The object that is read last before the mapping."""


@pytest.fixture(scope="module")
def odd() -> Iterator[Odd]:
    with virtual_sensor(module="tests.server.odd_sensor") as found:
        yield found


@pytest.fixture
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
    veth: Veth, sensor: VirtualSensor, text: str, check_interrupt: CheckInterrupt = lambda: None
) -> list[Sensor]:
    """Start and end, after a command; again where the sensor's process had to wait for too long."""
    for attempt in range(ATTEMPTS):
        sensor.command(text)
        with opened(veth.near) as bus:
            try:
                return bring_up(bus, asked(), check_interrupt).sensors
            except BusError as error:
                if not starved(str(error)) or attempt == ATTEMPTS - 1:
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


@pytest.mark.usefixtures("patience")
@pytest.mark.parametrize("report", ["0x1008 0 6 0", f"{LAST_READ} 0 12", "0x1C12 0 1 0", "0x1C12 0 15 0"])
def test_emergencies_among_the_answers_are_no_failure_and_are_said_in_words(
    odd: Odd, caplog: pytest.LogCaptureFixture, report: str
) -> None:
    """0x1C12 is read by SOEM's mapping, and pysoem tells nothing of those: it costs a retry."""
    assert start(*odd, f"report {report}")[0].pdo_size
    said = " ".join(record.getMessage() for record in caplog.records)
    by_soem = report.startswith("0x1C12")
    assert ("an emergency, or" if by_soem else "emergency 0x4210") in said
    assert ("trying again" in said) is by_soem, said
    assert "unexpected" not in said


def test_a_slave_that_vanishes_does_not_hang_the_scan(odd: Odd, monkeypatch: pytest.MonkeyPatch) -> None:
    """SOEM would try on for two minutes, in its thread, until the slave is there again."""
    veth, sensor = odd
    monkeypatch.setattr(soem, "_SCAN_TIMEOUT_S", 1.0)
    with opened(veth.near) as bus:
        for _ in range(ATTEMPTS):
            sensor.command("hear")
            sensor.command("deaf-after 40")  # in the middle of reading the SII
            with pytest.raises(BusError) as info:
                bus.scan([0], [decode(bytes(256))], lambda: None)
            if "no EtherCAT slave answers" not in str(info.value):
                break
        bus.close()  # not from under SOEM
        sensor.command("hear")
    assert f"the scan of {veth.near} does not end: a slave stopped answering" in str(info.value)


@pytest.mark.usefixtures("patience")
@pytest.mark.parametrize("state", [2, 4, 8])
def test_a_start_is_given_up_while_a_sensor_does_not_change_its_state(odd: Odd, state: int) -> None:
    """Without waiting until the sensor has had its time and is blamed."""
    veth, sensor = odd
    before, threads, sockets = len(sensor.said()), threading.active_count(), packet_sockets()

    def check_interrupt() -> None:
        if "ignored" in sensor.said()[before:] and threading.active_count() == threads:  # the scan has ended
            raise StopRequestedError

    with pytest.raises(StopRequestedError):
        start(veth, sensor, f"ignore {state}", check_interrupt)
    sensor.command("ignore 0")
    assert packet_sockets() == sockets
    wait_until(lambda: sensor.stats()["al_state"] == "INIT", "INIT")


def test_whoever_was_first_keeps_all_others_out_before_it_has_opened_the_bus(odd: Odd) -> None:
    veth, _ = odd
    with claimed(veth.near):
        said = one_sentence(tool("objects", veth.near, code=1))
        assert f"{veth.near} is in use by another EtherCAT master" in said
    with server(veth.near, *SLOW) as running:
        with contextlib.closing(Server(veth.near)) as second:
            assert second.wait() == 1
            assert f"{veth.near} is in use by another EtherCAT master" in second.said()
        running.process.kill()
        running.wait()
        with server(veth.near, *SLOW):
            pass
    assert tool("objects", veth.near).code == 0
