"""The blocking client, against a scripted server and a whole one."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import socket
import subprocess
import sys
import threading
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
from tests.bridge.scripted_server import ScriptedServer, description, process_data
from tests.served_simulation import served
from tests.server.running import PATIENCE_S, free_port
from tests.simulation import MemoryChannel, Simulation

ROOT = Path(__file__).parents[2]


@pytest.fixture
def scripted() -> Iterator[ScriptedServer]:
    with ScriptedServer() as running:
        yield running


@pytest.fixture
def sensor(scripted: ScriptedServer) -> Iterator[Client]:
    """One that has subscribed, and waits for long."""
    with connect(scripted.port, timeout_s=PATIENCE_S) as client:
        assert scripted.subscribed.wait(PATIENCE_S)
        yield client


def test_samples_come_decoded_in_order_and_nothing_old(scripted: ScriptedServer, sensor: Client) -> None:
    scripted.send_sample(1.0)
    scripted.send_sample(1.0, DataFlag.REPEATED)
    scripted.send_sample(1.0, DataFlag.INVALID)
    scripted.send_sample(2.0, DataFlag.GAP)
    samples = iter(sensor)
    first, second = next(samples), next(samples)
    assert [first.force[0], second.force[0]] == [1.0, 2.0]
    assert first.acceleration[0] == pytest.approx((1.0 + 6 / 16) * STANDARD_GRAVITY)
    assert sensor.frame is not None
    assert sensor.frame.sequence == 4
    assert sensor.frame.flags & DataFlag.GAP


def test_units_and_sizes(scripted: ScriptedServer) -> None:
    with connect(scripted.port, imu_units=ImuUnits.SI, timeout_s=PATIENCE_S) as sensor:
        assert scripted.subscribed.wait(PATIENCE_S)
        scripted.send_sample(3.0, process_data=process_data(3.0, 77))
        assert next(iter(sensor)).acceleration[0] == 3.0 + 6 / 16


def test_what_is_not_granted_does_not_end_it(scripted: ScriptedServer) -> None:
    with connect(scripted.port, cpu=10**6, timeout_s=PATIENCE_S) as sensor:
        (refused,) = sensor.scheduling.refused
        assert refused.startswith("CPU 1000000 (there are ")
        scripted.send_sample(1.0)
        assert next(iter(sensor)).force[0] == 1.0


def test_raw_gives_every_frame_and_event_in_order(scripted: ScriptedServer) -> None:
    with Client(scripted.port, fresh_only=False, every=2, sensors=[0], raw=True) as sensor:
        sensor.connect()
        assert scripted.requests[-1] | {"id": 0} == {
            "action": "subscribe", "id": 0, "fresh_only": False, "every": 2, "sensors": [0]
        }  # fmt: skip
        scripted.send_sample(1.0)
        scripted.send_json({"event": "reconfigured", "sensor": 0})
        for flags in (DataFlag.REPEATED, DataFlag.INVALID):
            scripted.send_sample(1.0, flags)
        scripted.drop()
        items: list[object] = []
        while not items or not isinstance(items[-1], Disconnected):
            items += sensor.poll_all(PATIENCE_S)
        assert isinstance(items[0], Connected)
        assert [getattr(item, "flags", item) for item in items[1:-1]] == [
            0, {"event": "reconfigured", "sensor": 0}, 1, 2
        ]  # fmt: skip


def test_without_reconnection_the_last_frames_come_before_the_error(scripted: ScriptedServer) -> None:
    with Client(scripted.port, reconnect=False).connect() as sensor:
        assert scripted.subscribed.wait(PATIENCE_S)
        scripted.send_sample(1.0)
        scripted.drop()
        scripted.disconnected.wait(PATIENCE_S)
        assert [frame.sequence for frame in sensor.receive(PATIENCE_S)] == [1]
        assert sensor.poll(PATIENCE_S) == []
        assert isinstance(sensor.events[-1], Disconnected)
        with pytest.raises(ConnectionFailedError, match="closed"):
            sensor.poll(PATIENCE_S)


def test_a_connection_that_ended_is_made_anew_and_begins_with_a_gap(
    scripted: ScriptedServer, sensor: Client
) -> None:
    for connections in (1, 2, 3):
        assert scripted.subscribed.wait(PATIENCE_S)
        scripted.send_sample(1.0)
        (frame,) = sensor.receive(PATIENCE_S)
        assert bool(frame.flags & DataFlag.GAP) == (connections > 1)
        assert scripted.connections == connections
        scripted.drop()
        while sensor.session.connected:
            sensor.poll(PATIENCE_S)
        while not sensor.session.connected:
            sensor.poll(PATIENCE_S)
    kinds = [type(event) for event in sensor.events]
    assert kinds == [Connected, Disconnected, Connected, Disconnected, Connected, Disconnected, Connected]


def test_nothing_new_is_an_error_that_says_why(scripted: ScriptedServer) -> None:
    with connect(scripted.port) as sensor:
        with pytest.raises(NoSampleError, match="no new sample of sensor 0 for 20 ms: silent") as caught:
            next(iter(sensor))
        assert caught.value.condition is Condition.SILENT
        for flags, condition in (
            (DataFlag.REPEATED, Condition.REPEATED),
            (DataFlag.INVALID, Condition.INVALID),
        ):
            scripted.send_sample(1.0)
            assert len(sensor.receive(PATIENCE_S)) == 1
            scripted.send_sample(1.0, flags)
            with pytest.raises(NoSampleError) as caught:
                sensor.receive(0.3)
            assert caught.value.condition in (condition, Condition.SILENT)
        scripted.send_json({"event": "sensor_lost", "sensor": 0})
        with pytest.raises(NoSampleError) as caught:
            sensor.receive()
        assert caught.value.condition is Condition.SENSOR_LOST
        scripted.close()
        while sensor.session.connected:
            sensor.poll(PATIENCE_S)
        with pytest.raises(NoSampleError, match=r"disconnected \(.+\)") as caught:
            sensor.receive()
        assert caught.value.condition is Condition.DISCONNECTED


def test_what_comes_before_a_reply_is_kept(scripted: ScriptedServer, sensor: Client) -> None:
    scripted.send_sample(1.0)
    scripted.send_json({"event": "reconfigured", "sensor": 0})
    assert sensor.ask("status")["ok"]
    assert [frame.sequence for frame in sensor.poll()] == [1]
    assert sensor.events[-1] == {"event": "reconfigured", "sensor": 0}
    assert sensor.poll(0.01) == []


OURS = boot_id()


CLAIMED: list[tuple[object, bool]] = [
    (OURS, True), ("elsewhere", False), ("", False), (f"{OURS} 5 0", False), ("x" * 60_000, False),
    (None, True), (7, True), (True, True), ([OURS], True), ({}, True),
]  # fmt: skip


@pytest.mark.parametrize(("claimed", "near"), CLAIMED)
def test_a_named_clock_decides_whose_it_is(scripted: ScriptedServer, claimed: object, near: bool) -> None:
    """By its address the server is always here, as behind an SSH tunnel; what cannot be a name is none."""
    scripted.description = description(boot_id=claimed)
    with connect(scripted.port) as client:
        assert client.session.same_machine == near


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


def test_a_refusal_is_the_servers_sentence(scripted: ScriptedServer) -> None:
    refused = {"code": "sensor", "message": "it\nrefuses", "abort_code": 0x06090011}
    scripted.answers["sdo_read"] = lambda _: {"ok": False, "error": refused}
    scripted.answers["status"] = lambda _: {"ok": False}
    with connect(scripted.port) as client:
        with pytest.raises(RefusedError, match="it\\?refuses") as caught:
            client.ask("sdo_read", sensor=0, index=0x8011)
        assert (caught.value.code, caught.value.abort_code) == ("sensor", 0x06090011)
        with pytest.raises(RefusedError, match="no reason"):
            client.ask("status")
        assert client.ask("describe")["ok"], "the connection goes on"


def test_no_reply_and_another_protocol_and_bytes_that_are_none(scripted: ScriptedServer) -> None:
    scripted.answers["status"] = lambda _: None
    with connect(scripted.port) as client:
        with pytest.raises(NoReplyError, match="no reply to status"):
            client.ask("status", timeout_s=0.05)
        scripted.send_raw(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        with pytest.raises(ConnectionFailedError, match="not this protocol"):
            client.ask("describe")
    for version in (2, True, None):
        scripted.description = description(protocol=version)
        with pytest.raises(ConnectionFailedError, match="install the same version"):
            connect(scripted.port)


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


def test_a_refused_subscription_closes_the_connection(scripted: ScriptedServer) -> None:
    scripted.answers["subscribe"] = lambda _: {"ok": False, "error": {"code": "bad_request", "message": "no"}}
    with pytest.raises(RefusedError):
        connect(scripted.port)
    assert scripted.disconnected.wait(PATIENCE_S)


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


@pytest.fixture
def descriptors_to_1024() -> Iterator[None]:
    """Everything that is opened from now on has a descriptor that `select` does not take."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, limits[1]), limits[1]))
    taken = [os.open(os.devnull, os.O_RDONLY)]
    while taken[-1] < 1024:
        taken.append(os.dup(taken[0]))
    yield
    for descriptor in taken:
        os.close(descriptor)
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_it_receives_beyond_1024_descriptors(
    scripted: ScriptedServer, descriptors_to_1024: None, sensor: Client
) -> None:
    assert sensor.fileno() > 1024
    scripted.send_sample(1.0)
    assert [frame.sequence for frame in sensor.receive(PATIENCE_S)] == [1]


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


def test_every_sample_of_a_whole_server_once_and_in_order() -> None:
    with served(sinc_length=256) as server, connect(server.port, timeout_s=PATIENCE_S) as sensor:
        assert sensor.description["sensors"][0]["rate_hz"] == 200
        numbers = []
        for sample in sensor:
            assert sensor.frame is not None
            assert sample.is_finite
            numbers.append(sensor.frame.sequence)
            if len(numbers) == 100:
                break
        assert numbers == sorted(set(numbers))
        assert sensor.ask("status")["ok"]
        assert sensor.receive(PATIENCE_S)


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
