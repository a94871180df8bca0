"""`ethercat-record`: everything it receives is in the file, whatever happens to it.

It is a process where it is stopped, killed or watched from outside.
"""

from __future__ import annotations

import contextlib
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from mcap.reader import NonSeekingReader
from rosbags.rosbag2 import Reader

from clients.record import program
from clients.recording.file_format import frame_topic
from clients.recording.reader import open_recording
from protocol.framing import DataFlag, DataMessage
from tests.clients.recordings import frame, record
from tests.clients.running import Client, NoSignals, Recorder, Replay, free_port, replaying, wait_until
from tests.server.running import needs_bus, server

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
    with open_recording(path) as recording:
        return list(recording.frames())


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
    with open_recording(out) as recording:
        assert recording.cut_off is None
        assert recording.end is not None
        assert recording.end["reason"] == "time is up"
        assert [sensor.serial for sensor in recording.sensors] == [100, 101]
        assert recording.metadata["server"] == f"localhost:{endless.port}"
        assert f"{recording.frame_count} frames of 2 sensors" in said
        assert is_whole(list(recording.frames()))


def test_one_sensor_of_two(endless: Replay, out: Path, run: Run) -> None:
    code, _ = run(out, endless.port, "--sensor", "1", "--seconds", "0.3", "--ros")
    assert code == 0
    with open_recording(out) as recording:
        assert {item.sensor for item in recording.frames()} == {1}
        assert recording.chosen == {1}


def test_it_ends_with_its_standard_input(endless: Replay, out: Path) -> None:
    recorder = Recorder(out, endless.port, "--until-eof")
    try:
        wait_until(lambda: recorder.size() > 5000, "frames")
        assert recorder.process.stdin
        recorder.process.stdin.write("this is not the end\n")
        recorder.process.stdin.flush()
        size = recorder.size()
        wait_until(lambda: recorder.size() > size, "more frames")
        recorder.process.stdin.close()
        assert recorder.wait() == 0
    finally:
        recorder.close()
    with open_recording(out) as recording:
        assert recording.end is not None
        assert recording.end["reason"] == "asked to stop"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(endless: Replay, out: Path, number: int) -> None:
    recorder = Recorder(out, endless.port)
    try:
        recorder.wait_for("Ctrl-C ends it")
        wait_until(lambda: recorder.size() > 5000, "data")
        recorder.signal(number)
        assert recorder.wait() == 0
        assert "nothing was lost" in recorder.said()
        assert "Traceback" not in recorder.said()
    finally:
        recorder.close()
    with open_recording(out) as recording:
        assert recording.cut_off is None
        assert recording.end is not None
        assert recording.end["reason"] == "asked to stop"


def test_it_records_across_the_restart_of_the_server(source: Path, out: Path) -> None:
    port = free_port()
    with replaying("--loop", source, port=port):
        recorder = Recorder(out, port)
        recorder.wait_for("Ctrl-C ends it")
        wait_until(lambda: recorder.size() > 5000, "data")
    try:
        recorder.wait_for("disconnected")
        with replaying("--loop", source, port=port):
            before = recorder.size()
            wait_until(lambda: recorder.size() > before + 5000, "more data")
            recorder.signal(signal.SIGINT)
            assert recorder.wait() == 0
            assert "nothing was lost" in recorder.said()
    finally:
        recorder.close()
    with open_recording(out) as recording:
        names = [event.name for event in recording.events]
        assert names == ["connected", "shutting_down", "disconnected", "connected"]
        assert [event.by_recorder for event in recording.events] == [True, False, True, True]
        assert len(recording.descriptions) == 2


# -- what is lost


def test_what_the_server_withheld_is_said(out: Path, tmp_path: Path, run: Run) -> None:
    gappy = tmp_path / "gappy.mcap"
    missing = {50, 51, 120}
    record(gappy, (frame(n, flags=4 if n - 1 in missing else 0) for n in range(200) if n not in missing))
    with replaying("--speed", "max", gappy) as served:
        code, said = run(out, served.port, "--no-reconnect")
    assert code == 0
    assert "3 frames of sensor 0 not read in time" in said


