"""`tare --undo` and `tare --clear`, without a server and through one, on simulated sensors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.simulated_links import simulated_bus
from tests.simulation import SimulatedBus
from tests.tool.running import one_sentence, tool_here


@pytest.fixture
def bench() -> Iterator[SimulatedBus]:
    with simulated_bus("--signal", "rest", "--serial", "4711") as bus:
        yield bus


def offset(*where: object) -> list[float]:
    rows = tool_here("read", *where, "Force/Torque Offset", "--json").json["sensors"][0]["objects"]
    return [row["value"] for row in rows[1:]]


def test_a_tare_is_undone_and_done_again(bench: SimulatedBus) -> None:
    tared = tool_here("tare", bench.near, "--samples", 50, "--json").json["new_offset"]
    assert offset(bench.near) == pytest.approx(tared, rel=1e-5)
    undone = tool_here("tare", bench.near, "--undo", "--json").json
    assert (undone["new_offset"], offset(bench.near)) == ([0.0] * 6, [0.0] * 6)
    tool_here("tare", bench.near, "--undo")  # of the undoing: it is the tare again
    assert offset(bench.near) == pytest.approx(tared, rel=1e-5)


def test_clearing_sets_zero_and_can_be_undone(bench: SimulatedBus) -> None:
    tool_here("tare", bench.near, "--samples", 50)
    tared = offset(bench.near)
    assert "new offset" in tool_here("tare", bench.near, "--clear").out
    assert offset(bench.near) == [0.0] * 6
    tool_here("tare", bench.near, "--undo")
    assert offset(bench.near) == tared != [0.0] * 6


def test_only_the_tare_that_is_in_force_is_undone(bench: SimulatedBus) -> None:
    tool_here("tare", bench.near, "--samples", 50)
    bench.power_cycle()
    said = one_sentence(tool_here("tare", bench.near, "--undo", code=1))
    assert "has changed since its last tare here" in said
    assert offset(bench.near) == [0.0] * 6


@pytest.mark.parametrize("content", [None, "", "[]", '{"4711": 1}', '{"4711": {"before": [1], "after": 2}}'])
def test_without_a_known_tare_there_is_nothing_to_undo(
    bench: SimulatedBus, state: Path, content: str | None
) -> None:
    file = state / "bota-ethercat-bridge" / "tares.json"
    file.unlink(missing_ok=True)
    if content is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    assert "no tare of sensor 0: BFT-SENS-ECAT-M8, serial 4711" in one_sentence(
        tool_here("tare", bench.near, "--undo", code=1)
    )
    assert bench.written() == []


def test_a_clearing_that_does_not_take_leaves_the_old_offset(bench: SimulatedBus) -> None:
    tool_here("tare", bench.near, "--samples", 50)
    before = offset(bench.near)
    bench.command("on-write 0x8000 2 abort 0x8000 3 0x08000022")
    assert "the old offset is in force" in one_sentence(tool_here("tare", bench.near, "--clear", code=1))
    assert offset(bench.near) == before


def test_undo_and_clear_exclude_each_other(bench: SimulatedBus) -> None:
    assert "not allowed with" in tool_here("tare", bench.near, "--undo", "--clear", code=2).err
