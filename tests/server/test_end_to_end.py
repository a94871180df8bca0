"""The whole server as a process: real pysoem, real frames, real sockets, signals, and processes that end.

What it does with samples and requests is tested in simulated time.
"""

from __future__ import annotations

import contextlib
import json
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.server.manager import Manager
from tests.server.running import Client, Server, Veth, has_ipv6, needs_bus, server, wait_until
from tests.simulation import check_frames, fresh, reading

pytestmark = [pytest.mark.bus, needs_bus]

CONFIG = "[sensor]\nfir = true\nsinc_length = 512\n[sensor.1]\nsinc_length = 1024\n"
"""Low rates, which take little of the machine."""


def interface_exists(name: str) -> bool:
    return name in {name for _, name in socket.if_nameindex()}


class Shared:
    """A server that streams a chain of two sensors, as a service with a configuration file."""

    def __init__(self, running: Server, manager: Manager, config: Path) -> None:
        self.running, self.manager, self.config = running, manager, config


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    """The last test ends it."""
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
        status = client.ask("status")
        withheld = sum(each["withheld"] for each in status["clients"])
        for counters in status["sensors"]:
            own = [frame for frame in frames if frame.sensor == counters["sensor"]]
            check_frames(own, complete=False)
            numbers = [reading(frame).number for frame in fresh(own)]
            missing = numbers[-1] - numbers[0] + 1 - len(numbers)
            assert missing <= counters["lost_samples"] + withheld or counters["recoveries"]


def test_status_counts_what_happened(shared: Shared) -> None:
    """By the kernel's clock."""
    with shared.running.connect() as client:
        client.ask("subscribe")
        client.fresh(30)
        status = client.ask("status")
        assert status["cycles"] >= max(counters["fresh"] for counters in status["sensors"]) >= 15
        for distribution in (status["wake_us"], status["exchange_us"]):
            assert (
                0 < distribution["p50"] <= distribution["p99"] <= distribution["p999"] <= distribution["max"]
            )
        (me,) = [c for c in status["clients"] if c["peer"].endswith(f":{client.sock.getsockname()[1]}")]
        assert me["sent"] >= 30


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_bare_json_works_with_a_plain_socket(shared: Shared, host: str) -> None:
    if host == "::1" and not has_ipv6():
        pytest.skip("no IPv6 on this machine")
    with socket.create_connection((host, shared.running.port), timeout=30) as sock:
        sock.sendall(b'{"action":"subscribe"}{"action":"status","id":"me"}')
        lines = sock.makefile("rb")
        refused, status = json.loads(lines.readline()), json.loads(lines.readline())
        assert refused["error"]["code"] == "bad_request"
        assert "framed" in refused["error"]["message"]
        assert (status["id"], status["ok"]) == ("me", True)


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


def test_sighup_reloads_the_configuration(shared: Shared) -> None:
    """A real signal, and a thread beside the loop."""
    running = shared.running
    with running.connect() as client:
        client.ask("subscribe")
        shared.config.write_text(CONFIG + "imu_active = 3\n[server]\nidle_timeout_s = 299\n")
        applied, before = "sensor 1: applied imu_active = 3", len(running.said())
        while applied not in running.said():
            at = len(running.said())
            running.signal(signal.SIGHUP)
            # Again if a starved sensor was away in this very moment.
            wait_until(lambda n=at: "imu_active = 3" in running.said()[n:], applied)  # type: ignore[misc]
        assert "changed idle_timeout_s" in running.said()[before:]
        assert len(client.fresh(10)) == 10


def test_killed_and_started_again_at_once_on_the_same_port_beside_another(shared: Shared) -> None:
    """What the kernel does with the processes, interfaces and sockets that a killed server leaves."""
    with contextlib.ExitStack() as stack:
        bystander = stack.enter_context(shared.running.connect())
        bystander.ask("subscribe")
        killed = stack.enter_context(server("virtual"))
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

        again = stack.enter_context(server("virtual", port=killed.port))
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
    """A real signal and exit code; the last test here."""
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


def test_veth_helper_cleans_up() -> None:
    with Veth() as veth:
        assert interface_exists(veth.near)
    assert not interface_exists(veth.near)
