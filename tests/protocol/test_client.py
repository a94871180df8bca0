"""The Python client: against a scripted server in simulated time, over TCP, and against a whole server.

What it makes of a stream, `latest` above all, is in tests/protocol/golden/readings.json, for both languages.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import math
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bota_ethercat import address
from bota_ethercat.address import boot_id
from bota_ethercat.client import Client, Condition, Connected, Disconnected, NoSampleError, connect
from bota_ethercat.client.channel import TcpChannel
from bota_ethercat.errors import ConnectionFailedError, NoReplyError, RefusedError, UnreachableError
from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import STANDARD_GRAVITY, ImuUnits
from ethercat_server.simulation.server import MemoryChannel
from tests.bridge.scripted_server import MemoryServer, ScriptedChannel, ScriptedServer, process_data
from tests.descriptions import description, sensor_row
from tests.golden_vectors import odd_messages
from tests.served_simulation import served
from tests.server.running import PATIENCE_S, free_port, full_listener
from tests.simulation import Simulation

ROOT = Path(__file__).parents[2]


@pytest.fixture
def server() -> MemoryServer:
    return MemoryServer()


def client_of(server: MemoryServer, sensors: int = 1, **options: Any) -> Client:
    if sensors > 1:
        rows = [{"sensor": number, "rate_hz": 800} for number in range(sensors)]
        server.description = description() | {"sensors": rows}
    return Client(1, channel=ScriptedChannel(server), **options).connect()


def test_samples_come_decoded_in_order_and_nothing_old(server: MemoryServer) -> None:
    sensor = client_of(server)
    server.send_sample(1.0)
    server.send_sample(1.0, DataFlag.REPEATED)
    server.send_sample(1.0, DataFlag.INVALID)
    server.send_sample(2.0, DataFlag.GAP)
    samples = iter(sensor)
    first, second = next(samples), next(samples)
    assert [first.force[0], second.force[0]] == [1.0, 2.0]
    assert first.acceleration[0] == pytest.approx((1.0 + 6 / 16) * STANDARD_GRAVITY)
    assert sensor.frame is not None
    assert sensor.frame.sequence == 4
    assert sensor.frame.flags & DataFlag.GAP
    sensor = client_of(server, imu_units=ImuUnits.SI)
    server.send_sample(3.0, process_data=process_data(3.0, 77))
    assert next(iter(sensor)).acceleration[0] == 3.0 + 6 / 16


def test_a_frame_was_measured_before_its_stamp_by_the_delay_of_the_filters(server: MemoryServer) -> None:
    sensor = client_of(server)
    server.send_sample(1.0)
    (frame,) = sensor.receive()
    assert sensor.measured_ns(frame) is None, "the server did not say"
    server.send_json({"event": "reconfigured", "sensor": 0, "delay_ms": {"force_torque": 1.88}})
    server.send_sample(2.0)
    (frame,) = sensor.receive()
    assert sensor.measured_ns(frame) == frame.stamp_ns - 1_880_000
    assert sensor.measured_ns(frame, "acceleration") is None


def test_raw_gives_every_frame_and_event_in_order(server: MemoryServer) -> None:
    sensor = client_of(server, fresh_only=False, every=2, raw=True)
    assert server.requests[-1] | {"id": 0} == {
        "action": "subscribe", "id": 0, "fresh_only": False, "every": 2
    }  # fmt: skip
    server.send_sample(1.0)
    server.send_json({"event": "reconfigured", "sensor": 0})
    for flags in (DataFlag.REPEATED, DataFlag.INVALID):
        server.send_sample(1.0, flags)
    server.drop()
    items: list[object] = []
    while not items or not isinstance(items[-1], Disconnected):
        items += sensor.poll_all()
    assert isinstance(items[0], Connected)
    found = [getattr(item, "epoch", getattr(item, "flags", item)) for item in items[1:-1]]
    assert found == [0, 0, {"event": "reconfigured", "sensor": 0}, 1, 1, 2]  # what is in force by its epoch


def test_without_reconnection_the_last_frames_come_before_the_error(server: MemoryServer) -> None:
    sensor = client_of(server, reconnect=False)
    server.send_sample(1.0)
    server.drop()
    assert [frame.sequence for frame in sensor.receive()] == [1]
    assert sensor.poll(1.0) == []
    assert isinstance(sensor.events[-1], Disconnected)
    with pytest.raises(ConnectionFailedError, match="closed"):
        sensor.poll(1.0)


def test_a_connection_that_ended_is_made_anew_and_begins_with_a_gap(server: MemoryServer) -> None:
    sensor = client_of(server)
    for connections in (1, 2, 3):
        server.send_sample(1.0)
        (frame,) = sensor.receive()
        assert bool(frame.flags & DataFlag.GAP) == (connections > 1)
        assert server.connections == connections
        server.drop()
        while sensor.session.connected:
            sensor.poll(1.0)
        while not sensor.session.connected:
            sensor.poll(1.0)
    kinds = [type(event) for event in sensor.events]
    assert kinds == [Connected, Disconnected, Connected, Disconnected, Connected, Disconnected, Connected]


def test_nothing_new_is_an_error_that_says_why(server: MemoryServer) -> None:
    sensor = client_of(server)
    with pytest.raises(NoSampleError, match="no new sample of sensor 0 for 20 ms: silent"):
        next(iter(sensor))
    for condition in (Condition.REPEATED, Condition.INVALID):
        server.send_sample(1.0)
        assert len(sensor.receive()) == 1
        begun_ns = server.now_ns
        flag = DataFlag[condition.name]
        server.at(begun_ns + 10_000_000, functools.partial(server.send_sample, 1.0, flag))
        with pytest.raises(NoSampleError) as caught:
            sensor.receive()
        assert caught.value.condition is condition
        assert server.now_ns == begun_ns + 20_000_000
    server.send_json({"event": "sensor_lost", "sensor": 0})
    with pytest.raises(NoSampleError) as caught:
        sensor.receive()
    assert caught.value.condition is Condition.SENSOR_LOST
    server.listens = False
    server.drop()
    with pytest.raises(NoSampleError, match=r"disconnected \(.+\)") as caught:
        sensor.receive()
    assert caught.value.condition is Condition.DISCONNECTED


def test_each_sensor_must_have_a_sample_in_time(server: MemoryServer) -> None:
    sensor = client_of(server, 2)
    begun_ns = server.now_ns
    server.send_sample(1.0, sensor=1)
    for ms in range(25):
        server.at(begun_ns + ms * 10**6, functools.partial(server.send_sample, 1.0))
    with pytest.raises(NoSampleError, match="no new sample of sensor 1 for 20 ms: silent"):
        deque(sensor, maxlen=0)
    assert server.now_ns == begun_ns + 20_000_000
    assert sensor.receive(), "the samples of sensor 0 are kept"
    server.send_sample(1.0, sensor=1)
    sensor.receive()
    server.now_ns += 25_000_000
    for number in range(3):
        server.send_sample(float(number))
    with pytest.raises(NoSampleError, match="sensor 1"):
        sensor.receive()
    sequences = [frame.sequence for frame in sensor.receive()]
    assert sequences == sorted(sequences), "those that are put back stay in order"
    assert sequences[-1] - sequences[-3] == 2


def test_what_comes_before_a_reply_is_kept(server: MemoryServer) -> None:
    sensor = client_of(server)
    server.send_sample(1.0)
    server.send_json({"event": "reconfigured", "sensor": 0})
    assert sensor.ask("status")["ok"]
    assert [frame.sequence for frame in sensor.poll()] == [1]
    assert sensor.events[-1] == {"event": "reconfigured", "sensor": 0}
    assert sensor.poll() == []


@pytest.mark.parametrize("rate_hz", [800, None])
def test_reading_connects_by_itself(server: MemoryServer, rate_hz: float | None) -> None:
    server.description["sensors"][0]["rate_hz"] = rate_hz
    server.on_subscribe = lambda: server.send_sample(1.0)
    assert [frame.sequence for frame in Client(1, channel=ScriptedChannel(server)).receive()] == [1]
    for sample in Client(1, channel=ScriptedChannel(server)):
        assert sample.force[0] == 1.0
        break


@pytest.mark.parametrize("timeout_s", [0, -1.0])
def test_a_new_connection_does_not_wait_either(timeout_s: float) -> None:
    """Over a socket: the waiting is the kernel's."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        channel = TcpChannel("127.0.0.1", listener.getsockname()[1])
        assert channel.connect(PATIENCE_S)
        waking = threading.Timer(1.0, channel.shutdown)  # one that waits says then that it has failed
        waking.start()
        try:
            assert channel.receive(bytearray(10), timeout_s) == 0
        finally:
            waking.cancel()
            channel.close()


