"""The bus in memory: no clock, sockets or threads of its own; the same input gives the same answers."""

import ast
import random
from pathlib import Path

from ethercat_server import virtual_sensor
from ethercat_server.ethercat import wire
from ethercat_server.ethercat.wire import Command
from ethercat_server.virtual_sensor.bus import Bus
from ethercat_server.virtual_sensor.faults import obey
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.virtual_sensor.raw_master import OP, RawMaster, chain

MS = 1_000_000
OUTSIDE = {"cli.py", "link.py", "virtual_bus.py"}
"""The program around the simulation."""
FAULTS = ("lose 2", "noise force.x 3", "skip 40 @1", "warn 1 5", "power cycle 0.01 @1", "safeop 27", "stick")


def run(seed: int) -> list[bytes | None]:
    master = RawMaster(*chain(2, seed=seed)).go(OP)
    chance = random.Random(seed)
    answers = []
    for _ in range(300):
        master.wait(chance.randrange(2 * MS))
        if chance.random() < 0.05:
            assert obey(master.bus, chance.choice(FAULTS)) == "ok"
        lrw = wire.build((Command.LRW, 0, 0, bytes(2 * 62)))
        answers.append(bytes(lrw) if master.bus.process(lrw, len(lrw), master.now) else None)
    return answers


def test_a_seed_gives_a_run() -> None:
    answers = run(1)
    assert answers == run(1)
    assert answers != run(2)
    assert None in answers


def test_power_returns_at_its_own_instant() -> None:
    bus = Bus([SensorOptions()], 0)
    assert obey(bus, "power cycle 0.5") == "ok"
    bus.idle(1400 * MS)
    assert bus.sensors[0].statistics()["sample"] == 720, "0.9 s at 800 Hz"


def test_the_simulation_asks_for_no_time_socket_or_thread() -> None:
    root = Path(virtual_sensor.__file__).parent
    for path in root.rglob("*.py"):
        names = {
            alias.name for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Import) for alias in node.names
        }  # fmt: skip
        if path.name not in OUTSIDE:
            assert not names & {"time", "socket", "select", "threading", "os"}, path
