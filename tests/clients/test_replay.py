"""`ethercat-replay`: a client cannot tell it from a server, except by its `describe`.

It runs in a thread, except where its imports are what a test is about.
"""

from __future__ import annotations

import math
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from bota_clients.recording.reader import Description, Event, open_recording
from bota_clients.replay import cli, program
from bota_clients.replay.sensors import ReplayedSensors
from bota_ethercat.client import Client, connect
from bota_ethercat.control import ErrorCode
from bota_ethercat.errors import RefusedError
from bota_ethercat.framing import DataMessage
from bridge.stream.link import find_sensor
from tests.clients.recordings import PERIOD_NS, START_NS, describe, frame, record, writer
from tests.clients.running import NoSignals, listen, replaying, signalled
from tests.served_simulation import served
from tests.server.running import PATIENCE_S, free_port, wait_until
from tests.server.running import Client as Requests

COUNT = 400
EMERGENCY = {"code": 0xFF01, "text": "device specific", "register": 0x81, "data": "0102030405"}

Run = Callable[..., tuple[int, str]]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


@pytest.fixture
def frames(path: Path) -> list[DataMessage]:
    return record(
        path, (frame(n // 2, sensor=n % 2, flags=4 if n == 50 else 0) for n in range(COUNT)), sensors=(0, 1)
    )


def play(path: Path, *arguments: str) -> list[DataMessage]:
    """All that a client gets from a replay that runs once."""
    with replaying(*arguments, path) as served, listen(served.port, fresh_only=False) as client:
        frames = list(client.frames())
        assert served.wait() == 0
    return frames


def samples(path: Path, *arguments: str) -> list[object]:
    with replaying(*arguments, path) as served, Client(served.port, reconnect=False).connect() as client:
        return [client.decode(frame) for frame in client.frames()]


def test_the_first_client_gets_everything_from_the_first_frame_on(
    path: Path, frames: list[DataMessage]
) -> None:
    assert play(path, "--original-stamps") == frames


def test_moved_stamps_are_near_now_and_keep_their_spacing(path: Path, frames: list[DataMessage]) -> None:
    began = time.time_ns(), time.monotonic_ns()
    played = play(path)
    offset = played[0].stamp_ns - frames[0].stamp_ns
    assert all(new.stamp_ns - old.stamp_ns == offset for old, new in zip(frames, played, strict=True))
    assert began[0] < played[0].stamp_ns < time.time_ns()
    assert began[1] < played[0].monotonic_ns < time.monotonic_ns()
    for old, new in zip(frames, played, strict=True):
        assert new._replace(stamp_ns=0, monotonic_ns=0) == old._replace(stamp_ns=0, monotonic_ns=0)


def test_the_same_recording_gives_the_same_values_always(path: Path, frames: list[DataMessage]) -> None:
    del frames
    first, again, fast = samples(path), samples(path), samples(path, "--speed", "20")
    assert first == again == fast
    assert len(first) == COUNT


def test_it_keeps_the_original_timing(path: Path, frames: list[DataMessage]) -> None:
    del frames
    with replaying(path) as served, listen(served.port) as client:
        began = time.monotonic()
        list(client.frames())
        assert time.monotonic() - began >= (COUNT / 2 - 1) * PERIOD_NS / 1e9


def test_it_loops_with_numbers_that_go_on(path: Path, frames: list[DataMessage]) -> None:
    del frames
    with replaying("--loop", "--speed", "50", path) as served, listen(served.port, sensors=[1]) as client:
        played = []
        for item in client.frames():
            played.append(item)
            if len(played) == COUNT:  # twice
                break
    numbers = [item.sequence for item in played]
    assert all(b - a >= 1 for a, b in pairwise(numbers))
    assert numbers[-1] >= COUNT - 1
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(played))


def test_several_recordings_are_played_one_after_the_other(tmp_path: Path) -> None:
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    record(first, (frame(n) for n in range(10)))
    record(second, (frame(n, **{"force.z": 1}) for n in range(10)))
    with replaying("--speed", "max", first, second) as served, listen(served.port) as client:
        played = list(client.frames())
        assert client.description["replay"]["files"] == ["a.mcap", "b.mcap"]
    assert [item.sequence for item in played] == list(range(20))


def test_a_recording_that_was_cut_off_is_played_as_far_as_it_goes(
    path: Path, frames: list[DataMessage]
) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with replaying("--original-stamps", path) as served, listen(served.port, fresh_only=False) as client:
        played = list(client.frames())
        assert "was cut off" in served.said()
    assert 0 < len(played) < COUNT
    assert played == frames[: len(played)]


# -- what clients may ask


def test_describe_says_that_it_is_a_replay(path: Path, frames: list[DataMessage]) -> None:
    del frames
    with replaying("--speed", "2", "--loop", path) as served, Requests(served.port) as client:
        reply = client.ask("describe")
    assert reply["replay"] == {
        "files": ["run.mcap"], "recorded": "?", "recorded_version": "?", "pace": 2.0, "loop": True,
        "stamps": "moved",
    }  # fmt: skip
    assert reply["sensors"] == describe(0, 1)["sensors"]
    assert reply["protocol"] == 1


def keys(value: object) -> object:
    """The keys of a reply, of the objects in it, and of the first in each of its lists."""
    if isinstance(value, list):
        return [keys(row) for row in value[:1]]
    return {key: keys(row) for key, row in value.items()} if isinstance(value, dict) else None


def test_status_has_all_that_a_server_s_has(path: Path) -> None:
    made = writer(path)
    made.describe(START_NS, describe(0))
    made.event(START_NS, {"event": "emergency", **EMERGENCY, "sensor": 0, "count": 4, "message": "over"})
    for number in range(100):
        made.frame(frame(number, temperature=30.0 if number else math.nan))
    made.finish({})
    with served() as server, connect(server.port) as client:
        server.command("emergency 0xFF01 0x81 0102030405")
        client.receive(PATIENCE_S)
        wait_until(lambda: client.ask("status")["sensors"][0]["emergency"], "the emergency")
        expected = client.ask("status")
    with replaying("--loop", path) as running, connect(running.port) as client:
        next(client.frames())
        status = client.ask("status")
    assert keys(status) == keys(expected)
    (sensor,) = status["sensors"]
    assert {**sensor["emergency"], "ago_s": 0} == {**EMERGENCY, "ago_s": 0}
    assert (sensor["emergencies"], sensor["not_finite"]) == (1, 1)
    assert sensor["fresh"] > 0
    assert sensor["clock"]["period_us"] == 1250
    assert status["clients"][0]["sent"] > 0


@pytest.mark.parametrize(
    ("action", "values"),
    [
        ("configure", {"settings": {"sinc_length": 64}}),
        ("tare", {}),
        ("sdo_read", {"index": 0x8010, "subindex": 1}),
        ("sdo_write", {"index": 0x8010, "subindex": 1, "hex": "00"}),
    ],
)
def test_what_needs_a_sensor_is_refused_in_a_sentence(
    path: Path, frames: list[DataMessage], action: str, values: dict[str, Any]
) -> None:
    del frames
    with replaying("--loop", path) as served, connect(served.port) as client:
        with pytest.raises(RefusedError, match="this is a replay of a recording") as refused:
            client.ask(action, **values)
        assert refused.value.code == ErrorCode.NOT_READY
        assert client.receive(PATIENCE_S)


def test_the_node_takes_it_for_a_server(path: Path, frames: list[DataMessage]) -> None:
    del frames
    with replaying("--loop", path) as served, connect(served.port, sensors=[1]) as client:
        info = find_sensor(client.description, 1)
        assert (info.sensor, info.serial, info.rate, info.settings) == (1, "101", 800, {"sinc_length": 64})
        assert client.receive(PATIENCE_S)


def test_shutdown_ends_it(path: Path, frames: list[DataMessage]) -> None:
    del frames
    with replaying("--loop", path) as served, connect(served.port) as client:
        client.ask("shutdown")
        assert served.wait() == 0
        assert "stopped after" in served.said()


def test_what_happened_happens_again(path: Path) -> None:
    made = writer(path)
    made.describe(START_NS, describe(0))
    made.frame(frame(0))
    made.event(START_NS, {"event": "sensor_lost", "sensor": 0, "reason": "gone", "message": "gone"})
    made.event(START_NS, {"event": "shutting_down"})
    made.event(START_NS, {"event": "connected", "source": "recorder"})
    made.frame(frame(1, flags=2))
    made.event(START_NS, {"event": "reconfigured", "sensor": 0, "settings": {"sinc_length": 32}})
    made.frame(frame(2))
    made.finish({})
    with replaying(path) as served, listen(served.port, fresh_only=False) as client:
        assert len(list(client.frames())) == 3
        events = [event["event"] for event in client.events if isinstance(event, dict)]
        assert events == ["sensor_lost", "reconfigured", "shutting_down"]


def test_describe_follows_the_events(path: Path, frames: list[DataMessage]) -> None:
    del frames
    with open_recording(path) as recording:
        sensors = ReplayedSensors(recording.sensors)
    for event, state in (("sensor_lost", "lost"), ("sensor_back", "OP")):
        row = {"event": event, "sensor": 1, "settings": {"sinc_length": 32}, "rate_hz": 1600}
        sensors.take(Event(0, row))
        described = [sensor.describe() for sensor in sensors.sensors]
        assert [sensor["rate_hz"] for sensor in described] == [800, 1600]
        assert [(row["state"], row["settings"]["sinc_length"]) for row in described] == [
            ("OP", 64),
            (state, 32),
        ]


def test_no_sensor_settles_for_ever(path: Path, frames: list[DataMessage]) -> None:
    """It did when it was described; the node's tare waits for the end of it."""
    del frames
    with open_recording(path) as recording:
        sensors = ReplayedSensors(recording.sensors)
    described = describe(0)
    described["sensors"][0]["settling"] = True
    sensors.describe(Description(0, described))
    assert not sensors.sensors[0].describe()["settling"]


# -- arguments and what is not there


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the program here; its exit code and what it said."""

    def running(*arguments: object) -> tuple[int, str]:
        try:
            code = program.run([*map(str, arguments)], NoSignals())
        except SystemExit as ended:
            code = int(str(ended.code))
        return code, capsys.readouterr().err

    return running


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "required"),
        (("x.mcap", "99999"), "99999 is no port: it must be from 1 to 65535"),
        (("x.mcap", "--speed", "0"), "it must be a number"),
        (("x.mcap", "--speed", "nan"), "it must be a number"),
        (("x.mcap", "--host", "nowhere"), "an IP address of this machine"),
    ],
)
def test_wrong_arguments_are_exit_code_2(arguments: tuple[str, ...], sentence: str, run: Run) -> None:
    code, said = run(*arguments)
    assert code == 2
    assert sentence in said


def test_a_file_that_is_no_recording_is_said(path: Path, run: Run) -> None:
    code, said = run(path)
    assert (code, "No such file" in said) == (1, True)
    path.write_text("hello")
    code, said = run(path)
    assert (code, "is not an MCAP file" in said) == (1, True)


def test_a_port_that_is_taken_is_said(path: Path, frames: list[DataMessage], run: Run) -> None:
    del frames
    with socket.create_server(("127.0.0.1", 0)) as taken:
        code, said = run(path, taken.getsockname()[1])
    assert code == 1
    assert "is in use by another program" in said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_before_anybody_came(
    path: Path, frames: list[DataMessage], number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    del frames
    assert signalled(cli.main, number, lambda: "replaying" in capsys.readouterr().err, path, free_port()) == 0


def test_a_damaged_recording_ends_it_with_a_sentence(path: Path, frames: list[DataMessage]) -> None:
    del frames
    data = bytearray(path.read_bytes())
    position = data.index(b"zstd", 4000) + 100
    data[position] ^= 0xFF
    path.write_bytes(data)
    with replaying("--speed", "max", path) as served, listen(served.port) as client:
        list(client.frames())
        assert served.wait() == 1
        assert "is damaged at byte" in served.said()


def test_it_needs_no_bus() -> None:
    code = "import sys; from bota_clients import replay, record; import bota_clients.replay.program, "
    code += "bota_clients.record.program; sys.exit('pysoem' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
