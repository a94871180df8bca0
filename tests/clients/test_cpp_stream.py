"""What a controller in C++ is told, against a server that this test plays: ages, gaps, bounds, reconnecting.

The test is the server, in the same thread: it sends, then asks the client what it makes of that.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import math
import select
import socket
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from bota_ethercat.address import Address, boot_id
from bota_ethercat.control import request
from bota_ethercat.framing import DataFlag, encode_json
from bota_ethercat.text.json_text import JsonObject
from tests.bridge.scripted_server import ScriptedServer
from tests.clients.cpp_programs import (
    ROOT,
    Driver,
    assert_no_faults,
    driver,
    end_driver,
    frame,
    needs_gxx,
    patient,
    start_driver,
)
from tests.descriptions import description, sensor_row
from tests.golden_vectors import READ, ReadStream, odd_messages
from tests.server.running import PATIENCE_S, free_port, full_listener, wait_until

pytestmark = [needs_gxx, patient]

REPEATED, INVALID, GAP = DataFlag.REPEATED, DataFlag.INVALID, DataFlag.GAP
NAN, INF = math.nan, math.inf
MAX_AGE = 2**63 - 1
TCP_FIN_WAIT2 = b"\x05"  # the state in TCP_INFO of who has closed its side, and the other end knows
PATIENT = {"max_age_ms": 60_000}
"""For what must not depend on how fast this machine is."""
GRANTED = {"reply": "subscribe", "ok": True, **description()}
REFUSED = {"reply": "subscribe", "ok": False, "error": {"code": "busy", "message": "no 9"}}
OURS = boot_id() or pytest.fail("this machine has no boot id")


class PlayedServer(ScriptedServer):
    answer: JsonObject | bytes = GRANTED

    def _answer(self, message: JsonObject) -> None:
        assert self._asking is not None
        self.streams.append(self._asking)
        self._asking.sendall(self.answer if isinstance(self.answer, bytes) else encode_json(self.answer))

    def send(self, *messages: bytes | JsonObject) -> None:
        """Send messages, and wait until the client's kernel has them."""
        stream = self.streams[-1]

        def unsent() -> int:
            return int(struct.unpack("i", fcntl.ioctl(stream.fileno(), termios.TIOCOUTQ, b"\0\0\0\0"))[0])

        for message in messages:
            stream.sendall(message if isinstance(message, bytes) else encode_json(message))
        wait_until(lambda: unsent() == 0, "the client's kernel")


@pytest.fixture(scope="module", autouse=True)
def no_faults() -> Iterator[None]:
    yield
    assert_no_faults()


@pytest.fixture
def server() -> Iterator[PlayedServer]:
    with PlayedServer() as played:
        yield played


def connected(server: PlayedServer, running: Driver, answer: JsonObject | bytes = GRANTED) -> Driver:
    server.answer = answer
    return running.connect()


@contextlib.contextmanager
def stream(server: PlayedServer, answer: JsonObject | bytes = GRANTED, **options: object) -> Iterator[Driver]:
    with driver(server.port, **{**PATIENT, **options}) as running:
        yield connected(server, running, answer)


def until_up(running: Driver, step: str = "latest") -> None:
    wait_until(lambda: running.do(step) is not None and running.info()["link"] == "up", "the subscription")


def picked(reading: JsonObject, *names: str) -> tuple[Any, ...]:
    return tuple(reading[name] for name in names)


class CppPlayer:
    def __init__(self, server: PlayedServer, running: Driver) -> None:
        self.server, self.running = server, running

    def now(self, now_ns: int) -> None:
        self.running.begin("now", now_ns)

    def connect(self, description: JsonObject) -> None:
        connected(self.server, self.running, {"reply": "subscribe", "ok": True, **description})

    def send(self, message: bytes) -> None:
        self.server.send(message)

    def end(self) -> None:
        connection = self.server.streams[-1]
        connection.shutdown(socket.SHUT_WR)

        def state() -> bytes:
            return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)

        wait_until(lambda: state() == TCP_FIN_WAIT2, "the client's kernel")

    def read(self, sensor: int) -> dict[str, object]:
        told = self.running.latest(sensor)
        told["sequence"] = told["sequence"] if told["has_sample"] else None
        told["age_ns"] = None if told["age_ns"] == MAX_AGE else told["age_ns"]
        return told


