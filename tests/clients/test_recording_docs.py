"""docs/recording.md says what the programs take and what the file has."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest

from bota_clients.record import options as record_options
from bota_clients.recording import file_format
from bota_clients.replay import options as replay_options
from bota_ethercat.framing import DataMessage
from tests.clients.recordings import frame

DOCS = (Path(__file__).parents[2] / "docs" / "recording.md").read_text()


def test_arguments_and_options_may_stand_in_any_order() -> None:
    recording = record_options.parse_options(["a.mcap", "--seconds", "5", "host:1"])
    assert (recording.path, str(recording.address), recording.seconds) == (Path("a.mcap"), "host:1", 5)
    replay = replay_options.parse_options(["a.mcap", "--loop", "b.mcap", "12002"])
    assert (replay.paths, replay.port, replay.loop) == ([Path("a.mcap"), Path("b.mcap")], 12002, True)


def test_every_topic_and_schema_is_described() -> None:
    for name in (
        file_format.frame_topic(0).replace("0", "N"), file_format.DESCRIPTION_TOPIC, file_format.EVENTS_TOPIC,
        file_format.FRAME_SCHEMA, file_format.TEXT_SCHEMA, file_format.METADATA, file_format.END_METADATA,
    ):  # fmt: skip
        assert f"`{name}`" in DOCS, name


def test_the_bytes_of_a_frame_are_as_described() -> None:
    rows = re.findall(r"^\| (\d+) \| (\w+) \| `(\w+)`", DOCS, re.MULTILINE)
    formats = {"u8": "<B", "u16": "<H", "u64": "<Q"}
    item = frame(7, sensor=3, flags=5)
    body = file_format.pack_frame(item)
    seen = {
        name: struct.unpack_from(formats[kind], body, int(at))[0]
        for at, kind, name in rows
        if kind in formats
    }
    assert seen == dict(zip(DataMessage._fields[:6], item[:6], strict=True))
    assert body.startswith(bytes.fromhex("00010000"))
    assert struct.unpack_from("<I", body, 32) == (len(item.process_data),)
    assert body[36:] == item.process_data


def test_the_example_reads_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.clients.recordings import record

    record(tmp_path / "run.mcap", (frame(n) for n in range(10)))
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", DOCS, re.DOTALL)
    exec(compile(example, "docs/recording.md", "exec"), {})
