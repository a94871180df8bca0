"""`ethercat-sensor filters`: figures that follow from the delay, and the page that shows them."""

from __future__ import annotations

from pathlib import Path

import pytest

from bota_ethercat.sensor.filters import FORCE_TORQUE_FILTERS
from tests.json_schema import problems
from tests.tool.running import told, tool_here

PAGE = Path(__file__).parents[2] / "docs" / "filters.md"


def test_the_page_has_what_the_command_says() -> None:
    said = tool_here("filters", "--loop", 500).out.splitlines()
    shown = PAGE.read_text().split("$ ethercat-sensor filters --loop 500\n")[1].split("```")[0].splitlines()
    assert [line for line in said if line in shown] == [line for line in shown if line != "..."]


def test_the_figures_of_a_setting() -> None:
    found = told("filters", "--loop", 500)
    assert not problems("sensor", found, "filters")
    rows = {(row["sinc_length"], row["fir"]): row for row in found["settings"]}
    assert rows.keys() == {(length, fir) for length in FORCE_TORQUE_FILTERS for fir in (False, True)}
    default, filtered, longer = rows[64, False], rows[64, True], rows[256, False]
    assert (default["noise"], default["delay_ms"], filtered["delay_ms"]) == (1, 1.88, 15)
    # 1.5 and 12 periods of 1.25 ms; half a period more until the loop of 50 Hz bandwidth reads it.
    assert default["phase_deg"]["20"] == pytest.approx(360 * 20 * 1.875e-3)
    assert default["margin_deg"] == pytest.approx(60 - 360 * 50 * 2.5e-3)
    assert filtered["margin_deg"] == pytest.approx(60 - 360 * 50 * 15.625e-3)
    assert longer["noise"] == pytest.approx(0.5)
    # A low-pass filter with -3 dB at 31.5 instead of 209.5 Hz.
    assert filtered["noise"] == pytest.approx((31.5 / 209.5) ** 0.5, rel=0.02)
    limits = [rows[key]["noise_limit_n"] for key in ((32, False), (51, False), (51, True), (341, False))]
    assert limits == [None, pytest.approx(0.6), None, pytest.approx(0.193, abs=0.001)]


@pytest.mark.parametrize(
    ("asked", "sinc_length", "fir", "why"),
    [
        ((500,), 32, False, "least noise that leaves 30°"),
        ((500, "--bandwidth", 10), 32, True, "least noise that leaves 30°"),
        ((100, "--bandwidth", 2), 128, True, "a new sample in every cycle"),
        ((1000,), 32, False, "lower the loop's bandwidth to 67 Hz"),
        ((2000, "--bandwidth", 2), 128, True, "fewer samples than cycles"),
    ],
)
def test_what_is_recommended(asked: tuple[object, ...], sinc_length: int, fir: bool, why: str) -> None:
    found = told("filters", "--loop", *asked)["recommended"]
    assert why in found.pop("why")
    assert found == {"sinc_length": sinc_length, "fir": fir}


@pytest.mark.parametrize("hz", ["0", "nan", "fast"])
def test_a_loop_needs_a_rate(hz: str) -> None:
    assert "--loop" in tool_here("filters", "--loop", hz, code=2).err
