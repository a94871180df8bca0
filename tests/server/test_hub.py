"""The hub and its connections: requests, subscriptions, slow and hostile clients, timeouts.

In memory and without real time: that sockets behave alike is tested in test_transport.py. Hostile clients in
numbers are in test_hostile.py.
"""

from __future__ import annotations

import json
import struct
from itertools import pairwise
from typing import Any

import pytest

from bota_ethercat.control import parse_request, reply
from bota_ethercat.framing import (
    MAX_REQUEST_LENGTH,
    DataFlag,
    DataMessage,
    FrameDecoder,
    encode_data,
    encode_json,
)
from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.serving import permissions
from ethercat_server.serving.connection import Connection, ConnectionState, Timeouts
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.send_queue import MAX_QUEUED_DATA
from ethercat_server.simulation.transport import InMemoryStream, InMemoryTransport
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import ManualClock, Simulation, life_of

DESCRIBE = encode_json({"action": "describe"})
ANSWER = {"reply": "describe", "ok": True}
TURN_NS = 1_250_000  # time between two deadlines: the acquisition loop's at 800 Hz


def decoded(data: bytes | bytearray) -> list[Any]:
    decoder = FrameDecoder()
    decoder.feed(data)
    return list(decoder)


def one_frame(sequence: int, position: int = 0, flags: int = 0, newest_ns: int = 0) -> OutgoingFrame:
    """One that says that the newest sample was there at `newest_ns`."""
    return encode_data(sequence, 1, 2, position, flags, 3, bytes(61)), position, flags, newest_ns


