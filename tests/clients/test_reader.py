"""What was recorded is read back; what was cut off is read as far as it goes; what is damaged is refused."""

from __future__ import annotations

import itertools
import random
import re
import struct
import zlib
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import zstandard
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer

from bota_clients.errors import RecordingError
from bota_clients.identify.last_offset import AtLastOffset
from bota_clients.recording import file_format
from bota_clients.recording.columns import RECORD, columns, joined, table_of
from bota_clients.recording.file_format import RecordedDescription, RecordedEvent
from bota_clients.recording.mcap_file import MAX_CHUNK, McapFile
from bota_clients.recording.reader import open_recording
from bota_clients.report.series import of_recording
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import ImuUnits, SampleDecoder
from tests.clients.recordings import PERIOD_NS, START_NS, describe, frame, record, write
from tests.clients.test_export_windows import tared

DOCS = (Path(__file__).parents[2] / "docs" / "recording.md").read_text()
CHUNKS = 10
PER_CHUNK = 30


FRAMES = [frame(number) for number in range(CHUNKS * PER_CHUNK)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Of a recording of FRAMES."""
    path = tmp_path / "run.mcap"
    record(path, FRAMES, PER_CHUNK)
    return path


def chunk_ends(path: Path) -> list[int]:
    """Where the parts of a recording end that a flush wrote: behind the index of each chunk."""
    data, position, ends = path.read_bytes(), 8, []
    while data[position] != 0x0F:
        opcode, length = struct.unpack_from("<BQ", data, position)
        position += 9 + length
        if opcode == 0x07 and data[position] != 0x07:
            ends.append(position)
    return ends


def test_frames_come_back_byte_for_byte(path: Path) -> None:
    with open_recording(path) as recording:
        assert list(recording.frames()) == FRAMES
        assert recording.frame_count == len(FRAMES)
        assert (recording.cut_off, recording.end) == (None, {})
    extreme = DataMessage(2**64 - 1, 2**64 - 1, 2**64 - 1, 255, 255, 65535, bytes(range(77)))
    record(path, [extreme], sensors=(255,))
    with open_recording(path) as recording:
        assert list(recording.frames(255)) == [extreme]
        found = recording.columns(255)
    assert found.stamp_ns == found.monotonic_ns == found.sequence == [2**63 - 1], "the latest there is"
    assert (found.flags.tolist(), found.wkc.tolist()) == ([255], [65535])


def test_sensors_are_told_apart(path: Path) -> None:
    record(path, (frame(n, sensor=n % 2) for n in range(100)), sensors=(0, 1))
    with open_recording(path) as recording:
        assert [f.sequence for f in recording.frames(1)] == list(range(1, 100, 2))
        assert [(s.sensor, s.info.serial, s.frames) for s in recording.sensors] == [
            (0, 100, 50),
            (1, 101, 50),
        ]
        assert list(recording.frames(7)) == []


def test_settings_are_known_over_time(path: Path) -> None:
    first, then = describe(0, chop=False), describe(0)
    first["sensors"][0]["serial"] = 2**32 - 1
    then["sensors"][0] |= {"settings": {"sinc_length": 32}, "rate_hz": 1600, "serial": 2**32 - 1}
    event: Any = {"event": "reconfigured", "sensor": 0, "settings": {"sinc_length": 32}}
    write(path, [first, frame(8), event, then, frame(9)], end={"reason": "asked to"})
    with open_recording(path) as recording:
        (sensor,) = recording.sensors
        assert sensor.info.serial == 2**32 - 1
        assert sensor.info.settings == {"sinc_length": 64, "chop": False}
        history = [
            (at - START_NS, now.info.settings["sinc_length"], now.info.rate_hz) for at, now in sensor.history
        ]
        assert history == [(0, 64, 800), (8 * PERIOD_NS, 32, 1600)]
        assert [type(item) for item in recording.everything()] == [
            RecordedDescription, DataMessage, RecordedEvent, RecordedDescription, DataMessage,
        ]  # fmt: skip
        assert recording.events[0].name == "reconfigured"
        assert not recording.events[0].by_recorder
        assert recording.end == {"reason": "asked to"}


def test_before_it_was_told_what_is_in_force_is_what_was_told_first(path: Path) -> None:
    told = [describe(0) | {"sensors": [describe(0)["sensors"][0] | {"rate_hz": hz}]} for hz in (800, 1600)]
    write(path, [frame(0), frame(1), told[0], frame(2), told[1], frame(3)])
    with open_recording(path) as recording:
        found = [(in_force.info.rate_hz, batch.sequence.tolist()) for in_force, batch in recording.batches(0)]
    assert found == [(800, [0, 1]), (800, [2]), (1600, [3])]


def test_columns_are_what_the_decoder_gives(path: Path) -> None:
    source = random.Random(1)
    names = ("force.y", "torque.z", "acceleration.x", "acceleration.z", "angular_rate.y", "temperature")
    values: dict[str, Any] = {name: source.uniform(-50, 50) for name in names}
    orientation: dict[str, Any] = {"orientation.w": 1.0}
    old = DataFlag.REPEATED
    made = [
        frame(0, **values, warnings=0x80000001, force_torque_saturated=0x21),
        frame(1, flags=old, size=77, **values, **orientation),
        frame(2, size=77, acceleration_saturated=4),
    ]
    record(path, made)
    with open_recording(path) as recording:
        table = recording.columns(0)
        assert str(table) == str(columns(recording.frames()))
    for row, item in enumerate(made):
        sample = SampleDecoder(len(item.process_data)).decode(item.process_data)
        for name in ("force", "torque", "acceleration", "angular_rate"):
            assert tuple(getattr(table, name)[row]) == getattr(sample, name)
        assert table.temperature[row] == sample.temperature
        assert table.warnings[row] == sample.warnings
        assert table.force_torque_saturated[row] == sample.force_torque_saturated
        assert table.acceleration_saturated[row] == sample.acceleration_saturated
        assert (table.sequence[row], table.stamp_ns[row]) == (item.sequence, item.stamp_ns)
    assert str(table.orientation[:, 3].tolist()) == "[nan, 1.0, nan]"
    assert list(table.fresh) == [True, False, True]
    assert list(table.where(table.fresh).sequence) == [0, 2]

    record(path, [])
    with open_recording(path) as recording:
        table = recording.columns(0)
    assert (len(table), table.force.shape, table.orientation.shape) == (0, (0, 3), (0, 4))


@pytest.mark.parametrize("seed", range(6))
def test_any_valid_file_is_read_as_the_mcap_library_reads_it(tmp_path: Path, seed: int) -> None:
    """Chunks of all sizes, two sensors of different process data, other messages between, other writers."""
    draw, path = random.Random(seed), tmp_path / "any.mcap"
    with path.open("wb") as file:
        kind = draw.choice((CompressionType.ZSTD, CompressionType.NONE))
        size, has_crc, has_index = draw.choice((1, 300, 9000, 1 << 20)), draw.random() < 0.5, seed % 3 > 0
        index = IndexType.ALL if has_index else IndexType.NONE
        made = Writer(file, size, kind, index_types=index, enable_data_crcs=has_crc)
        made.start("ros2", "any")
        made.add_metadata(file_format.METADATA, {"format": "1"})
        schemas = {
            name: made.register_schema(name, "ros2msg", text.encode())
            for name, text in file_format.DEFINITIONS.items()
        }
        topics = [file_format.frame_topic(sensor) for sensor in (0, 1)] + [file_format.EVENTS_TOPIC, "/other"]
        channels = [
            made.register_channel(topic, "cdr", schemas[list(schemas)[topic.startswith("/ethercat/sensor")]])
            for topic in topics
        ]
        for number in range(draw.choice((40, 900))):
            sensor = draw.choice((0, 1)) if seed % 2 else number // 50 % 2
            item = frame(number, sensor, draw.choice((0, 0, 0, 1, 2, 4)), draw.choice((61, 61, 77)))
            made.add_message(channels[sensor], item.stamp_ns, file_format.pack_frame(item), item.stamp_ns)
            if draw.random() < 0.05:
                event = file_format.pack_json({"event": "x" * draw.randrange(90), "number": number})
                made.add_message(channels[2], item.stamp_ns, event, item.stamp_ns)
            if draw.random() < 0.1:
                made.add_message(channels[3], item.stamp_ns, bytes(draw.randrange(200)), item.stamp_ns)
        made.finish()  # type: ignore[no-untyped-call]
    with path.open("rb") as file, open_recording(path) as recording:
        told = [
            (topic.topic, message.data)
            for _, topic, message in NonSeekingReader(file).iter_messages(log_time_order=False)
        ]
        for sensor in (0, 1):
            own = [file_format.unpack_frame(data, sensor) for topic, data in told if topic == topics[sensor]]
            assert str(recording.columns(sensor)) == str(columns(own))
            assert list(recording.frames(sensor)) == own
        tables = [each for each in recording.tables() if not isinstance(each, RecordedEvent)]
        numbers = [int(row) for each in tables for row in cast(Any, each)["sequence"]]
        assert numbers == [each.sequence for each in recording.frames()]
        assert [each.event for each in recording.events] == [
            file_format.unpack_json(data, topic) for topic, data in told if topic == topics[2]
        ]


@pytest.mark.parametrize("size", [61, 77])
@pytest.mark.parametrize("name", ["", "cdr", "sensor", "length", "size"])
def test_what_is_no_frame_of_the_sensor_is_an_error_wherever_it_is(path: Path, name: str, size: int) -> None:
    record(path, [frame(number, size=size, sensor=3) for number in range(5)], sensors=(3,))
    with open_recording(path) as recording:
        ((_, *parts),) = [[*recording._parts(recording._channels(3))]]
        ((rows, sensors),) = cast("list[tuple[Any, Any]]", parts)
        rows = rows.copy()
    if not name:
        assert table_of([rows[:2], rows[2:]], sensors)["sequence"].tolist() == [0, 1, 2, 3, 4]
        return
    assert RECORD.fields is not None
    at = int(RECORD.fields[name][1])
    for row in range(5):
        broken = rows.copy()
        broken[row, at] ^= 1
        with pytest.raises(RecordingError):
            table_of([broken], sensors)


def test_frames_of_both_sizes_are_read_together(path: Path) -> None:
    """In one table, as far as a batch goes; what only one has is not known of the other."""
    orientation: dict[str, Any] = {"orientation.x": 0.5, "orientation.w": 0.25}
    made = [frame(n, size=61 + 16 * (n % 7 > 3), **(orientation if n % 7 > 3 else {})) for n in range(10_000)]
    record(path, made)
    with open_recording(path) as recording:
        tables = [each for each in recording.tables(0) if isinstance(each, np.ndarray)]
        assert [len(each) for each in tables] == [4096, 4096, 10_000 - 2 * 4096]
        found = recording.columns(0)
    assert found.sequence.tolist() == [*range(10_000)]
    assert found.force[:, 0].tolist() == [*range(10_000)]
    has = np.arange(10_000) % 7 > 3
    assert (np.isfinite(found.orientation).all(axis=1) == has).all()
    assert found.orientation[4].tolist() == [0.5, 0.0, 0.0, 0.25]


# -- cut off


def test_cut_anywhere_everything_up_to_the_last_whole_chunk_is_read(path: Path, tmp_path: Path) -> None:
    data, ends = path.read_bytes(), chunk_ends(path)
    assert len(ends) == CHUNKS
    source = random.Random(2)
    cuts = {*ends, *(end + 1 for end in ends), *(end - 1 for end in ends), len(data) - 1}
    cuts |= {source.randrange(ends[0], len(data)) for _ in range(60)}
    for cut in cuts:
        part = tmp_path / "part.mcap"
        part.write_bytes(data[:cut])
        whole = sum(end <= cut for end in ends)
        with open_recording(part) as recording:
            found = list(recording.frames())
            assert found == FRAMES[: len(found)], cut
            assert whole * PER_CHUNK <= len(found) <= (whole + 1) * PER_CHUNK, cut
            assert recording.cut_off, cut
            assert recording.end is None or cut > ends[-1]


def test_an_empty_tail_after_a_power_failure_is_left_out(path: Path) -> None:
    data, ends = path.read_bytes(), chunk_ends(path)
    path.write_bytes(data[: ends[4]] + bytes(4096))
    with open_recording(path) as recording:
        assert list(recording.frames()) == FRAMES[: 5 * PER_CHUNK]
        assert "4096 bytes" in str(recording.cut_off)
    # The length is there, the blocks behind it are not.
    path.write_bytes(data[: ends[4] + 100] + bytes(ends[5] - ends[4] - 100))
    with open_recording(path) as recording:
        assert list(recording.frames()) == FRAMES[: 5 * PER_CHUNK]
        assert recording.cut_off
    # Nor those of the last three chunks, whose records are there.
    gone = bytearray(data[: ends[5]])
    for begin, end in itertools.pairwise(ends[2:6]):
        gone[begin + 60 : begin + 200] = bytes(140)
        assert (gone[begin], begin + 200 < end) == (0x06, True)
    path.write_bytes(gone)
    with open_recording(path) as recording:
        assert list(recording.frames()) == FRAMES[: 3 * PER_CHUNK]
        assert str(recording.cut_off) == "it has no footer, and is read without 3 damaged chunks at its end"


# -- damaged and hostile


def test_other_files_and_what_was_cut_off_before_the_first_chunk_are_refused(path: Path) -> None:
    whole = path.read_bytes()
    no_recording = "is not an MCAP file|was cut off before anything was recorded"
    for what in (b"", b"x", b"hello, I am no MCAP file", bytes(4096), whole[:7], whole[:8], whole[:20]):
        path.write_bytes(what)
        with pytest.raises(RecordingError, match=no_recording):
            open_recording(path)


def test_what_is_not_there_or_another_format_is_said(path: Path) -> None:
    write(path, [], format="99")
    with pytest.raises(RecordingError, match="'99'"):
        open_recording(path)
    with pytest.raises(RecordingError, match="No such file"):
        open_recording(path.with_name("no.mcap"))
    with pytest.raises(RecordingError, match="directory"):
        open_recording(path.parent)
    assert file_format.FORMAT_VERSION == "1"


def test_a_flipped_bit_in_a_chunk_is_found(path: Path) -> None:
    data, ends = bytearray(path.read_bytes()), chunk_ends(path)
    data[ends[3] + 200] ^= 0x10
    path.write_bytes(data)
    with open_recording(path) as recording:
        found = recording.frames()
        assert [next(found) for _ in range(4 * PER_CHUNK)] == FRAMES[: 4 * PER_CHUNK]
        with pytest.raises(RecordingError, match="damaged at byte"):
            next(found)


def test_no_flipped_byte_does_more_than_an_error(path: Path) -> None:
    record(path, (frame(number) for number in range(40)), 20)
    data = path.read_bytes()
    source, sentences = random.Random(3), []
    for _ in range(300):
        hostile = bytearray(data)
        for _ in range(source.choice((1, 1, 2, 8))):
            hostile[source.randrange(len(hostile))] = source.choice((0, 0xFF, 0x7F, source.randrange(256)))
        path.write_bytes(hostile[: source.choice((len(data), source.randrange(len(data))))])
        try:
            with open_recording(path) as recording:
                list(recording.everything())
        except RecordingError as error:
            sentences.append(str(error))
    assert sentences
    assert not any("\n" in sentence for sentence in sentences)


def chunk(body: bytes, size: int, packed: bytes, compression: bytes = b"zstd") -> bytes:
    head = struct.pack("<QQQII", 0, 0, size, zlib.crc32(body), len(compression)) + compression
    record_body = head + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(record_body)) + record_body


@pytest.mark.parametrize(
    ("size", "packed"),
    [
        (MAX_CHUNK + 1, b"x"),
        (2**63, b"x"),
        (100, zstandard.compress(bytes(50_000_000))),
        (50, zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1_000_000))),
    ],
)
def test_a_chunk_that_claims_more_than_it_may_is_refused(path: Path, size: int, packed: bytes) -> None:
    record(path, [frame(0)])
    data, end = path.read_bytes(), chunk_ends(path)[0]
    path.write_bytes(data[:end] + chunk(b"", size, packed) + data[end:])
    with pytest.raises(RecordingError, match="damaged at byte"):
        open_recording(path)


def test_a_text_that_is_no_json_is_refused(path: Path) -> None:
    record(path, [frame(0)])
    file = McapFile(path)
    number = next(n for n, topic in file.topics.items() if topic == file_format.DESCRIPTION_TOPIC)
    file.close()
    body = struct.pack("<HIQQ", number, 0, 0, 0) + b"\x00\x01\x00\x00" + struct.pack("<I", 2) + b"[\0"
    body = struct.pack("<BQ", 5, len(body)) + body
    data, end = path.read_bytes(), chunk_ends(path)[0]
    path.write_bytes(data[:end] + chunk(body, len(body), zstandard.compress(body)) + data[end:])
    with pytest.raises(RecordingError, match="not JSON"):
        open_recording(path)


# -- docs/recording.md


def test_every_topic_and_schema_is_described() -> None:
    for name in (
        file_format.frame_topic(0).replace("0", "N"), file_format.DESCRIPTION_TOPIC, file_format.EVENTS_TOPIC,
        *file_format.DEFINITIONS, file_format.METADATA, file_format.END_METADATA,
    ):  # fmt: skip
        assert f"`{name}`" in DOCS, name


def test_the_bytes_of_a_frame_are_as_described() -> None:
    text = DOCS[DOCS.index("`bota_ethercat/msg/Frame` is") : DOCS.index("u32 length")]
    item = frame(7, sensor=3, flags=5)
    body = file_format.pack_frame(item)
    at, size, seen = 4, 0, dict[str, int]()
    for bits, name in re.findall(r"u(\d+)\s|`(\w+)`", text):
        size = int(bits) // 8 if bits else size
        if name:
            at, seen[name] = at + size, int.from_bytes(body[at : at + size], "little")
    assert seen == dict(zip(DataMessage._fields[:6], item[:6], strict=True))
    assert body.startswith(bytes.fromhex("00010000"))
    assert struct.unpack_from("<I", body, 32) == (len(item.process_data),)
    assert body[36:] == item.process_data


def test_the_example_reads_a_recording(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(path.parent)
    (example,) = re.findall(r"```python\n([^`]*open_recording.*?)```", DOCS, re.DOTALL)
    exec(compile(example, "docs/recording.md", "exec"), {})


def test_only_what_is_around_a_change_of_the_sensors_own_offset_is_left_out(tmp_path: Path) -> None:
    """0.1 s before it was told and two samples after, none where it is told again; announced: not before."""
    path = tared(tmp_path / "run.mcap", (1.0, 1.0, 2.0, None, 4.0), (5.0, 5.0, 6.0, 7.3, 8.0))
    with open_recording(path) as recording:
        read = AtLastOffset(recording, recording.sensors[0], ImuUnits.SI)
        found = joined([*read])
    remarks = ["800 frames left out: the sensor's own offset was not known"]
    assert (read.offset, read.said) == ((4.0, 0, 0, 0, 0, 0), remarks)
    assert found.force[:, 0] == pytest.approx(8.0)
    assert sorted({*range(4000)} - {*found.sequence.tolist()}) == [*range(1520, 1603), *range(2400, 3203)]
    (remark,) = (each for each in of_recording(path, ImuUnits.SI)[0].remarks if "own offset" in each)
    assert remark.startswith("The sensor's own offset was changed 2 times (by a tare, say): ")


def test_before_a_change_that_was_announced_no_sample_is_in_doubt(tmp_path: Path) -> None:
    items: list[Any] = [describe(0, fir=False)]
    items[0]["sensors"][0]["offset"] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    for begin, end, offset in ((0, 800, None), (800, 810, [2.0, 4.0, 6.0, 8.0, 1.0, 1.0]), (810, 1600, None)):
        items += [frame(number) for number in range(begin, end)]
        if end < 1600:
            items.append({"event": "offset_changed", "sensor": 0, "offset": offset})
    write(path := tmp_path / "run.mcap", items)
    with open_recording(path) as recording:
        read = AtLastOffset(recording, recording.sensors[0], ImuUnits.SI)
        found = joined([*read])
    assert sorted({*range(1600)} - {*found.sequence.tolist()}) == [*range(800, 813)]
    assert read.said == ["10 frames left out: the sensor's own offset was not known"]
    as_later = (found.force[[0, -1]].tolist(), found.torque[[0, -1]].tolist())
    assert as_later == ([[1, 2, 3], [1599, 0, 0]], [[4, -4, -5], [0, 0, 0]])


def test_settings_are_in_force_since_they_were_told_first_and_offsets_likewise(tmp_path: Path) -> None:
    six = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    items: list[Any] = [
        describe(0),
        frame(8),
        {"event": "offset_changed", "sensor": 0, "offset": six},
        frame(9),
    ]
    write(path := tmp_path / "run.mcap", [*items, describe(0, chop=True), frame(10)])
    with open_recording(path) as recording:
        (sensor,) = recording.sensors
    rows = [
        [((at - START_NS) // PERIOD_NS, now.info.settings.get("chop"), now.info.offset) for at, now in each]
        for each in (sensor.history, sensor.offsets)
    ]
    assert rows[0] == [(0, None, tuple(six)), (9, True, None)]
    assert rows[1] == [(0, None, None), (8, None, tuple(six)), (9, True, None)]
