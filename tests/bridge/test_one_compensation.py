"""One stream, compensated by every program that compensates: the same wrench, sample by sample.

The streams are a server's, of a virtual sensor that is moved, tared and loses its power, in simulated time;
the recorder writes them, and node and ros2_control plugin get what the server sent.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

from bota_clients.export.cli import main as export
from bota_clients.identify.cli import main as identify
from bota_clients.record.recorder import Recorder, RecordingClient
from bota_clients.recording.columns import columns
from bota_clients.recording.file_format import RecordedDescription, RecordedEvent
from bota_clients.recording.reader import open_recording
from bota_clients.report.cli import main as report
from bota_ethercat.address import Address
from bota_ethercat.framing import DataMessage, encode_data
from ethercat_server.simulation.machine import Machine
from ethercat_server.simulation.server import MemoryChannel
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.signals import MOVE_LENGTH, POSE_LENGTH
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.simulated_node import QUICK, STEP_S, Node, Server, Stages, six, stamp_ns
from tests.clients.cpp_programs import end_driver, needs_gxx, patient
from tests.clients.test_sensor_loop import Loop, Seen, program
from tests.compensation.making import written_parameters
from tests.ended import run_here
from tests.server.running import wait_until
from tests.simulation import Simulation

Array = NDArray[np.float64]
Step = tuple[float, Callable[[Simulation], object]]
RATE_HZ = 100
CYCLE_S = POSE_LENGTH + MOVE_LENGTH
NOISE_N, NOISE_NM = 0.6, 0.02  # of a sample, more than five standard deviations
TARED = [5.0, -4.0, 3.0, 0.1, -0.2, 0.3]  # what the sensor is to read


def tare(target: list[float]) -> Callable[[Simulation], object]:
    return lambda server: server.connect().send("tare", samples=50, target=target)


def write_fz(value: float) -> Callable[[Simulation], object]:
    keys = {"index": 0x8000, "subindex": 3, "type": "f32", "value": value}
    return lambda server: server.connect().send("sdo_write", **keys)


def cut_power(server: Simulation) -> object:
    return server.backend.command("power cycle 0.3")


def recorded(path: Path, server: Simulation, seconds: float, *steps: Step) -> Path:
    with (
        mock.patch("bota_ethercat.client.client.TcpChannel", return_value=MemoryChannel(server)),
        contextlib.closing(RecordingClient(Address("localhost", 12001), None)) as source,
    ):
        source.connect()
        recorder = Recorder(path, "test", {}, overwrite=False)
        begin_ns = server.clock.now_ns
        for after_s, act in (*steps, (seconds, lambda _: None)):
            while server.clock.now_ns < begin_ns + after_s * 1e9:
                recorder.put(source.batch(0.02))
            act(server)
        recorder.stop("")
    assert recorder.error is None
    return path


class Recorded(NamedTuple):
    """What one sensor was heard to do."""

    identified: Path  # a recording of poses, with a tare in the middle
    run: Path  # later: tared before; a tare that is taken back, two changes and a power cycle
    offset: list[float]  # the sensor's own, at the end of the poses


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("heard")
    poses = SensorOptions(signal="poses")
    server = Simulation(poses, machine=Machine(), settings={"sinc_length": 512})
    server.run(0.1)
    identified = recorded(folder / "poses.mcap", server, 6 * CYCLE_S, (2 * CYCLE_S + 1, tare(TARED)))
    asking = server.connect()
    offset = asking.described()["offset"]
    server.run(0.5)
    asking.ask("tare", samples=50)
    run = recorded(
        folder / "run.mcap", server, 7.0,
        (0.1, tare([9.0] * 6)),  # taken back: it is moved meanwhile
        (3.5, tare([9.0] * 6)), (5.2, write_fz(-3.5)), (6.0, cut_power),
    )  # fmt: skip
    server.close()
    return Recorded(identified, run, offset)


@pytest.fixture(scope="module")
def tool(heard: Recorded) -> Path:
    path = heard.identified.with_suffix(".yaml")
    ended = run_here(identify, heard.identified, "--yaml", path)
    assert ended.code == 0, ended.err
    return path


def exported(run: Path, tool: Path) -> tuple[list[int], Array]:
    out = run.with_suffix(".npz")
    with open_recording(run) as recording:
        table = columns(recording.frames(0))
    table = table.where(table.fresh)
    at = run.with_suffix(".csv")
    at.write_text(f"timestamp\n{table.stamp_ns[-1] - 20_000_000}\n")
    ended = run_here(export, run, out, "--at", at, "--window", 1000, "--tool", tool, "--force")
    assert ended.code == 0, ended.err
    made = np.load(out)
    is_valid = made["force_torque_compensated_valid"][0]
    wrench, age_s = (made[name][0][is_valid] for name in ("force_torque_compensated", "force_torque_age"))
    instants = made["monotonic_ns"][0] - 1e9 * age_s + 15e6
    which = np.abs(table.monotonic_ns - instants[:, np.newaxis]).argmin(axis=1)
    assert np.abs(table.monotonic_ns[which] - instants).max() < 1e6
    return table.stamp_ns[which].tolist(), wrench.astype(float)


def is_no_contact(wrench: Array) -> bool:
    return bool((np.abs(wrench) < [NOISE_N] * 3 + [NOISE_NM] * 3).all())


def test_the_bias_is_that_of_the_last_offset(heard: Recorded, tool: Path) -> None:
    """The virtual sensor's bias is its offset; half of the poses were read with another one."""
    found = written_parameters(tool)
    assert found["sensor_offset"] == pytest.approx(heard.offset, abs=1e-6)
    assert found["bias"] == pytest.approx(heard.offset, abs=0.05)
    assert max(map(abs, heard.offset)) > 5.0
    ended = run_here(report, heard.run)
    assert "own offset was changed 4 times" in ended.out, ended.out


