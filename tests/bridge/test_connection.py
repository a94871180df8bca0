"""The TCP connection: what is asked, what is refused, and that every failure is one exception."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from bridge.stream.connection import Connection, find_sensor
from protocol.errors import ConnectionFailedError, UnreachableError
from protocol.text.visible import printable
from tests.bridge.scripted_server import ScriptedServer, description


@pytest.fixture
def server() -> Iterator[ScriptedServer]:
    with ScriptedServer() as scripted:
        yield scripted


@pytest.fixture
def connection(server: ScriptedServer) -> Iterator[Connection]:
    opened = Connection("localhost", server.port)
    yield opened
    opened.close()


def failure(connection: Connection) -> str:
    with pytest.raises(ConnectionFailedError) as caught:
        connection.subscribe(0)
    return str(caught.value)


def test_describes_then_subscribes(server: ScriptedServer, connection: Connection) -> None:
    info = connection.subscribe(0)
    assert [r["action"] for r in server.requests] == ["describe", "subscribe"]
    assert server.requests[1]["sensors"] == [0]
    assert "BFT-SENS-ECAT-M8" in str(info)
    assert connection.same_machine


def test_what_follows_the_reply_is_kept(server: ScriptedServer, connection: Connection) -> None:
    server.on_subscribe = lambda: server.send_sample(1.0)
    connection.subscribe(0)
    message = connection.next_message()
    while message is None:
        connection.receive()
        message = connection.next_message()
    assert message[0] == 1  # type: ignore[index]


def test_nothing_there_is_unreachable() -> None:
    with socket.create_server(("127.0.0.1", 0)) as gone:
        port = gone.getsockname()[1]
    with pytest.raises(UnreachableError):
        Connection("127.0.0.1", port)
    for host in ("no.such.host.invalid", "a" * 300, "\udcff"):
        with pytest.raises(UnreachableError):
            Connection(host, port)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"protocol": 2}, "speaks protocol 2"),
        ({"protocol": True}, "protocol True"),
        ({"protocol": None}, "protocol None"),
        ({"protocol": "\x1b[2J" * 100}, "protocol"),
        ({"sensors": []}, "no sensor 0"),
        ({"sensors": None}, "no sensor 0"),
        ({"sensors": [1, "x", None]}, "no sensor 0"),
        ({"sensors": [{"sensor": 3}]}, "it has: 3"),
        ({"sensors": [{"sensor": False}]}, "no sensor 0"),
    ],
)
def test_a_server_that_does_not_fit_is_named(
    server: ScriptedServer, connection: Connection, changes: dict[str, Any], words: str
) -> None:
    server.description = description(**changes)
    text = failure(connection)
    assert words in text
    assert text.isprintable()
    assert len(text) < 400


def test_a_refusal_carries_the_servers_words(server: ScriptedServer, connection: Connection) -> None:
    error = {"code": "not_ready", "message": "the bus is\nstarting"}
    server.answers["describe"] = lambda _: {"ok": False, "error": error}
    assert failure(connection) == "the server refused describe: the bus is?starting (not_ready)"


@pytest.mark.parametrize(
    "garbage",
    [b"HTTP/1.1 400\r\n\r\n", b"\xff" * 100, b"\0\0\0\x01\x01", b"\0\0\0\x03\x02[]", b"\0\0\0\x02\x02{"],
)
def test_garbage_for_an_answer(server: ScriptedServer, connection: Connection, garbage: bytes) -> None:
    def answer(_: object) -> None:
        server.send_raw(garbage)

    server.answers["describe"] = answer
    text = failure(connection)
    assert "not this protocol" in text
    assert text.isprintable()


@pytest.mark.parametrize("reply", [{}, {"ok": 1}, {"ok": "true"}, {"ok": False}, {"ok": False, "error": []}])
def test_a_reply_without_ok_is_a_refusal(
    server: ScriptedServer, connection: Connection, reply: dict[str, Any]
) -> None:
    server.answers["describe"] = lambda _: reply
    assert "refused" in failure(connection)


def test_an_end_instead_of_an_answer(server: ScriptedServer, connection: Connection) -> None:
    def answer(_: object) -> None:
        server.drop()

    server.answers["describe"] = answer
    assert "closed" in failure(connection)


def test_replies_to_nobody_are_no_replies(connection: Connection) -> None:
    identifiers: tuple[object, ...] = (99, None, "x", [1], {}, 1.0)
    for identifier in identifiers:
        assert not connection.take_reply({"reply": "x", "id": identifier})


def test_closing_tells_whoever_waits(connection: Connection) -> None:
    waiting = connection.send_request("shutdown")
    connection.close()
    with pytest.raises(ConnectionFailedError):
        waiting.result(5)


def test_shutdown_from_another_thread_ends_a_blocked_receive(
    server: ScriptedServer, connection: Connection
) -> None:
    connection.subscribe(0)
    threading.Timer(0.05, connection.shutdown).start()
    with pytest.raises(ConnectionFailedError):
        all(connection.receive() is not True for _ in range(100))


def test_text_from_outside_is_made_fit_for_a_log() -> None:
    assert printable("a\nb\x1b[0m\u202e\ud800") == "a?b?[0m??"
    assert len(printable("x" * 10_000)) == 200


def test_find_sensor_takes_the_row_it_is_asked_for() -> None:
    rows = [{"sensor": 1, "name": "A"}, {"sensor": 0, "name": "B", "rate_hz": "\n"}]
    info = find_sensor({"sensors": rows}, 0)
    assert (info.name, info.serial, info.rate_hz) == ("B", "?", "?")
