"""`ethercat-record`: everything it receives is in the file, whatever happens to it.

It is a process where it is stopped or killed from outside, which nothing else can do.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import random
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from mcap.reader import NonSeekingReader
from rosbags.rosbag2 import Reader

from bota_clients.record import cli, program, recorder
from bota_clients.record import recorder as record_parts
from bota_clients.record.recorder import FLUSH_S, Parts, Recorder
from bota_clients.record.source import BATCH_S, Batch, Source
from bota_clients.recording.file_format import FORMAT_VERSION, frame_topic
from bota_clients.recording.reader import open_recording
from bota_ethercat.address import Address
from bota_ethercat.framing import DataFlag, DataMessage
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.bridge.scripted_server import ScriptedServer
from tests.clients.recordings import frame, record
from tests.clients.running import (
    NoSignals,
    RecorderProcess,
    Replay,
    frames_in,
    recording,
    replaying,
    signalled,
)
from tests.served_simulation import served
from tests.server.running import PATIENCE_S, free_port, needs_bus, server, wait_until

Run = Callable[..., tuple[int, str]]
SECOND = 800
"""Frames of one sensor in a second."""
OLD = DataFlag.REPEATED | DataFlag.INVALID


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of two sensors."""
    path = tmp_path_factory.mktemp("source") / "source.mcap"
    record(path, (frame(n // 2, sensor=n % 2) for n in range(SECOND)), sensors=(0, 1))
    return path


@pytest.fixture(scope="module")
def endless(source: Path) -> Iterator[Replay]:
    with replaying("--loop", source) as running:
        yield running


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out.mcap"


def read(path: Path) -> list[DataMessage]:
    with open_recording(path) as opened:
        return list(opened.frames())


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


def is_whole(frames: list[DataMessage]) -> bool:
    """No number of a sensor is missing."""
    for sensor in {item.sensor for item in frames}:
        numbers = [item.sequence for item in frames if item.sensor == sensor]
        if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            return False
    return True


# -- what it records


@pytest.mark.parametrize("stamps", [(), ("--original-stamps",)])
def test_record_replay_record_gives_the_same_frames(
    source: Path, out: Path, stamps: tuple[str, ...], run: Run
) -> None:
    with replaying(*stamps, "--speed", "max", source) as served:
        code, said = run(out, served.port, "--no-reconnect")
        assert served.wait() == 0
    assert code == 0, said
    assert "nothing was lost" in said
    original, again = read(source), read(out)
    if not stamps:
        original, again = (
            [f._replace(stamp_ns=0, monotonic_ns=0) for f in part] for part in (original, again)
        )
    assert original == again


def test_it_ends_by_itself_and_says_what_it_has(endless: Replay, out: Path, run: Run) -> None:
    code, said = run(out, endless.port, "--seconds", "0.5")
    assert code == 0
    with open_recording(out) as opened:
        assert opened.cut_off is None
        assert opened.end is not None
        assert opened.end["reason"] == "time is up"
        assert [sensor.serial for sensor in opened.sensors] == [100, 101]
        assert opened.metadata["server"] == f"localhost:{endless.port}"
        assert f"{opened.frame_count} frames of 2 sensors" in said
        assert is_whole(list(opened.frames()))


def test_one_sensor_of_two(endless: Replay, out: Path, run: Run) -> None:
    code, _ = run(out, endless.port, "--sensor", "1", "--seconds", "0.3")
    assert code == 0
    with open_recording(out) as opened:
        assert {item.sensor for item in opened.frames()} == {1}
        assert opened.chosen == {1}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(
    endless: Replay, out: Path, number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert signalled(cli.main, number, lambda: frames_in(out) > 50, out, endless.port) == 0
    assert "nothing was lost" in capsys.readouterr().err
    with open_recording(out) as opened:
        assert opened.cut_off is None
        assert opened.end is not None
        assert opened.end["reason"] == "asked to stop"


def test_it_records_across_the_restart_of_the_server(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with served(sinc_length=512) as first, recording(out, first.port) as recorder:
        recorder.wait_for_frames(20)
        first.close()
        with served(port=first.port, sinc_length=512):
            recorder.wait_for_frames(20)
            assert recorder.stop() == 0
    assert "nothing was lost" in capsys.readouterr().err
    with open_recording(out) as opened:
        names = [event.name for event in opened.events]
        assert names == ["connected", "shutting_down", "disconnected", "connected"]
        assert [event.by_recorder for event in opened.events] == [True, False, True, True]
        assert len(opened.descriptions) == 2


def test_it_records_on_without_a_sensor_that_the_restarted_server_lacks(
    out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        served(SensorOptions(), SensorOptions(), sinc_length=512) as first,
        recording(out, first.port, "--sensor", "0", "--sensor", "1") as recorder,
    ):
        recorder.wait_for_frames(20)
        first.close()
        with served(port=first.port, sinc_length=512) as second:
            recorder.wait_for_frames(20)
            second.close()
        with served(SensorOptions(), SensorOptions(), port=first.port, sinc_length=512):
            wait_until(lambda: read(out)[-1].sensor == 1, "a frame of the sensor that is back")
            assert recorder.stop() == 0
    assert "connected: without sensor 1" in capsys.readouterr().err
    with open_recording(out) as opened:
        said = [event.event.get("message") for event in opened.events if event.name == "connected"]
        assert said == [None, "without sensor 1", None]


def test_a_refusal_does_not_end_a_recording_that_runs(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with ScriptedServer() as server, recording(out, server.port) as recorder:
        assert server.subscribed.wait(PATIENCE_S)
        server.answers["subscribe"] = lambda _: {"ok": False, "error": {"code": "busy", "message": "not now"}}
        server.drop()
        wait_until(lambda: "refused: not now" in capsys.readouterr().err, "the refusal")
        server.answers.clear()
        assert server.subscribed.wait(PATIENCE_S)
        server.send_sample(1.0)
        recorder.wait_for_frames(1)
        assert recorder.stop() == 0


# -- what is lost


def test_what_the_server_withheld_is_said(out: Path, tmp_path: Path, run: Run) -> None:
    gappy = tmp_path / "gappy.mcap"
    missing = {50, 51, 120}
    record(gappy, (frame(n, flags=4 if n - 1 in missing else 0) for n in range(200) if n not in missing))
    with replaying("--speed", "max", gappy) as served:
        code, said = run(out, served.port, "--no-reconnect")
    assert code == 0
    assert "3 frames of sensor 0 not read in time" in said


def test_a_moment_without_running_and_the_end_of_its_input(out: Path) -> None:
    """A process, to be stopped by SIGSTOP and to have a standard input."""
    with served(sinc_length=512) as server:
        recorder = RecorderProcess(out, server.port, "--until-eof")
        try:
            wait_until(lambda: frames_in(out) > 20, "frames")
            recorder.signal(signal.SIGSTOP)
            before = frames_in(out)
            time.sleep(0.5)
            recorder.signal(signal.SIGCONT)
            wait_until(lambda: frames_in(out) > before + 100, "the frames of that time, and more")
            assert recorder.process.stdin
            recorder.process.stdin.write("this is not the end\n")
            recorder.process.stdin.flush()
            before = frames_in(out)
            wait_until(lambda: frames_in(out) > before, "more frames")
            recorder.process.stdin.close()
            assert recorder.wait() == 0
            assert "nothing was lost" in recorder.said()
        finally:
            recorder.signal(signal.SIGCONT)
            recorder.close()
    assert is_whole(read(out))
    with open_recording(out) as opened:
        assert opened.end is not None
        assert opened.end["reason"] == "asked to stop"


def test_seconds_of_frames_have_room_in_the_kernel(endless: Replay) -> None:
    source = Source(Address("localhost", endless.port), None)
    source.connect()
    with socket.socket(fileno=os.dup(source._client.fileno())) as same:
        room = same.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    source.close()
    most = int(Path("/proc/sys/net/core/rmem_max").read_text())
    assert room >= min(4 * 1024 * 1024, 2 * most)


def new_recorder(out: Path) -> Recorder:
    return Recorder(Parts(out, size=None, seconds=None, overwrite=False), "test", {"format": FORMAT_VERSION})


def test_frames_get_into_the_file_before_it_ends(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert BATCH_S + FLUSH_S < 0.5, "a machine that is busy may double it"
    now_s, in_file = [0.0], []

    def batches() -> Iterator[Batch | None]:
        yield [frame(number) for number in range(10)]
        now_s[0] += FLUSH_S
        yield []
        in_file.append(frames_in(out))
        yield None

    queued = batches()
    played = SimpleNamespace(get=lambda timeout: next(queued), put=lambda batch: None, empty=lambda: True)
    monkeypatch.setattr(recorder, "time", SimpleNamespace(monotonic=lambda: now_s[0], time_ns=time.time_ns))
    monkeypatch.setattr(recorder, "queue", SimpleNamespace(SimpleQueue=lambda: played, Empty=queue.Empty))
    new_recorder(out).stop("")
    assert in_file == [10], "though no more come"


def test_a_backlog_does_not_delay_its_end(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a machine so loaded that writing all of it would take minutes, and more came than can be queued."""
    calls = itertools.count()
    monkeypatch.setattr(
        recorder, "time", SimpleNamespace(monotonic=lambda: next(calls) * 0.1, time_ns=time.time_ns)
    )
    monkeypatch.setattr(recorder, "MAX_BACKLOG", 20_000)
    came: list[Batch] = [
        [frame(number) for number in range(first, first + 64)] for first in range(0, 32_000, 64)
    ]
    slow = new_recorder(out)
    for batch in came:
        slow.put(batch)
    slow.stop("asked to stop")
    assert slow.error is None
    with open_recording(out) as opened:
        assert len(list(opened.frames())) == slow.saved < 16_000
        assert opened.cut_off is None
        lost = sum(event.event["frames"] for event in opened.events)
        assert opened.end is not None
        assert str(lost) == opened.end["dropped"]
    assert slow.saved + lost == 32_000


def test_of_a_file_that_is_removed_nothing_is_said_to_be_there(out: Path) -> None:
    removed = new_recorder(out)
    removed.put([frame(number) for number in range(10)])
    wait_until(lambda: frames_in(out) == 10, "the frames")
    out.unlink()
    removed.put([frame(10)])
    removed.stop("asked to stop")
    assert str(removed.error) == f"{out} was removed while it was written: nothing of it is left"
    assert (removed.saved, removed.tally.dropped) == (0, 11)


def test_a_part_that_was_taken_away_is_none_of_its_business(
    endless: Replay, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        record_parts, "time", SimpleNamespace(monotonic=lambda: 10 * time.monotonic(), time_ns=time.time_ns)
    )
    part = out.with_name("out_0.mcap")
    with recording(out, endless.port, "--rotate-seconds", "1") as recorder:
        wait_until(out.with_name("out_1.mcap").exists, "the second file")
        part.unlink()
        wait_until(out.with_name("out_3.mcap").exists, "the fourth file")
        assert recorder.stop() == 0


def killed(endless: Replay, out: Path, frames: int) -> None:
    """Kill a recorder once there are so many frames; all of them are there."""
    recorder = RecorderProcess(out, endless.port, "--force")
    try:
        recorder.wait_for("Ctrl-C ends it")
        wait_until(lambda: frames_in(out) > frames, "frames")
        before = frames_in(out)
        recorder.signal(signal.SIGKILL)
        recorder.wait()
    finally:
        recorder.close()
    assert len(read(out)) >= before
    assert is_whole(read(out))
    assert {item.sensor for item in read(out)} == {0, 1}


def test_killed_it_leaves_what_was_there(endless: Replay, out: Path) -> None:
    killed(endless, out, 500)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_killed_twenty_times_it_leaves_everything_twenty_times(endless: Replay, out: Path) -> None:
    source = random.Random(4)
    for _ in range(20):
        killed(endless, out, source.randrange(200, 5000))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "small"
    folder.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=48k", "tmpfs", folder],
        check=False,
        capture_output=True,
        text=True,
    )
    if made.returncode:
        pytest.skip(f"no small disk here ({made.stderr.strip()}): run as root with CAP_SYS_ADMIN")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def test_a_full_disk_ends_it_with_what_was_written_whole(endless: Replay, small_disk: Path, run: Run) -> None:
    out = small_disk / "out.mcap"
    code, said = run(out, endless.port, "--seconds", "30")
    assert code == 1
    assert "No space left on device; what was written before is intact" in said
    assert "came but could not be written" in said
    frames = read(out)
    assert len(frames) > 100
    assert is_whole(frames)
    assert f"{len(frames)} frames of 2 sensors" in said


# -- files


def test_rotation_loses_nothing_between_the_files(
    endless: Replay, out: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        record_parts, "time", SimpleNamespace(monotonic=lambda: 10 * time.monotonic(), time_ns=time.time_ns)
    )
    with recording(out, endless.port, "--rotate-seconds", "1") as recorder:
        wait_until(lambda: len(list(out.parent.glob("out_*.mcap"))) >= 3, "three files")
        assert recorder.stop() == 0
    said = capsys.readouterr().err
    parts = sorted(out.parent.glob("out_*.mcap"))
    assert not out.exists()
    frames: list[DataMessage] = []
    for number, part in enumerate(parts):
        with open_recording(part) as opened:
            assert opened.metadata["part"] == str(number)
            assert opened.cut_off is None
            assert [sensor.serial for sensor in opened.sensors] == [100, 101]
            frames += opened.frames()
    assert is_whole(frames)
    assert f"{len(frames)} frames" in said


def test_nothing_is_overwritten_unasked(endless: Replay, out: Path, run: Run) -> None:
    out.write_text("precious")
    code, said = run(out, endless.port, "--seconds", "0.3")
    assert code == 1
    assert "exists: choose another name, or use --force to replace it" in said
    assert out.read_text() == "precious"
    code, _ = run(out, endless.port, "--seconds", "0.3", "--force")
    assert code == 0
    assert read(out)


def test_two_recorders_do_not_write_to_one_file(endless: Replay, out: Path, run: Run) -> None:
    with recording(out, endless.port) as recorder:
        recorder.wait_for_frames(1)
        code, said = run(out, endless.port, "--force", "--seconds", "0.3")
        assert code == 1
        assert "another ethercat-record is writing to it" in said
    assert is_whole(read(out))


# -- arguments and servers that are not there


@pytest.mark.parametrize("rotate", [(), ("--rotate-size", "1M")])
def test_a_refusal_is_one_sentence_and_leaves_no_file(
    endless: Replay, out: Path, rotate: tuple[str, ...], run: Run
) -> None:
    code, said = run(out, endless.port, "--sensor", "3", "--seconds", "30", *rotate)
    assert code == 1
    last = said.splitlines()[-1]
    assert last == "ethercat-record: the server has no sensor 3 (it has: 0, 1)"
    assert "nothing was lost" not in said
    assert not list(out.parent.glob("out*.mcap"))
    code, said = run(out, endless.port, "--sensor", "1", "--seconds", "0.3", *rotate)
    assert code == 0, said


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "required"),
        (("x.mcap", "localhost:99999"), "99999 is no port: it must be from 1 to 65535"),
        (("x.mcap", "--seconds", "-1"), "a number of seconds"),
        (("x.mcap", "--seconds", "nan"), "a number of seconds"),
        (("x.mcap", "--rotate-size", "10"), "at least 100k"),
        (("x.mcap", "--rotate-seconds", "0.1"), "at least 1 s"),
        (("x.mcap", "--sensor", "300"), "a position on the bus"),
    ],
)
def test_wrong_arguments_are_exit_code_2(arguments: tuple[str, ...], sentence: str, run: Run) -> None:
    code, said = run(*arguments)
    assert code == 2
    assert sentence in said


def test_without_a_server_it_makes_no_file(out: Path, run: Run) -> None:
    code, said = run(out, free_port())
    assert code == 1
    assert "start ethercat-server, or use --wait" in said
    assert not out.exists()


def test_it_waits_for_a_server_if_it_is_told_to(
    source: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = free_port()
    with recording(out, port, "--wait", "--no-reconnect") as recorder:
        wait_until(lambda: "waiting for a server" in capsys.readouterr().err, "a word")
        with replaying("--speed", "max", source, port=port):
            assert recorder.wait() == 0
    assert len(read(out)) == SECOND


def test_the_wait_can_be_ended(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with recording(out, free_port(), "--wait") as recorder:
        assert recorder.stop() == 0
    assert "nothing was recorded" in capsys.readouterr().err


def test_a_sensor_that_is_not_there_is_said(endless: Replay, out: Path, run: Run) -> None:
    code, said = run(out, endless.port, "--sensor", "5")
    assert code == 1
    assert "the server has no sensor 5 (it has: 0, 1)" in said


def test_a_folder_that_is_not_there_is_said(out: Path, run: Run) -> None:
    code, said = run(out.parent / "no" / "x.mcap", free_port())
    assert code == 1
    assert "there is no folder" in said


# -- with a server


def test_settings_that_change_meanwhile_are_in_the_recording(out: Path) -> None:
    def last_setting() -> tuple[object, float]:
        with open_recording(out) as opened:
            (sensor,) = opened.sensors
            return sensor.history[-1].values["sinc_length"], sensor.history[-1].rate_hz

    with (
        served(sinc_length=512) as server,
        server.client() as client,
        recording(out, server.port) as recorder,
    ):
        recorder.wait_for_frames(1)
        assert client.ask("configure", sensor=0, settings={"sinc_length": 256})["ok"]
        wait_until(lambda: last_setting() == (256, 200), "the new settings")
        recorder.wait_for_frames(20)
        assert recorder.stop() == 0
    with open_recording(out) as opened:
        assert opened.sensors[0].settings["sinc_length"] == 512
        assert is_whole(list(opened.frames()))


@pytest.mark.long
@pytest.mark.bus
@needs_bus
@pytest.mark.timeout(300)
def test_two_sensors_at_1600_hz_for_a_minute(out: Path) -> None:
    """Nothing lost between server and file, for part of the server's CPU."""
    seconds = 60
    with server("virtual", "--virtual", "--sensors 2", "--set", "sinc_length=32") as running:
        recorder = RecorderProcess(out, running.port, "--seconds", str(seconds))
        used = psutil.Process(recorder.process.pid)
        serves = psutil.Process(running.process.pid)
        spent, began = 0.0, sum(serves.cpu_times()[:2])
        try:
            while recorder.process.poll() is None:
                with contextlib.suppress(psutil.NoSuchProcess):
                    spent = max(spent, sum(used.cpu_times()[:2]))
                time.sleep(0.1)
            served_s = sum(serves.cpu_times()[:2]) - began
            assert recorder.wait() == 0
            said = recorder.said()
        finally:
            recorder.close()
    print(f"{100 * spent / seconds:.1f} % of a core, server {100 * served_s / seconds:.1f} %; {said}")
    frames = read(out)
    assert "not read in time" not in said
    assert "could not be written" not in said
    assert is_whole(frames)
    assert len(frames) > 0.95 * 2 * 1600 * seconds
    assert spent < 0.4 * served_s
    with Reader(out) as bag:  # another library's
        counts = {connection.topic: connection.msgcount for connection in bag.connections}
    assert counts[frame_topic(0)] + counts[frame_topic(1)] == len(frames)
    with out.open("rb") as file:
        messages = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        assert sum(1 for _ in messages) == sum(counts.values())
