"""The benchmark's modes that measure one thing: what they make of made-up records, and their programs."""

from __future__ import annotations

import socket
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from ethercat_server.virtual_sensor.options import SensorOptions
from protocol.framing import DataMessage, FrameDecoder
from protocol.pdo import SampleDecoder
from scripts.benchmarks import statistics
from scripts.benchmarks.chain import ScriptError, Setup
from scripts.benchmarks.modes import cards, compensation, node, vendor
from scripts.benchmarks.processes import yardstick
from scripts.benchmarks.processes.relay import Delay
from scripts.benchmarks.records import began
from scripts.benchmarks.statistics import Arrivals
from tests.served_simulation import served
from tests.server.running import PATIENCE_S
from tests.test_benchmark import NO_STOPS, clock_data

SETUP = Setup(800, 1, 5.0, 0)
MS = 1_000_000


# -- slow network cards


def departures(delay: Delay, count: int, every_ns: int = 10_000) -> list[float]:
    """When frames leave that arrive at this interval, all of them under way at once."""
    for number in range(count):
        delay.put(bytes([number]), number * every_ns)
    left = []
    for number in range(count):
        left.append(delay.due_ns)
        assert delay.take() == bytes([number])
    assert delay.due_ns == float("inf")
    return left


def test_every_frame_is_delayed_alike() -> None:
    assert departures(Delay(400_000), 3) == [400_000, 410_000, 420_000]


def test_jitter_stays_in_its_limits_and_keeps_the_order() -> None:
    left = departures(Delay(400_000, 100_000, seed=1), 200)
    assert left == sorted(left)
    delays = [due - number * 10_000 for number, due in enumerate(left)]
    assert 300_000 <= min(delays) < 350_000, "no frame leaves earlier"
    assert 450_000 < max(delays) <= 500_000
    assert left == departures(Delay(400_000, 100_000, seed=1), 200)
    assert left != departures(Delay(400_000, 100_000, seed=2), 200)


def test_the_longest_round_trips_are_for_800_hz() -> None:
    assert {card.round_trip_ms for card in cards.cards(800, ())} == {0.05, 0.44, 0.86, 2, 3}
    assert {card.round_trip_ms for card in cards.cards(1600, ())} == {0.05, 0.44, 0.86, 2}
    assert [str(card) for card in cards.cards(800, (0.05, 2.0))] == ["0.05 ms", "2 ms", "2 ms ± 200 µs"]


def test_cards_are_measured_with_one_sensor() -> None:
    with pytest.raises(ScriptError, match="one sensor"):
        cards.measure(replace(SETUP, sensors=2), ())


# -- the node


def tcp(count: int = 1000) -> Arrivals:
    """A second at 1 kHz, each sample 100 µs old on arrival."""
    number = np.arange(count, dtype=np.int64)
    instant = number * MS + 5_000 * MS
    return Arrivals(number, instant, instant + 7, instant + 100_000)


def heard(which: Any = slice(None)) -> Arrivals:
    """The same at a subscriber, 300 µs later."""
    number, instant, stamp, received = (column[which] for column in tcp())
    return Arrivals(number, instant, 0 * stamp, received + 300_000)


def test_messages_are_the_clients_samples() -> None:
    figures = node.compare(tcp(), heard(slice(5, 990)))
    assert (figures["samples"], figures["lost"], figures["repeated"]) == (985, 0, 0)
    assert figures["decoded_wrongly"] == 0
    assert (figures["tcp_age_us"]["p50"], figures["ros_age_us"]["p99"]) == (100, 400)


def test_wrong_messages_are_counted() -> None:
    messages = heard(np.r_[0:400, 403:600, 599:1000])
    messages.instant[600] += 1
    figures = node.compare(tcp(), messages)
    assert (figures["lost"], figures["repeated"], figures["decoded_wrongly"]) == (3, 1, 1)


def test_first_message_after_a_silence() -> None:
    messages = heard(np.r_[0:300, 700:1000])
    messages.received[300] += 5_000
    assert node.first_after(messages, 0.3) == 405.0
    assert node.first_after(messages) == 400.0
    with pytest.raises(AssertionError, match="no silence"):
        node.first_after(heard(), 0.3)


# -- compensation


