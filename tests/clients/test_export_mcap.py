"""`ethercat-export --mcap`: what other libraries refuse, or read nothing of, they read whole afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader, AnyReaderError

from bota_clients.export.cli import main
from bota_clients.identify.cli import main as identify
from bota_clients.recording.file_format import frame_topic
from bota_clients.recording.reader import REWRITTEN, open_recording
from bota_clients.report.series import of_recording
from bota_ethercat.pdo import ImuUnits
from tests.bridge.test_one_stream import recorded
from tests.clients.recordings import describe, frame, record, write
from tests.clients.running import Replay, frames_in
from tests.corpus import STREAMS
from tests.ended import completed, run_here
from tests.server.running import PATIENCE_S, wait_until

MAIN = "from bota_clients.export.cli import main; raise SystemExit(main())"
Message = tuple[str, int, int, int, bytes]


def messages(path: Path) -> list[Message]:
    """What `mcap` reads by the index at the end of the file: all, in the order in which they stand there."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(row.topic, msg.log_time, msg.publish_time, msg.sequence, msg.data) for _, row, msg in found]


def in_bag(path: Path) -> Counter[str]:
    """The messages by topic that `rosbags` decodes, by the definitions in the file."""
    with AnyReader([path]) as bag:
        return Counter(
            connection.topic
            for connection, _, data in bag.messages()
            if bag.deserialize(data, connection.msgtype)
        )


def export(*arguments: object) -> str:
    ended = run_here(main, *arguments)
    assert ended.code == 0, ended.err
    return ended.err


def test_what_a_recorder_that_was_killed_leaves_becomes_a_whole_file(tmp_path: Path) -> None:
    """SIGKILL, in the middle of it; afterwards the end of the disk's last block."""
    source, cut, out = (tmp_path / name for name in ("source.mcap", "cut.mcap", "whole.mcap"))
    record(source, (frame(number // 2, sensor=number % 2) for number in range(1600)), sensors=(0, 1))
    with Replay("--loop", source) as server:
        command = [sys.executable, "-m", "bota_clients.record.cli", str(cut), "--server", f":{server.port}"]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            wait_until(lambda: frames_in(cut) > 500, "the frames")
        finally:
            process.kill()
            process.wait(PATIENCE_S)
    with cut.open("ab") as file:
        file.write(bytes(512))
    for other in (messages, in_bag):
        with pytest.raises((McapError, AnyReaderError)):
            other(cut)

    said = export(cut, "--mcap", out)
    with open_recording(cut) as before, open_recording(out) as after:
        assert (before.end, after.end, after.cut_off) == (None, None, None)
        assert after.metadata == {**before.metadata, "repaired": before.cut_off}
        items = list(before.everything())
        assert list(after.everything()) == items
        frames = Counter(frame_topic(item.sensor) for item in before.frames())
    assert f"{out}: {frames.total()} frames\n" in said
    assert len(messages(out)) == len(items)
    decoded = in_bag(out)
    assert {topic: decoded[topic] for topic in frames} == frames
    assert decoded["/ethercat/description"] >= 1
    assert [each.name for each in tmp_path.iterdir() if each.name.startswith(".")] == []


def test_of_a_complete_recording_every_message_and_note_is_the_same(tmp_path: Path) -> None:
    """In many chunks; then of one sensor alone."""
    path, out = tmp_path / "run.mcap", tmp_path / "out.mcap"
    items: list[Any] = [frame(number // 2, sensor=number % 2) for number in range(3000)]
    for at in (2500, 1500, 500):
        items.insert(at, {"event": "reconfigured", "sensor": 0, "values": [0.1, None]})
    notes = {"reason": "asked to stop", "dropped": "7"}
    write(path, [describe(0, 1), *items], 1000, notes, started="today")
    export(path, out)
    assert messages(out) == messages(path)
    with open_recording(out) as recording:
        assert (recording.end, "repaired" in recording.metadata) == (notes, False)
    assert "1 500 frames" in export(path, "--sensor", 1, "--mcap", out, "--force")
    with open_recording(out) as recording:
        assert (recording.chosen, len(recording.events)) == ({1}, 3)
        assert [item.sequence for item in recording.frames()] == [*range(1500)]


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["--mcap", "out.mcap", "--all"], 2, "omit the other output, --all"),
        (["out.csv", "--mcap", "out.mcap"], 2, "omit the other output"),
        (["out.mcap", "--fps", "30"], 2, "omit the other output"),
        (["--mcap", "./run.mcap"], 2, "would overwrite the recording"),
        (["--mcap", "out.mcap", "--sensor", "3"], 1, "has no samples of sensor 3"),
        (["--mcap", "other.mcap"], 1, "other.mcap exists"),
        (["--mcap", "no/out.mcap"], 1, "no/out.mcap cannot be written"),
    ],
)
def test_what_it_refuses_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[Any], code: int, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    record(Path("run.mcap"), [frame(0)])
    Path("other.mcap").touch()
    ended = run_here(main, "run.mcap", *arguments)
    assert (ended.code, sentence in ended.err) == (code, True), ended.err
    assert sorted(each.name for each in tmp_path.iterdir()) == ["other.mcap", "run.mcap"]


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_recording_that_rosbags_has_written_again_is_the_same(compression: str, tmp_path: Path) -> None:
    """Without the recorder's notes, which is said. A process: rosbags has this as a program."""
    run, folder = recorded(STREAMS["offset_written"], tmp_path / "run.mcap"), tmp_path / "bag"
    command = ("--src", run, "--dst", folder, "--dst-storage", "mcap", "--compress-mode", "storage")
    done = completed(sys.executable, "-m", "rosbags.convert", *command, "--compress", compression)
    assert done.returncode == 0, done.stderr
    (again,) = folder.glob("*.mcap")
    assert f"{again} {REWRITTEN}" in export(again, tmp_path / "b.csv")
    assert f"{again} {REWRITTEN}" in run_here(identify, again).err
    assert f"The recording {REWRITTEN}." in of_recording(again, ImuUnits.G_DPS)[0].remarks
    export(run, tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_chunks_of_another_compressor_are_refused_as_what_they_are(tmp_path: Path) -> None:
    run = recorded(STREAMS["plain"], tmp_path / "run.mcap")
    run.write_bytes(run.read_bytes().replace(b"\x04\0\0\0zstd", b"\x04\0\0\0lz4f"))
    ended = run_here(main, run, tmp_path / "a.csv")
    what = f"{run} is compressed with lz4f, which is not read: write it again with zstd, or none"
    assert (ended.code, ended.err) == (1, f"ethercat-export: {what}\n")


def test_what_cannot_be_written_is_named_as_asked_for(tmp_path: Path) -> None:
    """A pipe or a device is written into, also by root; of a regular file nothing is left."""
    record(run := tmp_path / "run.mcap", map(frame, range(300)))
    (link := tmp_path / "link").symlink_to(tmp_path / "target.mcap")
    os.mkfifo(pipe := tmp_path / "pipe")
    read = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    for option in ("--mcap", "--ros"):
        for out in (pipe, link):
            assert f"{out}: " in export(run, option, out, "--force")
        assert (pipe.is_fifo(), link.is_symlink()) == (True, True)
        assert os.read(read, 1 << 20) == link.read_bytes()
        limited = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)); {MAIN}"
        done = completed(sys.executable, "-c", limited, run, option, tmp_path / "out.mcap")
        assert done.stderr == f"ethercat-export: {tmp_path / 'out.mcap'} cannot be written: File too large\n"
    assert {path.name for path in tmp_path.iterdir()} == {"run.mcap", "link", "target.mcap", "pipe"}
    os.close(read)
