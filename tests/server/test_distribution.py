"""The fixed-memory distribution against exact percentiles."""

from __future__ import annotations

import random

from ethercat_server.distribution import Distribution, RecentDistribution


def test_percentiles_are_exact_to_a_few_percent() -> None:
    noise = random.Random(0)
    values = sorted(int(10 ** noise.uniform(0, 10)) for _ in range(50_000))
    distribution = Distribution()
    for value in values:
        distribution.record(value)
    for fraction in (0.01, 0.5, 0.9, 0.99, 0.999):
        exact = values[int(fraction * (len(values) - 1))]
        (found,) = distribution.percentiles_ns(fraction)
        assert exact <= found * 1.001
        assert found <= exact * 1.05 + 1


def test_extremes() -> None:
    distribution = Distribution()
    assert distribution.percentiles_ns(0.5) == [0]
    distribution.record(-5)
    distribution.record(10**15)
    assert distribution.percentiles_ns(0.5) == [0]
    assert distribution.summary_us()["max"] == 10**12
    assert distribution.count == 2


def test_recent_forgets_after_ten_rolls_but_everything_does_not() -> None:
    recent = RecentDistribution()
    recent.record(5_000_000)
    for _ in range(9):
        recent.roll()
        recent.record(1_000)
    assert recent.last_10s().summary_us()["max"] == 5000
    recent.roll()
    recent.record(2_000)
    assert recent.last_10s().count == 10
    assert recent.last_10s().summary_us()["max"] == 2
    assert recent.everything().count == 11
    assert recent.everything().summary_us()["max"] == 5000
