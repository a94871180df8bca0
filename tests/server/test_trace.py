"""A trace of the observations replays to the same decisions, to the bit, whatever happened."""

from __future__ import annotations

import base64
import itertools
import json
import random
from collections.abc import Sequence
from pathlib import Path

import pytest

from ethercat_server.doctor.cli import main as doctor
from ethercat_server.sampling.trace import Kind, Trace, TraceError
from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.ended import run_here
from tests.simulation import MemoryChannel, SimulatedServer, Simulation, fresh, simulated_bus


def trace_of(simulation: Simulation) -> bytes:
    """As a client gets it, part by part."""
    data, size = b"", 1
    while len(data) < size:
        part = simulation.cycle.tracing.part(len(data))
        size = part["size"]
        data += base64.b64decode(part["data"])
    assert len(data) == size
    return data


def check_replay(simulation: Simulation, numbers: Sequence[int] = (0,)) -> Trace:
    """Each new sample of the trace has the instant that was handed out with it."""
    trace = Trace(trace_of(simulation))
    steps = list(trace.replay())
    assert steps
    for number in numbers:
        dated = [
            int(step.instant_ns)
            for step in steps
            if step.record.kind is Kind.FRESH and step.record.sensor == number
        ]
        handed_out = [
            frame.monotonic_ns
            for frame in fresh(simulation.frames)
            if frame.sensor == number and frame.monotonic_ns > dated[0]
        ]
        assert len(handed_out) > 100
        known = {*dated}
        # Where one came before another was dated the stamp is moved by a ns; nothing else differs. The first
        # samples after a return are not handed out.
        assert {at_ns for at_ns in handed_out if at_ns not in known and at_ns - 1 not in known} == set()
    return trace


@pytest.mark.parametrize("dc", ["", "none"])
@pytest.mark.parametrize(
    "machine",
    [
        Machine(),
        Machine(seed=2, lost=0.02, late=0.02),
        Machine(seed=3, stall_every_s=0.1, stall_ns=5e6),
        Machine(seed=4, frame_ns=2e6, frame_jitter_ns=2e5),
    ],
    ids=["quiet", "bad wire", "stalls", "slow card"],
)
def test_a_replay_makes_the_same_decisions(machine: Machine, dc: str) -> None:
    simulation = Simulation(SensorOptions(signal="clock", ppm=150.0, dc=dc), machine=machine)
    simulation.run(3.0)
    check_replay(simulation)


def test_a_replay_begins_anew_where_a_sensor_came_back_and_where_event_times_are_given_up() -> None:
    simulation = Simulation(
        SensorOptions(signal="clock", ppm=150.0), SensorOptions(signal="clock", serial=2, dc="stuck")
    )
    simulation.at(1.0, "power cycle 0.1 @0")
    simulation.run(4.0)
    assert simulation.status()["sensors"][0]["recoveries"]
    check_replay(simulation, (0, 1))


def test_the_ring_has_the_last_minute_and_is_read_while_it_goes_on() -> None:
    simulation = Simulation(SensorOptions(sinc_length=512), settings={"sinc_length": 512})
    simulation.run(100.0)
    size = simulation.cycle.tracing.part(0)["size"]
    parts = []
    for offset in itertools.count(0, 24 << 10):
        if offset >= size:
            break
        parts.append(base64.b64decode(simulation.cycle.tracing.part(offset)["data"]) if offset else b"")
        simulation.run(0.05)
    trace = Trace(trace_of(simulation))
    seconds = (trace.records[-1].sent_ns - trace.records[0].sent_ns) * 1e-9
    assert 40 < seconds <= 100
    check_replay(simulation)


def test_a_file_is_hostile() -> None:
    simulation = Simulation()
    simulation.run(0.5)
    whole = trace_of(simulation)
    header = json.loads(whole.partition(b"\n")[0])
    for damaged in (
        b"", b"\n", b"{}\n", whole[:100], b"[" * 100_000, json.dumps({**header, "version": 2}).encode(),
        json.dumps({**header, "snapshots": 3}).encode(),
    ):  # fmt: skip
        with pytest.raises(TraceError):
            Trace(damaged)
    for key, value in (("round_trip", {"learn": 1}), ("sensors", [{}]), ("sensors", [{"events": []}])):
        snapshot = {**header["snapshots"][0], key: value}
        data = json.dumps({**header, "snapshots": [snapshot]}).encode() + b"\n" + whole.partition(b"\n")[2]
        with pytest.raises(TraceError):
            list(Trace(data).replay())
    chance = random.Random(1)
    for _ in range(200):
        mutated = bytearray(whole)
        for _ in range(chance.randint(1, 5)):
            mutated[chance.randrange(len(mutated))] = chance.randrange(256)
        try:
            for _ in itertools.islice(Trace(bytes(mutated)).replay(), 300):
                pass
        except TraceError:
            pass


def test_the_doctor_keeps_a_trace_and_shows_what_was_lost_and_why(tmp_path: Path) -> None:
    path = tmp_path / "a.trace"
    with simulated_bus("--sinc", 64) as bus:
        simulation = SimulatedServer(bus)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("bota_ethercat.client.client.TcpChannel", lambda *_: MemoryChannel(simulation))
            simulation.run(1.0)
            simulation.at(0.5, lambda: simulation.clock.stall(20e6))
            simulation.at(1.0, "skip 3")
            simulation.run(2.0)
            saved = run_here(doctor, "--trace", path)
        assert "ethercat-doctor" in saved.out
    shown = run_here(doctor, path).out
    assert "this computer sent nothing for 2" in shown
    assert "lost though it was polled: the sensor gave none" in shown
    path.write_bytes(b'{"format": "another"}\n')
    assert "it is no trace of the sampling clocks" in run_here(doctor, path).err


def test_who_may_not_control_the_server_gets_no_trace() -> None:
    simulation = Simulation()
    simulation.run(0.2)
    assert simulation.connect(1234).refused("trace")["code"] == "denied"
