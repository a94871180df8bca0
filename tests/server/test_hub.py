"""The TCP side with real sockets and no bus: both kinds of connection, hostile bytes, slow readers."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import time
from collections.abc import Iterator
from itertools import pairwise

import pytest

from ethercat_server import connection as connection_module
from ethercat_server import door
from ethercat_server.connection import (
    MAX_REQUEST_LENGTH,
    Connection,
    Limits,
    Subscription,
)
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.hub import Hub
from ethercat_server.outbox import MAX_QUEUED_DATA
from protocol.control import parse_request, reply
from protocol.framing import DataFlag, DataMessage, FrameDecoder, encode_data, encode_json
from protocol.json_text import JsonObject


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Served:
    """A hub and the means to talk to it from the same thread."""

    def __init__(self) -> None:
        self.hub = Hub(("127.0.0.1",), free_port())
        self.hub.start(self.handle)
        self.clients: list[socket.socket] = []
        self.sequence = 0

    def handle(self, connection: Connection, message: JsonObject) -> JsonObject:
        request = parse_request(message)
        if request.action == "subscribe":
            values = request.values
            connection.subscription = Subscription(
                2, values["sensors"], values["every"], values["fresh_only"]
            )
            self.hub.subscriptions_changed()
        return reply(request)

    def serve(self, seconds: float = 0.02) -> None:
        """Give the hub this long, but no fewer turns than fit into it: this process may be held up."""
        end, left = time.monotonic() + seconds, seconds / 0.002
        while left > 0 or time.monotonic() < end:
            self.hub.serve(time.monotonic_ns() + 2_000_000)
            left -= 1

    def connect(self) -> socket.socket:
        sock = socket.create_connection(("127.0.0.1", self.hub.port), timeout=5)
        self.clients.append(sock)
        self.serve()
        return sock

    def publish(self, place: int = 0, flags: int = 0, now_ns: int = 0) -> None:
        frame = encode_data(self.sequence, 1, 2, place, flags, 3, bytes(61))
        self.hub.publish(frame, place, flags, now_ns or time.monotonic_ns())
        self.sequence += 1

    def read(self, sock: socket.socket) -> list[DataMessage | JsonObject]:
        """Everything that has arrived, decoded."""
        self.serve()
        sock.setblocking(False)
        decoder, found = FrameDecoder(), []
        while True:
            try:
                data = sock.recv(65536)
            except BlockingIOError:
                break
            if not data:
                break
            decoder.feed(data)
            found += list(decoder)
        sock.settimeout(5)
        return found

    def subscribe(self, **keys: object) -> socket.socket:
        sock = self.connect()
        sock.sendall(encode_json({"action": "subscribe", **keys}))
        assert self.read(sock) == [{"reply": "subscribe", "ok": True}]
        return sock

    def is_closed(self, sock: socket.socket) -> bool:
        self.serve()
        sock.settimeout(0.05)
        try:
            while sock.recv(65536):
                pass
        except TimeoutError:
            return False
        except ConnectionError:
            pass
        return True


@pytest.fixture
def served() -> Iterator[Served]:
    server = Served()
    yield server
    for sock in server.clients:
        sock.close()
    server.hub.close()


def test_framed_request_is_answered_with_its_id(served: Served) -> None:
    with served.connect() as sock:
        sock.sendall(encode_json({"action": "describe", "id": {"any": ["thing", None]}}))
        assert served.read(sock) == [{"reply": "describe", "id": {"any": ["thing", None]}, "ok": True}]


def test_pipelined_requests_are_answered_in_order(served: Served) -> None:
    with served.connect() as sock:
        sock.sendall(b"".join(encode_json({"action": "describe", "id": n}) for n in range(20)))
        answers = served.read(sock)
        assert [answer["id"] for answer in answers if isinstance(answer, dict)] == list(range(20))


@pytest.mark.parametrize("ending", [b"", b"\n", b" \r\n"])
def test_bare_json_needs_no_newline(served: Served, ending: bytes) -> None:
    with served.connect() as sock:
        sock.sendall(b'{"action":"describe","id":7}' + ending)
        served.serve()
        assert json.loads(sock.recv(4096)) == {"reply": "describe", "id": 7, "ok": True}


def test_bare_json_connection_answers_then_closes_when_the_client_half_closes(served: Served) -> None:
    with served.connect() as sock:
        sock.sendall(b'{"action":"describe"}\n{"action":"describe"}\n')
        sock.shutdown(socket.SHUT_WR)
        served.serve(0.1)
        assert len(sock.recv(4096).splitlines()) == 2
        assert sock.recv(10) == b""


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        (b"{nonsense", "not valid JSON"),
        (b"[1, 2]", "must be an object"),
        (b'{"action": 5}', "must be a string"),
        (b"{}", "'action' is missing"),
        (b'{"action": "dance"}', "no action 'dance'"),
        (b'{"action": "describe", "colour": 1}', "takes no key 'colour'"),
        (b'{"action": "subscribe", "every": 0}', "'every' must be"),
        (b"\xff\xfe", "not UTF-8"),
        (b"[" * 4000, "nested"),
        (b'{"action":"describe","id":1e999}', "too large"),
        (b'{"action":"describe","id":NaN}', "NaN is no JSON number"),
    ],
)
def test_bad_json_gets_an_error_and_the_connection_goes_on(
    served: Served, body: bytes, complaint: str
) -> None:
    with served.connect() as sock:
        sock.sendall(struct.pack(">IB", len(body) + 1, 2) + body)
        sock.sendall(encode_json({"action": "describe", "id": 1}))
        bad, good = served.read(sock)
        assert isinstance(bad, dict)
        assert bad["ok"] is False
        assert complaint in bad["error"]["message"]
        assert good == {"reply": "describe", "id": 1, "ok": True}


@pytest.mark.parametrize(
    "poison",
    [
        struct.pack(">IB", 0, 2),
        struct.pack(">IB", MAX_REQUEST_LENGTH + 2, 2),
        struct.pack(">IB", 0xFFFFFFFF, 2),
        struct.pack(">IB", 5, 9) + b"abcd",
        encode_data(0, 0, 0, 0, 0, 0, bytes(61)),
        b"GET / HTTP/1.1\r\n\r\n",
    ],
)
def test_broken_framing_gets_an_error_and_is_closed_and_others_notice_nothing(
    served: Served, poison: bytes
) -> None:
    with served.subscribe() as bystander, served.connect() as sock:
        sock.sendall(poison)
        served.publish()
        (answer,) = served.read(sock)
        assert isinstance(answer, dict)
        assert answer["error"]["code"] == "bad_request"
        assert served.is_closed(sock)
        served.publish()
        frames = served.read(bystander)
        assert [f.sequence for f in frames if isinstance(f, DataMessage)] == [0, 1]


def test_endless_bare_line_is_cut_off(served: Served) -> None:
    with served.connect() as sock:
        sock.sendall(b'{"action": "' + b"x" * (MAX_REQUEST_LENGTH + 10))
        served.serve(0.05)
        assert b"a line of more than" in sock.recv(4096)
        assert served.is_closed(sock)


def test_disconnect_in_the_middle_of_a_frame(served: Served) -> None:
    with served.subscribe() as bystander:
        sock = served.connect()
        sock.sendall(encode_json({"action": "describe"})[:7])
        served.serve()
        sock.close()
        served.serve(0.15)
        served.publish()
        assert [type(m) for m in served.read(bystander)] == [DataMessage]
        assert len(served.hub.connections) == 1


def test_subscription_filters(served: Served) -> None:
    with (
        served.subscribe(sensors=[1]) as only_second,
        served.subscribe(every=3) as third,
        served.subscribe(fresh_only=False) as everything,
        served.subscribe() as default,
    ):
        now_ns = time.monotonic_ns()
        for number in range(9):
            served.publish(number % 2, DataFlag.REPEATED if number >= 6 else 0, now_ns)

        def sequences(sock: socket.socket) -> list[int]:
            return [m.sequence for m in served.read(sock) if isinstance(m, DataMessage)]

        assert sequences(only_second) == [1, 3, 5]
        assert sequences(third) == [0, 1]
        assert sequences(everything) == list(range(9))
        assert sequences(default) == list(range(6))
        # After 10 ms with nothing, a silent sensor becomes visible.
        served.publish(0, DataFlag.REPEATED, now_ns + 10_000_001)
        assert sequences(default) == [9]


def test_gap_is_kept_for_a_client_that_skips_the_frame_that_had_it(served: Served) -> None:
    with served.subscribe(every=2) as sock:
        served.publish()
        served.publish(flags=DataFlag.GAP)
        served.publish()
        served.publish()
        served.publish()
        frames = [m for m in served.read(sock) if isinstance(m, DataMessage)]
        assert [(f.sequence, f.flags) for f in frames] == [(0, 0), (2, DataFlag.GAP), (4, 0)]


def test_a_client_that_does_not_read_loses_the_oldest_whole_frames_and_is_told(served: Served) -> None:
    with served.subscribe() as slow, served.subscribe() as quick:
        (slow_connection, quick_connection) = served.hub.connections.values()
        received_quick: list[DataMessage | JsonObject] = []
        total = 0
        while slow_connection.outbox.withheld < 500:
            for _ in range(50):
                served.publish()
            total += 50
            received_quick += served.read(quick)
            assert total < 200_000
        received_slow = served.read(slow)
        while more := served.read(slow):
            received_slow += more
        frames = [m for m in received_slow if isinstance(m, DataMessage)]
        assert len(frames) == total - slow_connection.outbox.withheld
        assert frames[-1].sequence == total - 1
        jumps = [
            (after.flags & DataFlag.GAP, after.sequence - before.sequence)
            for before, after in pairwise(frames)
        ]
        assert all(bool(gap) == (step > 1) for gap, step in jumps)
        assert sum(step - 1 for _, step in jumps) == slow_connection.outbox.withheld
        assert len([m for m in received_quick if isinstance(m, DataMessage)]) == total
        assert quick_connection.outbox.withheld == 0


def test_queue_is_bounded(served: Served) -> None:
    with served.subscribe():
        (connection,) = served.hub.connections.values()
        for _ in range(20_000):
            served.publish()
        assert len(connection.outbox._queue) <= MAX_QUEUED_DATA


def test_a_client_that_asks_and_never_reads_is_closed(served: Served) -> None:
    with served.connect() as sock:
        request = encode_json({"action": "describe", "id": "x" * 4_000})
        sock.settimeout(0.01)
        for _ in range(2000):
            with contextlib.suppress(TimeoutError, ConnectionError):
                sock.sendall(request)
            served.serve(0.002)
            if not served.hub.connections:
                return
        pytest.fail("the connection is still open")


def test_too_many_clients_are_turned_away(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "MAX_CLIENTS", 2)
    with served.connect() as first, served.connect() as second, served.connect() as third:
        assert served.is_closed(third)
        for sock in (first, second):
            sock.sendall(encode_json({"action": "describe"}))
            assert served.read(sock) == [{"reply": "describe", "ok": True}]


def test_an_address_that_this_machine_does_not_have_is_said() -> None:
    with pytest.raises(ServerError, match=r"192\.0\.2\.1 cannot be used: this machine has no such address"):
        Hub(["192.0.2.1"], free_port())


def test_taken_port_is_said_at_once() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ServerError, match=f"port {port} on 127.0.0.1 is taken"):
            Hub(("127.0.0.1",), port)


def test_an_address_that_is_given_twice_is_listened_on_once() -> None:
    port = free_port()
    hub = Hub(("127.0.0.1", "::1", "127.0.0.1", "0:0:0:0:0:0:0:1"), port)
    try:
        with socket.create_connection(("127.0.0.1", port)):
            pass
    finally:
        hub.close()


@pytest.mark.parametrize(("every", "one"), [("0.0.0.0", "127.0.0.1"), ("::", "::1")])
def test_an_address_within_another_is_not_called_another_program(every: str, one: str) -> None:
    for hosts in ((every, one), (one, every)):
        with pytest.raises(UsageError, match=f"overlap: {every} is every address of this machine, {one} too"):
            Hub(hosts, free_port())


def test_close_delivers_what_waits_and_is_bounded(served: Served) -> None:
    with served.subscribe() as sock:
        served.publish()
        served.hub.broadcast({"event": "shutting_down"})
        sock.shutdown(socket.SHUT_RD)
        started = time.monotonic()
        served.hub.close()
        assert time.monotonic() - started < 10
        assert not served.hub.connections


def test_a_flood_of_requests_does_not_hold_up_the_acquisition(served: Served) -> None:
    crowd = [served.connect() for _ in range(40)]
    for sock in crowd:
        sock.sendall(encode_json({"action": "describe"}) * 100)
    handled: list[Connection] = []
    answer = served.handle

    def slow(connection: Connection, message: JsonObject) -> JsonObject:
        handled.append(connection)
        time.sleep(0.0003)
        return answer(connection, message)

    served.hub.start(slow)
    # No time left: a turn ends after a message or two all the same, and the next one goes on with others.
    turns = 0
    while len(set(handled)) < len(crowd):
        before = len(handled)
        served.hub.serve(time.monotonic_ns() - 1)
        assert len(handled) - before <= 2
        turns += 1
        assert turns < 500
    assert max(handled.count(connection) for connection in set(handled)) <= 6, "each has its turn"


def test_a_handler_that_fails_costs_one_reply_and_nothing_else(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_connection: Connection, _message: JsonObject) -> JsonObject:
        raise ZeroDivisionError

    with served.subscribe() as bystander, served.connect() as sock:
        monkeypatch.setattr(served.hub, "_handler", broken)
        sock.sendall(encode_json({"action": "describe"}))
        (answer,) = served.read(sock)
        assert isinstance(answer, dict)
        assert answer["error"]["code"] == "internal"
        served.publish()
        assert [type(m) for m in served.read(bystander)] == [DataMessage]


def closed(served: Served, sock: socket.socket) -> bool:
    served.serve(0.1)
    sock.settimeout(5)
    with contextlib.suppress(ConnectionError):
        while sock.recv(65536):
            pass
    return True


def test_a_client_that_takes_nothing_is_closed_after_a_while(served: Served) -> None:
    served.hub.limits = Limits(stall_ns=0.3e9)
    sock, other = served.subscribe(), served.subscribe()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    for _ in range(3000):
        served.publish()
        if _ % 100 == 0:
            other.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while other.recv(65536):
                    pass
    served.serve(0.5)
    assert len(served.hub.connections) == 1, "the one that reads stays"
    assert closed(served, sock)


def test_one_that_takes_a_little_now_and_then_stays(served: Served) -> None:
    served.hub.limits = Limits(stall_ns=1.5e9)
    sock = served.subscribe()
    ending = time.monotonic() + 2.0
    while time.monotonic() < ending:
        for _ in range(600):
            served.publish()
        sock.recv(60000)
        served.serve(0.1)
    assert len(served.hub.connections) == 1


def test_idle_and_unfinished_connections_are_closed_with_a_reason(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_module, "_UNFINISHED_NS", int(0.2e9))
    served.hub.limits = Limits(idle_ns=2e9)
    subscriber = served.subscribe()
    unfinished, idle = served.connect(), served.connect()
    idle.sendall(b'{"action":"describe"}\n')
    served.serve()
    assert b'"reply":"describe"' in idle.recv(4096)
    unfinished.sendall(b"\0\0\1\0\2{")
    served.serve(0.4)
    message = json.loads(unfinished.recv(4096)[5:])
    assert message["error"]["code"] == "bad_request"
    assert "has not finished its message" in message["error"]["message"]
    served.serve(2.2)
    assert b"asked nothing for 2 s" in idle.recv(4096)
    for sock in (unfinished, idle):
        assert sock.recv(1) == b""
        sock.close()
    served.serve(0.1)
    assert len(served.hub.connections) == 1, "who has subscribed need not say anything more"
    assert subscriber.fileno() >= 0


def test_a_client_that_asks_without_pause_waits_and_gets_all_answers_in_order(served: Served) -> None:
    hasty, other = served.connect(), served.connect()
    began = time.monotonic()
    hasty.sendall(b"".join(encode_json({"action": "describe", "id": n}) for n in range(400)))
    other.sendall(encode_json({"action": "describe", "id": 1}))
    assert served.read(other), "others need not wait for it"
    answers: list[object] = []
    while len(answers) < 400 and time.monotonic() - began < 30:
        answers += [m["id"] for m in served.read(hasty) if isinstance(m, dict)]
        assert len(answers) <= 101 + 500 * (time.monotonic() - began), "100 at once, then 500 a second"
    assert answers == list(range(400))


def test_strangers_cannot_take_all_places(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    served.hub.door.control_uids = frozenset()
    uids = iter(range(100, 10_000))
    monkeypatch.setattr(door, "peer_uid", lambda *_: next(uids))
    for _ in range(door.MAX_CLIENTS):
        served.connect()
    assert len(served.hub.connections) == door.MAX_CLIENTS - door.RESERVED
    monkeypatch.setattr(door, "peer_uid", lambda *_: 7)
    served.hub.door.control_uids = frozenset({7})
    for _ in range(door.RESERVED + 3):
        served.connect()
    assert len(served.hub.connections) == door.MAX_CLIENTS


@pytest.mark.parametrize("uid", [4711, None])
def test_one_stranger_cannot_take_the_places_of_others(
    served: Served, monkeypatch: pytest.MonkeyPatch, uid: int | None
) -> None:
    served.hub.door.control_uids = frozenset()
    monkeypatch.setattr(door, "peer_uid", lambda *_: uid)
    for _ in range(door.MOST_OF_A_STRANGER + 5):
        served.connect()
    assert len(served.hub.connections) == door.MOST_OF_A_STRANGER
    monkeypatch.setattr(door, "peer_uid", lambda *_: 4712)
    served.connect()
    assert len(served.hub.connections) == door.MOST_OF_A_STRANGER + 1


def test_an_answer_may_come_later_and_what_follows_waits_for_it(served: Served) -> None:
    waiting: list[tuple[Connection, JsonObject]] = []

    def later(connection: Connection, message: JsonObject) -> JsonObject | None:
        if message["action"] == "status":
            waiting.append((connection, message))
            return None
        return {"reply": message["action"], "id": message["id"]}

    served.hub.start(later)
    sock, other = served.connect(), served.connect()
    for number, action in enumerate(("status", "describe", "status", "describe")):
        sock.sendall(encode_json({"action": action, "id": number}))
    other.sendall(encode_json({"action": "describe", "id": 9}))
    assert served.read(sock) == []
    assert served.read(other), "others need not wait for it"
    for number in (0, 2):
        assert len(waiting) == 1
        served.hub.answer(waiting[0][0], {"reply": "status", "id": number})
        waiting.clear()
        assert [m["id"] for m in served.read(sock) if isinstance(m, dict)] == [number, number + 1]
    sock.sendall(encode_json({"action": "status", "id": 4}))
    served.serve()
    gone, _ = waiting.pop()
    sock.close()
    other.close()
    gone.failed = True
    served.serve(0.1)
    served.hub.answer(gone, {"reply": "status", "id": 4})
    assert served.hub.connections.get(gone.fd) is not gone
