"""What a controller in C++ is told, against a server that this test plays: ages, gaps, bounds, reconnecting.

The test is the server, in the same thread: it sends, then asks the client what it makes of that.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from bota_ethercat.address import boot_id
from bota_ethercat.control import request
from bota_ethercat.framing import DataFlag, FrameDecoder, encode_data, encode_json
from bota_ethercat.pdo import encode
from bota_ethercat.text.json_text import JsonObject
from tests.clients.cpp_programs import (
    ROOT,
    Driver,
    assert_no_faults,
    check,
    driver,
    end_driver,
    needs_gxx,
    patient,
    start_driver,
)
from tests.server.running import PATIENCE_S, free_port, wait_until

pytestmark = [needs_gxx, patient]

REPEATED, INVALID, GAP = DataFlag.REPEATED, DataFlag.INVALID, DataFlag.GAP
PATIENT = {"max_age_ms": 60_000}
"""For what must not depend on how fast this machine is."""
SENSOR = {"sensor": 0, "name": "BFT-SENS-ECAT-M8", "serial": 7, "pdo_size": 61, "rate_hz": 800, "state": "OP"}
GRANTED = {"reply": "subscribe", "ok": True, "protocol": 1, "version": "1.2.3", "sensors": [SENSOR]}


OURS = boot_id() or pytest.fail("this machine has no boot id")


def frame(
    sequence: int, flags: int = 0, *, sensor: int = 0, age_s: float = 0.0, size: int = 61, **values: float
) -> bytes:
    """A DATA message; its force along x is its number. `values` by name, with `__` for the dot."""
    # A machine that has been up for less than `age_s` has no such instant yet.
    time.sleep(max(0.0, age_s - time.monotonic()))
    instant = time.monotonic_ns() - int(age_s * 1e9)
    data = encode(size, {"force.x": sequence, **{k.replace("__", "."): v for k, v in values.items()}})
    return encode_data(sequence, 5, instant, sensor, flags, 3, data)


class PlayedServer:
    """A listening socket; connections are accepted when the test says so."""

    def __init__(self, port: int = 0) -> None:
        self.listener = socket.create_server(("127.0.0.1", port))
        self.listener.settimeout(PATIENCE_S)
        self.port: int = self.listener.getsockname()[1]
        self.connection: socket.socket | None = None
        self.asked: JsonObject = {}

    def accept(self, answer: JsonObject | bytes | None = None) -> None:
        """Take a connection, and what it asks, and answer."""
        self.hang_up()
        self.connection, _ = self.listener.accept()
        self.connection.settimeout(PATIENCE_S)
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        decoder, message = FrameDecoder(), None
        while message is None:
            data = self.connection.recv(4096)
            assert data, "the client closed the connection"
            decoder.feed(data)
            message = decoder.next_message()
        assert isinstance(message, dict)
        self.asked = message
        self.send(GRANTED if answer is None else answer)

    def send(self, *messages: bytes | JsonObject) -> None:
        """Send messages, and wait until the client's kernel has them."""
        assert self.connection is not None
        for message in messages:
            self.connection.sendall(message if isinstance(message, bytes) else encode_json(message))
        wait_until(lambda: unsent(self.connection) == 0, "the client's kernel")

    def hang_up(self) -> None:
        if self.connection is not None:
            self.connection.close()
            self.connection = None

    def close(self) -> None:
        self.hang_up()
        self.listener.close()


def unsent(connection: socket.socket | None) -> int:
    """Bytes that the other side has not acknowledged (SIOCOUTQ)."""
    import fcntl
    import termios

    assert connection is not None
    raw = fcntl.ioctl(connection.fileno(), termios.TIOCOUTQ, b"\0\0\0\0")
    return int(struct.unpack("i", raw)[0])


@pytest.fixture(scope="module", autouse=True)
def no_faults() -> Iterator[None]:
    yield
    assert_no_faults()


@pytest.fixture
def server() -> Iterator[PlayedServer]:
    played = PlayedServer()
    yield played
    played.close()


def connected(server: PlayedServer, running: Driver, answer: JsonObject | None = None) -> Driver:
    running.begin("connect", int(PATIENCE_S * 1000))
    server.accept(answer)
    told = running.answer()
    assert told == {"ok": True, "error": ""}
    return running


