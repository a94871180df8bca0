"""`watch`, `tare` and `read` use no samples of a sensor that has entered OP less than half a second ago."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from tests.simulated_links import SimulatedServer, simulated_bus, simulated_server
from tests.simulation import SimulatedBus
from tests.tool.running import tool_here

FORCE = (1.5, -2.25, -9.75)
SERVER = ("--server", SimulatedServer.address)
FORCE_Z = "0x6000:6"


@pytest.fixture
def bus() -> Iterator[SimulatedBus]:
    with simulated_bus("--signal", "rest") as found:
        yield found


def unsettled_at_first(bus: SimulatedBus) -> None:
    """The sensor gives a wrong force for the first 0.4 s in OP, from now on."""
    state = ""

    def look() -> None:
        nonlocal state
        before, state = state, bus.stats()["al_state"]
        if state == "OP" != before:
            bus.command("limit force.z 5")
            bus.at(0.4, "limit force.z off")
        bus.at(0.001, look)

    look()


def test_watch_begins_with_settled_data(bus: SimulatedBus) -> None:
    unsettled_at_first(bus)
    for end in (("--samples", 20), ("--seconds", 0.2)):
        shown = tool_here("watch", bus.near, *end, "--interval", 9, "--json").json
        assert (*shown["force"], shown["samples"] >= 20) == (*FORCE, True)


@pytest.mark.parametrize("command", ["watch", "tare", "read"])
def test_through_a_server_that_has_just_started(bus: SimulatedBus, command: str) -> None:
    unsettled_at_first(bus)
    with simulated_server(bus):
        if command == "watch":
            shown = tool_here("watch", *SERVER, "--samples", 20, "--interval", 9, "--json").json["force"][2]
        elif command == "tare":
            shown = -tool_here("tare", *SERVER, "--samples", 20, "--json").json["new_offset"][2]
        else:
            read = tool_here("read", FORCE_Z, *SERVER, "--json").json["sensors"][0]["objects"]
            shown = read[0]["value"]
    assert shown == FORCE[2]


def test_watch_leaves_out_what_has_not_settled_after_a_recovery(bus: SimulatedBus) -> None:
    unsettled_at_first(bus)
    bus.at(1.5, "power cycle 0.2")
    ended = tool_here("watch", bus.near, "--seconds", 3, "--interval", 0.1, "--json")
    rows = [json.loads(line) for line in ended.out.splitlines()]
    full = [row for row in rows if row["samples"]]
    assert all(tuple(row["force"]) == FORCE for row in full)
    assert len(full) < len(rows), "it was lost, and told so"
    assert sum(row["gaps"] for row in full) == 1, full
