"""The benchmark with eight clients: its clients' count of what came, and its ratio."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("numpy")

from protocol.framing import DataFlag, DataMessage
from protocol.pdo import encode
from scripts import _benchmark as benchmark
from scripts._benchmark_clients import ratio
from scripts._odd_clients import Tally


def frame(sequence: int, number: int, flags: int = 0) -> DataMessage:
    return DataMessage(sequence, 0, 0, 0, flags, 3, encode(61, {"force.x": number}))


def test_tally_tells_withheld_from_lost_and_flagged_from_not() -> None:
    tally = Tally()
    for each in (
        frame(10, 100),
        frame(11, 101),
        frame(12, 101, DataFlag.REPEATED),
        frame(13, 104, DataFlag.GAP),
        frame(20, 111, DataFlag.GAP),
        frame(21, 113),
    ):
        tally.take(each)
    told = json.loads(tally.summary())
    assert (told["frames"], told["lost"], told["unflagged"]) == (5, 9, 1)
    assert told["jumps"] == [[6, True]]


def test_ratio_is_of_the_rounds_medians() -> None:
    def rows(*p99: float) -> list[dict[str, dict[str, float]]]:
        return [{"wake_us": {"p99": value}} for value in p99]

    assert ratio(rows(50, 40, 1000), rows(60, 1, 75)) == 1.2


def test_clients_are_measured_on_one_configuration() -> None:
    options = benchmark.parse(["--clients"])
    assert (options.rates, options.sensors) == ([800], [1])