def test_nothing_is_lost_while_it_does_not_run_for_a_moment(endless: Replay, out: Path) -> None:
    recorder = Recorder(out, endless.port)
    try:
        wait_until(lambda: recorder.size() > 5000, "data")
        recorder.signal(signal.SIGSTOP)
        before = len(read(out))
        time.sleep(2)
        recorder.signal(signal.SIGCONT)
        wait_until(lambda: len(read(out)) > before + 2 * 2 * SECOND, "the frames of the two seconds")
        recorder.signal(signal.SIGINT)
        assert recorder.wait() == 0
        assert "nothing was lost" in recorder.said()
    finally:
        recorder.signal(signal.SIGCONT)
        recorder.close()
    assert is_whole(read(out))


def killed(endless: Replay, out: Path, after_s: float) -> None:
    """Kill a recorder; everything up to a second before is there."""
    recorder = Recorder(out, endless.port, "--force")
    try:
        recorder.wait_for("Ctrl-C ends it")
        wait_until(lambda: recorder.size() > 0, "data")
        time.sleep(after_s)
        recorder.signal(signal.SIGKILL)
        at_ns = time.time_ns()
        recorder.wait()
    finally:
        recorder.close()
    frames = read(out)
    assert is_whole(frames)
    assert {item.sensor for item in frames} == {0, 1}
    for sensor in (0, 1):
        last = max(item.stamp_ns for item in frames if item.sensor == sensor)
        assert at_ns - last < 1_000_000_000


def test_killed_it_leaves_everything_up_to_a_second_before(endless: Replay, out: Path) -> None:
    for number in range(3):
        killed(endless, out, 0.3 + 0.31 * number)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_killed_twenty_times_it_leaves_everything_twenty_times(endless: Replay, out: Path) -> None:
    source = random.Random(4)
    for _ in range(20):
        killed(endless, out, source.uniform(0.1, 3))


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


def test_rotation_loses_nothing_between_the_files(endless: Replay, out: Path, run: Run) -> None:
    code, said = run(out, endless.port, "--seconds", "3.4", "--rotate-seconds", "1")
    assert code == 0, said
    parts = sorted(out.parent.glob("out_*.mcap"))
    assert len(parts) >= 3
    assert not out.exists()
    frames: list[DataMessage] = []
    for number, part in enumerate(parts):
        with open_recording(part) as recording:
            assert recording.metadata["part"] == str(number)
            assert recording.cut_off is None
            assert [sensor.serial for sensor in recording.sensors] == [100, 101]
            frames += recording.frames()
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
    recorder = Recorder(out, endless.port)
    try:
        wait_until(lambda: recorder.size() > 0, "data")
        code, said = run(out, endless.port, "--force", "--seconds", "0.3")
        assert code == 1
        assert "another ethercat-record is writing to it" in said
    finally:
        recorder.close()
    assert is_whole(read(out))


# -- arguments and servers that are not there


@pytest.mark.parametrize("rotate", [(), ("--rotate-size", "1M")])
def test_a_refusal_is_one_sentence_and_leaves_no_file(
    endless: Replay, out: Path, rotate: tuple[str, ...], run: Run
) -> None:
    code, said = run(out, endless.port, "--sensor", "3", "--seconds", "30", *rotate)
    assert code == 1
    last = said.splitlines()[-1]
    assert last.startswith("ethercat-record: the server refused: ")
    assert "nothing was lost" not in said
    assert not list(out.parent.glob("out*.mcap"))
    code, said = run(out, endless.port, "--sensor", "1", "--seconds", "0.3", *rotate)
    assert code == 0, said


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "required"),
        (("x.mcap", "localhost:99999"), "it must be HOST:PORT"),
        (("x.mcap", "--seconds", "-1"), "a number of seconds"),
        (("x.mcap", "--seconds", "nan"), "a number of seconds"),
        (("x.mcap", "--rotate-size", "10"), "at least 100k"),
        (("x.mcap", "--rotate-seconds", "0.1"), "at least 1 s"),
        (("x.mcap", "--sensor", "300"), "a position on the bus"),
        (("x.mcap", "--ros-namespace", "a"), "requires --ros"),
        (("x.mcap", "--ros", "--ros-namespace", "1a"), "a ROS namespace"),
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


