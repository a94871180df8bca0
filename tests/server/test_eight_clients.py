"""Eight clients at 800 Hz, half of them troublesome, in simulated time.

The others lose nothing, and those that miss frames are told.
"""

from __future__ import annotations

import random
from itertools import pairwise

import pytest

from bota_ethercat.framing import DataFlag, DataMessage
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import OLD, Client, Simulation, check_frames, reading

ALL_FOR_S = 2.0
SMALL_BUFFER = 4096
"""Bytes on their way to a client that reads slowly; a kernel holds more."""


class Troublesome:
    """One that stops reading, one that reads slowly, one that sends noise, one that comes and goes."""

    def __init__(self, simulation: Simulation, seed: int) -> None:
        self._simulation, self._chance = simulation, random.Random(seed)
        self.stopped, self.slow = (simulation.connect(buffer_size=SMALL_BUFFER) for _ in range(2))
        for client in (self.stopped, self.slow):
            client.ask("subscribe")
        self._noise: list[Client] = []
        self._churn: list[Client] = []
        simulation.on_serve = self._act

    def _act(self, _until_ns: int) -> None:
        chance = self._chance
        self.slow.reads = chance.random() < 0.02
        if chance.random() < 0.1:
            self._noise.append(self._simulation.connect())
            self._noise[-1].stream.send(chance.randbytes(chance.randrange(1, 200)))
            self._noise[-1].reads = False
        if chance.random() < 0.1:
            self._churn.append(self._simulation.connect())
            self._churn[-1].send("subscribe")
        for some in (self._noise, self._churn):
            if len(some) > 4:
                some.pop(0).close()

    def end(self) -> None:
        self._simulation.on_serve = lambda _: None
        for client in (*self._noise, *self._churn):
            client.close()
        self.stopped.reads = self.slow.reads = True


def jumps(frames: list[DataMessage]) -> list[tuple[int, bool]]:
    """How many frames each jump of the sequence skips, and whether the frame after it has GAP."""
    return [
        (after.sequence - before.sequence - 1, bool(after.flags & DataFlag.GAP))
        for before, after in pairwise(frames)
        if after.sequence != before.sequence + 1 and not (before.flags | after.flags) & OLD
    ]


@pytest.mark.parametrize("seed", range(3))
def test_the_honest_lose_nothing_and_the_others_know_what_they_missed(seed: int) -> None:
    simulation = Simulation(SensorOptions(signal="clock", ppm=150.0))
    honest = [simulation.connect() for _ in range(4)]
    for client in honest:
        client.ask("subscribe")
    troublesome = Troublesome(simulation, seed)
    stopped, slow = troublesome.stopped, troublesome.slow
    simulation.run(0.1)
    stopped.reads = False
    simulation.run(ALL_FOR_S)

    status = honest[0].ask("status")
    rows = {row["peer"]: row for row in status["clients"]}
    for client in (stopped, slow):
        assert rows[client.stream.other.peer]["withheld"] > 0
    troublesome.end()
    simulation.run(0.5)
    for client in honest:
        assert len(client.frames) > ALL_FOR_S * 800
        assert jumps(client.frames) == [], "the server withheld frames from a client that reads"
        check_frames(client.frames)
        assert not client.at_end
    for client in (stopped, slow):
        missed = jumps(client.frames)
        assert missed, "frames were withheld and nothing tells of it"
        assert all(told for _, told in missed), "the first frame after it has GAP"
        check_frames(client.frames, complete=False)
        assert reading(client.frames[-1]).number >= reading(honest[0].frames[-1]).number - 1, "live again"
    assert len(simulation.hub.connections) == 6