@contextlib.contextmanager
def stream(server: PlayedServer, **options: object) -> Iterator[Driver]:
    """A connected client that has time."""
    with driver(server.port, **{**PATIENT, **options}) as running:
        yield connected(server, running)


def picked(reading: JsonObject, *names: str) -> tuple[Any, ...]:
    check(reading)
    return tuple(reading[name] for name in names)


# -- what is asked for


def test_it_subscribes_as_it_was_told(server: PlayedServer) -> None:
    with stream(server) as running:
        assert server.asked == request("subscribe", every=1, fresh_only=True)
        assert running.info()["names"] == ["BFT-SENS-ECAT-M8"]
    with driver(server.port, sensor=3, every=7, fresh_only=0) as running:
        connected(server, running)
        assert server.asked == request("subscribe", every=7, fresh_only=False, sensors=[3])


# -- latest


def test_nothing_came_yet(server: PlayedServer) -> None:
    with stream(server) as running:
        reading = running.latest()
        assert picked(reading, "has_sample", "is_new", "condition", "age_ns") == (
            False,
            False,
            "silent",
            2**63 - 1,
        )


def test_the_newest_is_new_once(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(*(frame(n) for n in range(10, 15)))
        first = running.latest()
        assert picked(first, "is_new", "sequence", "passed_over") == (True, 14, 4)
        assert picked(first, "withheld", "lost", "gap") == (0, 0, False)
        assert first["array"][0] == 14
        again = running.latest()
        assert picked(again, "is_new", "sequence", "passed_over", "fresh") == (False, 14, 0, True)
        assert again["age_ns"] > first["age_ns"]
        server.send(frame(15))
        assert picked(running.latest(), "is_new", "sequence", "passed_over") == (True, 15, 0)


def test_the_age_counts_from_the_instant_of_the_sample(server: PlayedServer) -> None:
    with stream(server, max_age_ms=20_000) as running:
        before = time.monotonic_ns()
        server.send(frame(1, age_s=8))
        reading = running.latest()
        after = time.monotonic_ns()
        assert 8e9 <= reading["age_ns"] <= 8e9 + after - before
        assert picked(reading, "fresh", "is_new", "age_is_lower_bound") == (True, True, False)
        server.send(frame(2, age_s=21))
        assert picked(running.latest(), "condition", "is_new", "sequence") == ("late", True, 2)


@pytest.mark.parametrize("age_s", [20, -1000], ids=["behind", "ahead"])
def test_the_age_counts_from_the_arrival_where_the_clock_is_another(
    server: PlayedServer, age_s: float
) -> None:
    with stream(server, age_from="arrival") as running:
        server.send(frame(1, age_s=age_s))
        reading = running.latest()
        assert picked(reading, "fresh", "age_is_lower_bound") == (True, True)
        assert reading["age_ns"] < 19e9


@pytest.mark.parametrize("claimed", ["elsewhere", "", OURS + " 1 0", OURS[:-1], "x" * 60_000])
def test_a_server_whose_clock_is_another_is_far_away_whatever_its_address(
    server: PlayedServer, claimed: str
) -> None:
    """As through an SSH tunnel: the address is this machine's."""
    with driver(server.port, **PATIENT) as running:
        connected(server, running, {**GRANTED, "boot_id": claimed})
        server.send(frame(1, age_s=-1000))
        reading = running.latest()
        assert picked(reading, "fresh", "age_is_lower_bound") == (True, True)
        assert reading["age_ns"] < 19e9


@pytest.mark.parametrize("claimed", [OURS, None, 7, [], {}, [OURS], True])
def test_a_server_with_our_clock_or_none_that_can_be_read_is_near(
    server: PlayedServer, claimed: object
) -> None:
    with driver(server.port, **PATIENT) as running:
        connected(server, running, {**GRANTED, "boot_id": claimed})
        server.send(frame(1, age_s=8))
        reading = running.latest()
        assert picked(reading, "fresh", "age_is_lower_bound") == (True, False)
        assert reading["age_ns"] >= 8e9


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
    name = "from bota_ethercat.address import boot_id; print(boot_id())"
    done = subprocess.run(
        [*shifted, sys.executable, "-c", name], check=True, capture_output=True, text=True, cwd=ROOT
    )
    assert done.stdout == f"{theirs}\n"


def test_a_sample_keeps_the_clock_of_its_own_connection(server: PlayedServer) -> None:
    with stream(server, reconnect_every_ms=1) as running:
        server.send(frame(1, age_s=8))
        assert picked(running.latest(), "age_is_lower_bound") == (False,)
        server.hang_up()
        accept_while(server, running, {**GRANTED, "boot_id": "elsewhere"})
        old = running.latest()
        assert picked(old, "sequence", "connection", "age_is_lower_bound") == (1, 2, False)
        assert old["age_ns"] >= 8e9


def test_a_stamp_ahead_of_this_clock_is_never_fresh(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(1, age_s=-1000))
        reading = running.latest()
        assert picked(reading, "condition", "age_ns", "is_new") == ("bad_clock", 2**63 - 1, True)


@pytest.mark.parametrize(("flag", "condition"), [(REPEATED, "repeated"), (INVALID, "invalid")])
def test_an_old_sample_does_not_become_new(server: PlayedServer, flag: int, condition: str) -> None:
    with stream(server, max_age_ms=5_000) as running:
        server.send(frame(1, age_s=6))
        running.latest()
        # The server stamps these with the time of the exchange: the data in them is older.
        server.send(frame(2, flag), frame(3, flag))
        reading = running.latest()
        assert picked(reading, "is_new", "sequence", "condition", "flags") == (False, 1, condition, flag)
        assert reading["age_ns"] > 6e9
        assert reading["array"][0] == 1
        server.send(frame(4))
        assert picked(running.latest(), "is_new", "sequence", "condition", "flags") == (True, 4, "fresh", 0)
        told = running.info()
        assert (told["frames"], told["samples"], told["repeated"] + told["invalid"]) == (4, 2, 2)


def test_only_marked_frames_are_no_sample_at_all(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(1, INVALID), frame(2, REPEATED))
        assert picked(running.latest(), "has_sample", "is_new", "condition") == (False, False, "repeated")
        assert picked(running.do("next", 0), "has_sample", "is_new") == (False, False)


def test_a_silent_server_shows(server: PlayedServer) -> None:
    with stream(server, max_age_ms=1) as running:
        server.send(frame(1))
        assert picked(running.latest(), "is_new") == (True,)
        assert picked(running.until(lambda r: r["condition"] == "silent", "silence"), "is_new") == (False,)
        assert running.info()["link"] == "up"


def test_a_lost_sensor_shows_until_it_is_back(server: PlayedServer) -> None:
    with stream(server, max_age_ms=20_000) as running:
        server.send(
            frame(1, age_s=21), {"event": "sensor_lost", "sensor": 0, "message": "sensor 0 is lost: cable"}
        )
        server.send(frame(2, INVALID))
        assert picked(running.latest(), "condition", "is_new", "flags") == ("sensor_lost", True, INVALID)
        assert running.info()["error"] == "sensor 0 is lost: cable"
        server.send({"event": "sensor_back", "sensor": 0}, frame(3, GAP))
        assert picked(running.latest(), "condition", "is_new", "gap") == ("fresh", True, True)


def test_warnings_of_samples_that_were_passed_over_are_not_lost(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(1, warnings=1), frame(2, warnings=64), frame(3))
        assert picked(running.latest(), "warnings_seen") == (65,)
        assert picked(running.latest(), "warnings_seen") == (0,)


NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("values", "condition", "with_imu"),
    [
        ({"force__x": NAN}, "not_finite", "not_finite"),
        ({"torque__z": -INF}, "not_finite", "not_finite"),
        ({"warnings": 1}, "saturated", "saturated"),
        ({"warnings": 16}, "saturated", "saturated"),
        ({"force_torque_saturated": 256}, "saturated", "saturated"),
        ({"force_torque_saturated": 1, "force__y": INF}, "not_finite", "not_finite"),
        ({"acceleration__x": NAN}, "fresh", "not_finite"),
        ({"angular_rate__z": INF}, "fresh", "not_finite"),
        ({"size": 77, "orientation__w": NAN}, "fresh", "not_finite"),
        ({"warnings": 2}, "fresh", "saturated"),
        ({"warnings": 4}, "fresh", "saturated"),
        ({"acceleration_saturated": 1}, "fresh", "saturated"),
        ({"angular_rate_saturated": 4}, "fresh", "saturated"),
        ({"warnings": 8 + 32 + 64, "temperature": NAN}, "fresh", "fresh"),
    ],
)  # fmt: skip
def test_a_recent_sample_that_is_worth_nothing_is_not_fresh(
    server: PlayedServer, values: dict[str, Any], condition: str, with_imu: str
) -> None:
    for judge_imu, wanted in ((0, condition), (1, with_imu)):
        with stream(server, judge_imu=judge_imu) as running:
            server.send(frame(1, **values))
            assert picked(running.latest(), "condition", "is_new", "has_sample") == (wanted, True, True)
            assert picked(running.latest(), "condition") == (wanted,)
            server.send(frame(2))
            assert picked(running.latest(), "condition") == ("fresh",)


