"""Hundreds of hostile connections: an honest client notices nothing of them, and nothing of them remains.

In memory and in simulated time; real sockets that are gone at once are in test_authority.py. Each kind is a
generator that pauses for a turn of the server's loop where it waits.
"""

from __future__ import annotations

import collections
import contextlib
import gc
import io
import logging
import os
import random
import struct
import sys
from collections.abc import Callable, Generator, Iterator
from types import SimpleNamespace

import pytest

from bota_ethercat.control import ACTIONS, request
from bota_ethercat.distribution import WINDOW_SLOTS
from bota_ethercat.framing import MAX_REQUEST_LENGTH, DataFlag, encode_json
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.process import logs
from ethercat_server.serving.bare_json import encode_bare_json
from ethercat_server.serving.connection import Connection
from ethercat_server.serving.permissions import MAX_CLIENTS_PER_USER
from ethercat_server.simulation.transport import InMemoryStream
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.hostile_bytes import BARE, FRAMED, HOSTILE_TEXTS, framed, mutate
from tests.server.running import OLD
from tests.simulation import Simulation, check_frames, more_if_long, reading

SEED = int(os.environ.get("FUZZ_SEED", "20261121"))
REQUEST_NS = 150_000  # what a request costs the server's thread in simulated time
LINGER_S = 1.2  # after which the server has closed whatever it does not need
CROWD_S = 2.0
LOG_LIMIT = 20_000  # characters that hostile clients may make the server log in ten seconds

# -- the hostile

# Connections that act, and that are left hanging: together somewhat more than one user may have.
AT_ONCE, MOST_HELD = 10, 8
# The connections come from many users, because one may not have many.
FIRST_UID, USERS, OF_ONE_USER = 60_000, 1_000, 20
PATIENCE_TURNS = 50_000
_SHUTDOWN = request("shutdown")

Steps = Generator[None, None, None]


class Hostile:
    """A client that means no good."""

    def __init__(
        self, stream: InMemoryStream, chance: random.Random, answers: collections.Counter[str]
    ) -> None:
        self.stream, self.chance, self.answers = stream, chance, answers
        self.is_held = False  # it stays open and says no more

    def hold(self) -> None:
        self.is_held = True

    def send_some(self, data: bytes) -> int:
        """As much as can be sent now."""
        with contextlib.suppress(BlockingIOError):
            return self.stream.send(data)
        return 0

    def send(self, data: bytes) -> Steps:
        while data := data[self.send_some(data) :]:
            yield

    def hear_some(self) -> bytes | None:
        """What has come, None if nothing has, b"" at the end."""
        with contextlib.suppress(BlockingIOError):
            data = self.stream.recv(65536)
            self.answers["refusals"] += data.count(b'"ok":false')
            self.answers["grants"] += data.count(b'"ok":true')
            return data
        return None

    def hear(self, turns: int = 16) -> Generator[None, None, bytes]:
        """What the server says in so many turns, or before it ends the connection."""
        found = b""
        for _ in range(turns):
            data = self.hear_some()
            found += data or b""
            if data == b"":
                return found
            yield
        assert turns < PATIENCE_TURNS, f"it does not end; it said {found!r}"
        return found


Kind = Callable[[Hostile], Steps]
KINDS: list[Kind] = []


def kind(function: Kind) -> Kind:
    """One way to be a nuisance. The connection is closed afterwards unless it is held."""
    KINDS.append(function)
    return function


def mutated(chance: random.Random) -> bytes:
    good = chance.choice((FRAMED, BARE))
    return b"".join(mutate(chance, chance.choice(good), good) for _ in range(chance.randint(1, 4)))


def huge(chance: random.Random) -> bytes:
    return struct.pack(">IB", chance.choice((16386, 2**24, 2**32 - 1)), 2) + b"{" * 1000


def json_bomb(chance: random.Random) -> bytes:
    text = chance.choice(HOSTILE_TEXTS)
    return framed(text) if chance.random() < 0.5 else b"{" + text + b"\n"


