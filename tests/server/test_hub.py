"""The hub and its connections in memory: requests, subscriptions, slow and hostile clients, timeouts.

Deterministic: no sockets, no real time. Real sockets are in test_transport.py and test_hostile.py.
"""

from __future__ import annotations

import struct
from itertools import pairwise

import pytest

from bota_ethercat.framing import DataFlag, DataMessage, FrameDecoder, encode_data, encode_json
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.serving import permissions
from ethercat_server.serving.connection import (
    MAX_QUEUED_DATA,
    MAX_REQUEST_LENGTH,
    Connection,
    Limits,
    State,
    Subscription,
)
from ethercat_server.serving.in_memory import InMemoryStream
from tests.server.served import TURN_NS, Served

DESCRIBE = encode_json({"action": "describe"})


@pytest.fixture
def served() -> Served:
    return Served()


def numbered(count: int, first: int = 0) -> bytes:
    return b"".join(encode_json({"action": "describe", "id": n}) for n in range(first, first + count))


def ids(messages: list[DataMessage | JsonObject]) -> list[object]:
    return [message["id"] for message in messages if isinstance(message, dict)]


def only_connection(served: Served) -> Connection:
    (connection,) = served.hub.connections.values()
    return connection


# -- requests


def test_framed_request_is_answered_with_its_id(served: Served) -> None:
    client = served.connect()
    client.send(encode_json({"action": "describe", "id": {"any": ["thing", None]}}))
    assert served.read(client) == [{"reply": "describe", "id": {"any": ["thing", None]}, "ok": True}]


def test_pipelined_requests_are_answered_in_order(served: Served) -> None:
    client = served.connect()
    client.send(numbered(20))
    assert ids(served.read(client)) == list(range(20))


def test_a_request_may_arrive_byte_by_byte(served: Served) -> None:
    client = served.connect()
    for byte in DESCRIBE:
        assert served.read(client) == []
        client.send(bytes((byte,)))
    assert served.read(client) == [{"reply": "describe", "ok": True}]


@pytest.mark.parametrize("ending", [b"", b"\n", b" \r\n"])
def test_bare_json_needs_no_newline(served: Served, ending: bytes) -> None:
    client = served.connect()
    client.send(b'{"action":"describe","id":7}' + ending)
    assert served.read_lines(client) == [{"reply": "describe", "id": 7, "ok": True}]


def test_bare_json_connection_answers_then_closes_when_the_client_half_closes(served: Served) -> None:
    client = served.connect()
    client.send(b'{"action":"describe"}\n{"action":"describe"}\n')
    client.end_sending()
    assert len(served.read_lines(client)) == 2
    assert served.is_closed(client)
    assert not served.hub.connections


def test_an_unfinished_bare_line_is_refused_when_the_client_half_closes(served: Served) -> None:
    client = served.connect()
    client.send(b'{"action":"describe"')
    client.end_sending()
    (answer,) = served.read_lines(client)
    assert "not valid JSON" in answer["error"]["message"]
    assert served.is_closed(client)


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
        (b'{"a":' + b"[" * 2000 + b"]" * 2000 + b"}", "nested"),
        (b'{"action":"describe","id":1e999}', "too large"),
        (b'{"action":"describe","id":NaN}', "NaN is no JSON number"),
    ],
)
def test_bad_json_gets_an_error_and_the_connection_goes_on(
    served: Served, body: bytes, complaint: str
) -> None:
    client = served.connect()
    client.send(struct.pack(">IB", len(body) + 1, 2) + body)
    client.send(encode_json({"action": "describe", "id": 1}))
    bad, good = served.read(client)
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
    bystander, client = served.subscribe(), served.connect()
    client.send(poison)
    served.publish()
    (answer,) = served.read(client)
    assert isinstance(answer, dict)
    assert answer["error"]["code"] == "bad_request"
    assert served.is_closed(client)
    served.publish()
    assert served.sequences(bystander) == [0, 1]


