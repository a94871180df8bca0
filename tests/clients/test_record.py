"""`ethercat-record`: everything it receives is in the file, whatever happens to it.

It is a process where it is stopped or killed from outside, which nothing else can do.
"""

from __future__ import annotations

import errno
import itertools
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace

import pytest

from bota_clients.errors import RecordingError
from bota_clients.record import cli, program, recorder
from bota_clients.record.recorder import BATCH_S, FLUSH_S, Batch
from bota_clients.recording.file_format import RecordedDescription, RecordedEvent
from bota_clients.recording.mcap_writer import DiskFile
from bota_clients.recording.reader import open_recording
from bota_ethercat.framing import DataFlag, DataMessage
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.bridge.scripted_server import ScriptedServer
from tests.clients.recordings import frame, record
from tests.clients.running import Recorder, Replay, frames_in, signalled
from tests.descriptions import description
from tests.ended import run_here
from tests.golden_vectors import odd_messages
from tests.served_simulation import served
from tests.server.running import PATIENCE_S, wait_until

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
    with Replay("--loop", source) as running:
        yield running


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out.mcap"


def read(path: Path) -> list[DataMessage]:
    with open_recording(path) as opened:
        return list(opened.frames())


def end(path: Path) -> Mapping[str, str]:
    """What it has at its end, which was not cut off."""
    with open_recording(path) as opened:
        assert opened.cut_off is None
        assert opened.end is not None
        return opened.end


def run(*arguments: object) -> tuple[int, str]:
    """Runs the program here; its exit code and what it said."""
    ended = run_here(cli.main, *arguments)
    return ended.code, ended.err


def is_whole(frames: list[DataMessage]) -> bool:
    """No number of a sensor is missing."""
    for sensor in {item.sensor for item in frames}:
        numbers = [item.sequence for item in frames if item.sensor == sensor]
        if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            return False
    return True


# -- what it records


