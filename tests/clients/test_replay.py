"""`ethercat-replay`: a client cannot tell it from a server, except by its `describe`.

It runs in a thread, except where its imports are what a test is about.
"""

from __future__ import annotations

import contextlib
import math
import os
import random
import signal
import socket
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from bota_clients.recording.file_format import RecordedDescription, RecordedEvent
from bota_clients.recording.reader import open_recording
from bota_clients.replay import cli
from bota_clients.replay.pacing import Pacing
from bota_clients.replay.sensors import ReplayedSensors
from bota_ethercat.client import Client, connect
from bota_ethercat.control import ACTIONS, ErrorCode
from bota_ethercat.errors import RefusedError
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat_bridge.stream.link import find_sensor
from ethercat_server.serving.actions import Actions
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.clients.recordings import PERIOD_NS, START_NS, describe, frame, record, write
from tests.clients.running import Replay, listen, signalled
from tests.ended import run_here
from tests.rights import NOBODY, needs_another_user
from tests.served_simulation import served
from tests.server.running import PATIENCE_S, free_port, wait_until
from tests.server.running import Client as Requests
from tests.server.test_memory import any_request
from tests.simulation import Simulation

COUNT = 400
FRAMES = [frame(n // 2, sensor=n % 2, flags=4 if n == 50 else 0) for n in range(COUNT)]
NOW_NS = 50 * 10**9
REAL_NS = 1_800_000_000 * 10**9
EMERGENCY = {"code": 0xFF01, "text": "device specific", "register": 0x81, "data": "0102030405"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "run.mcap"
    record(path, FRAMES, sensors=(0, 1))
    return path


def play(path: Path, *arguments: str) -> list[DataMessage]:
    """All that a client gets from a replay that runs once."""
    with Replay(*arguments, path) as served, listen(served.port, fresh_only=False) as client:
        frames = list(client.frames())
        assert served.wait() == 0
    return frames


def contents(frames: list[DataMessage]) -> list[DataMessage]:
    """The frames without their times."""
    return [frame._replace(stamp_ns=0, monotonic_ns=0) for frame in frames]


def samples(path: Path, *arguments: str) -> list[object]:
    with Replay(*arguments, path) as served, Client(served.port, reconnect=False).connect() as client:
        return [client.decode(frame) for frame in client.frames()]


def test_the_first_client_gets_everything_with_stamps_near_now_that_keep_their_spacing(path: Path) -> None:
    began = time.time_ns(), time.monotonic_ns()
    played = play(path)
    moved = [
        (new.stamp_ns - old.stamp_ns, new.monotonic_ns - old.monotonic_ns)
        for old, new in zip(FRAMES, played, strict=True)
    ]
    assert len(set(moved)) == 1
    assert began[0] < played[0].stamp_ns < time.time_ns()
    assert began[1] < played[0].monotonic_ns < time.monotonic_ns()
    assert contents(played) == contents(FRAMES)


def test_the_same_recording_gives_the_same_values_always_in_its_original_timing(path: Path) -> None:
    began = time.monotonic()
    first = samples(path)
    assert time.monotonic() - began >= (COUNT / 2 - 1) * PERIOD_NS / 1e9
    assert first == samples(path, "--speed", "20")
    assert len(first) == COUNT


def test_a_sensor_that_was_silent_is_shown_every_10_ms(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record(path, [frame(n, flags=DataFlag.REPEATED if n > 10 else 0) for n in range(60)])
    with Replay(path) as served, listen(served.port) as client:
        played = list(client.frames())
    assert [item.sequence for item in played if not item.flags] == [*range(11)]
    assert len(played) in range(11 + 2, 11 + 7)


def test_it_loops_with_numbers_that_go_on(path: Path) -> None:
    with Replay("--loop", "--speed", "50", path) as served, listen(served.port, sensors=[1]) as client:
        played = []
        for item in client.frames():
            played.append(item)
            if len(played) == COUNT:  # twice
                break
    numbers = [item.sequence for item in played]
    assert all(b - a >= 1 for a, b in pairwise(numbers))
    assert numbers[-1] >= COUNT - 1
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(played))


def test_a_recording_that_was_cut_off_is_played_as_far_as_it_goes(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with Replay(path) as served, listen(served.port, fresh_only=False) as client:
        played = list(client.frames())
        assert "was cut off" in served.said()
    assert 0 < len(played) < COUNT
    assert contents(played) == contents(FRAMES[: len(played)])


# -- what clients may ask


def test_describe_says_that_it_is_a_replay(path: Path) -> None:
    with Replay("--speed", "2", "--loop", path) as served, Requests(served.port) as client:
        reply = client.ask("describe")
    assert reply["replay"] == {
        "files": ["run.mcap"], "recorded": "?", "recorded_version": "?", "pace": 2.0, "loop": True,
    }  # fmt: skip
    assert reply["sensors"] == [{**row, "settling": False} for row in describe(0, 1)["sensors"]]
    assert reply["protocol"] == 1


def keys(value: object) -> object:
    """The keys of a reply, of the objects in it, and of the first in each of its lists."""
    if isinstance(value, list):
        return [keys(row) for row in value[:1]]
    return {key: keys(row) for key, row in value.items()} if isinstance(value, dict) else None


def test_status_has_all_that_a_server_s_has(path: Path) -> None:
    event = {"event": "emergency", **EMERGENCY, "sensor": 0, "count": 4, "message": "over"}
    frames = (frame(number, temperature=30.0 if number else math.nan) for number in range(100))
    write(path, [describe(0), event, *frames])
    with served() as server, connect(server.port) as client:
        server.command("emergency 0xFF01 0x81 0102030405")
        client.receive(PATIENCE_S)
        wait_until(lambda: client.ask("status")["sensors"][0]["emergency"], "the emergency")
        expected = client.ask("status")
        expected["sensors"][0]["drift"] = None  # as before the first seconds at rest
    with Replay("--loop", path) as running, connect(running.port) as client:
        next(client.frames())
        status = client.ask("status")
    assert keys(status) == keys(expected)
    (sensor,) = status["sensors"]
    assert {**sensor["emergency"], "ago_s": 0} == {**EMERGENCY, "ago_s": 0}
    assert (sensor["emergencies"], sensor["not_finite"]) == (1, 1)
    assert sensor["fresh"] > 0
    assert sensor["clock"]["period_us"] == 1250
    assert status["clients"][0]["sent"] > 0


def test_the_first_subscriber_gets_the_description_that_the_second_gets(path: Path) -> None:
    described = describe(0)
    described["sensors"][0] |= {
        "offset": [0.5] * 6, "meaning": {"sinc_length": "800 Hz"},
        "delay_ms": {"force_torque": 2.5, "acceleration": 1.0, "angular_rate": 1.0},
    }  # fmt: skip
    write(path, [described, *map(frame, range(2000))])
    with Replay(path) as running, connect(running.port) as first:
        reading = first.latest(timeout_s=PATIENCE_S)
        assert reading.frame is not None
        assert reading.measured_ns() == reading.frame.stamp_ns - 2_500_000
        with connect(running.port) as second:
            assert second.latest(timeout_s=PATIENCE_S).fresh
            assert first.description["sensors"] == second.description["sensors"]
        assert first.description["sensors"] == [{**described["sensors"][0], "settling": False}]


def test_a_position_that_no_sensor_can_have_costs_nothing(path: Path) -> None:
    items: list[Any] = []
    for position in (0, 1_000_000, 256, -1, 10**30, True, 1.0, "0"):
        items += [describe(0), {"event": "reconfigured", "sensor": position, "settings": {"sinc_length": 32}}]
        items[-2]["sensors"][0]["sensor"] = position
    write(path, [*items, frame(0)])
    with open_recording(path) as recording:
        assert [sensor.sensor for sensor in recording.sensors] == [0]
        assert len(ReplayedSensors(recording).sensors) == 1


@needs_another_user
def test_its_own_user_may_end_it_and_nobody_else(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: NOBODY.pw_uid)
    with Replay("--loop", path) as running:
        monkeypatch.undo()
        with Requests(running.port, NOBODY.pw_uid + 1) as client:
            assert client.ask("shutdown")["error"]["code"] == "denied"
        with Requests(running.port, NOBODY.pw_uid) as client:
            assert client.ask("shutdown")["ok"]
        assert running.wait() == 0


@pytest.mark.parametrize("seed", range(3))
def test_requests_are_answered_as_by_a_server_whose_sensors_are_lost(path: Path, seed: int) -> None:
    """Requests at random, and whether they are granted, or refused with which code."""
    chance, server = random.Random(seed), Simulation(SensorOptions(), SensorOptions())
    server.command("power off @0")
    server.run(1.0)
    expected = server.connect()
    with open_recording(path) as recording, contextlib.closing(Simulation()) as other:
        replayed = ReplayedSensors(recording)
        other.hub.start(Actions(other.hub, other.cycle, replayed).handle)
        client, codes = other.connect(), set[str]()
        for _ in range(300):
            action = chance.choice([action for action in (*ACTIONS, "no_such") if action != "shutdown"])
            keys = any_request(chance, action) if action in ACTIONS else {}
            found = [each.ask(action, **keys) for each in (expected, client)]
            wanted, given = [(each["ok"], each.get("error", {}).get("code")) for each in found]
            assert given == wanted, (action, keys)
            codes.add(str(wanted[1]))
    assert codes == {"None", "bad_request", "not_ready", "unknown_action"}


def test_the_node_takes_it_for_a_server_and_shutdown_ends_it(path: Path) -> None:
    with Replay("--loop", path) as served, connect(served.port, sensors=[1]) as client:
        with pytest.raises(RefusedError, match="this is a replay of a recording") as refused:
            client.ask("tare")
        assert refused.value.code == ErrorCode.NOT_READY
        info = find_sensor(client.description, 1)
        assert (info.sensor, info.serial, info.rate_hz, info.settings) == (1, 101, 800, {"sinc_length": 64})
        assert client.receive(PATIENCE_S)
        client.ask("shutdown")
        assert served.wait() == 0
        assert "stopped after" in served.said()


def test_what_happened_happens_again(path: Path) -> None:
    lost = {"event": "sensor_lost", "sensor": 0, "reason": "gone", "message": "gone"}
    ended, again = {"event": "shutting_down"}, {"event": "connected", "source": "recorder"}
    changed = {"event": "reconfigured", "sensor": 0, "settings": {"sinc_length": 32}}
    write(path, [describe(0), frame(0), lost, ended, again, frame(1, flags=2), changed, frame(2)])
    with Replay(path) as served, listen(served.port, fresh_only=False) as client:
        assert len(list(client.frames())) == 3
        events = [event["event"] for event in client.events if isinstance(event, dict)]
        assert events == ["sensor_lost", "reconfigured", "shutting_down"]


def test_what_is_said_of_sensors_follows_the_recording(path: Path) -> None:
    """What is in force, and the events that tell it: tests/bridge/test_one_stream.py."""
    write(path, [describe(0, 1)])
    with open_recording(path) as recording:
        sensors = ReplayedSensors(recording)
    sensors.follow(RecordedEvent(0, {"event": "sensor_lost", "sensor": 1}))
    assert [sensor.describe()["state"] for sensor in sensors.sensors] == ["OP", "LOST"]
    sensors.follow(RecordedEvent(0, {"event": "reconfigured", "sensor": 1, "rate_hz": 1600}))
    assert [sensor.describe()["rate_hz"] for sensor in sensors.sensors] == [800, 1600]
    for code in (1, 2):
        sensors.follow(RecordedEvent(0, {"event": "emergency", "sensor": 1, "code": code}))
    status = sensors.sensors[1].status()
    assert (status["emergencies"], status["emergency"]["code"]) == (2, 2)
    reply = describe(0)
    reply["sensors"][0] |= {"settling": True, "rate_hz": 400}  # the node's tare waits for the end of that
    (told,) = sensors.follow(RecordedDescription(0, reply))  # only the recorder connected again
    assert told == {"event": "reconfigured", "sensor": 0, "settings": {"sinc_length": 64}, "rate_hz": 400}
    assert not sensors.sensors[0].describe()["settling"]
    assert sensors.follow(RecordedDescription(0, reply)) == []
    for flags in (0, 0, 0, DataFlag.REPEATED, DataFlag.INVALID, DataFlag.INVALID | DataFlag.REPEATED):
        sensors.count(frame(0, flags=flags))
    status = sensors.status()
    counts = [status["sensors"][0][name] for name in ("fresh", "repeated", "invalid")]
    assert (counts, status["cycles"]) == ([3, 1, 2], 6)


# -- when a frame goes out, under which number and stamps


class Clock:
    """Both clocks of this machine, as a test sets them."""

    def __init__(self) -> None:
        self.passed_ns = 0

    def monotonic_ns(self) -> int:
        return NOW_NS + self.passed_ns

    def realtime_ns(self) -> int:
        return REAL_NS + self.passed_ns


def timeline(speed: float = 1.0, *, clock: Clock | None = None) -> Pacing:
    clock = clock or Clock()
    return Pacing(speed, monotonic_ns=clock.monotonic_ns, realtime_ns=clock.realtime_ns)


def test_speed_divides_all_times() -> None:
    line = timeline(speed=4)
    first, second = line.due(frame(0)), line.due(frame(4))
    assert second.at_ns - first.at_ns == PERIOD_NS
    assert second.frame.stamp_ns - first.frame.stamp_ns == PERIOD_NS


def test_a_frame_before_its_turn_is_not_held_back_and_holds_none_back() -> None:
    line = timeline()
    late = frame(1)._replace(monotonic_ns=5 * PERIOD_NS)  # an INVALID one has the time of the exchange
    due = [line.due(item).at_ns - NOW_NS for item in (frame(0), late, frame(2), frame(6))]
    assert due == [0, 5 * PERIOD_NS, 5 * PERIOD_NS, 6 * PERIOD_NS]


def test_again_numbers_go_on_and_there_is_one_period_between() -> None:
    clock = Clock()
    line = timeline(clock=clock)
    for number in (10, 11, 14):
        last = line.due(frame(number))
    clock.passed_ns = 2 * PERIOD_NS
    line.begin_again()
    first = line.due(frame(10))
    assert first.frame.sequence == last.frame.sequence + 1 == 15
    assert first.at_ns - last.at_ns == 3 * PERIOD_NS
    assert first.frame.stamp_ns - last.frame.stamp_ns == 3 * PERIOD_NS
    assert line.due(frame(12)).frame.sequence == 17


def test_across_a_restart_of_the_machine_the_pause_is_that_of_the_stamps() -> None:
    line = timeline()
    line.due(frame(0)._replace(monotonic_ns=900 * 10**9))
    line.reconnected()
    after = frame(0)._replace(monotonic_ns=10**9, stamp_ns=START_NS + 3 * 10**9)
    assert line.due(after).at_ns - NOW_NS == 3 * 10**9
    later = after._replace(monotonic_ns=10**9 + PERIOD_NS, stamp_ns=after.stamp_ns + PERIOD_NS)
    assert line.due(later).at_ns - NOW_NS == 3 * 10**9 + PERIOD_NS


def test_numbers_and_times_stay_in_their_fields() -> None:
    line = timeline()
    line.due(frame(0)._replace(monotonic_ns=2**64 - 1, stamp_ns=2**64 - 1, sequence=2**64 - 1))
    line.begin_again()
    moved = line.due(frame(5)._replace(monotonic_ns=0, stamp_ns=0)).frame
    assert all(0 <= value < 2**64 for value in moved[:3])
    low = line.due(frame(6)._replace(monotonic_ns=2**64 - 1, stamp_ns=2**64 - 1)).frame
    assert low.stamp_ns == low.monotonic_ns == 2**64 - 1


# -- arguments and what is not there


@pytest.mark.parametrize(
    ("code", "arguments", "sentence"),
    [
        (2, (), "required"),
        (2, ("x.mcap", "--speed", "nan"), "it must be 'max' or a number"),
        (1, ("/no/x.mcap",), "No such file"),
        (1, (__file__,), "is not an MCAP file"),
    ],
)
def test_what_cannot_be_played_is_said(code: int, arguments: tuple[str, ...], sentence: str) -> None:
    ended = run_here(cli.main, *arguments)
    assert ended.code == code
    assert sentence in ended.err


def test_a_port_that_is_taken_is_said(path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        ended = run_here(cli.main, path, "--server", taken.getsockname()[1])
    assert ended.code == 1
    assert "is in use by another program" in ended.err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_before_anybody_came(
    path: Path, number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        signalled(
            cli.main, number, lambda: "replaying" in capsys.readouterr().err, path, "--server", free_port()
        )
        == 0
    )


def test_a_damaged_recording_ends_it_with_a_sentence(path: Path) -> None:
    data = bytearray(path.read_bytes())
    position = data.index(b"zstd", 4000) + 100
    data[position] ^= 0xFF
    path.write_bytes(data)
    with Replay("--speed", "max", path) as served, listen(served.port) as client:
        list(client.frames())
        assert served.wait() == 1
        assert "is damaged at byte" in served.said()