def test_a_bad_sample_that_is_old_is_old_first(server: PlayedServer) -> None:
    with stream(server, max_age_ms=5_000) as running:
        server.send(frame(1, age_s=6, warnings=1, force__x=NAN))
        assert picked(running.latest(), "condition") == ("late",)
        server.hang_up()
        running.until(lambda r: r["condition"] == "disconnected", "the end")


def test_saturated_samples_can_be_used_on_purpose(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(7, warnings=1))
        saturated = running.do("next", 1000)
        assert picked(saturated, "condition", "sequence", "warnings_seen") == ("saturated", 7, 1)
        assert saturated["array"][0] == 7


def test_what_is_wrong_with_a_sample_that_was_passed_over_is_not_the_newest_ones(
    server: PlayedServer,
) -> None:
    with stream(server) as running:
        server.send(frame(1, warnings=1), frame(2, force__y=NAN), frame(3))
        assert picked(running.latest(), "condition", "warnings_seen") == ("fresh", 1)


def test_sensors_are_kept_apart(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(1, sensor=0), frame(900, sensor=255, flags=GAP), frame(2, sensor=0))
        assert picked(running.latest(0), "sequence", "passed_over", "gap") == (2, 1, False)
        assert picked(running.do("peek", 255), "sequence", "passed_over", "gap", "is_new") == (
            900,
            0,
            True,
            True,
        )
        assert picked(running.do("peek", 1), "has_sample", "condition") == (False, "silent")