def test_a_refused_client_that_still_sends_can_read_its_last_reply(served: Served) -> None:
    client = served.connect()
    client.send(struct.pack(">IB", 0, 2))
    served.serve(0.06)
    client.send(DESCRIBE * 100)  # a close with this unread would reset the connection
    (answer,) = served.read(client)
    assert isinstance(answer, dict)
    assert answer["error"]["code"] == "bad_request"
    client.end_sending()
    served.serve(0.06)
    assert not served.hub.connections
    assert client.at_end


def test_a_refused_client_that_never_closes_is_closed_after_a_second(served: Served) -> None:
    client = served.connect()
    client.send(struct.pack(">IB", 0, 2))
    served.serve(0.9)
    assert only_connection(served).state is State.LINGERING
    served.serve(0.2)
    assert not served.hub.connections


def test_endless_bare_line_is_cut_off(served: Served) -> None:
    client = served.connect()
    client.send(b'{"action": "' + b"x" * (MAX_REQUEST_LENGTH + 10))
    (answer,) = served.read_lines(client)
    assert "a line of more than" in answer["error"]["message"]
    assert served.is_closed(client)


def test_disconnect_in_the_middle_of_a_frame(served: Served) -> None:
    bystander, client = served.subscribe(), served.connect()
    client.send(DESCRIBE[:7])
    served.serve()
    client.close()
    served.serve(0.15)
    served.publish()
    assert served.sequences(bystander) == [0]
    assert len(served.hub.connections) == 1