def test_every_case_of_compensation_costs_something(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")
    monkeypatch.setattr(compensation, "SAMPLES", 200)
    monkeypatch.setattr(compensation, "MOST_US", 1e9)
    monkeypatch.setattr(compensation, "MOST_BY_DEFAULT_US", 1e9)
    rows = compensation.measure(SETUP, None)
    assert rows[0]["case"] == "decoding"
    assert len(rows) == 7
    assert all(0.0 < row["us"]["50"] <= row["us"]["99"] for row in rows)


@pytest.mark.parametrize("limit", ["MOST_US", "MOST_BY_DEFAULT_US"])
def test_too_much_is_said(monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    found = {name: {"50": 1.0, "99": 2.0, "mean": 1.0} for name in ("decoding", compensation.DEFAULT)}
    monkeypatch.setattr(compensation, "costs", lambda _: found)
    monkeypatch.setattr(compensation, limit, 1e-6)
    with pytest.raises(ScriptError, match=r"takes \d+\.\d µs a sample, more than"):
        compensation.measure(SETUP, None)


# -- Bota's driver


def test_a_repeated_sample_is_as_old_as_when_it_was_returned_first() -> None:
    number = np.array([1, 1, 2, 4, 4, 4])
    instant = number * MS
    ages = np.array([300, 1550, 400, 500, 1750, 3000])
    arrivals = Arrivals(number, instant, np.zeros_like(number), instant + ages)
    assert vendor.first_ages(arrivals).tolist() == [300, 400, 500]


def test_without_it_the_rest_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise ScriptError("bota-driver cannot be installed")

    monkeypatch.setattr(vendor, "installed", lambda: False)
    monkeypatch.setattr(vendor, "install", fail)
    assert vendor.main() == 0
    assert capsys.readouterr().err == "benchmark: bota-driver cannot be installed\n"


# -- the C program


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        return yardstick.build(tmp_path_factory.mktemp("yardstick"))
    except ScriptError as error:
        pytest.skip(str(error))


def test_the_c_client_records_what_the_server_sends(program: Path, tmp_path: Path) -> None:
    path = tmp_path / "records"
    with served(SensorOptions(signal="clock"), sinc_length=256) as server:
        subprocess.run(
            [program, "client", str(server.port), path, "0", "0.1"], check=True, timeout=PATIENCE_S
        )
    assert began(path).exists()
    (found,) = statistics.read_arrivals(path)
    counts = statistics.count(found, 5_000_000, NO_STOPS)
    assert counts.made == counts.arrivals + counts.lost > 1
    assert counts.repeated == 0
    assert (found.stamp != 0).all()


def test_the_c_master_looks_once_at_each_sample_and_not_before_it_is_there(
    program: Path, tmp_path: Path
) -> None:
    """Of two sensors, the second half a period after the first; one answer in 16 is lost."""
    period = 5_000_000
    start = time.monotonic_ns() - 10**9
    raw, bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    connection, client = socket.socketpair()
    arguments = (raw.fileno(), connection.fileno(), 200, 0, 2, 2, tmp_path / "own")
    command = [str(program), "master", *map(str, arguments)]
    asked: list[int] = []
    with raw, bus, connection, client:
        running = subprocess.Popen(command, pass_fds=(raw.fileno(), connection.fileno()))
        bus.settimeout(PATIENCE_S)
        while len(asked) < 50:
            frame = bytearray(bus.recv(1514))
            now = time.monotonic_ns()
            asked.append(frame[17])
            if len(asked) % 16:
                for i in range(2):
                    number = (now - start - i * period // 2) // period
                    at = 28 + 61 * i
                    frame[at : at + 61] = clock_data(number, start + i * period // 2 + number * period)
                bus.send(frame)
        running.terminate()
        bus.send(frame)
        assert running.wait(PATIENCE_S) == 0
        received = client.recv(65536)
    assert asked == [(asked[0] + n) % 256 for n in range(50)]
    messages = [received[at : at + 94] for at in range(0, len(received), 94)]
    for sensor in range(2):
        decoder = FrameDecoder()
        decoder.feed(b"".join(message for message in messages if message[29] == sensor))
        data = [message for message in decoder if isinstance(message, DataMessage)]
        assert [message.sequence for message in data] == list(range(len(data)))
        numbers = [
            int(decode_clock(SampleDecoder(61).decode(message.process_data).array).number) for message in data
        ]
        assert numbers == sorted(set(numbers)), "each once"
    assert len(messages) > 40, "hardly an exchange was in vain"
    assert len(statistics.read_numbers(tmp_path / "own", 2)) >= 46


def test_without_a_compiler_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ScriptError, match="apt install gcc"):
        yardstick.build(tmp_path)