def test_peek_does_not_read_the_socket(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(1))
        assert picked(running.do("peek", 0), "has_sample") == (False,)
        assert picked(running.latest(), "has_sample") == (True,)


# -- gaps


def test_what_was_missed_is_counted_at_gaps_only(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(10), frame(11), frame(20, GAP))
        assert picked(running.latest(), "gap", "withheld", "passed_over") == (True, 8, 2)
        server.send(frame(21, GAP))  # the server itself never saw some
        assert picked(running.latest(), "gap", "withheld") == (True, 0)
        server.send(frame(30))  # the sensor was silent, and nothing was withheld
        assert picked(running.latest(), "gap", "withheld") == (False, 0)
        told = running.info()
        assert (told["gaps"], told["withheld"], told["passed_over"]) == (2, 8, 2)


def test_one_frame_in_seven_is_no_gap(server: PlayedServer) -> None:
    with stream(server, every=7) as running:
        server.send(frame(7), frame(14), frame(28, GAP))
        assert picked(running.latest(), "gap", "withheld") == (True, 7)


def test_a_gap_that_came_with_a_marked_frame_is_told_with_the_next_sample(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(1))
        running.latest()
        server.send(frame(9, GAP | INVALID), frame(10))
        assert picked(running.latest(), "gap", "withheld", "sequence") == (True, 7, 10)


def test_a_sequence_that_goes_back_is_a_gap(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(50), frame(3))
        assert picked(running.latest(), "gap", "withheld", "sequence") == (True, 0, 3)


# -- next


