"""Real sensors do not read back the SINC length they were given: the sampling rate says what is in force."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.simulated_links import simulated_bus
from tests.simulation import SimulatedBus
from tests.tool.odd_firmware import other_sinc_length
from tests.tool.running import tool_here

UNMATCHED = ": by the sampling rate, which this length does not match"
MEANINGS = {
    64: (384, "800 Hz; cut-off 209.5 Hz with FIR off, 31.5 Hz with FIR on" + UNMATCHED),
    128: (768, "400 Hz; cut-off 105 Hz with FIR off, 16 Hz with FIR on" + UNMATCHED),
    341: (2048, "150 Hz; cut-off 39.5 Hz with FIR off, 6 Hz with FIR on" + UNMATCHED),
    1000: (6024, "51 Hz; cut-off not in the table" + UNMATCHED),
    2048: (12288, "25 Hz; cut-off not in the table" + UNMATCHED),
}


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulatedBus]:
    other_sinc_length(monkeypatch)
    with simulated_bus("--signal", "rest") as found:
        yield found


@pytest.mark.parametrize("length", MEANINGS)
def test_what_is_said_of_it_follows_the_rate(bus: SimulatedBus, length: int) -> None:
    applied = tool_here("apply", bus.near, "--set", f"sinc_length={length}", "--json").json
    assert applied["settings"]["sinc_length"] == length
    (read,) = tool_here("read", bus.near, "sinc_length", "--json").json["sensors"][0]["objects"]
    assert (read["value"], read["meaning"]) == MEANINGS[length]
    assert MEANINGS[length][1] in tool_here("objects", bus.near).out


def test_a_length_that_chop_hides_is_not_overwritten(bus: SimulatedBus) -> None:
    life = bus.backend.sensors.sensors[0].life
    assert life is not None
    life.dictionary.let_chop_divide(2)
    assert tool_here("apply", bus.near, "--set", "chop=on", "--json").json["rate_hz"] == 400
    written = bus.written()
    assert tool_here("apply", bus.near, "--set", "imu_active=3", "--json").json["rate_hz"] == 400
    assert {row[0] for row in bus.written()[len(written) :]} == {"0x8010"}
    asked = ("--set", "sinc_length=64")
    assert "nothing to change" in tool_here("plan", bus.near, *asked).out
    (read,) = tool_here("read", bus.near, "sinc_length", "--json").json["sensors"][0]["objects"]
    assert (read["value"], read["meaning"]) == (768, "400 Hz; cut-off not in the table" + UNMATCHED)


@pytest.mark.parametrize("length", [32, 128, 341, 342, 1000])
def test_plan_and_restore_end(bus: SimulatedBus, length: int, tmp_path: Path) -> None:
    asked = ("--set", f"sinc_length={length}")
    tool_here("plan", bus.near, *asked, code=3)
    tool_here("apply", bus.near, *asked)
    assert "nothing to change" in tool_here("plan", bus.near, *asked).out
    path = tmp_path / "a.json"
    tool_here("snapshot", bus.near, path)
    content = json.loads(path.read_text())
    content["settings"]["sinc_length"] = length  # of several with this rate, it cannot know which
    path.write_text(json.dumps(content))
    assert "nothing to restore" in tool_here("restore", bus.near, path).out
    tool_here("apply", bus.near, "--set", "sinc_length=64", "--set", "fir=on")
    restored = tool_here("restore", bus.near, path, "--json").json
    assert {row["name"]: row["then"] for row in restored["changes"]} == {"sinc_length": length, "fir": False}
    assert "nothing to restore" in tool_here("restore", bus.near, path).out
    assert bus.stats()["sinc_length"] == length
