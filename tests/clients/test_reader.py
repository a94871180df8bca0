"""What was recorded is read back; what was cut off is read as far as it goes; what is damaged is refused."""

from __future__ import annotations

import itertools
import random
import re
import struct
import zlib
from collections import OrderedDict, defaultdict
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
from bota_clients.recording.reader import REWRITTEN, open_recording
from bota_clients.report.series import of_recording
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import ImuUnits, SampleDecoder
from bota_ethercat.replies import SensorInfo
from bota_ethercat.stream.timeline import InForce, Timeline
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


def test_settings_and_offsets_are_in_force_since_they_were_told_first(path: Path) -> None:
    six = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    first, then = describe(0, chop=False), describe(0)
    first["sensors"][0]["serial"] = 2**32 - 1
    then["sensors"][0] |= {"settings": {"sinc_length": 32}, "rate_hz": 1600, "serial": 2**32 - 1}
    told: Any = {"event": "offset_changed", "sensor": 0, "offset": six}
    event: Any = {"event": "reconfigured", "sensor": 0, "settings": {"sinc_length": 32}, "offset": six}
    items = [first, frame(7), told, frame(8), event, then, frame(9), describe(0, chop=True), frame(10)]
    write(path, items, end={"reason": "asked to"})
    with open_recording(path) as recording:
        (sensor,) = recording.sensors
        assert sensor.info.serial == 2**32 - 1
        assert sensor.info.settings == {"sinc_length": 64, "chop": False}
        assert [type(item) for item in recording.everything()] == [
            RecordedDescription, DataMessage, RecordedEvent, DataMessage, RecordedEvent, RecordedDescription,
            DataMessage, RecordedDescription, DataMessage,
        ]  # fmt: skip
        assert [each.name for each in recording.events] == ["offset_changed", "reconfigured"]
        assert not recording.events[1].by_recorder
        assert recording.end == {"reason": "asked to"}
    history, offsets = (
        [
            (
                (at - START_NS) // PERIOD_NS,
                now.info.settings["sinc_length"],
                now.info.rate_hz,
                now.info.offset,
            )
            for at, now in each
        ]
        for each in (sensor.history, sensor.offsets)
    )
    assert history == [(0, 64, 800, tuple(six)), (8, 32, 1600, None), (9, 64, 800, None)]
    assert offsets == [(0, 64, 800, None), (7, 64, 800, tuple(six)), (8, 32, 1600, None)]


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