def test_next_gives_every_sample_in_order(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(frame(1), frame(2, REPEATED), frame(3, INVALID), frame(4, GAP), frame(5))
        got = [picked(running.do("next", 1000), "sequence", "gap", "is_new", "passed_over") for _ in range(3)]
        assert got == [(1, False, True, 0), (4, True, True, 0), (5, False, True, 0)]
        assert picked(running.do("next", 1), "sequence", "is_new") == (5, False)


def test_the_samples_that_came_with_the_reply_are_not_passed_over(server: PlayedServer) -> None:
    with driver(server.port, **PATIENT) as running:
        running.begin("connect", int(PATIENCE_S * 1000))
        server.accept(encode_json(GRANTED) + frame(1) + frame(2))
        assert running.answer()["ok"]
        assert picked(running.do("next", 1000), "sequence", "passed_over") == (1, 0)
        assert picked(running.do("next", 1000), "sequence", "passed_over") == (2, 0)


def test_latest_passes_over_what_next_has_not_taken(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send(*(frame(n) for n in range(1, 6)))
        assert picked(running.do("next", 1000), "sequence") == (1,)
        assert picked(running.latest(), "sequence", "passed_over", "withheld") == (5, 3, 0)
        assert picked(running.do("next", 0), "is_new") == (False,)


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
        server.hang_up()
        assert picked(running.answer(), "condition", "is_new") == ("disconnected", False)
        assert time.monotonic() - began < PATIENCE_S / 2


# -- bounds


def test_a_call_reads_a_bounded_amount_and_says_so(server: PlayedServer) -> None:
    with stream(server, max_bytes_per_call=940) as running:
        server.send(*(frame(n) for n in range(1, 26)))
        assert picked(running.latest(), "sequence", "more_waits", "passed_over") == (10, True, 9)
        assert picked(running.latest(), "sequence", "more_waits", "passed_over") == (20, True, 9)
        assert picked(running.latest(), "sequence", "more_waits", "passed_over") == (25, False, 4)


def test_messages_cut_anywhere_and_more_than_fits_the_buffer(server: PlayedServer) -> None:
    with stream(server, receive_buffer=4_000_000) as running:
        long = {"event": "something new", "text": "x" * 60_000}
        wire = b"".join(
            encode_json(long) + frame(n) if n % 50 == 0 else frame(n) for n in range(1, 1001)
        )  # fmt: skip
        assert server.connection is not None
        server.connection.setblocking(False)
        sent, last = 0, 0
        while last < 1000:
            with contextlib.suppress(BlockingIOError):
                sent += server.connection.send(wire[sent : sent + 7919])
            reading = running.latest()
            assert reading["sequence"] >= last
            assert not reading["gap"]
            last = reading["sequence"]
        told = running.info()
        assert (told["samples"], told["bad_messages"], told["gaps"]) == (1000, 0, 0)


def test_what_cannot_be_understood_costs_only_itself(server: PlayedServer) -> None:
    with stream(server) as running:
        bad = (
            b"[]",
            b'{"event":"sensor_lost"}',
            b'{"a":1e999}',
            b"\xff",
            b"{}",
            b'{"reply":"status","ok":1}',
        )
        server.send(*(struct.pack(">IB", 1 + len(text), 2) + text for text in bad), frame(1))
        assert picked(running.latest(), "fresh", "sequence") == (True, 1)
        assert running.info()["bad_messages"] == 5


def test_odd_values_where_others_are_expected(server: PlayedServer) -> None:
    with stream(server) as running:
        messages: list[JsonObject] = []
        for odd in (None, True, -1, 256, 1.5, 10**30, "0", "", [], {}, [0], {"sensor": 0}, "\\ud800\\u0000"):
            for name in ("sensor_lost", "sensor_back", "reconfigured", "emergency", "unknown", odd):
                messages.append({"event": name, "sensor": odd, "message": odd})
            messages += [
                {"event": "sensor_lost", "sensor": 1, "message": odd},
                {"reply": odd, "ok": odd, "error": odd},
                {"reply": odd, "ok": False, "error": {"message": odd}},
            ]
        server.send(*messages)
        server.send(frame(1))
        assert picked(running.latest(), "fresh", "is_new") == (True, True)
        assert running.info()["link"] == "up"


def test_what_comes_from_the_network_cannot_command_a_terminal(server: PlayedServer) -> None:
    with stream(server) as running:
        text = "\x1b[2J\n!" + "é" * 400
        server.send({"event": "sensor_lost", "sensor": 0, "message": text})
        running.latest()
        error = running.info()["error"]
        assert error.startswith("?[2J?!éé")
        assert error.endswith("é"), "it is cut between two characters"


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


def test_nobody_listens() -> None:
    with driver(free_port(), reconnect="when_told") as running:
        told = running.do("connect", 5000)
        assert not told["ok"]
        assert "nobody listens there: start ethercat-server" in told["error"]
        assert picked(running.latest(), "condition", "has_sample") == ("disconnected", False)
        assert picked(running.do("next", 1), "condition") == ("disconnected",)


def test_before_and_after_a_connection(server: PlayedServer) -> None:
    with driver(server.port, **PATIENT) as running:
        assert picked(running.latest(), "condition", "has_sample") == ("disconnected", False)
        assert running.info()["error"] == "not connected yet: call connect()"
        connected(server, running)
        server.send(frame(1))
        assert picked(running.latest(), "fresh") == (True,)
        running.do("close")
        assert running.info()["error"].endswith("closed by this program")
        for _ in range(20):
            running.latest()
        assert not select.select([server.listener], [], [], 0.2)[0], "it connected again after close"


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"reply": "subscribe", "ok": False, "error": {"code": "busy", "message": "no 9"}}, "refused: no 9"),
        ({**GRANTED, "protocol": 2}, "another version"),
        ({"reply": "subscribe", "ok": True}, "another version"),
        (b"SSH-2.0-OpenSSH_9.2\r\n", "is that ethercat-server?"),
        (struct.pack(">IB", 2**31, 2), "is that ethercat-server?"),
    ],
)  # fmt: skip
def test_a_connection_that_is_refused(server: PlayedServer, answer: Any, said: str) -> None:
    with driver(server.port, reconnect="when_told") as running:
        running.begin("connect", int(PATIENCE_S * 1000))
        server.accept(answer)
        told = running.answer()
        assert not told["ok"]
        assert said in told["error"]