def test_it_waits_for_a_server_if_it_is_told_to(source: Path, out: Path) -> None:
    port = free_port()
    recorder = Recorder(out, port, "--wait", "--no-reconnect")
    try:
        recorder.wait_for("waiting for a server")
        with replaying("--speed", "max", source, port=port):
            assert recorder.wait() == 0
    finally:
        recorder.close()
    assert len(read(out)) == SECOND


def test_a_signal_ends_the_wait(out: Path) -> None:
    recorder = Recorder(out, free_port(), "--wait")
    try:
        recorder.wait_for("waiting for a server")
        recorder.signal(signal.SIGINT)
        assert recorder.wait() == 0
        assert "nothing was recorded" in recorder.said()
    finally:
        recorder.close()


def test_a_sensor_that_is_not_there_is_said_by_the_server(endless: Replay, out: Path, run: Run) -> None:
    code, said = run(out, endless.port, "--sensor", "5")
    assert code == 1
    assert "names sensor 5, but the bus has 2" in said


def test_a_folder_that_is_not_there_is_said(out: Path, run: Run) -> None:
    code, said = run(out.parent / "no" / "x.mcap", free_port())
    assert code == 1
    assert "there is no folder" in said


# -- with a server


@pytest.mark.bus
@needs_bus
def test_settings_that_change_meanwhile_are_in_the_recording(out: Path) -> None:
    with server("virtual") as running, Client(running.port) as client:
        recorder = Recorder(out, running.port, "--ros")
        try:
            wait_until(lambda: recorder.size() > 0, "data")
            assert client.ask("configure", sensor=0, settings={"sinc_length": 128})["ok"]
            recorder.wait_for("reconfigured 0")
            size = recorder.size()
            wait_until(lambda: recorder.size() > size, "samples at the new rate")
            recorder.signal(signal.SIGINT)
            assert recorder.wait() == 0
        finally:
            recorder.close()
    with open_recording(out) as recording:
        (sensor,) = recording.sensors
        assert sensor.settings["sinc_length"] == 64
        assert (sensor.history[-1].values["sinc_length"], sensor.history[-1].rate_hz) == (128, 400)
        assert is_whole(list(recording.frames()))


@pytest.mark.long
@pytest.mark.bus
@needs_bus
@pytest.mark.timeout(300)
@pytest.mark.parametrize(("ros", "most"), [((), 0.15), (("--ros",), 0.25)], ids=["frames", "ros"])
def test_two_sensors_at_1600_hz_for_a_minute(out: Path, ros: tuple[str, ...], most: float) -> None:
    """Nothing lost between server and file, under 15 % of a core; with three ROS messages a frame, 25 %."""
    seconds = 60
    with server("virtual", "--virtual", "--sensors 2", "--set", "sinc_length=32") as running:
        recorder = Recorder(out, running.port, "--seconds", str(seconds), *ros)
        used = psutil.Process(recorder.process.pid)
        spent = 0.0
        try:
            while recorder.process.poll() is None:
                with contextlib.suppress(psutil.NoSuchProcess):
                    spent = max(spent, sum(used.cpu_times()[:2]))
                time.sleep(0.1)
            assert recorder.wait() == 0
            said = recorder.said()
        finally:
            recorder.close()
    print(f"{100 * spent / seconds:.1f} % of a core; {said}")
    frames = read(out)
    assert "not read in time" not in said
    assert "could not be written" not in said
    assert is_whole(frames)
    assert len(frames) > 0.95 * 2 * 1600 * seconds
    assert spent < most * seconds
    with Reader(out) as bag:  # another library's
        counts = {connection.topic: connection.msgcount for connection in bag.connections}
    assert counts[frame_topic(0)] + counts[frame_topic(1)] == len(frames)
    if ros:
        fresh = sum(item.sensor == 0 and not item.flags & OLD for item in frames)
        assert counts["/sensor_0/wrench"] == counts["/sensor_0/imu/data_raw"] == fresh
    with out.open("rb") as file:
        messages = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        assert sum(1 for _ in messages) == sum(counts.values())