def noise(chance: random.Random) -> bytes:
    return chance.randbytes(chance.choice((1, 4, 5, 100, 4000)))


def saying(what: Callable[[random.Random], bytes]) -> Kind:
    def say(client: Hostile) -> Steps:
        yield from client.send(what(client.chance))
        yield from client.hear()

    say.__name__ = what.__name__
    return say


KINDS += map(saying, (noise, mutated, huge, json_bomb))


def any_form(client: Hostile, message: dict[str, object]) -> bytes:
    return client.chance.choice((encode_json, encode_bare_json))(message)


@kind
def half_close(client: Hostile) -> Steps:
    yield from client.send(any_form(client, request("status")))
    client.stream.end_sending()
    if not (yield from client.hear(PATIENCE_TURNS)):
        raise ConnectionAbortedError("one too many: not let in")
    client.answers["heard after a half close"] += 1


@kind
def reset_with_a_request(client: Hostile) -> Steps:
    yield from client.send(client.chance.choice(FRAMED[:-2]) * client.chance.randint(0, 3))
    if client.chance.random() < 0.5:
        yield
    client.stream.reset()


@kind
def half_a_message_then_silence(client: Hostile) -> Steps:
    whole = client.chance.choice((*FRAMED[:3], *BARE[:3]))
    yield from client.send(whole[: client.chance.randrange(1, len(whole))])
    client.hold()


@kind
def flood(client: Hostile) -> Steps:
    client.send_some(any_form(client, request("status")) * client.chance.randint(50, 2000))
    if client.chance.random() < 0.5:
        client.hold()  # the answers wait for ever
    yield


@kind
def asks_much_and_reads_nothing(client: Hostile) -> Steps:
    client.send_some(encode_json(request("describe", "x" * (MAX_REQUEST_LENGTH - 60))) * 90)
    client.hold()
    yield


@kind
def subscribe_and_vanish(client: Hostile) -> Steps:
    every = client.chance.choice((1, 7))
    yield from client.send(encode_json(request("subscribe", every=every, fresh_only=False)))
    if client.chance.random() < 0.5:
        yield from client.hear()
    client.chance.choice((client.stream.reset, client.hold, client.stream.close))()


@kind
def shut_it_down(client: Hostile) -> Steps:
    message = client.chance.choice((_SHUTDOWN, {**_SHUTDOWN, "uid": 0, "user": "root"}))
    yield from client.send(any_form(client, message) * client.chance.randint(1, 3))
    if client.chance.random() < 0.5:
        yield
    how = client.chance.randrange(3)
    if how == 2:
        yield from client.hear()
    else:
        (client.stream.reset, client.stream.close)[how]()