class Served:
    """A hub with clients in memory, on a clock that stands still until the hub waits or a test does."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.transport = InMemoryTransport(self.clock)
        self.hub = Hub(self.transport, self.clock.monotonic_ns)
        self.hub.start(self.handle)
        self.sequence = 0
        self.newest_ns = [0, 0]  # when the newest sample of each sensor was there

    def handle(self, connection: Connection, message: JsonObject) -> JsonObject:
        request = parse_request(message)
        if request.action == "subscribe":
            values = request.values
            wanted = [number in (values["sensors"] or (0, 1)) for number in range(2)]
            connection.subscribe(wanted, values["every"], values["fresh_only"])
            self.hub.subscriptions_changed()
        return reply(request)

    def serve(self, seconds: float = 0.02) -> None:
        """Turns of the loop until this much time has passed."""
        span_ns = round(seconds * 1e9)
        end_ns, turn_ns = self.clock.now_ns + span_ns, max(TURN_NS, span_ns // 1000)
        while self.clock.now_ns < end_ns:
            self.hub.serve(min(end_ns, self.clock.now_ns + turn_ns))

    def connect(self, uid: int | None = 0, sent: bytes = b"", *, buffer_size: int = 65536) -> InMemoryStream:
        client = self.transport.connect(uid, buffer_size=buffer_size)
        self.serve()
        if sent:
            client.send(sent)
        return client

    def subscribe(self, *, buffer_size: int = 65536, **keys: object) -> InMemoryStream:
        client = self.connect(sent=encode_json({"action": "subscribe", **keys}), buffer_size=buffer_size)
        assert self.read(client) == [{"reply": "subscribe", "ok": True}]
        return client

    def publish(self, position: int = 0, flags: int = 0, now_ns: int | None = None, count: int = 1) -> None:
        for _ in range(count):
            now_ns = self.clock.now_ns if now_ns is None else now_ns
            if not flags & DataFlag.REPEATED:
                self.newest_ns[position] = now_ns
            self.hub.publish([one_frame(self.sequence, position, flags, self.newest_ns[position])], now_ns)
            self.sequence += 1

    def read(self, client: InMemoryStream) -> list[Any]:
        """Everything that arrives within a few turns, decoded."""
        self.serve()
        return decoded(client.recv_all())

    def read_slowly(self, client: InMemoryStream) -> bytearray:
        """Everything that waits, through a buffer that cuts frames anywhere."""
        received = bytearray()
        while data := client.recv_all():
            received += data
            self.serve()
        return received

    def read_lines(self, client: InMemoryStream) -> list[Any]:
        """What arrives on a bare JSON connection."""
        self.serve()
        return [json.loads(line) for line in client.recv_all().splitlines()]

    def refusal(self, client: InMemoryStream) -> str:
        """The message of the refusal that is all that arrives."""
        self.serve()
        data = client.recv_all()
        (answer,) = [json.loads(data)] if data[:1] == b"{" else decoded(data)
        assert answer["error"]["code"] == "bad_request"
        message: str = answer["error"]["message"]
        return message

    def sequences(self, client: InMemoryStream) -> list[int]:
        """The sequence numbers of the DATA that arrives."""
        return [message.sequence for message in self.read(client) if isinstance(message, DataMessage)]

    def is_closed(self, client: InMemoryStream) -> bool:
        """Whether the server closes the connection, once everything that it sent was read."""
        self.serve(0.1)
        client.recv_all()
        return client.at_end

    @property
    def connections(self) -> list[Connection]:
        return list(self.hub.connections.values())

    @property
    def only(self) -> Connection:
        (connection,) = self.connections
        return connection


@pytest.fixture
def served() -> Served:
    return Served()


def numbered(count: int, first: int = 0) -> bytes:
    return b"".join(encode_json({"action": "describe", "id": n}) for n in range(first, first + count))


def ids(messages: list[Any]) -> list[object]:
    return [message["id"] for message in messages]


# -- requests


def test_framed_requests_are_answered_in_order_with_their_ids(served: Served) -> None:
    client = served.connect(sent=encode_json({"action": "describe", "id": {"any": ["thing", None]}}))
    assert served.read(client) == [{**ANSWER, "id": {"any": ["thing", None]}}]
    client.send(numbered(20))
    assert ids(served.read(client)) == list(range(20))


@pytest.mark.parametrize("ending", [b"", b"\n", b" \r\n"])
def test_bare_json_needs_no_newline(served: Served, ending: bytes) -> None:
    client = served.connect(sent=b'{"action":"describe","id":7}' + ending)
    assert served.read_lines(client) == [{**ANSWER, "id": 7}]


def test_bare_json_connection_answers_then_closes_when_the_client_half_closes(served: Served) -> None:
    client = served.connect(sent=b'{"action":"describe"}\n{"action":"describe"}\n')
    client.end_sending()
    assert len(served.read_lines(client)) == 2
    assert served.is_closed(client)
    assert not served.connections


def test_an_unfinished_bare_line_is_refused_when_the_client_half_closes(served: Served) -> None:
    client = served.connect(sent=b'{"action":"describe"')
    client.end_sending()
    assert "not valid JSON" in served.refusal(client)
    assert served.is_closed(client)


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        (b"{nonsense", "not valid JSON"),
        (b"[1, 2]", "must be an object"),
        (b'{"action": "subscribe", "every": 0}', "'every' must be"),
        (b"\xff\xfe", "not UTF-8"),
        (b'{"a":' + b"[" * 2000 + b"]" * 2000 + b"}", "nested"),
        (b'{"action":"describe","id":1e999}', "too large"),
        (b'{"action":"describe","id":NaN}', "NaN is no JSON number"),
    ],
)
def test_bad_json_is_refused_and_the_connection_goes_on(served: Served, body: bytes, complaint: str) -> None:
    client = served.connect(sent=struct.pack(">IB", len(body) + 1, 2) + body + numbered(1, 1))
    bad, good = served.read(client)
    assert bad["ok"] is False
    assert complaint in bad["error"]["message"]
    assert good == {**ANSWER, "id": 1}


@pytest.mark.parametrize(
    "poison",
    [
        struct.pack(">IB", 0, 2),
        struct.pack(">IB", MAX_REQUEST_LENGTH + 2, 2),
        struct.pack(">IB", 5, 9) + b"abcd",
        encode_data(0, 0, 0, 0, 0, 0, bytes(61)),
        b"GET / HTTP/1.1\r\n\r\n",
        b'{"action": "' + b"x" * (MAX_REQUEST_LENGTH + 10),
    ],
)
def test_broken_framing_is_refused_and_closed_and_others_notice_nothing(
    served: Served, poison: bytes
) -> None:
    bystander, client = served.subscribe(), served.connect(sent=poison)
    served.publish()
    said = served.refusal(client)
    assert "a line of more than" in said or poison[:1] != b"{"
    assert served.is_closed(client)
    served.publish()
    assert served.sequences(bystander) == [0, 1]


def test_a_refused_client_that_still_sends_can_read_its_last_reply(served: Served) -> None:
    client = served.connect(sent=struct.pack(">IB", 0, 2))
    served.serve(0.06)
    client.send(DESCRIBE * 100)  # a close with this unread would reset the connection
    assert served.refusal(client)
    client.end_sending()
    served.serve(0.06)
    assert not served.connections
    assert client.at_end


def test_a_refused_client_that_never_closes_is_closed_after_a_second(served: Served) -> None:
    served.connect(sent=struct.pack(">IB", 0, 2))
    served.serve(0.9)
    assert served.only.state is ConnectionState.LINGERING
    served.serve(0.2)
    assert not served.connections


def test_a_handler_that_fails_costs_one_reply(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    def broken(_connection: Connection, _message: JsonObject) -> JsonObject:
        raise ZeroDivisionError

    bystander, client = served.subscribe(), served.connect()
    served.hub.start(broken)
    client.send(numbered(1, 7))
    (answer,) = served.read(client)
    assert (answer["reply"], answer["id"], answer["error"]["code"]) == ("describe", 7, "internal")
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
    client, other = served.connect(), served.connect(sent=numbered(1, 9))
    for number, action in enumerate(("status", "describe", "status", "describe")):
        client.send(encode_json({"action": action, "id": number}))
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
    newcomer = served.subscribe()
    served.publish(0, DataFlag.REPEATED, now_ns)
    assert served.sequences(newcomer) == [11], "it has had nothing yet"


def test_of_an_exchange_of_several_sensors_each_frame_has_its_own_flags(served: Served) -> None:
    client, now_ns = served.subscribe(), served.clock.now_ns
    served.hub.publish([one_frame(0, 0, 0, now_ns), one_frame(0, 1, DataFlag.REPEATED, now_ns)], now_ns)
    assert [frame.sensor for frame in served.read(client)] == [0], "the other is silent for a moment only"


def test_what_a_client_has_had_that_leaves_out_frames_is_what_it_was_sent(served: Served) -> None:
    client, now_ns = served.subscribe(every=3), served.clock.now_ns
    for after_ns, flags in ((0, 0), (8_000_000, 0), *((10_000_000 + n, DataFlag.REPEATED) for n in (0, 1))):
        served.publish(0, flags, now_ns + after_ns)
    assert served.sequences(client) == [0, 3], "the sample of 8 ms was not sent"


def test_gap_is_kept_for_a_client_that_skips_the_frame_that_had_it(served: Served) -> None:
    client = served.subscribe(every=2)
    for flags in (0, DataFlag.GAP, 0, 0, 0):
        served.publish(flags=flags)
    assert [(f.sequence, f.flags) for f in served.read(client)] == [(0, 0), (2, DataFlag.GAP), (4, 0)]


@pytest.mark.parametrize("every", [0, 1, 2, *range(253, 259)])
def test_who_does_not_read_loses_the_oldest_whole_frames_and_is_told(served: Served, every: int) -> None:
    """Of several sensors frames go at once: 1 has something new in each `every`th exchange, or never."""
    slow, quick = served.subscribe(buffer_size=10_007), served.subscribe()
    outbox, quick_outbox = (connection.outbox for connection in served.connections)
    made: list[list[int]] = [[], []]
    received_quick = []
    for number in range(2001):
        each = [0, 1] if (every and number % every == 0) or (every and number == 2000) else [0]
        for sensor in each:
            made[sensor].append(number)
        if number == 2000:
            received = served.read_slowly(slow)
            assert decoded(received)[-1].sequence == 1999, "the newest"
        served.hub.publish([one_frame(number, sensor) for sensor in each], served.clock.now_ns)
        if number % 50 == 0:
            received_quick += served.read(quick)
    received += slow.recv_all()
    got = decoded(received)
    assert outbox.withheld > len(made[0]) + len(made[1]) - MAX_QUEUED_DATA - 200, "the queue is bounded"
    assert len(got) == len(made[0]) + len(made[1]) - outbox.withheld == outbox.sent
    assert quick_outbox.withheld == 0
    for sensor in (0, 1):
        assert [frame.sequence for frame in received_quick if frame.sensor == sensor] == made[sensor]
        for before, after in pairwise([frame for frame in got if frame.sensor == sensor]):
            skipped = made[sensor].index(after.sequence) - made[sensor].index(before.sequence) - 1
            assert bool(after.flags & DataFlag.GAP) == (skipped > 0)


def test_samples_and_replies_arrive_in_the_order_in_which_they_were_sent(served: Served) -> None:
    """Also where the client reads between two of them, and nobody has noticed yet that there is room."""
    client = served.subscribe(buffer_size=len(one_frame(0)[0]))
    received = bytearray()

    def announce() -> None:
        served.only.send_json({"number": served.sequence})
        served.sequence += 1

    for _ in range(10):
        served.publish()
        announce()
        received += client.recv_all()
        announce()
        served.publish()
        served.serve()
    messages = decoded(received + served.read_slowly(client))
    numbers = [each.sequence if isinstance(each, DataMessage) else each["number"] for each in messages]
    assert numbers == list(range(40))


def test_a_subscriber_that_half_closes_continues_to_receive(served: Served) -> None:
    client = served.subscribe()
    client.end_sending()
    served.serve(0.2)
    assert served.only.state is ConnectionState.READING
    served.publish()
    assert served.sequences(client) == [0]
    client.close()
    served.publish(count=2)  # that nobody takes the first is known by the second
    served.serve(0.1)
    assert not served.connections


# -- how many, and for how long


@pytest.mark.parametrize("uid", [4711, None])
def test_no_user_can_use_up_the_connections_of_others(served: Served, uid: int | None) -> None:
    for _ in range(permissions.MAX_CLIENTS_PER_USER + 5):
        served.connect(uid)
    assert len(served.connections) == permissions.MAX_CLIENTS_PER_USER
    for other in range(100, 100 + permissions.MAX_CLIENTS):
        served.connect(other)
    assert len(served.connections) == permissions.MAX_CLIENTS - permissions.RESERVED_FOR_CONTROL
    served.hub.permissions.control_uids = frozenset({7})
    for _ in range(permissions.RESERVED_FOR_CONTROL + 3):
        last = served.connect(7)
    assert len(served.connections) == permissions.MAX_CLIENTS
    assert served.is_closed(last)


def test_those_who_have_most_cannot_keep_out_who_has_none(served: Served) -> None:
    """Three users hold all that they can get; a fourth connects, and connects again."""
    for uid in (1001, 1002, 1003):
        for _ in range(permissions.MAX_CLIENTS_PER_USER):
            if not (client := served.connect(uid)).at_end:
                client.send(encode_json({"action": "subscribe"}))
    for _ in range(3):
        bridge = served.connect(998, encode_json({"action": "subscribe"}))
        assert served.read(bridge) == [{"reply": "subscribe", "ok": True}]
        bridge.close()
        served.publish(count=2)
        served.serve(0.1)


def test_an_idle_connection_of_who_has_most_goes_first(served: Served) -> None:
    for uid in range(2000, 2000 + permissions.MAX_CLIENTS - permissions.RESERVED_FOR_CONTROL):
        served.connect(uid)
    crowd = served.connections

    def gone() -> list[Connection]:
        return [client for client in crowd if client not in served.connections]

    for client in crowd[:6]:
        client.uid = 1003
        client.subscribe([True], 1, fresh_only=True)
    assert served.is_closed(served.connect(3000)), "none is idle"
    crowd[4].subscription = None
    served.connect(3000)
    assert gone() == [crowd[4]]
    assert 3000 in {client.uid for client in served.connections}
    crowd[3].subscription = crowd[2].subscription = None
    served.connect(3000)
    assert gone() == [crowd[2], crowd[4]]
    assert served.is_closed(served.connect(1003)), "who has most cannot push out"


def test_an_idle_connection_of_who_may_control_stays(served: Served) -> None:
    for _ in range(permissions.MAX_CLIENTS - permissions.RESERVED_FOR_CONTROL):
        served.connect(0)
    assert served.is_closed(served.connect(3000))
    assert {client.uid for client in served.connections} == {0}


def test_what_was_queued_and_sent_does_not_count_for_ever(served: Served) -> None:
    """80 rounds in which 4 kB of JSON wait because the client reads late: it is not full."""
    client = served.connect(buffer_size=4096)
    for _ in range(80):
        served.only.send_json({"event": "x" * 4000})
        served.only.send_json({"event": "x" * 4000})
        for _ in range(3):
            client.recv_all()
            served.serve()
    assert not served.only.outbox.full
    assert not client.at_end


def test_who_waits_for_an_answer_is_not_idle(served: Served) -> None:
    """A tare of 20,000 samples at 25 Hz takes longer than the idle timeout."""
    served.hub.timeouts = Timeouts(idle_ns=60e9)
    served.hub.start(lambda _connection, _message: None)
    client = served.connect(sent=encode_json({"action": "tare", "id": 1}))
    served.serve(800.0)
    served.hub.answer(served.only, {"reply": "tare", "id": 1, "ok": True})
    assert served.read(client) == [{"reply": "tare", "id": 1, "ok": True}]
    served.serve(59.0)
    assert served.read(client) == [], "its idle time begins with the answer"
    served.serve(2.0)
    assert served.is_closed(client)


def test_a_request_in_two_parts_is_complete_once_both_are_there(served: Served) -> None:
    """The time that a message may take ends with it: a subscriber stays for as long as it likes."""
    request = encode_json({"action": "describe"})
    client = served.connect(sent=request[:7])
    served.serve(1.0)
    client.send(request[7:])
    served.serve(1.0)
    (answer,) = served.read(client)
    assert answer["reply"] == "describe"
    served.only.subscribe([True], 1, fresh_only=True)
    served.serve(60.0)
    assert served.read(client) == []
    assert not served.only.state.ending


def test_a_client_that_asks_and_never_reads_is_closed(served: Served) -> None:
    client = served.connect()
    request = encode_json({"action": "describe", "id": "x" * 4_000})
    for _ in range(200):
        if not served.connections:
            return
        if client.writable:
            client.send(request)
        served.serve(0.002)
    pytest.fail("the connection is still open")


def test_a_client_that_reads_nothing_is_closed_after_the_stall_timeout(served: Served) -> None:
    served.hub.timeouts = Timeouts(stall_ns=3e9)
    client, other = served.subscribe(), served.subscribe()
    for _ in range(60):
        served.publish(count=50)
        other.recv_all()
    served.serve(2.9)
    assert len(served.connections) == 2
    served.serve(0.2)
    assert served.only.peer == other.other.peer, "the one that reads stays"
    assert client.other.closed


def test_a_client_that_reads_a_little_now_and_then_stays(served: Served) -> None:
    served.hub.timeouts = Timeouts(stall_ns=1.5e9)
    client = served.subscribe()
    for _ in range(20):
        served.publish(count=600)
        client.recv(60_000)
        served.serve(1.4)
    assert len(served.connections) == 1


def test_idle_and_unfinished_connections_are_closed_with_a_reason(served: Served) -> None:
    served.hub.timeouts = Timeouts(idle_ns=60e9)
    subscriber, unfinished = served.subscribe(), served.connect()
    idle = served.connect(sent=b'{"action":"describe"}\n')
    assert served.read_lines(idle) == [ANSWER]
    unfinished.send(b"\0\0\1\0\2{")
    served.serve(9.9)
    assert len(served.connections) == 3
    served.serve(0.2)
    assert "its message is still incomplete after 10 s" in served.refusal(unfinished)
    served.serve(50)
    assert "it is not subscribed and has sent no request for 60 s" in served.refusal(idle)
    served.serve(1.1)
    assert unfinished.at_end
    assert idle.at_end
    assert served.only.peer == subscriber.other.peer, "a subscriber need not send anything"


def test_close_sends_what_waits_and_is_bounded(served: Served) -> None:
    reads, stalled = served.subscribe(), served.subscribe(buffer_size=500)
    served.publish(count=10)
    served.hub.broadcast({"event": "shutting_down"})
    began_ns = served.clock.now_ns
    served.hub.close()
    assert 0.9e9 < served.clock.now_ns - began_ns < 1.1e9, "until the stalled one is given up"
    assert not served.connections
    assert served.read(reads)[-1] == {"event": "shutting_down"}
    assert stalled.other.closed


# -- fairness


class Busy:
    """Takes time to answer, and notes whom."""

    def __init__(self, served: Served, cost_ns: int) -> None:
        self.handled: list[Connection] = []
        self._served, self._cost_ns = served, cost_ns
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


def test_a_turn_ends_at_its_deadline_but_for_one_request(served: Served) -> None:
    flood(served, 40)
    busy = Busy(served, 300_000)
    for _ in range(200):
        until_ns = served.clock.now_ns + TURN_NS
        served.hub.serve(until_ns)
        assert served.clock.now_ns - until_ns <= 100_000, "begun 200 µs before it at the latest"
        served.clock.now_ns = max(served.clock.now_ns, until_ns)
    assert busy.handled


def test_others_need_not_wait_for_a_client_that_asks_without_pause(served: Served) -> None:
    hasty, other = served.connect(), served.connect()
    Busy(served, 100_000)
    hasty.send(numbered(400))
    other.send(numbered(1, 1))
    assert ids(served.read(other)) == [1]
    answers: list[object] = []
    while len(answers) < 400 and served.clock.now_ns < 10e9:
        answers += ids(served.read(hasty))
    assert answers == list(range(400)), "it gets all answers, in order"


def test_in_the_pause_after_a_long_pass_what_waits_is_sent_and_nothing_is_read(served: Served) -> None:
    slow, hasty = served.subscribe(buffer_size=100), served.connect()
    busy = Busy(served, 2_000_000)
    served.publish(count=20)
    hasty.send(DESCRIBE * 2)
    served.serve(0.001)
    received = bytearray()
    while data := slow.recv_all():
        received += data
        served.serve(0.0001)
    assert [frame.sequence for frame in decoded(received)] == list(range(20))
    assert len(busy.handled) == 1, "18 ms after a request of 2 ms have not passed"
    served.serve(0.02)
    assert len(busy.handled) == 2


def test_a_thread_that_was_not_running_does_not_silence_the_clients(served: Served) -> None:
    client = served.connect()
    busy = Busy(served, 1_000_000_000)
    client.send(DESCRIBE * 2)
    served.serve(0.03)
    served.serve(0.03)
    assert len(busy.handled) == 2


# -- the whole server

CLOCK = SensorOptions(signal="clock", ppm=150.0)


@pytest.mark.parametrize("size", [61, 77])
def test_process_data_is_byte_for_byte_what_the_sensor_sent(size: int) -> None:
    simulation = Simulation(SensorOptions(pdo_size=size, signal="clock"))
    client = simulation.subscribe()
    assert client.described()["pdo_size"] == size
    layout = LAYOUTS[size]
    for frame in client.fresh(300):
        assert len(frame.process_data) == size
        # Unpacked and packed again it is the same: nothing is shifted, swapped or padded.
        assert layout.struct.pack(*layout.struct.unpack(frame.process_data)) == frame.process_data
    life, stream = life_of(simulation.backend), simulation.streams[0]
    simulation.run_until(lambda: stream.process_data == life.inputs(), "what the sensor has now")


def test_unsubscribe_stops_the_frames() -> None:
    simulation = Simulation(CLOCK)
    client = simulation.subscribe()
    client.collect(5)
    assert client.ask("unsubscribe")["ok"]
    client.frames.clear()
    simulation.run(1.0)
    assert not client.frames


def test_others_may_read_and_not_control() -> None:
    client = Simulation(CLOCK).connect(4711)
    for action, keys in (
        ("configure", {"settings": {"fir": True}}),
        ("tare", {}),
        ("sdo_write", {"index": 0x8000, "subindex": 1, "hex": "00000000"}),
        ("sii_read", {"word": 0}),
        ("trace", {}),
        ("shutdown", {}),
    ):
        assert client.refused(action, **keys)["code"] == "denied", action
    for action, keys in (
        ("describe", {}),
        ("status", {}),
        ("subscribe", {}),
        ("sdo_read", {"index": 0x1008}),
    ):
        assert client.ask(action, **keys)["ok"], action
    assert len(client.fresh(50)) == 50


def test_shutdown_ends_the_loop_and_takes_the_sensor_to_init() -> None:
    simulation = Simulation(CLOCK)
    watcher, asking = simulation.subscribe(), simulation.connect()
    assert asking.ask("shutdown")["ok"]
    assert simulation.cycle.stopping
    simulation.close()
    assert simulation.stats()["al_state"] == "INIT"
    watcher.receive()
    assert watcher.at_end
    assert len(Simulation(backend=simulation.backend).subscribe().fresh(50)) == 50


def test_a_connection_that_ends_while_its_request_is_handled_is_not_revived(served: Served) -> None:
    def end(connection: Connection, _: JsonObject) -> None:
        connection.finish()  # or an event found its queue full, say; the answer comes later

    served.hub.start(end)
    client = served.connect(sent=DESCRIBE)
    served.serve()
    assert served.is_closed(client)
    client.end_sending()
    served.serve(0.1)
    assert not served.connections


def test_a_transition_that_is_not_in_the_table_is_an_error(served: Served) -> None:
    served.connect()
    connection = served.only
    with pytest.raises(AssertionError, match="READING -> ANSWERING"):
        connection.answer_later()
    connection.finish()
    with pytest.raises(AssertionError, match="CLOSING -> READY"):
        connection.answered()
    assert connection.state is ConnectionState.CLOSING
