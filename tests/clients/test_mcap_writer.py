"""The writer's files beside those of the `mcap` library: of the same messages they are the same."""

from __future__ import annotations

import errno
import tempfile
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from bota_clients.recording.mcap_writer import DiskFile, McapWriter, message_rows
from tests.clients.recordings import START_NS


def fail(**_: object) -> None:
    raise OSError(errno.ENOTSUP, "Operation not supported")


DATA_END = b"\x0f\x04\0\0\0\0\0\0\0"


@pytest.mark.parametrize("is_lacking", [False, True])
def test_a_file_is_that_of_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_lacking: bool
) -> None:
    """To the byte up to the end of the data, and the summary behind it."""
    if is_lacking:  # a file system without files that have no name
        monkeypatch.setattr(tempfile, "TemporaryFile", fail)
    ours, theirs = tmp_path / "ours.mcap", tmp_path / "theirs.mcap"
    made = McapWriter(disk := DiskFile(ours, overwrite=False), "ros2", "test")
    library = Writer(str(theirs), 1 << 30, CompressionType.ZSTD, enable_data_crcs=True)
    library.start("ros2", "test")
    for number, (topic, schema) in enumerate((("/a", "A"), ("/b", "B")), 1):
        assert made.channel(topic, schema, schema.lower(), more=topic) == number
        of = library.register_schema(schema, "ros2msg", schema.lower().encode())
        assert library.register_channel(topic, "cdr", of, {"more": topic}) == number
    for begin_ns, name in enumerate(("first", "last"), START_NS):
        made.metadata(name, {"k": name})
        library.add_metadata(name, {"k": name})
        for part in range(3):
            made.message(2, begin_ns - part, b"one", 7)
            library.add_message(2, begin_ns - part, b"one", begin_ns - part, 7)
            # Of two lengths, in turns, the shorter ones padded.
            stamps, bodies = START_NS + np.arange(9), np.arange(45, dtype=np.uint8).reshape(9, 5)
            rows = message_rows(1, stamps, bodies, 10 * part)
            rows[::2, 1], rows[::2, -2:] = 22 + 3, 0
            made.messages(rows)
            for number, stamp in enumerate(stamps.tolist()):
                body = bodies[number].tobytes()[: 5 if number % 2 else 3]
                library.add_message(1, stamp, body, stamp, 10 * part + number)
            made.flush()
            library.flush()  # type: ignore[no-untyped-call]
    made.finish()
    disk.close()
    library.finish()  # type: ignore[no-untyped-call]
    read, summaries = [path.read_bytes() for path in (ours, theirs)], []
    end = read[0].index(DATA_END) + len(DATA_END) + 4  # with its CRC
    assert read[0][:end] == read[1][:end]
    for path in (ours, theirs):
        with path.open("rb") as file:
            summary = make_reader(file, validate_crcs=True).get_summary()
            assert summary
            summaries.append(vars(summary))
    assert summaries[0] == summaries[1]


def test_chunks_are_bounded(tmp_path: Path) -> None:
    """One that is not flushed ends by itself; a channel without messages is in the summary."""
    made = McapWriter(disk := DiskFile(tmp_path / "a.mcap", overwrite=False), "", "test")
    made.channel("/a", "A", "")
    made.channel("/b", "A", "")
    for _ in range(2):
        made.messages(message_rows(1, np.arange(600), np.zeros((600, 2000), np.uint8), 0))
    for number in range(600):
        made.message(1, number, bytes(2000), number)
    made.finish()
    disk.close()
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary
    assert summary.statistics
    assert (len(summary.chunk_indexes), summary.statistics.message_count) == (4, 1800)
    assert [each.topic for each in summary.channels.values()] == ["/a", "/b"]