@pytest.mark.parametrize("played", READ, ids=lambda played: played.name)
def test_readings_are_those_of_python(server: PlayedServer, played: ReadStream) -> None:
    options = {f"sensor{number}": number for number in played.sensors}
    with driver(
        server.port, max_age_ms=played.max_age_ms, every=played.every, reconnect="when_told", **options
    ) as running:
        played.play(CppPlayer(server, running))


# -- what is sent, and what the client makes of it


F = functools.partial(functools.partial, frame)
"""A frame that is stamped when it is sent."""


def text(body: bytes) -> bytes:
    return struct.pack(">IB", 1 + len(body), 2) + body


LOST = {"event": "sensor_lost", "sensor": 0, "message": "sensor 0 is lost: cable"}


def told(command: str, **expected: object) -> tuple[str, dict[str, object]]:
    return command, expected


CONVERSATIONS: dict[str, tuple[Any, list[Any]]] = {
    "what the server says of a lost sensor, and how often it was reconfigured": ({}, [
        LOST, told("latest", condition="sensor_lost"), told("info", error=LOST["message"]),
        {"event": "reconfigured", "sensor": 0}, told("latest", condition="silent"),
        told("info", reconfigurations=1),
    ]),
    "peek does not read the socket": ({}, [
        F(1), told("peek", has_sample=False), told("latest", has_sample=True),
    ]),
    "next gives every sample in order": ({}, [
        F(1), F(2, REPEATED), F(3, INVALID), F(4, GAP), F(5),
        told("next 1000", sequence=1, gap=False, is_new=True, passed_over=0),
        told("next 1000", sequence=4, gap=True, is_new=True, passed_over=0),
        told("next 1000", sequence=5, gap=False, is_new=True, passed_over=0),
        told("next 1", sequence=5, is_new=False),
    ]),
    "latest passes over what next has not taken": ({}, [
        *map(F, range(1, 6)), told("next 1000", sequence=1),
        told("latest", sequence=5, passed_over=3, withheld=0), told("next 0", is_new=False),
    ]),
    "a call reads a bounded amount and says so": ({"max_bytes_per_call": 940}, [
        *map(F, range(1, 26)), told("latest", sequence=10, more_waits=True, passed_over=9),
        told("latest", sequence=20, more_waits=True, passed_over=9),
        told("latest", sequence=25, more_waits=False, passed_over=4),
    ]),
    "what cannot be understood costs only itself": ({}, [
        *map(text, (b"[]", b'{"event":"sensor_lost"}', b'{"a":1e999}', b"\xff", b"{}")),
        text(b'{"reply":"status","ok":1}'), F(1), told("latest", fresh=True, sequence=1),
        told("info", bad_messages=5),
    ]),
    "odd values where others are expected": ({}, [
        b"".join(map(encode_json, odd_messages())),
        F(1), told("latest", fresh=True, is_new=True), told("info", link="up"),
    ]),
    # Nothing from the network commands a terminal, and it is cut between two characters.
    "a terminal": ({}, [
        {**LOST, "message": "\x1b[2J\n!" + "é" * 400}, told("latest"),
        told("info", error="?[2J?!" + "é" * 156),
    ]),
}  # fmt: skip


@pytest.mark.parametrize(("options", "steps"), CONVERSATIONS.values(), ids=CONVERSATIONS)
def test_conversations(server: PlayedServer, options: Any, steps: list[Any]) -> None:
    with stream(server, **options) as running:
        for step in steps:
            if not isinstance(step, tuple):
                server.send(step() if callable(step) else step)
                continue
            command, expected = step
            answer = running.latest() if command == "latest" else running.do(command)
            assert {name: answer[name] for name in expected} == expected, step


def test_it_subscribes_as_it_was_told(server: PlayedServer) -> None:
    with stream(server) as running:
        assert server.requests[-1] == request("subscribe", every=1, fresh_only=True)
        assert running.info()["sensor_count"] == 1
    with stream(server, sensor=3, every=7, fresh_only=0):
        assert server.requests[-1] == request("subscribe", every=7, fresh_only=False, sensors=[3])


