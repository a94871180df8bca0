"""The whole server as a process: real pysoem, real frames on a veth pair, real sockets."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from protocol.framing import DataFlag, DataMessage
from protocol.pdo import LAYOUTS
from tests.server.as_another_user import NO_OTHER_USER
from tests.server.running import Client, Server, Veth, needs_bus, server, virtual_sensor, wait_until

pytestmark = [pytest.mark.bus, needs_bus]


POISON = (
    b"\x00\x00\x01\x00\x02{",
    b"\xff" * 1000,
    b"GET / HTTP/1.1\r\n\r\n",
    b"{{{{",
    b"\x00\x00\x00\x05\x09abcd",
)


@pytest.fixture(scope="module")
def shared() -> Iterator[Server]:
    """One server for the tests that leave it as it is."""
    with server("virtual", "--virtual", "--signal clock --ppm 150") as running:
        yield running


def sample_number(frame: DataMessage) -> int:
    layout = LAYOUTS[len(frame.process_data)]
    first = layout.index("force.x")
    return decode_clock(layout.struct.unpack(frame.process_data)[first : first + 6]).number


def sample_numbers(frames: list[DataMessage]) -> list[int]:
    return [sample_number(frame) for frame in frames]


def test_every_sample_arrives_once_and_in_order(shared: Server) -> None:
    with shared.connect() as client:
        assert client.ask("subscribe")["ok"]
        frames = client.fresh(1500)
        numbers = sample_numbers(frames)
        assert numbers == sorted(set(numbers)), "a sample came twice or out of order"
        gaps = unflagged = 0
        for before, after in pairwise(frames):
            gap = bool(after.flags & DataFlag.GAP)
            unflagged += sample_number(after) > sample_number(before) + 1 and not gap
            gaps += gap
        assert unflagged <= 1 + len(frames) // 1000, "a starved sensor answers when nobody can know"
        assert gaps < 0.05 * len(frames)
        assert {frame.wkc for frame in frames} == {3}
        assert {frame.sensor for frame in frames} == {0}
        stamps = [frame.monotonic_ns for frame in frames]
        assert stamps == sorted(set(stamps))


def test_describe(shared: Server) -> None:
    with shared.connect() as client:
        reply = client.ask("describe")
        assert reply["protocol"] == 1
        (sensor,) = reply["sensors"]
        assert sensor["name"] == "BFT-SENS-ECAT-M8"
        assert (sensor["pdo_size"], sensor["rate_hz"], sensor["state"]) == (61, 800, "OP")
        assert sensor["settings"]["sinc_length"] == 64
        assert sensor["settings"]["fir"] is False
        assert sensor["settings"]["calibration_matrix"] is True


def test_status_counts_what_happened(shared: Server) -> None:
    with shared.connect() as client:
        client.ask("subscribe")
        client.collect(100)
        status = client.ask("status")
        (counters,) = status["sensors"]
        assert counters["fresh"] >= 100
        assert status["cycles"] >= counters["fresh"]
        for distribution in (status["wake_us"], status["exchange_us"]):
            assert (
                0 < distribution["p50"] <= distribution["p99"] <= distribution["p999"] <= distribution["max"]
            )
        (me,) = [c for c in status["clients"] if c["peer"].endswith(f":{client.sock.getsockname()[1]}")]
        assert me["sent"] >= 100
        assert me["withheld"] == 0


def test_bare_json_works_with_a_plain_socket(shared: Server) -> None:
    with socket.create_connection(("127.0.0.1", shared.port), timeout=10) as sock:
        sock.sendall(b'{"action":"subscribe"}{"action":"status","id":"me"}')
        lines = sock.makefile("rb")
        refused, status = json.loads(lines.readline()), json.loads(lines.readline())
        assert refused["error"]["code"] == "bad_request"
        assert "framed" in refused["error"]["message"]
        assert status["id"] == "me"
        assert status["ok"]


def test_ipv6_loopback_reaches_it_too(shared: Server) -> None:
    if not socket.has_ipv6 or not os.path.exists("/proc/net/if_inet6"):  # noqa: PTH110
        pytest.skip("no IPv6 on this machine")
    with socket.create_connection(("::1", shared.port), timeout=10) as sock:
        sock.sendall(b'{"action":"describe"}')
        assert json.loads(sock.recv(65536))["ok"]


def interface_exists(name: str) -> bool:
    return name in {name for _, name in socket.if_nameindex()}


@pytest.mark.parametrize("how", ["framed", "bare", "SIGTERM", "SIGINT"])
def test_every_way_to_end_is_clean(how: str) -> None:
    with server("virtual") as running, running.connect() as watcher:
        assert interface_exists(running.ifname)
        watcher.ask("subscribe")
        watcher.collect(3)
        if how == "framed":
            with running.connect() as client:
                assert client.ask("shutdown")["ok"]
        elif how == "bare":
            with socket.create_connection(("127.0.0.1", running.port), timeout=10) as sock:
                sock.sendall(b'{"action": "shutdown"}')  # no newline, as the note's client does it
                assert json.loads(sock.recv(4096)) == {"reply": "shutdown", "ok": True}
        else:
            running.signal(getattr(signal, how))
        watcher.receive_all()
        assert {"event": "shutting_down"} in watcher.events
        assert running.wait() == 0
        assert not interface_exists(running.ifname)


def test_killed_server_leaves_no_virtual_bus_and_can_be_started_again_at_once() -> None:
    with server("virtual") as running:
        ifname, port = running.ifname, running.port
        running.signal(signal.SIGKILL)
        running.wait()
        again = Server("virtual")
        try:
            again.wait_streaming()
        finally:
            again.close()
        wait_until(lambda: not interface_exists(ifname), "the virtual bus to be gone")
        with socket.socket() as sock:
            assert sock.connect_ex(("127.0.0.1", port)) != 0


def test_shutdown_takes_the_sensor_to_init() -> None:
    with virtual_sensor() as (veth, sensor):
        with server(veth.near):
            pass
        assert sensor.process.stdin is not None
        sensor.process.stdin.write("stats\n")
        sensor.process.stdin.flush()
        sensor.wait_for('"INIT"')


def test_a_chain_of_sensors_with_settings_of_their_own(tmp_path: Path) -> None:
    config = tmp_path / "chain.toml"
    config.write_text("[sensor]\nfir = true\n[sensor.1]\nsinc_length = 128\n")
    arguments = ("--config", str(config), "--virtual", "--sensors 2 --signal clock --ppm 200,-300")
    with server("virtual", *arguments) as running, running.connect() as client:
        described = client.ask("subscribe")["sensors"]
        assert [(s["sensor"], s["rate_hz"]) for s in described] == [(0, 800), (1, 400)]
        assert all(s["settings"]["fir"] for s in described)
        frames = client.fresh(1500)
        for position in (0, 1):
            numbers = sample_numbers([f for f in frames if f.sensor == position])
            assert len(numbers) > 300
            assert numbers == sorted(set(numbers))


def test_a_disconnect_in_mid_frame_and_garbage_disturb_nobody(shared: Server) -> None:
    with shared.connect() as client:
        client.ask("subscribe")
        before = client.fresh(10)
        for poison in POISON:
            with socket.create_connection(("127.0.0.1", shared.port)) as sock:
                sock.sendall(poison)
        after = client.fresh(400)
        numbers = sample_numbers(before + after)
        assert numbers == sorted(set(numbers))
        assert client.ask("status")["ok"]


def test_other_users_may_look_but_not_shut_it_down(shared: Server) -> None:
    if NO_OTHER_USER is not None:
        pytest.skip(NO_OTHER_USER)
    script = (
        "import os,socket\n"
        "'x'.encode('idna')\n"  # what connecting needs of the library, while it can be read
        "os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        f"s=socket.create_connection(('127.0.0.1',{shared.port}))\n"
        's.sendall(b\'{"action":"shutdown","uid":0}{"action":"shutdown"}{"action":"status"}\')\n'
        "f=s.makefile()\n"
        "print(f.readline(),f.readline(),f.readline(),sep='',end='')\n"
    )
    answer = subprocess.run(
        [sys.executable, "-I", "-S", "-c", script],
capture_output=True, text=True,
        check=True, env={"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"},
    ).stdout  # fmt: skip
    forged, denied, status = (json.loads(line) for line in answer.splitlines())
    assert forged["error"]["code"] == "bad_request"
    assert denied["error"]["code"] == "denied"
    assert status["ok"]
    with shared.connect() as client:
        assert client.ask("describe")["ok"]


def test_two_servers_at_once_do_not_disturb_one_another(shared: Server) -> None:
    with server("virtual") as other, other.connect() as client, Client(shared.port) as first:
        client.ask("subscribe")
        first.ask("subscribe")
        assert len(client.fresh(100)) == 100
        assert len(first.fresh(100)) == 100


def test_veth_helper_cleans_up() -> None:
    with Veth() as veth:
        assert interface_exists(veth.near)
    assert not interface_exists(veth.near)