@pytest.mark.parametrize("timeout_s", [0, -1.0])
def test_a_timeout_of_0_takes_what_has_arrived(server: MemoryServer, timeout_s: float) -> None:
    sensor, begun_ns = client_of(server, 2), server.now_ns
    for number in range(3):
        server.send_sample(1.0, sensor=number % 2)
    assert [frame.sequence for frame in sensor.receive(timeout_s)] == [1, 2, 3]
    with pytest.raises(NoSampleError, match="0 ms: the one before came within the last 20 ms"):
        sensor.receive(timeout_s)
    server.now_ns += 20_000_000
    with pytest.raises(NoSampleError, match="0 ms: silent"):
        sensor.receive(timeout_s)
    server.listens = False
    server.drop()
    with pytest.raises(NoSampleError, match="0 ms: disconnected"):
        sensor.receive(timeout_s)
    assert server.now_ns == begun_ns + 20_000_000


WAITS: dict[str, Callable[[Client, float], object]] = {
    "latest": lambda client, timeout_s: client.latest(timeout_s=timeout_s),
    "receive": lambda client, timeout_s: client.receive(timeout_s),
    "poll": Client.poll,
    "poll_all": Client.poll_all,
}


@pytest.mark.parametrize("wait", WAITS.values(), ids=WAITS)
def test_a_host_that_does_not_answer_takes_no_longer_than_the_timeout(
    wait: Callable[[Client, float], object], server: MemoryServer
) -> None:
    server.is_there = False
    client = Client(1, channel=ScriptedChannel(server))
    for timeout_s in (0.1, 2.0, 0.0, -1.0):
        begun_ns = server.now_ns
        with contextlib.suppress(NoSampleError):
            wait(client, timeout_s)
        assert begun_ns <= server.now_ns <= begun_ns + round(max(timeout_s, 0.0) * 1e9) + 1000


