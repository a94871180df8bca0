"""A world outside: its datagrams, what holds between and after them, and the way to the clients."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import pytest

from bota_ethercat.client import Client, World, connect
from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import STANDARD_GRAVITY, SampleDecoder
from bota_ethercat.world import Felt, decode, encode
from ethercat_server.simulation.machine import Machine
from ethercat_server.simulation.server import MemoryChannel
from ethercat_server.virtual_sensor.link import LinkError, bound
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.world import LOST_AFTER_S, ExternalWorld
from tests.server.running import needs_bus, server, wait_until
from tests.simulation import Simulation, fresh
from tests.virtual_sensor.conftest import Start
from tests.virtual_sensor.raw_master import OP, RawMaster

FELT = Felt((1.0, 2.0, 3.0, 4.0, 5.0, 6.0), (7.0, 8.0, 9.0), (10.0, 11.0, 12.0), 13.0)
RAW = SampleDecoder(61)
MS = 1_000_000


def push(newtons: float) -> Felt:
    return Felt((newtons, 0.0, 0.0, 0.0, 0.0, 0.0))


def test_the_datagram_byte_for_byte() -> None:
    data = encode(0.5, FELT, 2)
    assert data[:16] == b"FTW1" + bytes([2, 0, 0, 0]) + struct.pack("<d", 0.5)
    assert data[16:] == struct.pack("<13d", *range(1, 14))
    assert decode(data) == (2, 0.5, FELT)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        encode(0.0, FELT)[:-1],
        encode(0.0, FELT) + b"\0",
        b"FTW2" + encode(0.0, FELT)[4:],
        *(encode(0.0, push(value)) for value in (math.nan, math.inf, -1e300)),
        encode(0.0, FELT._replace(temperature=math.nan)),
    ],
)
def test_what_is_no_datagram_is_dropped(data: bytes) -> None:
    assert decode(data) is None


def test_a_moment_holds_until_the_next_and_comes_in_order() -> None:
    world = ExternalWorld()
    assert world(5.0) == push(0.0), "at rest before the first"
    wrong = 9.9, 10.102, 10.0005, math.nan  # old, to come, out of order, none
    for time_s, newtons in ((9.9, 3.0), (10.0, 1.0), (10.001, 2.0), *((each, 3.0) for each in wrong)):
        world.update(time_s, push(newtons), 10.001)
    assert world.counts == {"taken": 2, "refused": 5}
    assert [world(t).wrench[0] for t in (9.999, 10.0, 10.0009, 10.001, 11.0)] == [0.0, 1.0, 1.0, 2.0, 2.0]


@pytest.mark.parametrize(("lost", "newtons"), [("hold", 8.0), ("zero", 0.0), ("fault", None)])
def test_a_world_that_stops(lost: str, newtons: float | None) -> None:
    """None: the sensor gives nothing new, until the world goes on."""
    world = ExternalWorld(lost)
    master = RawMaster(SensorOptions(world=world, noise=False, last_bit=False)).go(OP)

    def go_on(count: int) -> bytes:
        for _ in range(count):
            world.update(master.now * 1e-9, push(8.0), master.now * 1e-9)
            master.wait(MS)
        return master.inputs()

    told = go_on(50)
    assert RAW.decode(told).force[0] == pytest.approx(8.0)
    master.wait(round(LOST_AFTER_S * 1e9) + 10 * MS)
    first = master.inputs()
    master.wait(10 * MS)
    if newtons is None:
        assert first == master.inputs(), "no new sample"
    else:
        assert RAW.decode(master.inputs()).force[0] == pytest.approx(newtons)
    assert RAW.decode(go_on(50)).force[0] == pytest.approx(8.0)
    assert master.bus.statistics()["sensors"][0]["world"] == {"taken": 100, "refused": 0}


STILL: tuple[dict[str, Any], ...] = ({"noise": False}, {"signal": "constant"}, {"signal": "rest"})


@pytest.mark.parametrize("still", STILL)
@pytest.mark.parametrize("calibrated", [True, False])
def test_where_nothing_moves_every_sample_is_new_and_no_channel_stands_still(
    still: dict[str, Any], calibrated: bool
) -> None:
    """As from a real converter, whose last bit is never still."""
    world = None if "signal" in still else lambda _: push(-7.0)
    simulation = Simulation(SensorOptions(**still), world=world, settings={"calibration_matrix": calibrated})
    simulation.run(2.0)
    samples = [RAW.decode(frame.process_data) for frame in simulation.frames[100:]]
    assert len(samples) > 1400
    assert not [frame for frame in simulation.frames[100:] if frame.flags]
    per_newton, per_newton_meter = (1.0, 1.0) if calibrated else (10_000.0, 500_000.0)
    for axis in range(3):
        for values, bit in (
            ([sample.force[axis] for sample in samples], 1e-4 * per_newton),
            ([sample.torque[axis] for sample in samples], 2e-6 * per_newton_meter),
            ([sample.acceleration[axis] for sample in samples], 2 / 2**15 * STANDARD_GRAVITY),
            ([sample.angular_rate[axis] for sample in samples], math.radians(250 / 2**15)),
        ):
            assert max(values) - min(values) == pytest.approx(2 * bit, rel=0.1)
            assert max(sum(1 for _ in run) for _, run in itertools.groupby(values)) < 30


def test_where_nothing_moves_and_nobody_wants_a_last_bit_no_sample_is_new() -> None:
    simulation = Simulation(SensorOptions(noise=False, last_bit=False), world=lambda _: push(-7.0))
    simulation.run(0.5)
    assert {frame.flags for frame in simulation.frames[100:]} == {DataFlag.REPEATED}


def rising(t: float) -> Felt:
    """10 N a second, from 0."""
    return push(10.0 * t)


@pytest.mark.parametrize(("sinc", "fir", "periods"), [(64, False, 1.5), (64, True, 12.0), (128, False, 1.5)])
def test_a_sample_is_late_by_the_filter_and_half_a_step(sinc: int, fir: bool, periods: float) -> None:
    simulation = Simulation(
        SensorOptions(noise=False), settings={"sinc_length": sinc, "fir": fir}, world=rising
    )
    simulation.run(0.4)
    delays = []
    for frame in fresh(simulation.frames)[40:]:
        taken_s = (frame.monotonic_ns - simulation.started_ns) * 1e-9
        delays.append(taken_s - RAW.decode(frame.process_data).force[0] / 10.0)
    assert statistics.mean(delays) == pytest.approx(periods * sinc / 51200 + 0.5e-3, abs=1e-4)


def test_a_seed_gives_a_run_to_the_bit() -> None:
    def run(seed: int) -> list[bytes]:
        machine = Machine(seed=seed, lost=0.01, late=0.01, stall_every_s=0.5, stall_ns=3e6)
        simulation = Simulation(
            SensorOptions(seed=seed), machine=machine, settings={"sinc_length": 512}, world=rising
        )
        simulation.at(0.5, "skip 3")
        simulation.at(1.0, "noise force.x 3")
        simulation.at(2.0, "power cycle 0.2")
        simulation.run(3.0)
        return [frame.process_data + frame.monotonic_ns.to_bytes(8) for frame in simulation.frames]

    one = run(1)
    assert len(one) > 250
    assert one == run(1) != run(2)


def test_whoever_reads_all_samples_gets_all_at_their_instants() -> None:
    simulation = Simulation(world=rising)
    with Client(12001, channel=MemoryChannel(simulation)).connect() as sensor:
        assert sensor.latest(timeout_s=1.0).fresh
        began_ns = simulation.clock.now_ns
        readings = [sensor.latest(timeout_s=0.05) for _ in range(400)]
        took_ns = simulation.clock.now_ns - began_ns
    assert all(reading.fresh and not reading.passed_over for reading in readings)
    assert took_ns == pytest.approx(400 * 1.25 * MS, rel=0.01)


def test_there_need_be_no_sensor(tmp_path: Path) -> None:
    with World(tmp_path / "world") as world:
        assert not world.send(time.monotonic(), (0,) * 6)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sensor:
            sensor.bind(world.path)
            assert world.send(1.5, (1, 2, 3, 4, 5, 6), (7, 8, 9), (10, 11, 12), 13, sensor=1)
            assert sensor.recv(200) == encode(1.5, FELT, 1)
            while world.send(2.0, (0,) * 6):
                pass  # it does not look: its buffer fills, and nobody waits
        assert not world.send(3.0, (0,) * 6)


@pytest.mark.bus
def test_hostile_datagrams_do_not_stop_the_sensor(
    veth: tuple[str, str], start: Start, tmp_path: Path
) -> None:
    path = tmp_path / "world"
    sensor = start(veth[0], "--world", str(path))
    with World(path) as world, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as hostile:
        for data in (b"", b"\xff" * 5000, encode(math.nan, FELT), encode(time.monotonic(), FELT, 200)):
            hostile.sendto(data, str(path))
        wait_until(lambda: world.send(time.monotonic(), FELT.wrench), "room")
        wait_until(lambda: sensor.stats()["world"]["taken"] >= 1, "a datagram that is taken")
        assert path.stat().st_mode & 0o777 == 0o600
    sensor.close()
    assert not path.exists()


def example(words: str) -> str:
    """The one in docs/world.md with these words."""
    page = (Path(__file__).parents[2] / "docs" / "world.md").read_text()
    (found,) = (block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if words in block)
    return str(found)


def test_the_example_in_simulated_time_runs() -> None:
    names: dict[str, Any] = {}
    exec(compile(example("Simulation("), "docs/world.md", "exec"), names)
    assert names["reading"].fresh
    assert 2000 * names["depth"] == pytest.approx(10.0, abs=0.5)
    assert [event["event"] for event in names["simulation"].events] == ["sensor_lost", "sensor_back"]


@pytest.mark.long
@needs_bus
def test_the_example_in_real_time_runs(tmp_path: Path) -> None:
    path = tmp_path / "world"
    with contextlib.ExitStack() as running:
        started = running.enter_context(server("virtual", f"--virtual=--world {path} --world-lost hold"))
        program = example("while True").replace("/tmp/world", str(path)).replace("12001", str(started.port))
        process = running.enter_context(subprocess.Popen([sys.executable, "-c", program]))
        running.callback(process.terminate)
        client = running.enter_context(connect(started.port))
        forces = deque[float](maxlen=400)
        for sample in client:
            forces.append(sample.force[2])
            if len(forces) == 400 and abs(statistics.mean(forces) + 10.0) < 0.2:
                break


def test_the_live_socket_of_another_program_is_not_taken_for_a_stale_one(tmp_path: Path) -> None:
    path = str(tmp_path / "socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as theirs:
        theirs.bind(path)
        theirs.listen()
        with (
            pytest.raises(LinkError, match="Address already in use"),
            bound(path),
        ):
            pass
        assert Path(path).is_socket()