@pytest.mark.parametrize("seed", range(12))
def test_any_valid_file_is_read_as_the_mcap_library_reads_it(tmp_path: Path, seed: int) -> None:
    """Chunks of all sizes, two sensors of different process data on any channels, notes and other messages
    between, other writers; and an index that counts too few messages.
    """
    draw, path = random.Random(seed), tmp_path / "any.mcap"
    with path.open("wb") as file:
        kind = draw.choice((CompressionType.ZSTD, CompressionType.NONE))
        size, has_crc, has_index = draw.choice((1, 300, 9000, 1 << 20)), draw.random() < 0.5, seed % 3 > 0
        index = IndexType.ALL if has_index else IndexType.NONE
        made = Writer(file, size, kind, index_types=index, enable_data_crcs=has_crc)
        made.start("ros2", "any")
        if seed % 4:
            made.add_metadata(file_format.METADATA, {"format": "1", "sensors": "0 ² x " * 170 + "7 1234"})
        schemas = {
            name: made.register_schema(name, "ros2msg", text.encode())
            for name, text in file_format.DEFINITIONS.items()
        }
        first, second = (file_format.frame_topic(sensor) for sensor in (0, 1))
        notes = file_format.EVENTS_TOPIC, file_format.DESCRIPTION_TOPIC
        topics = [first, second, *notes, "/other", first, second]
        from_ = draw.choice((0, 32_765, 65_528))
        numbered = type("Numbered", (OrderedDict,), {"__len__": lambda it: from_ + OrderedDict.__len__(it)})
        made._Writer__channels = numbered()  # type: ignore[attr-defined]
        channels = [
            made.register_channel(topic, "cdr", schemas[list(schemas)[topic.startswith("/ethercat/sensor")]])
            for topic in topics
        ]
        epochs = itertools.count()
        for number in range(draw.choice((40, 900))):
            sensor = draw.choice((0, 1)) if seed % 2 else number // 50 % 2
            item = frame(number, sensor, draw.choice((0, 0, 0, 1, 2, 4)), draw.choice((61, 61, 77)))
            channel = channels[sensor + draw.choice((0, 0, 0, 5))]
            made.add_message(channel, item.stamp_ns, file_format.pack_frame(item), item.stamp_ns)
            for of, body in (
                (0, {"event": "x" * draw.randrange(90), "number": number}),
                (0, {"event": "offset_changed", "sensor": draw.randrange(2), "offset": [float(number)] * 6}),
                (0, {"event": draw.choice(("connected", "lost")), "source": "recorder"}),
                (1, describe(*draw.choice(((0,), (1, 0))), sinc_length=32 + next(epochs))),
            ):
                if draw.random() < 0.02:
                    made.add_message(
                        channels[2 + of], item.stamp_ns, file_format.pack_json(body), item.stamp_ns
                    )
            if draw.random() < 0.1:
                made.add_message(channels[4], item.stamp_ns, bytes(draw.randrange(200)), item.stamp_ns)
        made.finish()  # type: ignore[no-untyped-call]
    with path.open("rb") as file:
        told = [
            (topic.topic, message.data, message.log_time)
            for _, topic, message in NonSeekingReader(file).iter_messages(log_time_order=False)
        ]
    frames = [
        file_format.unpack_frame(data, (first, second).index(topic))
        for topic, data, _ in told
        if topic in (first, second)
    ]
    in_force, timeline = defaultdict[int, list[InForce]](list), Timeline()
    items, begins = list[Any](), dict[int, InForce]()
    for topic, data, at_ns in told:
        if topic in (first, second):
            items.append(file_format.unpack_frame(data, (first, second).index(topic)))
            in_force[items[-1].sensor].append(timeline[items[-1].sensor])
        elif topic in notes:
            said = file_format.unpack_json(data, topic)
            items.append((RecordedEvent, RecordedDescription)[topic == notes[1]](at_ns, said))
            if topic == notes[1]:
                for now in timeline.describe(said):
                    begins.setdefault(now.sensor, now)
            elif said.get("source") != "recorder":
                for now in timeline.event(said):
                    begins.setdefault(now.sensor, InForce(SensorInfo(now.sensor)))
            elif said["event"] == "connected":
                timeline.connected({})
    if is_wrong := has_index and seed % 2 > 0:
        path.write_bytes(with_fewer_in_index(path.read_bytes(), draw))
    with open_recording(path) as recording:
        assert (recording.cut_off, REWRITTEN in recording.remarks) == (None, seed % 4 == 0)
        assert recording.chosen == ({0, 7, 12} if seed % 4 else set())
        assert [*recording.everything()] == items
        assert recording.events == [each for each in items if isinstance(each, RecordedEvent)]
        counts = [sum(each.sensor == sensor for each in frames) for sensor in (0, 1)]
        assert [each.sensor for each in recording.sensors] == [0, 1]
        if not is_wrong:
            assert [each.frames for each in recording.sensors] == counts
            assert recording.frame_count == sum(counts)
        for sensor in (0, 1):
            own = [each for each in frames if each.sensor == sensor]
            assert str(recording.columns(sensor)) == str(columns(own))
            assert list(recording.frames(sensor)) == own
            # What a description tells first was in force before it.
            told_first = begins.get(sensor, InForce(SensorInfo(sensor)))
            expected = [each if each.is_described else told_first for each in in_force[sensor]]
            batches = [(now, part.sequence.tolist()) for now, part in recording.batches(sensor)]
            assert [number for _, part in batches for number in part] == [each.sequence for each in own]
            assert [now for now, part in batches for _ in part] == expected
        assert [*recording.batches(7)] == []
        tables = [each for each in recording.tables() if isinstance(each, np.ndarray)]
        numbers = [int(row) for each in tables for row in each["sequence"]]
        assert numbers == [each.sequence for each in frames]


def with_fewer_in_index(data: bytes, draw: random.Random) -> bytes:
    """As of a writer whose message indexes are shorter than their records."""
    found, position = bytearray(data), 8
    while found[position] != 0x0F:
        opcode, length = struct.unpack_from("<BQ", found, position)
        if opcode == 0x07:
            (size,) = struct.unpack_from("<I", found, position + 11)
            struct.pack_into("<I", found, position + 11, 16 * draw.randrange(size // 16 + 1))
        position += 9 + length
    return bytes(found)


@pytest.mark.parametrize("size", [61, 77])
@pytest.mark.parametrize("name", ["", "cdr", "sensor", "length", "size"])
def test_what_is_no_frame_of_the_sensor_is_an_error_wherever_it_is(path: Path, name: str, size: int) -> None:
    record(path, [frame(number, size=size, sensor=3) for number in range(5)], sensors=(3,))
    with open_recording(path) as recording:
        _, rows, _ = cast("tuple[Any, Any, None]", [*recording._parts(3)])
        rows, sensors = rows.copy(), recording._of
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


def test_what_is_no_recording_or_not_there_is_refused(path: Path) -> None:
    whole = path.read_bytes()
    no_recording = "is not an MCAP file|was cut off before anything was recorded"
    for what in (b"", b"x", b"hello, I am no MCAP file", bytes(4096), whole[:7], whole[:8], whole[:20]):
        path.write_bytes(what)
        with pytest.raises(RecordingError, match=no_recording):
            open_recording(path)
    write(path, [], format="99")
    for named, said in (
        (path, "'99'"),
        (path.with_name("no.mcap"), "No such file"),
        (path.parent, "directory"),
    ):
        with pytest.raises(RecordingError, match=said):
            open_recording(named)
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