def test_record_replay_record_gives_the_same_frames(source: Path, out: Path) -> None:
    with Replay("--speed", "max", source) as served:
        code, said = run(out, "--server", served.port, "--no-reconnect")
        assert served.wait() == 0
    assert code == 0, said
    assert "nothing was lost" in said
    original, again = ([f._replace(stamp_ns=0, monotonic_ns=0) for f in read(path)] for path in (source, out))
    assert original == again


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(
    endless: Replay, out: Path, number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    ready = lambda: frames_in(out) > 50  # noqa: E731
    assert signalled(cli.main, number, ready, out, "--server", endless.port, "--sensor", 1) == 0
    assert "nothing was lost" in capsys.readouterr().err
    assert end(out)["reason"] == "asked to stop"
    with open_recording(out) as opened:
        assert {item.sensor for item in opened.frames()} == opened.chosen == {1}


def test_it_records_on_across_restarts_even_without_a_sensor_that_the_server_lacks(
    out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        served(SensorOptions(), SensorOptions(), sinc_length=512) as first,
        Recorder(out, first.port, "--sensor", "0", "--sensor", "1") as recorder,
    ):
        recorder.wait_for_frames(20)
        first.close()
        with served(port=first.port, sinc_length=512) as second:
            recorder.wait_for_frames(20)
            second.close()
        with served(SensorOptions(), SensorOptions(), port=first.port, sinc_length=512):
            wait_until(lambda: read(out)[-1].sensor == 1, "a frame of the sensor that is back")
            assert recorder.stop() == 0
    said = capsys.readouterr().err
    assert "connected: without sensor 1" in said
    assert "nothing was lost" in said
    with open_recording(out) as opened:
        names = ["connected", *("shutting_down", "disconnected", "connected") * 2]
        assert [event.name for event in opened.events] == names
        assert [event.by_recorder for event in opened.events] == [name != "shutting_down" for name in names]
        about = [event.event.get("message") for event in opened.events if event.name == "connected"]
        assert about == [None, "without sensor 1", None]
        assert sum(isinstance(item, RecordedDescription) for item in opened.everything()) == 3


def test_a_refusal_does_not_end_a_recording_that_runs(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with ScriptedServer() as server, Recorder(out, server.port) as recorder:
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


def later(sent: DataMessage, ms: float) -> DataMessage:
    """The same frame, so long after the first."""
    return sent._replace(monotonic_ns=frame(1).monotonic_ns + round(ms * 1e6))


@pytest.mark.parametrize(
    ("frames", "sentence"),
    [
        ([frame(1), frame(2), frame(1, 1)], "nothing was lost"),
        (
            [
                frame(1),
                RecordedEvent(0, {"event": "disconnected", "source": "recorder"}),
                frame(9),
                frame(1, 1),
            ],
            "nothing was lost; not counted: what came during 1 disconnection",
        ),
        (
            [frame(1), frame(2, 0, DataFlag.GAP), frame(3, 0, DataFlag.GAP), frame(1, 1)],
            "2 samples of sensor 0 lost on the bus (estimated)",
        ),
        (  # 800 Hz, and 400 Hz later
            [
                RecordedDescription(0, description()),
                frame(1),
                later(frame(2, 0, DataFlag.GAP), 12.5),
                RecordedEvent(0, {"event": "reconfigured", "sensor": 0, "rate_hz": 400}),
                later(frame(3, 0, DataFlag.GAP), 32.5),
            ],
            "16 samples of sensor 0 lost on the bus (estimated)",
        ),
        (
            [frame(1), frame(5, 0, DataFlag.GAP), frame(1, 1, DataFlag.INVALID)],
            "3 frames of sensor 0 not read in time, 1 frame of sensor 1 invalid",
        ),
    ],
)
def test_what_was_lost_is_said(frames: Batch, sentence: str, out: Path) -> None:
    recorder = new_recorder(out)
    recorder.put([*frames])
    recorder.stop("")
    assert recorder.summary.endswith(f"; {sentence}")


def new_recorder(out: Path) -> recorder.Recorder:
    return recorder.Recorder(out, "test", {}, overwrite=False)


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
        lost = sum(event.event["frames"] for event in opened.events)
        assert str(lost) == end(out)["dropped"]
    assert slow.saved + lost == 32_000


def test_of_a_file_that_is_removed_nothing_is_said_to_be_there(out: Path) -> None:
    removed = new_recorder(out)
    removed.put([frame(number) for number in range(10)])
    wait_until(lambda: frames_in(out) == 10, "the frames")
    out.unlink()
    removed.put([frame(10)])
    removed.stop("asked to stop")
    assert str(removed.error) == f"{out} was removed while it was written: nothing of it is left"
    assert (removed.saved, removed.dropped) == (0, 11)


def test_it_records_on_when_nobody_reads_what_it_says(out: Path) -> None:
    """A process: its standard error is a pipe whose reader goes before something is said."""
    reading, writing = os.pipe()
    with ScriptedServer() as server, open(reading) as said:  # noqa: PTH123
        command = [sys.executable, "-m", "bota_clients.record.cli", str(out), "--server", f":{server.port}"]
        process = subprocess.Popen(command, stderr=writing)
        os.close(writing)
        try:
            assert "Ctrl-C ends it" in said.readline()
            said.close()
            for sequence in range(3):
                server.send_json({"event": "reconfigured", "sensor": 0})
                server.send_sample(float(sequence))
                wait_until(lambda: frames_in(out) == server.sequence, "the sample")
            process.send_signal(signal.SIGHUP)
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
            process.wait()
    assert end(out)["reason"] == "asked to stop"
    assert len(read(out)) == 3


def test_without_a_standard_error_it_records_too(endless: Replay, out: Path) -> None:
    command = f'exec "$0" {out} --server :{endless.port} --for 0.2s 2>&-'
    program = Path(sys.executable).with_name("ethercat-record")
    subprocess.run(["sh", "-c", command, program], check=True, timeout=PATIENCE_S)
    assert end(out)["reason"] == "time is up"


def test_whatever_ends_it_finishes_the_file(
    endless: Replay, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And leaves no thread that keeps the program from ending."""

    def fail(*_: object) -> None:
        raise SystemExit(3)

    monkeypatch.setattr(program, "_report", fail)
    assert run(out, "--server", f":{endless.port}")[0] == 3
    assert end(out)["reason"] == "an error ended it"
    assert "recorder" not in {thread.name for thread in threading.enumerate()}


def test_a_fault_of_its_own_is_no_success(
    endless: Replay, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise LookupError("of the writer")

    monkeypatch.setattr("bota_clients.recording.writer.RecordingWriter.note", fail)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    code, said = run(out, "--server", endless.port)
    assert code == 1
    assert "a fault of this program ended the recording: LookupError('of the writer')" in said


def test_whatever_the_server_says_is_survived_and_recorded(
    out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ScriptedServer() as server, Recorder(out, server.port) as recorder:
        assert server.subscribed.wait(PATIENCE_S)
        for message in odd_messages():
            server.send_json(message)
        server.send_sample(1.0)
        recorder.wait_for_frames(1)
        assert recorder.stop() == 0
    assert "Traceback" not in capsys.readouterr().err
    with open_recording(out) as opened:
        known = {event.event["event"] for event in opened.events}
    assert {"sensor_lost", "unknown", ""} <= known
    assert all(isinstance(name, str) for name in known)


def test_a_disk_that_is_full_beside_the_file_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the index of the chunks is kept."""
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: Path("/dev/full").open("r+b"))  # noqa: SIM115
    disk = DiskFile(tmp_path / "run.mcap", overwrite=False)
    with pytest.raises(RecordingError, match=r"run.mcap cannot be written: No space left on device; what"):
        disk.keep(b"index")
    disk.close()


def test_a_full_disk_ends_it_with_what_was_written_whole(
    endless: Replay, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, room = os.write, 48_000

    def full(fd: int, data: bytes) -> int:
        nonlocal room
        if not room:
            raise OSError(errno.ENOSPC, "No space left on device")
        count = min(room, len(data))
        room -= count
        return int(real(fd, data[:count]))

    monkeypatch.setattr(os, "write", full)
    code, said = run(out, "--server", endless.port, "--seconds", "30")
    assert code == 1
    assert "No space left on device; what was written before is intact" in said
    assert "came but could not be written" in said
    frames = read(out)
    assert len(frames) > 100
    assert is_whole(frames)
    assert f"{len(frames)} frames of 2 sensors" in said


# -- files


def test_nothing_is_overwritten_unasked_or_by_two(endless: Replay, out: Path) -> None:
    out.write_text("precious")
    code, said = run(out, "--server", endless.port, "--seconds", "0.3")
    assert code == 1
    assert "exists: choose another name, or use --force to replace it" in said
    assert out.read_text() == "precious"
    with Recorder(out, endless.port, "--force") as recorder:
        recorder.wait_for_frames(1)
        code, said = run(out, "--server", endless.port, "--force", "--seconds", "0.3")
        assert code == 1
        assert "another ethercat-record is writing to it" in said
    assert is_whole(read(out))


# -- arguments and servers that are not there


def test_a_refusal_is_one_sentence_and_leaves_no_file(endless: Replay, out: Path) -> None:
    code, said = run(out, "--server", endless.port, "--sensor", "3", "--seconds", "30")
    assert code == 1
    assert said.splitlines()[-1] == "ethercat-record: the server has no sensor 3 (it has: 0, 1)"
    assert "nothing was lost" not in said
    assert not list(out.parent.glob("out*.mcap"))
    assert run(out, "--server", endless.port, "--sensor", "1", "--seconds", "0.3")[0] == 0
    code, said = run("/no/x.mcap", "--server", endless.port)
    assert (code, said) == (1, "ethercat-record: /no/x.mcap cannot be written: No such file or directory\n")


@pytest.mark.parametrize(
    ("code", "arguments", "sentence"),
    [
        (2, (), "required"),
        (2, ("x.mcap", "--server", "localhost:99999"), "99999 is no port: it must be a whole number from 1"),
        (2, ("x.mcap", "--seconds", "-1"), "it must be a time such as"),
        (2, ("x.mcap", "--sensor", "300"), "a whole number from 0 to 255"),
        *((2, ("x.mcap", f"--for={text}"), "it must be a time such as 30s, 5min or 2h")
          for text in ("0s", "-1s", "30x", "s", "nan", "1e3s", "5 ms", "5 months")),
        (1, ("x.mcap", "--server", "localhost:1"), "start ethercat-server"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_said(
    code: int, arguments: tuple[str, ...], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = run(*arguments)
    assert ended[0] == code
    assert sentence in ended[1]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("30s", 30), ("30", 30), ("1.5min", 90), ("2h", 7200), ("0.5 s", 0.5), ("5 minutes", 300),
        ("1 minute", 60), ("5m", 300), ("90 sec", 90), ("2hours", 7200),
    ],
)  # fmt: skip
def test_a_recording_for_a_time(text: str, seconds: float) -> None:
    assert cli.parse_options(["x.mcap", "--for", text]).seconds == seconds
    for arguments in (["x.mcap", "--for", *text.split()], ["--seconds", *text.split(), "x.mcap"]):
        options = cli.parse_options(arguments)
        assert (options.seconds, str(options.path)) == (seconds, "x.mcap")


# -- with a server


def test_settings_that_change_meanwhile_are_in_the_recording(out: Path) -> None:
    def last_setting() -> tuple[object, float]:
        with open_recording(out) as opened:
            (sensor,) = opened.sensors
            return sensor.history[-1].info.settings["sinc_length"], sensor.history[-1].info.rate_hz

    with served(sinc_length=512) as server, server.client() as client, Recorder(out, server.port) as recorder:
        recorder.wait_for_frames(1)
        assert client.ask("configure", sensor=0, settings={"sinc_length": 256})["ok"]
        wait_until(lambda: last_setting() == (256, 200), "the new settings")
        recorder.wait_for_frames(20)
        assert recorder.stop() == 0
    with open_recording(out) as opened:
        assert opened.sensors[0].info.settings["sinc_length"] == 512
        assert is_whole(list(opened.frames()))