def test_the_newest_sample_is_asked_for_and_nothing_is_raised(server: MemoryServer) -> None:
    """After the only connection has ended, and while another thread closes it."""
    client = client_of(server, reconnect=False)
    server.drop()
    begun_ns = server.now_ns
    assert [client.latest(timeout_s=0.01).condition for _ in range(3)] == [Condition.DISCONNECTED] * 3
    assert server.now_ns <= begun_ns + 30_001_000
    client.close()
    assert client.latest(timeout_s=0.01).condition is Condition.DISCONNECTED


def test_what_nobody_takes_is_dropped_with_a_gap(server: MemoryServer) -> None:
    """While the only thread waits for a reply; of each sensor, and events as well."""
    client = client_of(server, 3)
    count, most = 70_000, 65_536
    for number in range(2):
        server.send_sample(1.0, sensor=number)
    for _ in range(count):
        server.send_sample(1.0, sensor=2, sequence=server.sequence - 1)
    server.send_sample(1.0, sensor=0, sequence=2)
    client.ask("status")
    frames = client.poll()
    assert len(frames) <= most
    kept = [frame for frame in frames if frame.sensor == 2]
    assert kept[-1].sequence - kept[0].sequence == len(kept) - 1, "the newest"
    flagged = [(frame.sensor, frame.sequence) for frame in frames if frame.flags & DataFlag.GAP]
    assert flagged == [(2, kept[0].sequence), (0, 2)]
    for sequence in (3, 4):
        server.send_sample(1.0, sensor=1, sequence=sequence)
    assert [frame.flags for frame in client.poll()] == [DataFlag.GAP, 0]


def test_a_request_that_nobody_waits_for_any_more_ends_nothing(server: MemoryServer) -> None:
    server.answers["status"] = lambda _: None
    client = client_of(server)

    async def ask() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.wrap_future(client.request("status")), 0)

    asyncio.run(ask())
    future = client.request("status")
    assert not future.cancel(), "it is sent"
    for request in server.requests[-2:]:
        server.send_json({"reply": "status", "id": request["id"], "ok": True})
    server.send_sample(1.0)
    assert len(client.poll()) == 1
    assert future.result()["ok"]
    client.request("status").cancel()
    server.drop()
    assert client.poll() == [], "the connection ended before the reply"


