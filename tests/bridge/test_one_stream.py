"""Every consumer of a stream finds the same, sample by sample: what is in force, what may be used, and the
compensated wrench. A consumer is one row of CONSUMERS; the streams and their truth are tests/corpus.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
import pytest

from bota_clients.export.samples import MOST_LOST, samples_of
from bota_clients.export.windows import Windows
from bota_clients.monitor.compensated import NewestCompensated
from bota_clients.monitor.model import Model
from bota_clients.monitor.reader import MonitorReader
from bota_clients.recording.file_format import RecordedDescription, RecordedEvent
from bota_clients.recording.mcap_writer import DiskFile
from bota_clients.recording.reader import open_recording
from bota_clients.recording.writer import RecordingWriter
from bota_clients.replay.sensors import ReplayedSensors
from bota_clients.report.series import Series, of_recording
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.framing import DataMessage, encode_data, encode_json
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.text.json_text import JsonObject
from bota_ft_compensation.identification.parameter_file import write_payload
from tests.bridge.scripted_server import MemoryServer, ScriptedChannel, ScriptedServer
from tests.bridge.simulated_node import STEP_S, Node, Server, Stages, six, stamp_ns
from tests.clients.cpp_programs import end_driver, needs_gxx, patient
from tests.clients.test_sensor_loop import UNCHECKED, Loop, program
from tests.compensation.making import BIAS, TOOL
from tests.corpus import EPOCH_NS, OFFSET, STREAMS, TOOL_PARAMETERS, End, Six, Stream
from tests.server.running import wait_until

_ROUNDING = 1e-4  # N, Nm: of REAL32


class Found(NamedTuple):
    """What a consumer makes of one sample; None: it does not say."""

    usability: int | None = None
    wrench: Six | None = None  # compensated; None: there is none
    in_force: tuple[Six, int, float] | None = None  # offset, SINC length, Hz


Consumer = Callable[[Stream, Path], Iterator[tuple[int, Found]]]


def _python_client(stream: Stream, items: list[Any]) -> Iterator[tuple[int, Found]]:
    server = MemoryServer()
    server.description = stream.begin
    with Client(1, sensors=[0, 1], channel=ScriptedChannel(server)) as client:
        client.connect()
        for at_ns, item in items:
            server.now_ns = max(server.now_ns, at_ns)
            if isinstance(item, End):
                server.drop()
                while client.session.connected:
                    client.poll()
                server.description = item.description
                client.connect()
            elif not isinstance(item, DataMessage):
                server.send_raw(encode_json(item))
            else:
                server.send_raw(encode_data(*item))
                reading = client.latest(0, max_age_s=1e6)
                if reading.is_new and reading.frame and item.sensor == 0:
                    info = client.session.timeline[0].info
                    in_force = info.offset or (), info.settings["sinc_length"], info.rate_hz
                    yield reading.frame.stamp_ns, Found(int(reading.condition), in_force=in_force)


def client(stream: Stream, _: Path) -> Iterator[tuple[int, Found]]:
    yield from _python_client(stream, stream.items)


def recorded(stream: Stream, path: Path) -> Path:
    """As the recorder writes it."""
    writer = RecordingWriter(DiskFile(path, overwrite=True), "test", {})

    def note(at_ns: int, *notes: JsonObject) -> None:
        for each in notes:
            writer.note((RecordedEvent if "event" in each else RecordedDescription)(EPOCH_NS + at_ns, each))

    noted: JsonObject = {"event": "connected", "source": "recorder"}
    note(0, noted, stream.begin)
    for at_ns, item in stream.items:
        if isinstance(item, DataMessage):
            writer.frame(item)
        elif isinstance(item, End):
            note(at_ns, noted | {"event": "disconnected", "reason": "?"}, noted, item.description)
        else:
            note(at_ns, item)
    writer.finish({})
    return path


def replay(stream: Stream, folder: Path) -> Iterator[tuple[int, Found]]:
    """A client of a replay: what the recorder saw as another connection its clients see as events."""
    items: list[Any] = []
    with open_recording(recorded(stream, folder / "run.mcap")) as recording:
        sensors = ReplayedSensors(recording)
        stream = cast(Any, _With(begin=stream.begin))
        now_ns, is_first = 0, True
        for item in recording.everything():
            if isinstance(item, DataMessage):
                now_ns = item.stamp_ns - EPOCH_NS
                items.append((now_ns, item))
                continue
            if isinstance(item, RecordedDescription) and is_first:
                is_first = False
                continue
            items += [(now_ns, each) for each in sensors.follow(item)]
    yield from _python_client(stream, items)


class _With(NamedTuple):
    begin: Any


def export(stream: Stream, folder: Path) -> Iterator[tuple[int, Found]]:
    with open_recording(recorded(stream, folder / "run.mcap")) as recording:
        windows = Windows(MOST_LOST, tool=TOOL_PARAMETERS)
        for block in samples_of(recording, windows, 0):
            names = [name for name in block if name.startswith(("compensated_force_", "compensated_torque_"))]
            names = [name for name in names if "bound" not in name]
            wrenches = np.column_stack([block[name] for name in names])
            for row, number in enumerate(block["sequence"]):
                if number < 0:
                    continue
                stamp = int(block["stamp_utc"][row].astype(np.int64))
                wrench = tuple(wrenches[row].tolist()) if block["compensated_valid"][row] else None
                yield stamp, Found(None if block["valid"][row] else -1, wrench)


def monitor(stream: Stream, _: Path) -> Iterator[tuple[int, Found]]:
    server = MemoryServer()
    server.description = stream.begin
    model = Model("x", compensated=lambda: NewestCompensated(TOOL_PARAMETERS, ImuUnits.G_DPS))
    reader = MonitorReader(Address("localhost", 1), model)
    with Client(1, fresh_only=False, raw=True, channel=ScriptedChannel(server)) as client:
        client.connect()
        for at_ns, item in stream.items:
            server.now_ns = max(server.now_ns, at_ns)
            if isinstance(item, End):
                server.drop()
                while client.session.connected:
                    reader._hand_on(client, client.poll_all(), server.now_ns * 1e-9)
                server.description = item.description
                client.connect()
                continue
            server.send_raw(encode_data(*item) if isinstance(item, DataMessage) else encode_json(item))
            reader._hand_on(client, client.poll_all(), server.now_ns * 1e-9)
            if isinstance(item, DataMessage) and item.sensor == 0 and not item.flags & NOT_NEW:
                seen = model.state(server.now_ns * 1e-9).sensors[0]
                info, found = seen.info, seen.compensated
                in_force = info.offset or (), info.settings["sinc_length"], info.rate_hz
                yield item.stamp_ns, Found(None, found and (*found.force, *found.torque), in_force)


def report(stream: Stream, folder: Path) -> Iterator[tuple[int, Found]]:
    """Of the longest stretch without a change."""
    subject, *_ = of_recording(recorded(stream, folder / "run.mcap"), ImuUnits.G_DPS)
    for part, samples in zip(subject.parts, Series(subject).read(), strict=True):
        usable = np.asarray(samples.usable[:, :6].all(axis=1)).tolist()
        for stamp, is_usable in zip(part.stamp_ns[part.fresh].tolist(), usable, strict=True):
            yield stamp, Found(None if is_usable else -1)


class Playing(Server):
    """Plays a stream in the node's time."""

    def __init__(self, stream: Stream) -> None:
        super().__init__()
        self.description = stream.begin
        self.items = stream.items[::-1]
        self.now_ns = stream.items[0].at_ns - 2 * 10**9  # the node looks once a second who has subscribed
        self.ends_ns = stream.items[-1].at_ns + 10**8

    def step(self) -> None:
        self.now_ns += round(STEP_S * 1e9)
        while self.items and self.subscribed.is_set() and self.items[-1].at_ns <= self.now_ns:
            item = self.items.pop().item
            if isinstance(item, End):
                self.drop()
                self.description = item.description
            else:
                self.send_raw(encode_data(*item) if isinstance(item, DataMessage) else encode_json(item))


