"""Which frames are news: every fresh one once and in order, nothing old as new."""

from __future__ import annotations

import random
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.framing import DataMessage
from bridge.stream.frame_selector import BACKLOG_NS, FRESH_NS, FrameCounts, FrameSelector, RateLimit

PERIOD_NS = 1_250_000


def frame(number: int) -> DataMessage:
    """Frame `number` of a stream that began at time 0."""
    return DataMessage(number, 0, number * PERIOD_NS, 0, 0, 3, b"")


def frames(numbers: Iterable[int]) -> list[DataMessage]:
    return [frame(number) for number in numbers]


def selector(*, same_clock: bool = True, limit_hz: float = 0.0) -> tuple[FrameSelector, FrameCounts]:
    counts = FrameCounts()
    return FrameSelector(counts, same_clock=same_clock, limit_hz=limit_hz), counts


def numbers(selected: Iterable[DataMessage]) -> list[int]:
    return [item.sequence for item in selected]


def test_a_stall_in_several_reads_gives_nothing_until_it_is_fresh() -> None:
    select, counts = selector()
    now_ns = 1600 * PERIOD_NS
    for start in range(0, 1500, 500):
        assert select.select(frames(range(start, start + 500)), now_ns) == []
    assert numbers(select.select(frames(range(1500, 1600)), now_ns)) == [1599]
    assert counts.stale == 1599


def test_one_old_frame_alone_does_not_pass_on_the_same_machine() -> None:
    select, counts = selector()
    assert select.select([frame(1)], PERIOD_NS + BACKLOG_NS + 1) == []
    late = 100 * PERIOD_NS
    assert select.select([frame(100)], late + FRESH_NS + 1) == []
    assert numbers(select.select([frame(101)], 101 * PERIOD_NS + FRESH_NS)) == [101]
    assert counts.stale == 2


def test_clocks_that_differ_make_ages_relative() -> None:
    for offset_ns in (-(10**15), 10**15):
        select, _ = selector(same_clock=False)
        for i in range(1000):
            now_ns = offset_ns + i * PERIOD_NS + (i * 7919 % 1000) * 1000
            assert numbers(select.select([frame(i)], now_ns)) == [i]
        now_ns = offset_ns + 3000 * PERIOD_NS
        assert select.select(frames(range(1000, 2000)), now_ns) == []
        assert numbers(select.select(frames(range(2000, 3000)), now_ns)) == [2999]


@pytest.mark.parametrize("same_clock", [True, False])
@pytest.mark.parametrize("age_ns", [0, 5_000_000, 30_000_000])
def test_a_stall_costs_no_more_than_itself(same_clock: bool, age_ns: int) -> None:
    """Whatever is usual on this connection: what is queued after 60 ms gives one sample, the next passes."""
    select, counts = selector(same_clock=same_clock)
    offset_ns = age_ns if same_clock else age_ns - 10**15
    for i in range(8):
        assert numbers(select.select([frame(i)], offset_ns + i * PERIOD_NS)) == [i]
    for begin in (8, 1008):  # and again: nothing has changed for the rest of the connection
        now = begin + 48
        assert numbers(select.select(frames(range(begin, now)), offset_ns + now * PERIOD_NS)) == [now - 1]
        for i in range(now, begin + 1000):
            assert numbers(select.select([frame(i)], offset_ns + i * PERIOD_NS)) == [i]
    assert counts.stale == 2 * 47


def test_a_connection_that_has_become_slower_is_no_backlog_for_long() -> None:
    select, counts = selector()
    for i in range(800):
        select.select([frame(i)], i * PERIOD_NS)
    slower_ns = 80_000_000
    got = [n for i in range(800, 900) for n in numbers(select.select([frame(i)], slower_ns + i * PERIOD_NS))]
    assert got == list(range(816, 900))  # 20 ms
    assert counts.stale == 16
    stall = select.select(frames(range(900, 1000)), slower_ns + 1000 * PERIOD_NS)
    assert numbers(stall) == [999]


def test_a_clock_wrongly_taken_for_ours_does_not_silence_the_stream() -> None:
    select, _ = selector()
    offset_ns = 10**12
    got = [n for i in range(1000) for n in numbers(select.select([frame(i)], offset_ns + i * PERIOD_NS))]
    assert got == list(range(16, 1000))


def test_a_limit_takes_the_newest() -> None:
    select, counts = selector(limit_hz=100)
    got = numbers(select.select(frames(range(8)), 8 * PERIOD_NS))
    passed_over = numbers(select.passed_over)
    assert numbers(select.select(frames(range(8, 10)), 10 * PERIOD_NS)) == []
    passed_over += numbers(select.passed_over)
    got += numbers(select.select(frames(range(10, 16)), 16 * PERIOD_NS))
    passed_over += numbers(select.passed_over)
    assert got == [7, 15]
    assert passed_over == [*range(7), *range(8, 15)]
    assert counts.limited == 14


@pytest.mark.parametrize("limit_hz", [1.0, 10.0, 99.9, 100.0, 333.0, 799.0])
@pytest.mark.parametrize("rate_hz", [800, 801, 997, 1000, 1333, 1600, 1700])
def test_a_limit_below_the_streams_rate_is_kept_and_reached(limit_hz: float, rate_hz: int) -> None:
    limit = RateLimit(limit_hz)
    passed = sum(limit.allows(i * 1_000_000_000 // rate_hz) for i in range(3 * rate_hz))
    assert 3 * limit_hz - 1 <= passed <= 3 * limit_hz + 2


@pytest.mark.parametrize("seed", range(4))
def test_a_limit_equal_to_the_streams_rate_lets_all_pass(seed: int) -> None:
    limit = RateLimit(800.0)
    jitter = random.Random(seed).randint
    assert all(limit.allows(i * PERIOD_NS + jitter(-200_000, 200_000)) for i in range(1, 20_000))


@given(
    st.lists(
        st.tuples(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.integers(0, 255)), max_size=20
    )
)
def test_hostile_numbers_are_survived(rows: list[tuple[int, int, int]]) -> None:
    for limit_hz in (0.0, 100.0):
        for same_clock in (True, False):
            select, _ = selector(same_clock=same_clock, limit_hz=limit_hz)
            for sequence, monotonic_ns, flags in rows:
                message = DataMessage(sequence, 0, monotonic_ns, 0, flags, 3, b"")
                assert len(select.select([message], 10**12)) <= 1