def test_a_server_that_does_not_answer(server: PlayedServer) -> None:
    with driver(server.port, reconnect="when_told") as running:
        told = running.do("connect", 100)
        assert not told["ok"]
        assert "did not answer in time" in told["error"]


def test_it_starts_without_the_server() -> None:
    port = free_port()
    with driver(port, reconnect_every_ms=1, **PATIENT) as running:
        assert not running.do("connect", 1000)["ok"]
        late = PlayedServer(port)
        assert picked(running.latest(), "condition") == ("disconnected",)
        accept_while(late, running)
        late.send(frame(1))
        running.until(lambda r: r["fresh"], "the first sample")
        late.close()


def accept_while(server: PlayedServer, running: Driver, answer: JsonObject | None = None) -> None:
    """Take the connection that the client makes step by step, a step in each call."""
    wait_until(
        lambda: bool(running.latest() and select.select([server.listener], [], [], 0)[0]), "a connection"
    )
    running.latest()
    running.begin("next", 20)
    server.accept(answer)
    running.answer()
    wait_until(lambda: bool(running.latest() and running.info()["link"] == "up"), "the subscription")


def test_a_connection_that_was_lost_is_made_anew(server: PlayedServer) -> None:
    with stream(server, max_age_ms=20_000, reconnect_every_ms=1) as running:
        server.send(frame(70, age_s=21))
        assert picked(running.latest(), "sequence", "connection") == (70, 1)
        server.send({"event": "shutting_down"})
        server.hang_up()
        down = running.until(lambda r: r["condition"] == "disconnected", "the end")
        assert picked(down, "is_new", "has_sample", "sequence") == (False, True, 70)
        accept_while(server, running)
        assert picked(running.latest(), "is_new", "connection", "condition", "sequence") == (
            False,
            2,
            "silent",
            70,
        )
        server.send(frame(3))
        anew = running.latest()
        assert picked(anew, "is_new", "fresh", "gap", "withheld", "sequence") == (True, True, True, 0, 3)
        server.send(frame(4))
        assert picked(running.latest(), "is_new", "gap") == (True, False)


def test_it_says_why_the_connection_ended(server: PlayedServer) -> None:
    with stream(server, reconnect="when_told") as running:
        server.send({"event": "shutting_down"})
        server.hang_up()
        wait_until(lambda: bool(running.latest()) and running.info()["link"] == "down", "the end")
        assert running.info()["error"] == f"127.0.0.1 port {server.port}: the server was shut down"


