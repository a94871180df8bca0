"""The Python client: against a scripted server in simulated time, over TCP, and against a whole server.

What it makes of a stream, `latest` above all, is in tests/protocol/golden/readings.json, for both languages.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import resource
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
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
from tests.bridge.scripted_server import ScriptedServer, description, process_data
from tests.golden_vectors import odd_messages
from tests.protocol.scripted_channel import MemoryServer, ScriptedChannel
from tests.server.running import PATIENCE_S, free_port
from tests.simulation import MemoryChannel, Simulation

ROOT = Path(__file__).parents[2]


@pytest.fixture
def server() -> MemoryServer:
    return MemoryServer()


def client_of(server: MemoryServer, **options: Any) -> Client:
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


def test_units_and_sizes(server: MemoryServer) -> None:
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
    sensor = client_of(server, fresh_only=False, every=2, sensors=[0], raw=True)
    assert server.requests[-1] | {"id": 0} == {
        "action": "subscribe", "id": 0, "fresh_only": False, "every": 2, "sensors": [0]
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
    assert [getattr(item, "flags", item) for item in items[1:-1]] == [
        0, {"event": "reconfigured", "sensor": 0}, 1, 2
    ]  # fmt: skip


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
    rows = [{"sensor": number, "rate_hz": 800} for number in (0, 1)]
    server.description = description() | {"sensors": rows}
    sensor = client_of(server)
    begun_ns = server.now_ns
    server.send_sample(1.0, sensor=1)
    for ms in range(25):
        server.at(begun_ns + ms * 10**6, functools.partial(server.send_sample, 1.0))
    with pytest.raises(NoSampleError, match="no new sample of sensor 1 for 20 ms: silent"):
        deque(sensor, maxlen=0)
    assert server.now_ns == begun_ns + 20_000_000
    assert sensor.receive(), "the samples of sensor 0 are kept"


def test_what_comes_before_a_reply_is_kept(server: MemoryServer) -> None:
    sensor = client_of(server)
    server.send_sample(1.0)
    server.send_json({"event": "reconfigured", "sensor": 0})
    assert sensor.ask("status")["ok"]
    assert [frame.sequence for frame in sensor.poll()] == [1]
    assert sensor.events[-1] == {"event": "reconfigured", "sensor": 0}
    assert sensor.poll() == []


def test_odd_messages_cost_nothing(server: MemoryServer) -> None:
    sensor = client_of(server)
    for message in odd_messages():
        server.send_json(message)
    server.send_sample(1.0)
    assert sensor.latest().fresh


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str | None]]:
    """`boot_id` of a machine whose kernel says these things; None: there is no such file."""

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


def test_nobody_there() -> None:
    with pytest.raises(UnreachableError):
        connect(free_port())
    with pytest.raises(UnreachableError):
        connect(70000)


def test_a_host_that_is_not_known_is_said_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(UnreachableError, match=r"^Name or service not known$"):
        connect(12001, "sensor-cell-3")


class HeldUp(ScriptedChannel):
    """Its client is not run for `held_s` once, in a `receive`, and does other things for `busy_s` of it."""

    held_s = 0.0

    def receive(self, buffer: memoryview, timeout_s: float) -> int:
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


@pytest.mark.parametrize("hosts", [("::1", "127.0.0.1"), ("127.0.0.1", "::1")])
def test_an_address_that_this_computer_cannot_have_is_passed_over(
    hosts: Sequence[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without IPv6 `localhost` has its address all the same. With a server, and without one before that."""

    class Socket(socket.socket):
        def __init__(self, family: int = socket.AF_INET, *arguments: Any, **named: Any) -> None:
            if family == socket.AF_INET6:
                raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))
            super().__init__(family, *arguments, **named)

    families = [socket.AF_INET6 if ":" in host else socket.AF_INET for host in hosts]
    port = free_port()
    found = [(family, 0, 0, "", (host, port)) for family, host in zip(families, hosts, strict=True)]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    monkeypatch.setattr(socket, "socket", Socket)
    with contextlib.closing(Client(port)) as client:
        with pytest.raises(UnreachableError, match=r"^Connection refused$"):
            client.connect()
        with ScriptedServer(port):
            client.connect()


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
    """Which `select` does not take."""
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
    """Of the section of the docs."""
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


@pytest.mark.parametrize(("pull", "reason"), PULLS.values(), ids=PULLS)
def test_the_guard_of_the_docs_stops_within_two_timeouts(pull: Pull, reason: str) -> None:
    source = examples()[1]
    assert len(source.splitlines()) <= 15
    server = Simulation(settings={"sinc_length": 64})
    channel = MemoryChannel(server)
    names: dict[str, Any] = {}
    exec(source, names)
    names["connect"] = lambda port, **options: Client(port, channel=channel, **options).connect()
    pulled_ns = server.clock.now_ns + 2_000_000_000

    def stop(why: str) -> None:
        assert pulled_ns < server.clock.now_ns < pulled_ns + 21_000_000, why
        assert re.match(reason, why)

    server.clock.at(pulled_ns, lambda: pull(server, channel))
    names["guard"](stop)