def test_the_exported_wrench_follows_the_offset(heard: Recorded, tool: Path) -> None:
    stamps, wrench = exported(heard.run, tool)
    assert len(stamps) > 500
    assert is_no_contact(wrench), np.abs(wrench).max(axis=0)


Items = list[DataMessage | RecordedDescription | RecordedEvent]


def described(items: Items) -> dict[str, Any]:
    """What the server says of itself, first."""
    reply = next(item.reply for item in items if isinstance(item, RecordedDescription))
    return {name: value for name, value in reply.items() if name not in ("reply", "id")}


class Again(Server):
    """Sends what a recording has, when it is time."""

    def __init__(self, items: Items) -> None:
        super().__init__()
        self.description = described(items)
        self.items = items[::-1]
        self.now_ns = next(item.monotonic_ns for item in items if isinstance(item, DataMessage)) - 10**8

    def step(self) -> None:
        self.now_ns += round(STEP_S * 1e9)
        while self.items and self.subscribed.is_set():
            item = self.items[-1]
            if isinstance(item, DataMessage):
                if item.monotonic_ns > self.now_ns:
                    break
                self.send_raw(encode_data(*item))
            elif isinstance(item, RecordedEvent) and not item.by_recorder:
                self.send_json(item.event)
            self.items.pop()


def test_the_nodes_wrench_is_the_exported_one(heard: Recorded, tool: Path) -> None:
    stamps, wrench = exported(heard.run, tool)
    with open_recording(heard.run) as recording:
        server = Again([*recording.everything(0)])
    with Node(server, **QUICK, **written_parameters(tool)) as node:
        stages = Stages(node)
        node.run_until(lambda: not server.items, "the end")
        by_stamp = {stamp_ns(message): six(message) for message in stages.final}
    both = [(by_stamp[at], row) for at, row in zip(stamps, wrench.tolist(), strict=True) if at in by_stamp]
    assert len(both) > len(stamps) - 1.5 * RATE_HZ  # the node looks once a second who has subscribed
    told, written = np.array(both).swapaxes(0, 1)
    assert told == pytest.approx(written, abs=1e-4)


class Reading(Loop):
    def until_force(self, force_x: float) -> Seen:
        """The first cycle that sees a sample with this force."""
        wait_until(lambda: self.read()["force.x"] == force_x, "the sample")
        return self.read()


@needs_gxx
@patient
def test_the_plugins_wrench_is_the_exported_one(heard: Recorded, tool: Path) -> None:
    """A process and sockets: the plugin has no other input, and takes the server for another machine's."""
    stamps, wrench = exported(heard.run, tool)
    wanted = dict(zip(stamps, wrench.tolist(), strict=True))
    with open_recording(heard.run) as recording:
        items = [*recording.everything(0)]
    loop, played = Reading(program()), ScriptedServer()
    played.description = described(items) | {"boot_id": "another"}
    try:
        loop.opened(played.port, payload_file=tool)
        checked = 0
        for item in items:
            if isinstance(item, RecordedEvent) and not item.by_recorder:
                played.send(item.event)
            if not isinstance(item, DataMessage):
                continue
            played.send(encode_data(*item))
            if item.stamp_ns in wanted:
                seen = loop.until_force(columns([item]).force[0, 0])
                names = [f"compensated.{name}.{axis}" for name in ("force", "torque") for axis in "xyz"]
                assert [seen[name] for name in names] == pytest.approx(wanted[item.stamp_ns], abs=1e-4)
                checked += 1
        assert checked == len(wanted)
    finally:
        loop.do("stop")
        played.close()
        assert end_driver(loop.process) == 0
