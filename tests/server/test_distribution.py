"""The fixed-memory distribution against exact percentiles."""

from __future__ import annotations

import random

import pytest

from ethercat_server.acquisition.histogram import Distribution, RecentDistribution


def test_percentiles_are_exact_to_a_few_percent() -> None:
    noise = random.Random(0)
    values = sorted(int(10 ** noise.uniform(0, 10)) for _ in range(50_000))
    distribution = Distribution()
    for value in values:
        distribution.record(value)
    fractions = (0.01, 0.5, 0.9, 0.99, 0.999)
    for fraction, found in zip(fractions, distribution.percentiles_ns(fractions), strict=True):
        exact = values[int(fraction * (len(values) - 1))]
        assert exact <= found * 1.001
        assert found <= exact * 1.05 + 1


def test_extremes() -> None:
    distribution = Distribution()
    assert distribution.percentiles_ns((0.5,)) == [0]
    distribution.record(-5)
    distribution.record(10**15)
    assert distribution.percentiles_ns((0.5,)) == [0]
    assert distribution.summary_us()["max"] == pytest.approx(10**12)
    assert distribution.count() == 2


def test_recent_forgets_after_ten_rolls_but_everything_does_not() -> None:
    recent = RecentDistribution()
    recent.record(5_000_000)
    for _ in range(9):
        recent.roll()
        recent.record(1_000)
    assert recent.summaries_us()[1]["max"] == 5000
    recent.roll()
    recent.record(2_000)
    everything, last = recent.summaries_us()
    assert last["max"] == 2
    assert last["p50"] == pytest.approx(1, rel=0.05)
    assert everything["max"] == 5000


def test_reading_takes_no_longer_with_time() -> None:
    """It happens between two exchanges: what fills is the buckets that there are."""
    noise = random.Random(1)
    recent = RecentDistribution()
    for _ in range(60):
        for _ in range(300):
            recent.record(int(noise.gammavariate(4, 20_000)))
        recent.roll()
    assert len(recent._before._counts) < 300
    assert len(recent._slots) == 10