def test_it_reconnects_only_where_it_is_told(server: PlayedServer) -> None:
    """After the loss the control loop makes no system call; the step of reconnecting is its own call."""
    with stream(server, reconnect="when_told", reconnect_every_ms=1) as running:
        server.send(frame(1))
        running.latest()
        before = running.info()
        assert (before["receives"], before["other_calls"]) == (1, 0)
        server.hang_up()
        wait_until(lambda: bool(running.latest()) and running.info()["link"] == "down", "the end")
        lost = running.info()
        assert lost["other_calls"] == 0, "not even close()"
        for _ in range(5):
            running.latest()
            running.do("peek", 0)
            assert picked(running.do("next", 3_600_000), "is_new", "connection") == (False, 1)
        after = running.info()
        assert (after["receives"], after["other_calls"]) == (lost["receives"], 0)
        assert (after["fd"], select.select([server.listener], [], [], 0)[0]) == (-1, [])
        wait_until(
            lambda: (running.do("reconnect"), select.select([server.listener], [], [], 0)[0])[1] != [],
            "an attempt",
        )
        running.do("reconnect")  # sends the subscription
        server.accept()
        wait_until(lambda: running.do("reconnect"), "the subscription")
        server.send(frame(2))
        assert picked(running.latest(), "fresh", "gap", "connection", "sequence") == (True, True, 2, 2)
        assert running.info()["other_calls"] == 0


def test_it_may_be_told_by_a_server_that_starts_later() -> None:
    port = free_port()
    with driver(port, reconnect="when_told", reconnect_every_ms=1) as running:
        assert running.do("reconnect") is False
        assert running.info()["error"] == "not connected yet: call connect()"
        assert not running.do("connect", 1000)["ok"]
        late = PlayedServer(port)
        wait_until(
            lambda: (running.do("reconnect"), select.select([late.listener], [], [], 0)[0])[1] != [],
            "an attempt",
        )
        running.do("reconnect")
        late.accept()
        wait_until(lambda: running.do("reconnect"), "the subscription")
        late.close()


def test_a_refusal_does_not_stand_in_the_way_of_connect(server: PlayedServer) -> None:
    with stream(server, reconnect_every_ms=1) as running:
        server.hang_up()
        refused = {"reply": "subscribe", "ok": False, "error": {"code": "busy", "message": "no 9"}}
        running.do("next", int(PATIENCE_S * 1000))  # the loss
        running.begin("next", int(PATIENCE_S * 1000))
        server.accept(refused)
        assert picked(running.answer(), "condition") == ("disconnected",)
        assert "no 9" in running.info()["error"]
        connected(server, running)


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
        late = PlayedServer(port)
        for _ in range(200):
            running.latest()
        assert not select.select([late.listener], [], [], 0.1)[0]
        late.close()


def test_reconfigured_is_counted(server: PlayedServer) -> None:
    with stream(server) as running:
        server.send({"event": "reconfigured", "sensor": 0, "settings": {}})
        running.latest()
        assert running.info()["reconfigurations"] == 1


@pytest.mark.parametrize(
    ("event", "lost"),
    [
        ({"rate_hz": 400}, 3),
        ({"rate_hz": 800, "sensor": 1}, 7),
        ({}, 7),
        ({"rate_hz": 0}, 7),
        ({"rate_hz": -1}, 7),
        ({"rate_hz": 1e300}, 7),
        ({"rate_hz": "400"}, 7),
    ],
)
@pytest.mark.parametrize("name", ["reconfigured", "sensor_back"])
def test_what_is_lost_after_an_event_counts_by_the_new_rate(
    server: PlayedServer, name: str, event: JsonObject, lost: int
) -> None:
    """10 ms without a sample are 8 periods before, and 4 at 400 Hz."""
    with stream(server) as running:
        server.send({"event": name, "sensor": 0, "settings": {}, **event})
        server.send(
            *(
                encode_data(n, 5, 10**9 + at_ms * 10**6, 0, flags, 3, encode(61, {}))
                for n, at_ms, flags in ((1, 0, 0), (2, 10, GAP))
            )
        )
        assert picked(running.latest(), "lost") == (lost,)


# -- real time


def test_nothing_is_allocated_in_any_state(server: PlayedServer) -> None:
    with stream(server, reconnect_every_ms=1) as running:
        assert server.connection is not None
        for n in range(1, 200):
            server.connection.sendall(frame(n))
            running.latest() if n % 2 else running.do("next", 1000)
        server.send(
            {"event": "sensor_lost", "sensor": 0, "message": "gone"}, b"\0\0\0\3\2[]", frame(300, GAP)
        )
        running.latest()
        server.hang_up()
        running.do("next", 20)
        accept_while(server, running)
        server.close()
        for _ in range(20):
            running.latest()
        told = running.info()
        assert (told["connections"], told["bad_messages"], told["link"]) == (2, 1, "down")
        assert (told["allocated"], told["allocates"]) == (0, True)