def ask_without_pause(client: Hostile) -> Steps:
    """One of a crowd: asks as much as it can, all kinds of requests, and reads the answers. Without end."""
    room = MAX_REQUEST_LENGTH - 60
    plain = (request("status"), request("describe", "x" * room), request("no"), _SHUTDOWN)
    asked = [encode_json(message) for message in plain]
    asked.append(encode_json(request("sdo_read", index=0x1008)))
    asked.append(framed(b'{"action":"describe","id":[' + b",".join([b"1e15"] * (room // 5)) + b"]}"))
    while True:
        for some in asked:
            yield from client.send(some * 4)
            if client.hear_some() == b"":
                raise ConnectionAbortedError


class Siege:
    """`count` hostile connections of random kinds, some at a time; the first ones are of one kind each."""

    def __init__(self, connect: Callable[[int], InMemoryStream], count: int, seed: int) -> None:
        """`connect` makes a connection of a user."""
        self.done: collections.Counter[str] = collections.Counter()
        self.answers: collections.Counter[str] = collections.Counter()
        self._connect, self._count = connect, count
        self._chance = random.Random(seed)
        self._acting: dict[Hostile, tuple[Kind, Steps]] = {}
        self._held: collections.deque[Hostile] = collections.deque()
        self._begun = 0

    def act(self) -> None:
        """A turn of each."""
        if self._begun < self._count and len(self._acting) < AT_ONCE and self._chance.random() < 0.6:
            self._begin()
        for client, (nuisance, steps) in list(self._acting.items()):
            try:
                next(steps)
                continue
            except StopIteration:
                pass
            except ConnectionError:
                self.answers["cut off"] += 1
            del self._acting[client]
            self.done[nuisance.__name__] += 1
            self._held.append(client)
            if not client.is_held or len(self._held) > MOST_HELD:
                (self._held.popleft() if client.is_held else self._held.pop()).stream.close()
        if self.is_over:
            while self._held:
                self._held.pop().stream.close()

    def _begin(self) -> None:
        chance, number = self._chance, self._begun
        self._begun += 1
        stream = self._connect(FIRST_UID + number // OF_ONE_USER % USERS)
        nuisance = KINDS[number] if number < len(KINDS) else chance.choice(KINDS)
        client = Hostile(stream, chance, self.answers)
        self._acting[client] = nuisance, nuisance(client)

    @property
    def is_over(self) -> bool:
        return self._begun == self._count and not self._acting

    def check(self) -> None:
        """They were of all kinds."""
        print(self.done, self.answers)
        assert sum(self.done.values()) == self._count
        assert all(self.done[nuisance.__name__] for nuisance in KINDS)


# -- the besieged


class Besieged:
    """A server whose requests take time, and an honest client that only listens."""

    def __init__(self) -> None:
        self.simulation = Simulation(SensorOptions(signal="clock", ppm=150.0))
        self.log = io.StringIO()
        # What others were granted although it needs a right that they do not have.
        self.granted: list[JsonObject] = []
        self._streams: list[InMemoryStream] = []
        assert self.simulation.hub._handler is not None
        self._handle = self.simulation.hub._handler
        self.simulation.hub.start(self._handle_slowly)
        self.listener, self.asking = self.simulation.subscribe(), self.simulation.connect()
        self.listener.fresh(200)

    def _handle_slowly(self, connection: Connection, message: JsonObject) -> JsonObject | None:
        self.simulation.clock.stall(REQUEST_NS)
        answer = self._handle(connection, message)
        if connection.uid != 0 and ACTIONS[message["action"]].controls:
            self.granted.append(message)
        return answer

    def connect(self, uid: int) -> InMemoryStream:
        self._streams.append(self.simulation.transport.connect(uid))
        return self._streams[-1]

    def endure(self, siege: Siege) -> None:
        def act(_: int) -> None:
            siege.act()
            if len(self.listener.frames) > 2000:
                self.check()

        self.simulation.on_serve = act
        self.simulation.run_until(lambda: siege.is_over, "the end of the siege", 1e6)
        self.simulation.on_serve = lambda _: None
        self.simulation.run(LINGER_S)
        siege.check()
        assert {"grants", "refusals", "heard after a half close"} <= siege.answers.keys()
        self.check_status()
        self.forget_streams()

    def forget_streams(self) -> None:
        """The two ends of a connection refer to one another."""
        for stream in self._streams:
            assert stream.other.closed
            del stream.other.other, stream.other
        self._streams.clear()

    def check(self) -> None:
        """The honest client got every sample; only the last one is kept."""
        frames = self.listener.frames
        check_frames(frames)
        assert not any(frame.flags & (OLD | DataFlag.GAP) for frame in frames)
        assert reading(frames[-1]).number - reading(frames[0]).number == len(frames) - 1
        del frames[:-1]
        self.simulation.frames.clear()
        self.simulation.published_ns.clear()

    def check_status(self) -> None:
        self.check()
        status = self.asking.ask("status")
        assert [row["withheld"] for row in status["clients"]] == [0, 0], "nobody else is left"
        assert (status["sensors"][0]["lost_samples"], status["sensors"][0]["recoveries"]) == (0, 0)
        assert self.granted == []
        assert "Traceback" not in self.log.getvalue()
        self.asking.replies.clear()


@contextlib.contextmanager
def besieged() -> Iterator[Besieged]:
    """With the log as the server writes it, and with the collector off, as it is in the loop.

    To be entered by the test itself: what a fixture logs is recorded by pytest.
    """
    found = Besieged()
    clock = found.simulation.clock
    handler = logging.StreamHandler(found.log)
    handler.setFormatter(logs.OneLine("ethercat-server"))
    handler.addFilter(logs.Repetitions())
    logger = logging.getLogger("ethercat_server")
    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as cleanup:
        patch.setattr(logs, "time", SimpleNamespace(monotonic=lambda: clock.now_ns * 1e-9))
        patch.setattr(logger, "propagate", False)
        patch.setattr(logger, "level", logging.INFO)
        logger.addHandler(handler)
        cleanup.callback(logger.removeHandler, handler)
        gc.collect()
        gc.disable()
        cleanup.callback(gc.enable)
        yield found


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("count", more_if_long([300], [300, 50_000]))
def test_hostile_connections_harm_nobody(count: int) -> None:
    with besieged() as found:
        found.simulation.run(1.0 + WINDOW_SLOTS)  # what is kept of the last ten seconds has its size then
        began_ns, blocks = found.simulation.clock.now_ns, []
        for part in range(3):
            found.endure(Siege(found.connect, count, SEED + part))
            circles = gc.collect()
            blocks.append(sys.getallocatedblocks())
        assert circles == 0, "nobody collects them while the bus runs"
        assert blocks[2] - blocks[1] < 2 * count, f"memory grows: {blocks} blocks"
        tens = (found.simulation.clock.now_ns - began_ns) * 1e-10
        assert len(found.log.getvalue()) < LOG_LIMIT * (1 + tens), "the log can be flooded"
        assert found.asking.ask("describe")["ok"]


def test_a_crowd_that_asks_without_pause_costs_no_samples() -> None:
    with besieged() as found:
        answers: list[collections.Counter[str]] = [
            collections.Counter() for _ in range(MAX_CLIENTS_PER_USER + 4)
        ]
        crowd = {
            number: ask_without_pause(Hostile(found.connect(4711), random.Random(SEED), counted))
            for number, counted in enumerate(answers)
        }

        def act(_: int) -> None:
            for number, steps in list(crowd.items()):
                try:
                    next(steps)
                except ConnectionError:
                    del crowd[number]

        found.simulation.on_serve = act
        found.simulation.run(CROWD_S)
        found.check()
        assert len(crowd) == MAX_CLIENTS_PER_USER, "more are not let in"
        assert found.granted == []
        assert found.log.getvalue().count("shutdown denied") == 5, "more are summed up later"
        handled = [answers[number]["grants"] + answers[number]["refusals"] for number in crowd]
        assert min(handled) > 0.5 * max(handled), "each has its turn"
        spent = sum(handled) * REQUEST_NS / (CROWD_S * 1e9)
        assert 0.05 < spent < 0.11, "they get a tenth of the time"
        assert found.asking.ask("status")["sensors"][0]["lost_samples"] == 0


def test_their_reading_does_not_keep_root_from_its_work() -> None:
    with besieged() as found:
        pressing = [found.simulation.connect(4711) for _ in range(12)]
        for client in pressing:
            for _ in range(20):
                client.send("sdo_read", index=0x1008)
        answered: collections.Counter[bool] = collections.Counter()

        def press(_: int) -> None:
            for client in pressing:
                for reply in client.replies:
                    answered[reply["ok"]] += 1
                    client.send("sdo_read", index=0x1008)
                client.replies.clear()

        found.simulation.on_serve = press
        for number in range(20):
            reply = found.asking.ask("configure", settings={"imu_active": 1 + number % 2})
            assert reply["ok"], reply
        found.check()
        assert answered[True] > 50
        assert answered[False] > 50, "only some may wait for a sensor"