def test_a_clock_that_is_shifted_is_another_one(server: PlayedServer) -> None:
    """A process in a time namespace: nothing but the kernel can make one."""
    shifted = ("unshare", "--time", "--monotonic", "86400")
    if subprocess.run([*shifted, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this user or kernel makes no time namespace")
    theirs = f"{OURS.split()[0]} 86400 0"  # against the kernel's own clock, also if ours is shifted
    process = start_driver(*shifted)
    try:
        running = Driver(server.port, process, **PATIENT)
        for claimed, far in ((OURS, True), (theirs, False)):
            connected(server, running, {**GRANTED, "boot_id": claimed})
            server.send(frame(1))
            assert picked(running.latest(), "age_is_lower_bound") == (far,)
    finally:
        assert end_driver(process) == 0
    name = "from bota_ethercat.address import Address, boot_id; print(boot_id())"
    done = subprocess.run(
        [*shifted, sys.executable, "-c", name], check=True, capture_output=True, text=True, cwd=ROOT
    )
    assert done.stdout == f"{theirs}\n"


@pytest.mark.parametrize(
    ("values", "condition"),
    [
        ({"acceleration__x": NAN}, "not_finite"), ({"angular_rate__z": INF}, "not_finite"),
        ({"size": 77, "orientation__w": NAN}, "not_finite"), ({"warnings": 2}, "saturated"),
        ({"warnings": 4}, "saturated"), ({"acceleration_saturated": 1}, "saturated"),
        ({"angular_rate_saturated": 4}, "saturated"), ({"warnings": 160, "temperature": NAN}, "fresh"),
        ({"warnings": 64}, "not_finite"), ({"warnings": 8}, "not_finite"),
    ],
)  # fmt: skip
def test_a_recent_sample_whose_imu_is_judged_too(
    server: PlayedServer, values: dict[str, Any], condition: str
) -> None:
    with stream(server, judge_imu=1) as running:
        server.send(frame(1, **values))
        assert picked(running.latest(), "condition", "is_new", "has_sample") == (condition, True, True)


# -- next


def test_the_samples_that_came_with_the_reply_are_not_passed_over(server: PlayedServer) -> None:
    with stream(server, encode_json(GRANTED) + frame(1) + frame(2)) as running:
        for sequence in (1, 2):
            assert picked(running.do("next", 1000), "sequence", "passed_over") == (sequence, 0)


def test_next_waits_for_the_sample(server: PlayedServer) -> None:
    with stream(server) as running:
        running.begin("next", int(PATIENCE_S * 1000))
        server.send(frame(1, REPEATED))
        server.send(frame(2)[:50])
        assert running.process.stdout is not None
        assert not select.select([running.process.stdout], [], [], 0.05)[0], "it did not wait"
        server.send(frame(2)[50:])
        assert picked(running.answer(), "sequence", "is_new") == (2, True)


def test_next_says_at_once_that_the_connection_is_lost(server: PlayedServer) -> None:
    with stream(server, max_age_ms=0, reconnect="when_told") as running:
        running.begin("next", int(PATIENCE_S * 1000))
        began = time.monotonic()
        server.drop()
        assert picked(running.answer(), "condition", "is_new") == ("disconnected", False)
        assert time.monotonic() - began < PATIENCE_S / 2


# -- bounds


@pytest.mark.parametrize(
    ("wire", "said"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n", "a length that no message has"),
        (struct.pack(">IB", 3, 9) + b"{}", "an unknown type"),
        (struct.pack(">IB", 50, 1) + bytes(49), "a length that no sensor has"),
    ],
)
def test_a_server_that_breaks_the_framing_is_left(server: PlayedServer, wire: bytes, said: str) -> None:
    with stream(server, max_age_ms=0) as running:
        server.send(frame(1), wire, frame(2))
        assert picked(running.latest(), "sequence", "condition") == (1, "disconnected")
        told = running.info()
        assert said in told["error"]
        assert told["fd"] == -1


# -- connecting


def test_it_does_not_connect_again_after_close(server: PlayedServer) -> None:
    with stream(server) as running:
        running.do("close")
        assert running.info()["error"].endswith("closed by this program")
        for _ in range(20):
            assert picked(running.latest(), "condition", "has_sample") == ("disconnected", False)
        time.sleep(0.1)
        assert server.connections == 1


@pytest.mark.parametrize(
    ("answer", "said", "is_refused"),
    [
        (REFUSED, "refused: no 9", True),
        ({**GRANTED, "protocol": 2}, "another version", True),
        ({"reply": "subscribe", "ok": True}, "another version", True),
        (b"SSH-2.0-OpenSSH_9.2\r\n", "is that ethercat-server?", False),
        (struct.pack(">IB", 2**31, 2), "is that ethercat-server?", False),
        (b"", "did not answer in time", False),
    ],
)
def test_a_connection_that_fails(server: PlayedServer, answer: Any, said: str, is_refused: bool) -> None:
    with driver(server.port, reconnect="when_told") as running:
        server.answer = answer
        told = running.do("connect", int(PATIENCE_S * 1000) if answer else 100)
        assert not told["ok"]
        assert said in told["error"]
        assert running.info()["refused"] is is_refused


@pytest.mark.parametrize("step", ["latest", "reconnect"])
def test_it_starts_without_the_server(step: str) -> None:
    port = free_port()
    mode = {"latest": "by_itself", "reconnect": "when_told"}[step]
    with driver(port, reconnect=mode, reconnect_every_ms=1, **PATIENT) as running:
        running.do(step)
        assert running.info()["error"] == "not connected yet: call connect()"
        told = running.do("connect", 1000)
        assert (told["ok"], "nobody listens there: start ethercat-server" in told["error"]) == (False, True)
        # Not once there is a server, where one call of a client that connects by itself may do for all of it.
        assert picked(running.latest(), "condition") == ("disconnected",)
        with PlayedServer(port) as late:
            if step == "reconnect":  # until it is told to
                assert picked(running.latest(), "condition") == ("disconnected",)
            until_up(running, step)
            late.send(frame(1))
            wait_until(lambda: running.latest()["fresh"], "the first sample")


def test_a_host_that_does_not_answer_takes_no_longer_than_the_timeout() -> None:
    """Connecting is pending, and every call returns; then it is said that nobody answers."""
    with full_listener() as port, driver(port, reconnect_every_ms=1) as running:
        assert "did not answer in time" in running.do("connect", 50)["error"]
        for words in (("latest",), ("next", 50), ("next", 0), ("reconnect",)):
            running.do(*words)
        wait_until(lambda: running.latest() and running.info()["error"].endswith("no answer"), "its end")


def is_down(running: Driver) -> Callable[[], bool]:
    return lambda: bool(running.latest()) and running.info()["link"] == "down"


def test_it_says_why_the_connection_ended(server: PlayedServer) -> None:
    with stream(server, reconnect="when_told") as running:
        server.send({"event": "shutting_down"})
        server.drop()
        wait_until(is_down(running), "the end")
        assert running.info()["error"] == f"127.0.0.1 port {server.port}: the server was shut down"


def test_it_reconnects_only_where_it_is_told(server: PlayedServer) -> None:
    """After the loss the control loop makes no system call; the step of reconnecting is its own call."""
    with stream(server, reconnect="when_told", reconnect_every_ms=1) as running:
        server.send(frame(1))
        running.latest()
        before = running.info()
        assert (before["receives"], before["other_calls"]) == (1, 0)
        server.drop()
        wait_until(is_down(running), "the end")
        lost = running.info()
        assert lost["other_calls"] == 0, "not even close()"
        for _ in range(5):
            running.latest()
            running.do("peek", 0)
            assert picked(running.do("next", 3_600_000), "is_new", "connection") == (False, 1)
        after = running.info()
        assert (after["receives"], after["other_calls"]) == (lost["receives"], 0)
        assert (after["fd"], server.connections) == (-1, 1)
        until_up(running, "reconnect")
        server.send(frame(2))
        assert picked(running.latest(), "fresh", "gap", "connection", "sequence") == (True, True, 2, 2)
        assert running.info()["other_calls"] == 0


def test_a_refusal_does_not_stand_in_the_way_of_connect(server: PlayedServer) -> None:
    with stream(server, reconnect_every_ms=1) as running:
        server.answer = REFUSED
        server.drop()
        running.do("next", int(PATIENCE_S * 1000))  # the loss
        assert picked(running.do("next", int(PATIENCE_S * 1000)), "condition") == ("disconnected",)
        assert "no 9" in running.info()["error"]
        connected(server, running)
        assert running.info()["refused"] is False


def test_a_client_that_is_moved_goes_on(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(1), frame(2)[:50])
        assert picked(running.latest(), "sequence") == (1,)
        before = running.info()
        running.do("moved")
        server.send(frame(2)[50:], frame(3))
        assert picked(running.latest(), "sequence", "passed_over", "connection") == (3, 1, 1)
        after = running.info()
        assert (after["fd"], after["connections"], after["samples"]) == (before["fd"], 1, 3)
        running.do("close")
        running.do("moved")
        connected(server, running)


def test_it_tries_again_no_more_often_than_it_may() -> None:
    port = free_port()
    with driver(port, reconnect_every_ms=3_600_000) as running:
        running.do("connect", 1000)
        with PlayedServer(port) as late:
            for _ in range(200):
                running.latest()
            time.sleep(0.1)
            assert late.connections == 0


# -- real time


def test_nothing_is_allocated_in_any_state(server: PlayedServer) -> None:
    with stream(server, reconnect_every_ms=1) as running:
        for n in range(1, 200):
            server.send_raw(frame(n))
            running.latest() if n % 2 else running.do("next", 1000)
        settings = {"calibration_matrix": False, "imu_active": 0}
        server.send(
            LOST, {"event": "reconfigured", "sensor": 0, "rate_hz": 400, "settings": settings}, text(b"[]"),
            frame(300, GAP),
        )  # fmt: skip
        running.latest()
        server.drop()
        running.do("next", 20)
        until_up(running)
        server.close()
        for _ in range(20):
            running.latest()
        told = running.info()
        assert (told["connections"], told["bad_messages"], told["link"]) == (2, 1, "down")
        assert (told["allocated"], told["allocates"]) == (0, True)


# -- requests


def test_describe_tare_and_refusals() -> None:
    refused = {"ok": False, "error": {"code": "sensor", "message": "no object", "abort_code": 0x06020000}}
    results = {
        name: [at + n / 8 for n in range(6)]
        for at, name in enumerate(("old_offset", "new_offset", "residual", "deviation"))
    }
    with ScriptedServer() as sensor, driver(sensor.port) as running:
        sensor.answers |= {
            "tare": lambda _: {"ok": True, **results},
            "sdo_read": lambda asked: {"ok": True, "value": 1} if asked.get("subindex") else refused,
        }
        told = running.do("describe")
        wanted = {name: value for name, value in sensor_row().items() if name != "settings"}
        assert (told["ok"], told["version"], told["sensors"]) == (True, "0.1.0", [wanted])
        told = running.do("tare", 20, 1.5, -2, 0, 0.25, 0, 0)
        assert sensor.requests[-1] == request(
            "tare", sensor=0, samples=20, target=[1.5, -2, 0, 0.25, 0, 0]
        )  # fmt: skip
        assert told == {**results, "ok": True, "error": "", "code": "", "abort_code": 0}
        told = running.do("ask", '{"action":"sdo_read","index":"0x8010","subindex":1,"id":[1,"é"]}')
        assert (told["ok"], told["reply"]["value"], told["reply"]["id"]) == (True, 1, [1, "é"])
        told = running.do("ask", '{"action":"sdo_read","index":"0x1234"}')
        assert (told["ok"], told["code"], told["abort_code"]) == (False, "sensor", 0x06020000)
        assert told["error"] == "no object"
        assert "no JSON object" in running.do("ask", "{nonsense")["error"]
    with driver(free_port()) as running:
        for what in ("describe", "tare 10"):
            told = running.do(what)
            assert (told["ok"], "nobody listens there" in told["error"]) == (False, True)


def test_a_server_is_named_as_in_the_other_programs() -> None:
    texts = (
        "robot", "robot:14101", "14101", ":14101", "[::1]", "[::1]:14101", "::1", "robot:", "robot:0", "0",
        "robot:65535", "robot:65536", "robot:+1", "robot:1x", ":",
    )  # fmt: skip
    with driver(1) as running:
        assert running.do("server") == [True, "localhost", 12001], "$BOTA_SERVER of the tests"
        for text in texts:
            try:
                wanted = [True, *Address.parse(text)]
            except ValueError:
                wanted = [False, "localhost", 12001]
            assert running.do("server", text) == wanted, text
