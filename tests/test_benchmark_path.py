"""What a new sample costs the server, from the wire to its clients: held here, so that it does not grow."""

from __future__ import annotations

import functools

import pytest

from scripts.benchmarks.path import CLOCKS, count

once = functools.cache(count)


@pytest.mark.parametrize("clock", CLOCKS)
def test_the_way_of_a_sample_is_short(clock: str) -> None:
    one = once(CLOCKS[clock], 1)
    assert one["lines"] <= 150
    assert one["calls"] <= 14
    assert one["system_calls"] <= 5
    # What is learned from some samples only, and done now and then, included.
    assert one["mean_lines"] <= 200
    assert one["mean_calls"] <= 25


@pytest.mark.long
def test_another_subscriber_costs_its_own_frame_only() -> None:
    one, four = once("", 1), once("", 4)
    assert four["lines"] - one["lines"] <= 3 * 12
    assert four["calls"] - one["calls"] <= 3 * 2
    assert four["system_calls"] - one["system_calls"] == 3
