"""Runs `ethercat-server` and `ethercat-virtual-sensor` as processes, and talks to them over real sockets."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from bota_ethercat.control import request
from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.framing import DataFlag, DataMessage, FrameDecoder, encode_json
from bota_ethercat.text.json_text import JsonObject

START_TIMEOUT_S = 40.0
PATIENCE_S = 30.0


def why_no_bus() -> str | None:
    """Why this machine cannot run a bus over a veth pair; None if it can."""
    name = f"ec{os.getpid()}t"
    made = subprocess.run(
        ["ip", "link", "add", name, "type", "veth", "peer", "name", name + "x"],
        check=False,
        capture_output=True,
        text=True,
    )
    if made.returncode:
        return f"no veth pairs here ({made.stderr.strip()}): run as root with CAP_NET_ADMIN"
    subprocess.run(["ip", "link", "del", name], check=True)
    try:
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW).close()
    except PermissionError:
        return "no raw sockets here: run as root with CAP_NET_RAW"
    return None


NO_BUS = why_no_bus()
needs_bus = pytest.mark.skipif(NO_BUS is not None, reason=NO_BUS or "")


def has_ipv6() -> bool:
    """Whether this machine has the address ::1."""
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


def _ports() -> Iterator[int]:
    """This worker's, below those that the kernel gives to whoever asks for any: nobody else takes one."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    first, count = 13_000 + worker % 4 * 4_500, 4_500
    start = random.randrange(count)  # two runs on one machine
    while True:
        yield from (first + (start + number) % count for number in range(count))


_PORTS = _ports()


def free_port() -> int:
    for port in _PORTS:
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("unreachable")


def wait_until(condition: Callable[[], object], what: str, seconds: float = PATIENCE_S) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited {seconds} s for {what}"
        time.sleep(0.02)


_AWAY = "taken out of OP to be set up: ask again"
_AWAY_S = 20.0


class Program:
    """A program of ours running as a process, its standard error in a file."""

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        under: Sequence[str] = (),
        python: str | Path = sys.executable,
    ) -> None:
        """`under` is a command that becomes the program given behind it, such as `setpriv ...`."""
        descriptor, path = tempfile.mkstemp(prefix="ethercat-test-")
        self.log = Path(path)
        with open(descriptor, "w") as log:  # noqa: PTH123
            self.process = subprocess.Popen(
                [*under, python, "-m", module, *arguments],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )

    def said(self) -> str:
        return self.log.read_text()

    def wait_for(self, text: str) -> None:
        def arrived() -> bool:
            assert self.process.poll() is None, f"ended with {self.process.returncode}: {self.said()}"
            return text in self.said()

        wait_until(
            arrived, f"{text!r} from {self.process.args!r}, which said {self.said()!r}", START_TIMEOUT_S
        )

    def wait(self) -> int:
        return self.process.wait(timeout=PATIENCE_S)

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        if self.process.stdin:
            with contextlib.suppress(BrokenPipeError):
                self.process.stdin.close()
        self.log.unlink(missing_ok=True)


class Server(Program):
    """A running server, on a free port unless it is told which."""

    def __init__(
        self,
        ifname: str,
        *arguments: str,
        name: str | None = None,
        port: int = 0,
        under: Sequence[str] = (),
        python: str | Path = sys.executable,
    ) -> None:
        self.port = port or free_port()
        names = [name] if name else []
        super().__init__(
            "ethercat_server.daemon.cli", [ifname, *names, str(self.port), *arguments], under, python
        )

    @property
    def ifname(self) -> str:
        """The bus's interface, which for `virtual` is named after the process."""
        return f"ecat{self.process.pid}"

    def wait_streaming(self) -> Server:
        self.wait_for("streaming")
        return self

    def connect(self) -> Client:
        return Client(self.port)


@contextlib.contextmanager
def server(ifname: str, *arguments: str, port: int = 0, under: Sequence[str] = ()) -> Iterator[Server]:
    running = _streaming(ifname, *arguments, port=port, under=under)
    try:
        yield running
    finally:
        running.close()


_STARVED = (
    "no EtherCAT slave answers",
    "stopped answering",
    "did not answer",
    "does not answer in",
    "is lost: no frame comes back",
    "cannot be read",
    "0x00000000",  # vendor or product
    "cannot be mapped",
    "does not end",
    "does not go to",  # after a lost frame of SOEM's set-up
    "maps process data of",  # as much of it as SOEM could read in its time
)
"""What it says at start where a busy machine lets the virtual sensor's process wait for too long."""
ATTEMPTS = 5


def starved(said: str) -> bool:
    """Whether the sensor may have been."""
    return any(words in said for words in _STARVED)