def test_odd_messages_cost_nothing(server: MemoryServer) -> None:
    sensor = client_of(server)
    for message in odd_messages():
        server.send_json(message)
    server.send_sample(1.0)
    assert sensor.latest().fresh
    assert all(isinstance(item["event"], str) for item in sensor.events if isinstance(item, dict))


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str | None]]:
    def named(boot: str | None, offsets: str | None) -> str | None:
        for name, text in (("_BOOT_ID", boot), ("_CLOCK_OFFSETS", offsets)):
            path = tmp_path / name
            path.unlink(missing_ok=True)
            if text is not None:
                path.write_text(text)
            monkeypatch.setattr(address, name, path)
        boot_id.cache_clear()
        return boot_id()

    monkeypatch.delenv("BOOT_ID", raising=False)
    yield named
    boot_id.cache_clear()


def test_a_clock_is_named_by_boot_and_offset(
    machine: Callable[..., str | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    boot = "30f330ff-4912-4148-a536-d779e31b74a6"
    unshifted = "monotonic           0         0\nboottime            7         0\n"
    assert machine(boot + "\n", unshifted) == boot
    assert machine(boot + "\n", None) == boot, "a kernel without time namespaces"
    assert machine(boot, unshifted.replace("0         0", "-86400         5", 1)) == f"{boot} -86400 5"
    for odd in ("", "monotonic", "monotonic 1\n", "monotonic a b\n", "boottime 0 0\n"):
        assert machine(boot, odd) is None
    assert machine("", unshifted) is None
    assert machine("no id", unshifted) is None
    assert machine(None, unshifted) is None
    monkeypatch.setenv("BOOT_ID", boot.replace("-", ""))  # as systemd's %b has it
    assert machine(None, unshifted) == boot


def test_a_refusal_is_the_servers_sentence(server: MemoryServer) -> None:
    refused = {"code": "sensor", "message": "it\nrefuses", "abort_code": 0x06090011}
    server.answers["sdo_read"] = lambda _: {"ok": False, "error": refused}
    server.answers["status"] = lambda _: {"ok": False}
    client = client_of(server)
    with pytest.raises(RefusedError, match="it\\?refuses") as caught:
        client.ask("sdo_read", sensor=0, index=0x8011)
    assert (caught.value.code, caught.value.abort_code) == ("sensor", 0x06090011)
    with pytest.raises(RefusedError, match="no reason"):
        client.ask("status")
    assert client.ask("describe")["ok"], "the connection goes on"


def test_no_reply_and_another_protocol_and_bytes_that_are_none(server: MemoryServer) -> None:
    server.answers["status"] = lambda _: None
    client = client_of(server)
    with pytest.raises(NoReplyError, match="no reply to status"):
        client.ask("status")
    server.send_raw(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    with pytest.raises(ConnectionFailedError, match="not this protocol"):
        client.ask("describe")
    for version in (2, True, None):
        server.description = description(protocol=version)
        with pytest.raises(ConnectionFailedError, match="install the same version"):
            client_of(server)


def test_a_refused_subscription_closes_the_connection(server: MemoryServer) -> None:
    server.answers["subscribe"] = lambda _: {"ok": False, "error": {"code": "bad_request", "message": "no"}}
    with pytest.raises(RefusedError):
        client_of(server)
    assert not server.is_connected


# -- over TCP


@pytest.fixture
def scripted() -> Iterator[ScriptedServer]:
    with ScriptedServer() as running:
        yield running


def test_what_is_not_granted_does_not_end_it(scripted: ScriptedServer) -> None:
    with connect(scripted.port, cpu=10**6, timeout_s=PATIENCE_S) as sensor:
        (refused,) = sensor.scheduling.refused
        assert refused.startswith("CPU 1000000 (there are ")
        scripted.send_sample(1.0)
        assert next(iter(sensor)).force[0] == 1.0


def test_nobody_there_and_a_host_that_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    with pytest.raises(
        UnreachableError, match=rf"^no server at localhost:{port} \(Connection refused\): start"
    ):
        connect(port)
    with pytest.raises(UnreachableError, match="65535"):
        connect(70000)
    with pytest.raises(ConnectionFailedError, match=f"not connected to localhost:{port}"):
        Client(port).ask("status")

    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    sentence = "no server at sensor-cell-3:12001 (Name or service not known): start ethercat-server, or give"
    with pytest.raises(UnreachableError, match=f"^{re.escape(sentence)} its address$"):
        connect(12001, "sensor-cell-3")


class HeldUp(ScriptedChannel):
    """Its client is not run for `held_s` once, in a `receive`, and does other things for `busy_s` of it."""

    held_s = 0.0

    def receive(self, buffer: bytearray | memoryview, timeout_s: float) -> int:
        count = super().receive(buffer, timeout_s)
        self._server.now_ns, self.held_s = self._server.now_ns + round(self.held_s * 1e9), 0.0
        return count


@pytest.mark.parametrize("busy", [True, False])
def test_a_client_knows_of_itself_that_it_did_not_look(
    busy: bool, server: MemoryServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    cpu_ns = 0
    monkeypatch.setattr(time, "process_time_ns", lambda: cpu_ns)
    client = Client(1, channel=HeldUp(server))
    assert client.take_unread() == (0.0, False), "without a connection there is nothing to read"
    client.connect()
    client.take_unread()
    client.poll(1.0)  # nobody sends anything
    assert client.take_unread()[0] == 0.0
    server.now_ns += 8_400_000_000
    cpu_ns += 8_400_000_000 * busy
    assert client.take_unread() == (8.4, busy)
    client.poll(0.0)
    assert client.take_unread() == (8.4, busy), "the same, once it has looked"
    client.poll(0.1)
    assert client.take_unread()[0] == 0.0
    for _ in range(84):  # the thread that reads does other things, which need no CPU: another one runs
        server.now_ns += 100_000_000
        unread_s, is_busy = client.take_unread()
    assert (round(unread_s, 3), is_busy) == (8.4, True)


def test_a_client_that_was_not_run_does_not_say_that_the_server_is_silent(server: MemoryServer) -> None:
    channel = HeldUp(server)
    client = Client(1, channel=channel).connect()
    server.now_ns += 10**9  # its caller's
    channel.held_s = 0.12
    with pytest.raises(
        NoSampleError, match=r"for 20 ms: late: this program did not read for 120 ms$"
    ) as late:
        client.receive(0.02)
    assert late.value.condition is Condition.SILENT
    server.now_ns += 10**9
    with pytest.raises(NoSampleError, match=r"for 20 ms: silent: nothing arrives from the server$"):
        client.receive(0.02)


@contextlib.contextmanager
def returned(client: Client) -> Iterator[None]:
    """What is done meanwhile does not wait until the client is closed."""
    closer = threading.Timer(PATIENCE_S, client.close)
    closer.start()
    try:
        yield
        assert closer.is_alive(), "it returned because it was closed"
    finally:
        closer.cancel()
        client.close()


def waits_everywhere(client: Client) -> None:
    """All that waits returns while connecting is pending; then it is said that nobody answers."""
    with returned(client):
        for wait in (*WAITS.values(), *WAITS.values()):
            for timeout_s in (0.01, 0.0, -1.0):
                with contextlib.suppress(NoSampleError):
                    wait(client, timeout_s)
        assert client.latest().condition is Condition.DISCONNECTED
        with pytest.raises(UnreachableError, match=f"^no server at {client.address} \\((?!no conn)"):
            client.connect()


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bota_ethercat.client.channel.CONNECT_TIMEOUT_S", 0.2)


@pytest.mark.usefixtures("hasty")
def test_a_full_backlog_takes_no_longer_than_the_timeout() -> None:
    """`connect` is pending: the computer is off, or its program hangs."""
    with full_listener() as port:
        waits_everywhere(Client(port))


@pytest.mark.usefixtures("hasty")
def test_name_servers_that_do_not_answer_take_no_longer_than_the_timeout(
    monkeypatch: pytest.MonkeyPatch, scripted: ScriptedServer
) -> None:
    answered, asked, look_up = threading.Event(), list[object](), socket.getaddrinfo

    def late(host: object, *arguments: Any, **options: Any) -> Any:
        asked.append(host)
        answered.wait()
        return look_up("localhost", *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", late)
    client = Client(scripted.port, "robot")
    waits_everywhere(client)
    client = Client(scripted.port, "robot")
    with contextlib.closing(client):
        for _ in range(3):
            with pytest.raises(UnreachableError, match="the name servers do not answer"):
                client.connect()
        assert asked == ["robot"] * 2, "no more threads, however often"
        answered.set()
        client.connect()


def test_no_socket_of_a_family_is_an_address_that_does_not_answer(
    monkeypatch: pytest.MonkeyPatch, scripted: ScriptedServer
) -> None:
    """::1 comes first, and a process may be allowed IPv4 only; whichever comes first."""
    found = [(socket.AF_INET6, ("::1", scripted.port)), (socket.AF_INET, ("127.0.0.1", scripted.port))]
    real = socket.socket

    def made(family: int = -1, *rest: Any, **options: Any) -> socket.socket:
        if family == socket.AF_INET6:
            raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))
        return real(family, *rest, **options)

    monkeypatch.setattr(socket, "socket", made)
    for addresses in (found, found[::-1]):
        rows = [(family, socket.SOCK_STREAM, 6, "", address) for family, address in addresses]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, rows=rows, **__: rows)
        with connect(scripted.port) as client:
            assert client.ask("status")["ok"]
    scripted.close()
    with pytest.raises(UnreachableError):
        connect(scripted.port)


def test_another_thread_may_close_it(scripted: ScriptedServer) -> None:
    client = connect(scripted.port)
    closer = threading.Timer(0.1, client.close)
    closer.start()
    with pytest.raises(ConnectionFailedError):
        client.receive(PATIENCE_S)
    closer.join()
    with pytest.raises(ConnectionFailedError, match="closed"):
        client.receive(1.0)
    with pytest.raises(ConnectionFailedError, match="closed"):
        client.ask("status")


def test_another_thread_may_ask_while_one_receives(scripted: ScriptedServer) -> None:
    with connect(scripted.port) as client:
        over = threading.Event()

        def read() -> None:
            while not over.is_set():
                client.poll(0.05)

        reader = threading.Thread(target=read)
        reader.start()
        client.channel.wait(over, 0.1)
        try:
            assert all(client.ask("status")["ok"] for _ in range(20))
        finally:
            over.set()
            reader.join()


def test_it_receives_beyond_1024_descriptors(scripted: ScriptedServer) -> None:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, limits[1]), limits[1]))
    with contextlib.ExitStack() as taken:
        taken.callback(resource.setrlimit, resource.RLIMIT_NOFILE, limits)
        while taken.enter_context(open(os.devnull)).fileno() < 1024:  # noqa: PTH123
            pass
        sensor = taken.enter_context(connect(scripted.port, timeout_s=PATIENCE_S))
        assert scripted.subscribed.wait(PATIENCE_S)
        scripted.send_sample(1.0)
        assert [frame.sequence for frame in sensor.receive()] == [1]


