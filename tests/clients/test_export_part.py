"""A part of a recording has what the whole has there, to the bit; what others left out can be given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from pyarrow import parquet
from rosbags.highlevel import AnyReader

from bota_clients.export.cli import main
from bota_clients.identify.cli import main as identify
from bota_clients.identify.last_offset import AtLastOffset
from bota_clients.recording.asked import Asked, Moment
from bota_clients.recording.file_format import DESCRIPTION_TOPIC
from bota_clients.recording.reader import REWRITTEN, UNKNOWN, open_recording
from bota_clients.report.cli import main as report
from bota_clients.report.series import of_recording
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits
from bota_ft_compensation.identification.parameter_file import write_payload
from tests.bridge.test_one_stream import recorded
from tests.clients.recordings import write
from tests.compensation.making import BIAS, TOOL
from tests.corpus import BEGIN_NS, EPOCH_NS, OFFSET, PERIOD_NS, STREAMS
from tests.ended import run_here

LOW, HIGH = 105_000_000, 385_000_000
START = EPOCH_NS + BEGIN_NS + PERIOD_NS  # of every stream
BEGIN, END = (f"{np.datetime64(START + each, 'ns')}Z" for each in (LOW, HIGH))
SECONDS = ["--from", LOW * 1e-9, "--to", f"{HIGH * 1e-9}s"]
STAMPS = ["--from", BEGIN, "--to", END]
PART = Asked(Moment("", LOW, is_stamp=False), Moment("", HIGH, is_stamp=False))


def export(*arguments: object) -> str:
    ended = run_here(main, *arguments, "--force")
    assert ended.code == 0, ended.err
    return ended.err


@pytest.fixture
def tool(tmp_path: Path) -> Path:
    path = tmp_path / "tool.yaml"
    write_payload(path, TOOL, "", [("bias", BIAS.values, ""), ("sensor_offset", OFFSET, "")])
    return path


@pytest.mark.parametrize("part", [SECONDS, STAMPS], ids=["seconds", "stamps"])
@pytest.mark.parametrize("name", STREAMS)
def test_a_table_has_the_rows_of_the_whole(name: str, part: list[Any], tool: Path, tmp_path: Path) -> None:
    """Compensated by filters that have seen what came before; windows, too."""
    run = recorded(STREAMS[name], tmp_path / "run.mcap")
    can = name not in ("compensated_by_the_sensor", "configured_frame", "imu_off")
    more: list[Any] = ["--sensor", 0, *(["--tool", tool] if can else [])]
    for options in (more, [*more, "--fps", 200, "--window", 8]):
        made = []
        for asked in ([], part):
            export(run, tmp_path / "out.npz", *options, *asked)
            made.append(dict(np.load(tmp_path / "out.npz")))
        whole, cut = made
        times = whole["stamp_ns" if "--fps" in options else "stamp_utc"].astype(np.int64) - START
        if part is SECONDS:
            times = whole["monotonic_ns"] - BEGIN_NS - PERIOD_NS
        held = (times >= LOW) & (times < HIGH)
        assert 0 < held.sum() < len(held)
        for column in {*whole} - {"attributes"}:
            assert cut[column].tobytes() == whole[column][held].tobytes(), column
    lines = []
    for asked in ([], part):
        export(run, tmp_path / "out.csv", "--sensor", 0, *asked)
        lines.append((tmp_path / "out.csv").read_text().splitlines())
    head, *rows = lines[0]
    held_rows = [row for row in rows if BEGIN <= row.split(",")[1] < END]
    if part is SECONDS:
        held_rows = [row for row in rows if LOW <= round(float(row.split(",")[0]) * 1e9) < HIGH]
    assert lines[1] == [head, *held_rows]


def test_messages_and_data_set_are_those_of_the_part_too(tool: Path, tmp_path: Path) -> None:
    run, table, folder = (
        recorded(STREAMS["offset"], tmp_path / "run.mcap"),
        tmp_path / "t.parquet",
        tmp_path / "d",
    )
    export(run, table, *STAMPS, "--tool", tool)
    rows = parquet.read_table(table)
    export(run, f"{folder}/", *STAMPS, "--tool", tool)
    (file,) = folder.rglob("*.parquet")
    again = parquet.read_table(file, partitioning=None).drop(["recording"])
    assert str(again.to_pydict()) == str(rows.to_pydict())
    export(run, "--ros", tmp_path / "ros.mcap", *STAMPS, "--tool", tool)
    with AnyReader([tmp_path / "ros.mcap"]) as bag:
        times = {stamp for _, stamp, _ in bag.messages()}
    assert times == {*rows["stamp_utc"].to_numpy().astype(np.int64).tolist()}


@pytest.mark.parametrize(
    "name", ["other_rate", "offset", "lost_and_back", "two_sensors", "larger_process_data"]
)
def test_a_part_is_read_as_the_file_that_has_only_this_part(name: str, tmp_path: Path) -> None:
    """Also what is in force: settings of before and after it are none of its own."""
    run, cut = recorded(STREAMS[name], tmp_path / "run.mcap"), tmp_path / "cut.mcap"
    export(run, cut, *SECONDS)
    with open_recording(run, PART) as part, open_recording(cut) as file, open_recording(run) as whole:
        items = list(part.everything())
        assert items == list(file.everything())
        frames = [each for each in whole.frames() if LOW <= each.monotonic_ns - BEGIN_NS - PERIOD_NS < HIGH]
        assert [each for each in items if isinstance(each, DataMessage)] == frames
        notes = [each for each in items if not isinstance(each, DataMessage)]
        assert (
            notes == [each for each in whole.everything() if not isinstance(each, DataMessage)][: len(notes)]
        )
        assert part.frame_count == file.frame_count
        for ours, theirs in zip(part.sensors, file.sensors, strict=True):
            assert (ours.info, ours.frames) == (theirs.info, theirs.frames)
            if ours.frames:
                mine, other = (AtLastOffset(each, ours, ImuUnits.G_DPS) for each in (part, file))
                assert [each.force.tolist() for each in mine] == [each.force.tolist() for each in other]
    subjects = of_recording(run, ImuUnits.G_DPS, PART), of_recording(cut, ImuUnits.G_DPS)
    found = [[(each.info, [row.force.tolist() for row in each.parts]) for each in side] for side in subjects]
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (["--from", "-3"], "'-3': it must be seconds from the start (30, 5min), or a time"),
        (["--from", 5, "--to", "2s"], "--from 5 is not before --to 2s"),
        (["--to", BEGIN, "--from", END], f"--from {END} is not before --to {BEGIN}"),
        (["--from", "1h"], "has nothing from 1h: it is 790 ms long, from 2023-11-14 22:30:00 UTC on"),
        (["--to", "2020-01-01T00:00Z"], "has nothing to 2020-01-01T00:00Z: it is"),
        (["--set", "sinc_length=64"], "says settings and rate itself: omit --set and --rate"),
        (["--set", "sinc=64"], "no setting 'sinc'"),
    ],
)
@pytest.mark.parametrize("program", [main, identify, report])
def test_what_cannot_be_is_one_sentence(program: Any, part: list[Any], said: str, tmp_path: Path) -> None:
    run = recorded(STREAMS["plain"], tmp_path / "run.mcap")
    ended = run_here(program, run, *part)
    assert said in ended.err.splitlines()[-1]
    assert ended.code == (2 if "before --to" in said or "must be" in said or "no setting" in said else 1)
    assert [*tmp_path.iterdir()] == [run]


def test_a_part_of_nothing_is_nothing(tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", [])
    ended = run_here(main, tmp_path / "run.mcap", "--from", 3)
    assert ended.err == f"ethercat-export: {tmp_path}/run.mcap has no samples\n"


def rewritten(source: Path, path: Path, *, described: bool = True, **options: Any) -> Path:
    """As other programs that use the library of MCAP write it: without metadata."""
    with source.open("rb") as old, path.open("wb") as new:
        writer: Any = Writer(new, **options)
        channels = dict[int, int]()
        writer.start("ros2")
        for schema, channel, each in make_reader(old).iter_messages(log_time_order=False):
            if not described and channel.topic == DESCRIPTION_TOPIC:
                continue
            if schema and channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                channels[channel.id], each.log_time, each.data, each.publish_time, each.sequence
            )
        writer.finish()
    return path


@pytest.mark.parametrize(
    "options", [{"use_chunking": False}, {"compression": CompressionType.LZ4}], ids=["bare", "lz4"]
)
def test_without_chunks_and_by_lz4_it_is_the_same(options: Any, tmp_path: Path) -> None:
    run = recorded(STREAMS["two_sensors"], tmp_path / "run.mcap")
    again = rewritten(run, tmp_path / "again.mcap", **options)
    with open_recording(run) as before, open_recording(again) as after:
        assert list(after.everything()) == list(before.everything())
        assert after.remarks == [REWRITTEN]
    data = again.read_bytes()
    again.write_bytes(data[: len(data) * 2 // 3])
    with open_recording(run) as before, open_recording(again) as after:
        found = list(after.everything())
        assert found == list(before.everything())[: len(found)] != []
        assert (after.cut_off or "").startswith("it has no footer")


@pytest.mark.parametrize("name", ["gaps", "lost_and_back"])
@pytest.mark.parametrize("given", [["--set", "sinc_length=512", "--set", "fir=no"], ["--rate", 100]])
def test_what_a_recording_no_longer_says_can_be_given(name: str, given: list[Any], tmp_path: Path) -> None:
    """An event says only what is in force after it."""
    run = recorded(STREAMS[name], tmp_path / "run.mcap")
    again, tables = rewritten(run, tmp_path / "again.mcap", described=False), []
    ended = run_here(main, again, tmp_path / "out.npz")
    assert (ended.code, UNKNOWN.format(0) in ended.err) == (1, True)
    for path, more in ((run, []), (again, given)):
        assert "settings and rate" not in export(path, tmp_path / "out.npz", "--sensor", 0, *more)
        tables.append(dict(np.load(tmp_path / "out.npz")))
        tables[-1].pop("attributes")
    assert [*map(np.ndarray.tobytes, tables[1].values())] == [*map(np.ndarray.tobytes, tables[0].values())]
    for more in ([], given):
        said = run_here(report, again, "--force", *more).out
        assert (UNKNOWN.format(0) in said) == (not more)