def _streaming(ifname: str, *arguments: str, port: int, under: Sequence[str]) -> Server:
    """A server that streams; started again where the sensor was starved."""
    for attempt in range(ATTEMPTS):
        running = Server(ifname, *arguments, port=port, under=under)
        try:
            return running.wait_streaming()
        except BaseException:
            said = running.said()
            running.close()
            if attempt == ATTEMPTS - 1 or not starved(said):
                raise
    raise AssertionError("unreachable")


class Veth:
    """A veth pair of this test's own: `near` for the master, `far` for the sensor."""

    def __init__(self) -> None:
        unique = f"{os.getpid() % 1_000_000:06d}{time.monotonic_ns() // 1000 % 100_000:05d}"
        self.near, self.far = f"en{unique}", f"ef{unique}"

    def __enter__(self) -> Veth:
        self.ip("link", "add", self.near, "type", "veth", "peer", "name", self.far)
        self.ip("link", "set", self.near, "up")
        self.ip("link", "set", self.far, "up")
        wait_until(lambda: "LOWER_UP" in self.ip("link", "show", self.near), "the carrier")
        return self

    def __exit__(self, *_: object) -> None:
        subprocess.run(["ip", "link", "del", self.near], check=False, capture_output=True)

    @staticmethod
    def ip(*arguments: str) -> str:
        return subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True).stdout


@contextlib.contextmanager
def virtual_sensor(
    *arguments: str, module: str = "ethercat_server.virtual_sensor", first: tuple[str, ...] = ()
) -> Iterator[tuple[Veth, Program]]:
    """A veth pair with a virtual sensor on its far end: `module first... IFACE arguments...`."""
    with Veth() as veth:
        sensor = Program(module, [*first, veth.far, *arguments])
        try:
            sensor.wait_for("ready")
            yield veth, sensor
        finally:
            sensor.close()


def check_not_lost(client: Client, events: Sequence[JsonObject], lost_frames: int = 0) -> None:
    """None of the `events` says that a sensor was lost; for what loses no frame itself.

    Where there are more than `lost_frames` all the same, a busy machine starved the virtual sensor, and
    nothing can be said.
    """
    lost = [event for event in events if event["event"] in ("sensor_lost", "sensor_back")]
    assert not lost or client.ask("status")["lost_frames"] > lost_frames, lost


class Client:
    """A framed connection that keeps everything, and looks into refused replies too."""

    def __init__(self, port: int) -> None:
        try:
            self.sock = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        except ConnectionError as error:
            raise ConnectionFailedError(str(error)) from None
        self._decoder = FrameDecoder()
        self.events: list[JsonObject] = []
        self.frames: list[DataMessage] = []
        self._id = 0

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.sock.close()

    def receive(self) -> JsonObject | None:
        """Wait for one message; a reply is returned, frames and events are put by."""
        while (message := self._decoder.next_message()) is None:
            try:
                data = self.sock.recv(65536)
            except ConnectionError as error:
                raise ConnectionFailedError(str(error)) from None
            if not data:
                raise ConnectionFailedError("the server closed it")
            self._decoder.feed(data)
        if isinstance(message, DataMessage):
            self.frames.append(message)
            return None
        if "event" in message:
            self.events.append(message)
            return None
        return message

    def receive_all(self) -> None:
        """Receive until the server closes the connection."""
        with contextlib.suppress(ConnectionFailedError):
            while True:
                self.receive()

    def ask(self, action: str, **values: object) -> dict[str, Any]:
        """The reply to a request; asked again while a starved sensor is away for a moment."""
        deadline = time.monotonic() + _AWAY_S
        while True:
            reply = self.ask_once(action, **values)
            if _AWAY not in reply.get("error", {}).get("message", "") or time.monotonic() > deadline:
                return reply
            time.sleep(0.05)

    def ask_once(self, action: str, **values: object) -> dict[str, Any]:
        """The reply to a request, also where the sensor is lost on purpose."""
        self._id += 1
        self.sock.sendall(encode_json(request(action, self._id, **values)))
        while True:
            message = self.receive()
            if message is not None:
                assert message["id"] == self._id
                return message

    def wait_event(self, name: str) -> JsonObject:
        """The first event of this name that has not been asked for yet."""
        while not any(event["event"] == name for event in self.events):
            self.receive()
        found = next(event for event in self.events if event["event"] == name)
        self.events.remove(found)
        return found

    def collect(self, count: int) -> list[DataMessage]:
        """The next `count` frames."""
        self.frames.clear()
        while len(self.frames) < count:
            self.receive()
        return list(self.frames)

    def fresh(self, count: int) -> list[DataMessage]:
        """The next `count` frames that are new and valid samples."""
        self.frames.clear()
        old = DataFlag.REPEATED | DataFlag.INVALID
        while sum(not frame.flags & old for frame in self.frames) < count:
            self.receive()
        return [frame for frame in self.frames if not frame.flags & old]