def test_what_waits_for_a_slow_reader_is_bounded() -> None:
    """Left to itself the kernel makes room for ever more, up to 32 MB, the longer a connection is read."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        reader = TcpChannel("127.0.0.1", listener.getsockname()[1])
        assert reader.connect(PATIENCE_S)
        writer, _ = listener.accept()
    writer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)  # as the server's
    writer.setblocking(False)
    waiting = most = 0
    buffer = memoryview(bytearray(65536))
    with writer, contextlib.closing(reader):
        for _ in range(3000):
            with contextlib.suppress(BlockingIOError):
                while True:
                    waiting += writer.send(bytes(856))  # eight frames
            most = max(most, waiting)
            waiting -= reader.receive(buffer, PATIENCE_S)
    assert most < 340_000, "a second of two sensors at 1600 Hz"


def examples() -> list[str]:
    text = (ROOT / "docs" / "protocol.md").read_text().split("## A client in ten lines")[1].split("\n## ")[0]
    return [part.split("```")[0] for part in text.split("```python\n")[1:]]


def test_the_ten_lines_of_the_docs_run() -> None:
    example = examples()[0]
    assert len(example.splitlines()) <= 10
    with ScriptedServer() as scripted:

        def three_samples() -> None:
            for number in range(3):
                scripted.send_sample(float(number))
            scripted.drop()

        scripted.on_subscribe = three_samples
        run = subprocess.run(
            [sys.executable, "-c", example.replace("12001", str(scripted.port))],
            check=False, capture_output=True, text=True, timeout=30, cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
    assert run.stdout.count("\n") >= 3, run.stderr
    assert "NoSampleError: no new sample of sensor 0" in run.stderr


Pull = Callable[[Simulation, MemoryChannel], object]
PULLS: dict[str, tuple[Pull, str]] = {
    "sensor": (lambda server, _: server.command("power off"), "no force: invalid"),
    "cable": (lambda server, _: server.command("disconnect"), "no force: invalid"),
    "server stopped": (lambda server, _: setattr(server, "hangs", True), "no force: (silent|late)"),
    "server killed": (lambda _, channel: channel.kill(), "no force: disconnected"),
}


def guard(channel: TcpChannel) -> Callable[[Callable[[str], object]], object]:
    source = examples()[1]
    assert len(source.splitlines()) <= 16
    names: dict[str, Any] = {}
    exec(source.replace("signal.signal(number", "print(number"), names)  # the signals are not this process's
    names["Client"] = lambda _, **options: Client(1, channel=channel, **options)
    found: Callable[[Callable[[str], object]], object] = names["guard"]
    return found


@pytest.mark.parametrize(("pull", "reason"), PULLS.values(), ids=PULLS)
def test_the_guard_of_the_docs_stops_within_two_timeouts(pull: Pull, reason: str) -> None:
    server = Simulation(settings={"sinc_length": 64})
    channel = MemoryChannel(server)
    pulled_ns = server.clock.now_ns + 2_000_000_000

    def stop(why: str) -> None:
        assert pulled_ns < server.clock.now_ns < pulled_ns + 21_000_000, why
        assert re.match(reason, why)

    server.clock.at(pulled_ns, lambda: pull(server, channel))
    guard(channel)(stop)


BEGINNINGS: dict[str, tuple[Callable[[MemoryServer], object], str]] = {
    "no server": (lambda server: setattr(server, "listens", False), "no force: disconnected"),
    "computer off": (lambda server: setattr(server, "is_there", False), "no force: disconnected"),
    "server hangs": (lambda server: server.answers.update(describe=lambda _: None), "no force: disconnected"),
    "refused": (lambda server: server.answers.update(subscribe=lambda _: {"ok": False}), "no force: disconn"),
    "no sensor": (lambda server: server.description.update(sensors=[sensor_row(1)]), "no force: disconn"),
    "another program": (
        lambda server: setattr(server, "receive", lambda *_: server.send_raw(b"HTTP/1.1 400 Bad\r\n")),
        "no force: disconnected",
    ),
    "sensor lost": (
        lambda server: setattr(server, "on_subscribe", lambda: server.send_sample(0.0, DataFlag.INVALID)),
        "no force: (silent|invalid)",
    ),
    "nothing comes": (lambda server: None, "no force: silent"),
    "not finite": (
        lambda server: setattr(server, "on_subscribe", lambda: server.send_sample(math.nan)),
        "no force: faulty",
    ),
    "over the limit": (
        lambda server: setattr(server, "on_subscribe", lambda: server.send_sample(-60.0)), "60.0 N",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("begin", "reason"), BEGINNINGS.values(), ids=BEGINNINGS)
def test_the_guard_of_the_docs_stops_in_every_state_that_it_begins_in(
    begin: Callable[[MemoryServer], object], reason: str, server: MemoryServer
) -> None:
    begin(server)
    begun_ns, said = server.now_ns, list[str]()
    guard(ScriptedChannel(server))(said.append)
    assert len(said) == 1
    assert re.match(reason, said[0]), said
    assert server.now_ns <= begun_ns + 1_010_000_000


def test_the_guard_of_the_docs_waits_for_a_server_and_stops_when_it_is_ended(
    server: MemoryServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> int:
        raise KeyboardInterrupt

    server.listens = False
    server.on_subscribe = lambda: server.send_sample(-60.0)
    channel, said = ScriptedChannel(server), list[str]()
    wait = channel.wait

    def waited(event: threading.Event, seconds: float) -> bool:
        server.listens = True
        return wait(event, seconds)

    monkeypatch.setattr(channel, "wait", waited)
    guard(channel)(said.append)
    monkeypatch.setattr(channel, "receive", interrupt)
    with pytest.raises(KeyboardInterrupt):
        guard(channel)(said.append)
    assert said == ["60.0 N", "the guard has ended"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_guard_of_the_docs_stops_at_every_signal_that_ends_it(number: int) -> None:
    """A process, which systemd, docker and the end of an ssh session end so."""
    with served() as server:
        script = examples()[1].replace("12001", str(server.port)).replace("latest(", "latest(max_age_s=60, ")
        command = [sys.executable, "-c", f"{script}\nguard(lambda why: print(why, flush=True))"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            try:
                deadline = time.monotonic() + PATIENCE_S
                while not server.hub.connections and time.monotonic() < deadline:
                    time.sleep(0.01)
                process.send_signal(number)
                assert process.communicate(timeout=PATIENCE_S)[0] == "the guard has ended\n"
            finally:
                process.kill()