def test_a_handler_that_fails_costs_one_reply_and_nothing_else(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(_connection: Connection, _message: JsonObject) -> JsonObject:
        raise ZeroDivisionError

    bystander, client = served.subscribe(), served.connect()
    served.hub.start(broken)
    client.send(DESCRIBE)
    (answer,) = served.read(client)
    assert isinstance(answer, dict)
    assert answer["error"]["code"] == "internal"
    assert "internal error in a request" in caplog.text
    served.publish()
    assert served.sequences(bystander) == [0]


def test_an_answer_may_come_later_and_what_follows_waits_for_it(served: Served) -> None:
    waiting: list[tuple[Connection, JsonObject]] = []

    def later(connection: Connection, message: JsonObject) -> JsonObject | None:
        if message["action"] == "status":
            waiting.append((connection, message))
            return None
        return {"reply": message["action"], "id": message["id"]}

    served.hub.start(later)
    client, other = served.connect(), served.connect()
    for number, action in enumerate(("status", "describe", "status", "describe")):
        client.send(encode_json({"action": action, "id": number}))
    other.send(encode_json({"action": "describe", "id": 9}))
    assert served.read(client) == []
    assert served.read(other), "others need not wait for it"
    for number in (0, 2):
        assert len(waiting) == 1
        served.hub.answer(waiting[0][0], {"reply": "status", "id": number})
        waiting.clear()
        assert ids(served.read(client)) == [number, number + 1]
    client.send(encode_json({"action": "status", "id": 4}))
    served.serve()
    gone, _ = waiting.pop()
    client.close()
    gone.fail()
    served.serve(0.1)
    newcomer = served.connect()
    assert gone.fd in served.hub.connections, "its file descriptor is in use again"
    served.hub.answer(gone, {"reply": "status", "id": 4})
    assert served.hub.connections.get(gone.fd) is not gone
    assert served.read(newcomer) == []


# -- subscriptions


def test_subscription_filters(served: Served) -> None:
    only_second, third = served.subscribe(sensors=[1]), served.subscribe(every=3)
    everything, default = served.subscribe(fresh_only=False), served.subscribe()
    now_ns = served.clock.now_ns
    for number in range(9):
        served.publish(number % 2, DataFlag.REPEATED if number >= 6 else 0, now_ns)
    assert served.sequences(only_second) == [1, 3, 5]
    assert served.sequences(third) == [0, 1]
    assert served.sequences(everything) == list(range(9))
    assert served.sequences(default) == list(range(6))
    # After 10 ms with nothing, a silent sensor becomes visible.
    served.publish(0, DataFlag.REPEATED, now_ns + 9_999_999)
    served.publish(0, DataFlag.REPEATED, now_ns + 10_000_000)
    assert served.sequences(default) == [10]


def test_a_client_that_has_had_nothing_sees_a_silent_sensor_at_once(served: Served) -> None:
    client = served.subscribe()
    served.publish(flags=DataFlag.REPEATED, now_ns=1)
    assert served.sequences(client) == [0]


def test_gap_is_kept_for_a_client_that_skips_the_frame_that_had_it(served: Served) -> None:
    client = served.subscribe(every=2)
    for flags in (0, DataFlag.GAP, 0, 0, 0):
        served.publish(flags=flags)
    frames = [m for m in served.read(client) if isinstance(m, DataMessage)]
    assert [(f.sequence, f.flags) for f in frames] == [(0, 0), (2, DataFlag.GAP), (4, 0)]


def test_a_client_that_does_not_read_loses_the_oldest_whole_frames_and_is_told(served: Served) -> None:
    slow, quick = served.subscribe(buffer_size=10_000), served.subscribe()
    slow_connection, quick_connection = served.hub.connections.values()
    received_quick: list[int] = []
    total = 0
    while slow_connection.outbox.withheld < 500:
        for _ in range(50):
            served.publish()
        total += 50
        received_quick += served.sequences(quick)
    # A buffer that cuts frames anywhere, read on bit by bit.
    received = bytearray()
    while data := slow.recv_all():
        received += data
        served.serve()
    slow._received += received
    frames = [m for m in served.read(slow) if isinstance(m, DataMessage)]
    assert len(frames) == total - slow_connection.outbox.withheld
    assert frames[-1].sequence == total - 1
    jumps = [
        (after.flags & DataFlag.GAP, after.sequence - before.sequence) for before, after in pairwise(frames)
    ]
    assert all(bool(gap) == (step > 1) for gap, step in jumps)
    assert sum(step - 1 for _, step in jumps) == slow_connection.outbox.withheld
    assert received_quick == list(range(total))
    assert quick_connection.outbox.withheld == 0


@pytest.mark.parametrize("every", [1, 2, *range(253, 259)])
def test_frames_of_several_sensors_go_at_once_and_a_gap_is_told_for_each(served: Served, every: int) -> None:
    """Sensor 1 has something new in each `every`th exchange."""
    slow, quick = served.subscribe(buffer_size=10_007), served.subscribe()
    slow_connection, quick_connection = served.hub.connections.values()
    made: list[list[int]] = [[], []]
    for number in range(2000):
        each = [0, 1] if number % every == 0 else [0]
        for sensor in each:
            made[sensor].append(number)
        frames = [(encode_data(number, 1, 2, sensor, 0, 3, bytes(61)), sensor, 0) for sensor in each]
        served.hub.publish(frames, served.clock.now_ns)
        if number % 50 == 0:
            served.read(quick)
    received = bytearray()
    while data := slow.recv_all():
        received += data
        served.serve()
    served.hub.publish(
        [(encode_data(2000, 1, 2, sensor, 0, 3, bytes(61)), sensor, 0) for sensor in (0, 1)], 0
    )
    received += slow.recv_all()
    decoder = FrameDecoder()
    decoder.feed(received)
    got = [message for message in decoder if isinstance(message, DataMessage)]
    outbox = slow_connection.outbox
    assert outbox.withheld > 1000
    assert len(got) == len(made[0]) + len(made[1]) + 2 - outbox.withheld == outbox.sent
    assert quick_connection.outbox.withheld == 0
    for sensor in (0, 1):
        numbers = [*made[sensor], 2000]
        for before, after in pairwise([frame for frame in got if frame.sensor == sensor]):
            skipped = numbers.index(after.sequence) - numbers.index(before.sequence) - 1
            assert bool(after.flags & DataFlag.GAP) == (skipped > 0)


def test_queue_is_bounded(served: Served) -> None:
    served.subscribe()
    for _ in range(20_000):
        served.publish()
    assert len(only_connection(served).outbox._queue) <= MAX_QUEUED_DATA


def test_a_subscriber_that_half_closes_continues_to_receive(served: Served) -> None:
    client = served.subscribe()
    client.end_sending()
    served.serve(0.2)
    assert only_connection(served).state is State.HALF_CLOSED
    served.publish()
    assert served.sequences(client) == [0]
    client.close()
    served.publish()
    served.serve(0.1)
    assert not served.hub.connections


# -- how many, and for how long


def test_too_many_clients_are_refused(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(permissions, "MAX_CLIENTS", 2)
    first, second, third = served.connect(), served.connect(), served.connect()
    assert served.is_closed(third)
    for client in (first, second):
        client.send(DESCRIBE)
        assert served.read(client) == [{"reply": "describe", "ok": True}]


def test_other_users_cannot_use_up_all_connections(served: Served) -> None:
    for uid in range(100, 100 + permissions.MAX_CLIENTS):
        served.connect(uid)
    assert len(served.hub.connections) == permissions.MAX_CLIENTS - permissions.RESERVED_FOR_CONTROL
    served.hub.permissions.control_uids = frozenset({7})
    for _ in range(permissions.RESERVED_FOR_CONTROL + 3):
        served.connect(7)
    assert len(served.hub.connections) == permissions.MAX_CLIENTS


@pytest.mark.parametrize("uid", [4711, None])
def test_one_user_cannot_use_up_the_connections_of_others(served: Served, uid: int | None) -> None:
    for _ in range(permissions.MAX_CLIENTS_PER_USER + 5):
        served.connect(uid)
    assert len(served.hub.connections) == permissions.MAX_CLIENTS_PER_USER
    served.connect(4712)
    assert len(served.hub.connections) == permissions.MAX_CLIENTS_PER_USER + 1


def test_those_who_have_most_cannot_keep_out_who_has_none(served: Served) -> None:
    """Three users hold all that they can get; a fourth connects, and connects again."""
    for uid in (1001, 1002, 1003):
        for _ in range(permissions.MAX_CLIENTS_PER_USER):
            if not (client := served.connect(uid)).at_end:
                client.send(encode_json({"action": "subscribe"}))
    for _ in range(3):
        bridge = served.connect(998)
        bridge.send(encode_json({"action": "subscribe"}))
        assert served.read(bridge) == [{"reply": "subscribe", "ok": True}]
        bridge.close()
        served.publish()
        served.serve(0.1)


def test_an_idle_connection_of_who_has_most_goes_first(served: Served) -> None:
    for uid in range(2000, 2000 + permissions.MAX_CLIENTS - permissions.RESERVED_FOR_CONTROL):
        served.connect(uid)
    crowd = list(served.hub.connections.values())

    def gone() -> list[Connection]:
        return [client for client in crowd if client not in served.hub.connections.values()]

    for client in crowd[:6]:
        client.uid = 1003
        client.subscription = Subscription(1, None, 1, fresh_only=True)
    assert served.is_closed(served.connect(3000)), "none is idle"
    crowd[4].subscription = None
    served.connect(3000)
    assert gone() == [crowd[4]]
    assert 3000 in {client.uid for client in served.hub.connections.values()}
    crowd[3].subscription = crowd[2].subscription = None
    served.connect(3000)
    assert gone() == [crowd[2], crowd[4]]
    assert served.is_closed(served.connect(1003)), "who has most cannot push out"


def test_an_idle_connection_of_who_may_control_stays(served: Served) -> None:
    for _ in range(permissions.MAX_CLIENTS - permissions.RESERVED_FOR_CONTROL):
        served.connect(0)
    assert served.is_closed(served.connect(3000))
    assert {client.uid for client in served.hub.connections.values()} == {0}


def test_what_was_queued_and_sent_does_not_count_for_ever(served: Served) -> None:
    """80 rounds in which 4 kB of JSON wait because the client reads late: it is not full."""
    client = served.connect(buffer_size=4096)
    for _ in range(80):
        only_connection(served).send_json({"event": "x" * 4000})
        only_connection(served).send_json({"event": "x" * 4000})
        for _ in range(3):
            client.recv_all()
            served.serve()
    assert not only_connection(served).outbox.full
    assert not client.at_end


def test_who_waits_for_an_answer_is_not_idle(served: Served) -> None:
    """A tare of 20,000 samples at 25 Hz takes longer than the idle timeout."""
    served.hub.limits = Limits(idle_ns=60e9)
    served.hub.start(lambda _connection, _message: None)
    client = served.connect()
    client.send(encode_json({"action": "tare", "id": 1}))
    served.serve(800.0)
    served.hub.answer(only_connection(served), {"reply": "tare", "id": 1, "ok": True})
    assert served.read(client) == [{"reply": "tare", "id": 1, "ok": True}]
    served.serve(59.0)
    assert served.read(client) == [], "its idle time begins with the answer"
    served.serve(2.0)
    assert served.is_closed(client)


def test_a_client_that_asks_and_never_reads_is_closed(served: Served) -> None:
    client = served.connect()
    request = encode_json({"action": "describe", "id": "x" * 4_000})
    for _ in range(200):
        if not served.hub.connections:
            return
        if client.writable:
            client.send(request)
        served.serve(0.002)
    pytest.fail("the connection is still open")


def test_a_client_that_reads_nothing_is_closed_after_the_stall_timeout(served: Served) -> None:
    served.hub.limits = Limits(stall_ns=3e9)
    client, other = served.subscribe(), served.subscribe()
    for _ in range(60):
        for _ in range(50):
            served.publish()
        other.recv_all()
    served.serve(2.9)
    assert len(served.hub.connections) == 2
    served.serve(0.2)
    assert only_connection(served).peer == other.other.peer, "the one that reads stays"
    assert client.other.closed


def test_a_client_that_reads_a_little_now_and_then_stays(served: Served) -> None:
    served.hub.limits = Limits(stall_ns=1.5e9)
    client = served.subscribe()
    for _ in range(20):
        for _ in range(600):
            served.publish()
        client.recv(60_000)
        served.serve(1.4)
    assert len(served.hub.connections) == 1


def test_idle_and_unfinished_connections_are_closed_with_a_reason(served: Served) -> None:
    served.hub.limits = Limits(idle_ns=60e9)
    subscriber, unfinished, idle = served.subscribe(), served.connect(), served.connect()
    idle.send(b'{"action":"describe"}\n')
    assert served.read_lines(idle) == [{"reply": "describe", "ok": True}]
    unfinished.send(b"\0\0\1\0\2{")
    served.serve(9.9)
    assert len(served.hub.connections) == 3
    served.serve(0.2)
    (message,) = served.read(unfinished)
    assert isinstance(message, dict)
    assert message["error"]["code"] == "bad_request"
    assert "its message is still incomplete after 10 s" in message["error"]["message"]
    served.serve(50)
    (line,) = served.read_lines(idle)
    assert "it is not subscribed and has sent no request for 60 s" in line["error"]["message"]
    served.serve(1.1)
    assert unfinished.at_end
    assert idle.at_end
    assert only_connection(served).peer == subscriber.other.peer, "a subscriber need not send anything"


def test_close_sends_what_waits_and_is_bounded(served: Served) -> None:
    reads, stalled = served.subscribe(), served.subscribe(buffer_size=500)
    for _ in range(10):
        served.publish()
    served.hub.broadcast({"event": "shutting_down"})
    began_ns = served.clock.now_ns
    served.hub.close()
    assert 0.9e9 < served.clock.now_ns - began_ns < 1.1e9, "until the stalled one is given up"
    assert not served.hub.connections
    assert served.read(reads)[-1] == {"event": "shutting_down"}
    assert stalled.other.closed


def test_close_is_quick_if_all_clients_read(served: Served) -> None:
    client = served.subscribe()
    client.end_sending()
    served.serve()
    began_ns = served.clock.now_ns
    served.hub.close()
    assert served.clock.now_ns - began_ns < 0.1e9


# -- fairness


class Busy:
    """Takes time to answer, and notes whom."""

    def __init__(self, served: Served, cost_ns: int) -> None:
        self.handled: list[Connection] = []
        self._served = served
        self._cost_ns = cost_ns
        served.hub.start(self.handle)

    def handle(self, connection: Connection, message: JsonObject) -> JsonObject:
        self.handled.append(connection)
        self._served.clock.now_ns += self._cost_ns
        return self._served.handle(connection, message)


def flood(served: Served, count: int) -> list[InMemoryStream]:
    clients = [served.connect() for _ in range(count)]
    for client in clients:
        client.send(DESCRIBE * 100)
    return clients


def test_a_flood_of_requests_does_not_hold_up_the_acquisition(served: Served) -> None:
    flood(served, 40)
    busy = Busy(served, 300_000)
    # No time left: a turn ends after a message all the same, and the next one goes on with others.
    turns = 0
    while len(set(busy.handled)) < 40:
        before = len(busy.handled)
        served.hub.serve(served.clock.now_ns - 1)
        assert len(busy.handled) - before <= 2
        served.clock.now_ns += TURN_NS
        turns += 1
        assert turns < 500
    assert max(busy.handled.count(connection) for connection in set(busy.handled)) <= 6, "each has its turn"


def test_a_turn_ends_at_its_deadline_but_for_one_request(served: Served) -> None:
    flood(served, 40)
    busy = Busy(served, 300_000)
    for _ in range(200):
        until_ns = served.clock.now_ns + TURN_NS
        served.hub.serve(until_ns)
        assert served.clock.now_ns - until_ns <= 100_000, "begun 200 µs before it at the latest"
        served.clock.now_ns = max(served.clock.now_ns, until_ns)
    assert busy.handled


@pytest.mark.parametrize("cost_ns", [50_000, 1_000_000])
def test_clients_that_ask_without_pause_get_a_tenth_of_the_time(served: Served, cost_ns: int) -> None:
    clients = flood(served, 8)
    busy = Busy(served, cost_ns)
    began_ns = served.clock.now_ns
    for _ in range(400):
        served.hub.serve(served.clock.now_ns + TURN_NS)
        for client in clients:
            client.recv_all()
    share = len(busy.handled) * cost_ns / (served.clock.now_ns - began_ns)
    assert 0.05 < share <= 0.11


def test_others_need_not_wait_for_a_client_that_asks_without_pause(served: Served) -> None:
    hasty, other = served.connect(), served.connect()
    Busy(served, 100_000)
    hasty.send(numbered(400))
    other.send(encode_json({"action": "describe", "id": 1}))
    assert ids(served.read(other)) == [1]
    answers: list[object] = []
    while len(answers) < 400 and served.clock.now_ns < 10e9:
        answers += ids(served.read(hasty))
    assert answers == list(range(400)), "it gets all answers, in order"


def test_a_thread_that_was_not_running_does_not_silence_the_clients(served: Served) -> None:
    client = served.connect()
    busy = Busy(served, 1_000_000_000)
    client.send(DESCRIBE * 2)
    served.serve(0.03)
    served.serve(0.03)
    assert len(busy.handled) == 2


def test_samples_are_sent_while_requests_wait(served: Served) -> None:
    listener = served.subscribe(buffer_size=500)
    flood(served, 8)
    Busy(served, 1_000_000)
    received: list[int] = []
    for _ in range(100):
        served.publish()
        served.hub.serve(served.clock.now_ns + TURN_NS)
        served.hub.serve(served.clock.now_ns + TURN_NS)
        while listener.readable:
            received.append(len(listener.recv_all()))
    assert sum(received) >= 90 * len(encode_data(0, 0, 0, 0, 0, 0, bytes(61)))