def node(stream: Stream, _: Path) -> Iterator[tuple[int, Found]]:
    server = Playing(stream)
    with Node(server, on_saturation="stop", **TOOL_PARAMETERS) as running:
        stages = Stages(running)
        running.run_until(lambda: server.now_ns > server.ends_ns, "the end")
        by_stamp = {stamp_ns(message): tuple(six(message)) for message in stages.final}
    for each in stream.items:
        item = each.item
        if isinstance(item, DataMessage) and item.sensor == 0 and not item.flags & NOT_NEW:
            yield item.stamp_ns, Found(None, by_stamp.get(item.stamp_ns))


def plugin(stream: Stream, folder: Path) -> Iterator[tuple[int, Found]]:
    """A process and sockets: the plugin has no other input. Its condition is that of the C++ client."""
    given = [("bias", BIAS.values, ""), ("sensor_offset", OFFSET, "")]
    write_payload(folder / "tool.yaml", TOOL, "", given)
    loop, played = Loop(program()), ScriptedServer()
    played.description, is_told = stream.begin, False
    names = [f"compensated.{name}.{axis}" for name in ("force", "torque") for axis in "xyz"]
    try:
        loop.opened(played.port, payload_file=folder / "tool.yaml")
        for _, item in stream.items:
            if isinstance(item, End):
                played.description, was = item.description, played.connections
                played.drop()
                wait_until(lambda: played.connections > was and bool(played.streams), "a connection")  # noqa: B023
            elif isinstance(item, DataMessage):
                seen = _sent(loop, played, item)
                if item.sensor == 0 and not item.flags & NOT_NEW:
                    if not (is_told and seen["condition"] == UNCHECKED):  # it came with what tells it
                        wrench = [seen[name] for name in names]
                        yield item.stamp_ns, Found(None, None if None in wrench else tuple(wrench))
                    is_told = False
                continue
            else:
                played.send(item)
            is_told = True
        loop.do("stop")
    finally:
        played.close()
        assert end_driver(loop.process) == 0


