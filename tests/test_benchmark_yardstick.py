"""The C program that the benchmark measures with: its client and its master, by themselves."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest

from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from ethercat_server.virtual_sensor.options import SensorOptions
from protocol.framing import DataMessage, FrameDecoder
from protocol.pdo import SampleDecoder
from scripts.benchmarks import statistics
from scripts.benchmarks.processes.yardstick import build
from scripts.benchmarks.records import began
from scripts.demonstration.child import DemoError
from tests.served_simulation import served
from tests.server.running import PATIENCE_S
from tests.test_benchmark import NO_STOPS, clock_data


@pytest.fixture(scope="module")
def yardstick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    return build(tmp_path_factory.mktemp("yardstick"))


def test_the_c_client_records_what_the_server_sends(yardstick: Path, tmp_path: Path) -> None:
    path = tmp_path / "records"
    with served(SensorOptions(signal="clock"), sinc_length=256) as server:
        subprocess.run(
            [yardstick, "client", str(server.port), path, "0", "0.1"], check=True, timeout=PATIENCE_S
        )
    assert began(path).exists()
    (found,) = statistics.read_arrivals(path)
    counts = statistics.count(found, 5_000_000, NO_STOPS)
    assert counts.made == counts.arrivals + counts.lost > 1
    assert counts.repeated == 0
    assert (found.stamp != 0).all()


def test_the_c_master_looks_once_at_each_sample_and_not_before_it_is_there(
    yardstick: Path, tmp_path: Path
) -> None:
    """Of two sensors, the second half a period after the first; one answer in 16 is lost."""
    period = 5_000_000
    start = time.monotonic_ns() - 10**9
    raw, bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    connection, client = socket.socketpair()
    arguments = (raw.fileno(), connection.fileno(), 200, 0, 2, 2, tmp_path / "own")
    command = [str(yardstick), "master", *map(str, arguments)]
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
    with pytest.raises(DemoError, match="apt install gcc"):
        build(tmp_path)
