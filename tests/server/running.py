"""Runs `ethercat-server` and `ethercat-virtual-sensor` as processes, and talks to them over real sockets."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import pytest

from bota_ethercat.control import request
from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.framing import DataFlag, DataMessage, FrameDecoder, TerminalMessage, encode_json
from bota_ethercat.text.json_text import JsonObject
from tests.rights import socket_of

Test = TypeVar("Test", bound=Callable[..., None])
OLD = int(DataFlag.REPEATED | DataFlag.INVALID)  # flags of frames that carry no new sample
START_TIMEOUT_S = 40.0
SLOW = ("--set", "sinc_length=512")  # of a server: 100 Hz take little of the machine
HERE, THERE = "10.77.12.1", "10.77.12.2"  # the ends of a Veth between two machines
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


def on_a_bus(test: Test) -> Test:
    """Marks a test that needs a bus over a veth pair."""
    marked: Test = pytest.mark.bus(needs_bus(test))
    return marked


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


def wait_until(
    condition: Callable[[], object], what: str, seconds: float = PATIENCE_S, step_s: float = 0.02
) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited {seconds} s for {what}"
        time.sleep(step_s)


@contextlib.contextmanager
def full_listener() -> Iterator[int]:
    """The port of a listener that takes nobody any more: connecting to it is pending."""
    with socket.create_server(("127.0.0.1", 0), backlog=0) as listener, contextlib.ExitStack() as queued:
        where = listener.getsockname()
        while True:
            client = queued.enter_context(socket.socket())
            client.setblocking(False)
            client.connect_ex(where)
            if not select.select([], [client], [], 0.1)[1]:
                break
        yield where[1]


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
        self._log = Path(path)
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
        return self._log.read_text()

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
        self._log.unlink(missing_ok=True)


class Commanded:
    """Virtual sensors that take fault commands."""

    def command(self, line: str) -> str:
        """Have a command obeyed now; returns the answer."""
        raise NotImplementedError

    def stats(self, position: int = 0) -> dict[str, Any]:
        """What a virtual sensor says of itself."""
        found: dict[str, Any] = json.loads(self.command("stats"))["sensors"][position]
        return found

    def stats_of_foreign(self, place: int) -> dict[str, Any]:
        """What the foreign slave at this position says of itself."""
        found: dict[str, Any] = json.loads(self.command("stats"))["foreign"][str(place)]
        return found

    def written(self, position: int = 0) -> list[tuple[str, int, str]]:
        """The SDO writes so far: index, sub-index, data."""
        return [(row["index"], row["subindex"], row["hex"]) for row in self.stats(position)["sdo_writes"]]


class VirtualSensor(Program, Commanded):
    """`ethercat-virtual-sensor`, which takes commands on its standard input."""

    def command(self, line: str) -> str:
        assert self.process.stdin is not None
        before = len(self.said())
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        wait_until(lambda: self.said()[before:].endswith("\n"), f"the answer to {line}", step_s=0.005)
        answer = self.said()[before:].strip()
        assert answer.startswith("ok"), answer
        return answer[3:]


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

    def connect(self, uid: int | None = None) -> Client:
        return Client(self.port, uid)


@contextlib.contextmanager
def server(
    ifname: str,
    *arguments: str,
    port: int = 0,
    under: Sequence[str] = (),
    python: str | Path = sys.executable,
) -> Iterator[Server]:
    """One that streams; started again where the sensor was starved."""
    for attempt in range(ATTEMPTS):
        with contextlib.closing(Server(ifname, *arguments, port=port, under=under, python=python)) as running:
            try:
                running.wait_for("streaming")
            except BaseException:
                if attempt == ATTEMPTS - 1 or not starved(running.said()):
                    raise
                continue
            yield running
            return


# What it says at start where a busy machine lets the virtual sensor's process wait for too long.
STARVED = (
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
ATTEMPTS = 5


def starved(said: str, signs: Sequence[str] = STARVED) -> bool:
    """Whether the sensor may have been."""
    return any(words in said for words in signs)


WATCHDOG_US = 600_000


class Manager:
    """Stands for systemd: the notify socket, in `directory`, and what came through it."""

    def __init__(self, directory: Path) -> None:
        self._path = str(directory / "notify")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self._path)
        self._socket.setblocking(False)
        self._told: list[str] = []

    @contextlib.contextmanager
    def environment(self) -> Iterator[None]:
        """What is started within is its service."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("NOTIFY_SOCKET", self._path)
            patch.setenv("WATCHDOG_USEC", str(WATCHDOG_US))
            patch.delenv("WATCHDOG_PID", raising=False)
            yield

    @property
    def told(self) -> list[str]:
        """What it has been told so far. Until it looks the kernel keeps ten messages, and no more."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self._told.append(self._socket.recv(4096).decode())
        return self._told

    def wait(self, text: str) -> None:
        """Until it is told this."""
        wait_until(lambda: any(text in told for told in self.told), f"{text} in {self._told}")

    def close(self) -> None:
        self._socket.close()


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
def steady_addresses(lock_for: int = fcntl.LOCK_SH) -> Iterator[None]:
    """No other worker changes the addresses of interfaces meanwhile; LOCK_EX: this one does.

    Fast DDS reads the addresses when a participant begins: two that began with others do not find each other.
    """
    with Path(f"/dev/shm/test-addresses-{os.getuid()}").open("a") as lock:
        fcntl.flock(lock, lock_for)
        yield


@contextlib.contextmanager
def another_machine(veth: Veth) -> Iterator[list[str]]:
    """A network namespace with the far end of `veth` in it, and what runs a command there."""
    keeper = subprocess.Popen(["unshare", "--net", "sleep", "1000"])
    there = ["nsenter", f"--net=/proc/{keeper.pid}/ns/net"]
    try:
        own = Path("/proc/self/ns/net").readlink()
        wait_until(lambda: Path(f"/proc/{keeper.pid}/ns/net").readlink() != own, "the namespace")
        veth.ip("link", "set", veth.far, "netns", str(keeper.pid))
        for command in (
            f"address add {THERE}/30 dev {veth.far}",
            "link set lo up",
            f"link set {veth.far} up",
        ):
            subprocess.run([*there, "ip", *command.split()], check=True)
        yield there
    finally:
        keeper.kill()
        keeper.wait()


@contextlib.contextmanager
def virtual_sensor(
    *arguments: str, module: str = "ethercat_server.virtual_sensor.cli"
) -> Iterator[tuple[Veth, VirtualSensor]]:
    """A veth pair with a virtual sensor on its far end: `module IFACE --signal rest arguments...`."""
    with Veth() as veth:
        sensor = VirtualSensor(module, [veth.far, "--signal", "rest", *arguments])
        try:
            sensor.wait_for("ready")
            yield veth, sensor
        finally:
            sensor.close()


class FramedClient:
    """A framed connection that keeps everything; `wait` receives until something is so."""

    def __init__(
        self, send_all: Callable[[bytes], object], wait: Callable[[Callable[[], object], str], None]
    ) -> None:
        self.send_all, self.wait = send_all, wait
        self.frames: list[DataMessage] = []
        self.terminal_frames: list[TerminalMessage] = []
        self.events: list[JsonObject] = []  # those that `wait_event` has not returned
        self.replies: list[JsonObject] = []
        self._decoder = FrameDecoder()
        self._id = 0

    def keep(self, message: TerminalMessage | JsonObject) -> None:
        if isinstance(message, TerminalMessage):
            self.terminal_frames.append(message)
            return
        (self.events if "event" in message else self.replies).append(message)

    def send(self, action: str, **keys: object) -> int:
        """Send a request; returns its id."""
        self._id += 1
        self.send_all(encode_json(request(action, self._id, **keys)))
        return self._id

    def reply(self, number: int) -> dict[str, Any]:
        """Wait for the reply to the request with this id."""

        def found() -> list[JsonObject]:
            return [reply for reply in self.replies if reply.get("id") == number]

        self.wait(found, f"the reply to request {number}")
        return found()[0]

    def ask(self, action: str, **keys: object) -> dict[str, Any]:
        """The reply to a request."""
        return self.reply(self.send(action, **keys))

    def refused(self, action: str, **keys: object) -> dict[str, Any]:
        """The error of a request that is refused."""
        reply = self.ask(action, **keys)
        assert reply["ok"] is False, reply
        error: dict[str, Any] = reply["error"]
        return error

    def described(self, sensor: int = 0) -> dict[str, Any]:
        """What `describe` says of a sensor."""
        row: dict[str, Any] = self.ask("describe")["sensors"][sensor]
        return row

    def wait_event(self, name: str, sensor: int | None = None) -> JsonObject:
        """The first event of this name, of this sensor, that has not been returned yet."""

        def found() -> list[JsonObject]:
            named = [event for event in self.events if event["event"] == name]
            return [event for event in named if sensor in (None, event.get("sensor", sensor))]

        self.wait(found, name)
        event = found()[0]
        self.events.remove(event)
        return event

    def collect(self, count: int) -> list[DataMessage]:
        """The next `count` frames."""
        self.frames.clear()
        self.wait(lambda: len(self.frames) >= count, f"{count} frames")
        return self.frames[:count]

    def fresh(self, count: int) -> list[DataMessage]:
        """The next `count` frames that are new and valid samples."""
        self.frames.clear()
        found: list[DataMessage] = []
        looked_at = 0

        def enough() -> bool:
            nonlocal looked_at
            found.extend(frame for frame in self.frames[looked_at:] if not frame.flags & OLD)
            looked_at = len(self.frames)
            return len(found) >= count

        self.wait(enough, f"{count} new samples")
        return found[:count]


class Client(FramedClient):
    """On a real socket."""

    def __init__(self, port: int, uid: int | None = None) -> None:
        """`uid` is whose it is, if not of whom the tests are."""
        self.sock = socket_of(uid)
        super().__init__(self.sock.sendall, self._wait)
        self.sock.settimeout(PATIENCE_S)
        try:
            self.sock.connect(("127.0.0.1", port))
        except ConnectionError as error:
            self.sock.close()
            raise ConnectionFailedError(str(error)) from None

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.sock.close()

    def _wait(self, until: Callable[[], object], _what: str) -> None:
        while not until():
            self.receive()

    def receive(self) -> None:
        """Wait for one message."""
        while (message := self._decoder.next_message()) is None:
            try:
                data = self.sock.recv(65536)
            except ConnectionError as error:
                raise ConnectionFailedError(str(error)) from None
            if not data:
                raise ConnectionFailedError("the server closed it")
            self._decoder.feed(data)
        if isinstance(message, DataMessage) and not isinstance(message, TerminalMessage):
            self.frames.append(message)
        else:
            self.keep(message)

    def receive_all(self) -> None:
        """Receive until the server closes the connection."""
        with contextlib.suppress(ConnectionFailedError):
            self.wait(lambda: False, "the end")

    def ask(self, action: str, **keys: object) -> dict[str, Any]:
        """Asked again while a starved sensor is away for a moment."""
        deadline = time.monotonic() + _AWAY_S
        while True:
            reply = super().ask(action, **keys)
            if _AWAY not in reply.get("error", {}).get("message", "") or time.monotonic() > deadline:
                return reply
            time.sleep(0.05)

    def answers(self, *messages: JsonObject) -> list[JsonObject]:
        """To these requests."""
        before = len(self.replies)
        self.send_all(b"".join(map(encode_json, messages)))
        self.wait(lambda: len(self.replies) == before + len(messages), "answers")
        return self.replies[before:]