def _sent(loop: Loop, server: ScriptedServer, frame: DataMessage) -> Any:
    """What controllers see once a frame has come."""
    seen = dict[str, Any]()
    server.send(encode_data(*frame))
    if frame.sensor or frame.flags & NOT_NEW:
        return seen

    def has_come() -> bool:
        seen.update(loop.read())
        return bool(seen["sequence"] == frame.sequence)

    wait_until(has_come, "the sample")
    return seen


CONSUMERS: Final[Mapping[str, Consumer]] = {
    each.__name__: each for each in (client, replay, export, monitor, report, node, plugin)
}


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize(
    "consumer", [pytest.param(name, marks=[needs_gxx, patient] * (name == "plugin")) for name in CONSUMERS]
)
def test_every_consumer_finds_the_truth(consumer: str, name: str, tmp_path: Path) -> None:
    stream = STREAMS[name]
    found = dict(CONSUMERS[consumer](stream, tmp_path))
    wrong = list[tuple[Any, ...]]()
    for stamp, truth in stream.truth.items():
        if (seen := found.get(stamp)) is None:
            if consumer not in ("report", "plugin"):
                wrong.append((stamp, "missing"))
            continue
        if seen.usability == -1:
            if truth.force_torque == 0:
                wrong.append((stamp, "not usable", truth))
        elif seen.usability is not None and seen.usability != truth.force_torque:
            wrong.append((stamp, seen, truth))
        in_force = truth.offset, truth.sinc_length, truth.rate_hz
        if seen.in_force is not None and seen.in_force != in_force:
            wrong.append((stamp, seen.in_force, in_force))
        if consumer in ("client", "replay", "report"):
            continue
        expected = truth.wrench if truth.usability == 0 else None
        if expected is None:
            if seen.wrench is not None:
                wrong.append((stamp, "used", truth))
        elif seen.wrench is None:
            if truth.is_certain:
                wrong.append((stamp, "not used", truth))
        elif max(abs(a - b) for a, b in zip(seen.wrench, expected, strict=True)) > _ROUNDING:
            wrong.append((stamp, seen.wrench, truth))
    assert not wrong, [((at - EPOCH_NS) / 1e9, *rest) for at, *rest in wrong][:5]
