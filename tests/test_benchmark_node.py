"""The benchmark of the node: messages are matched with samples by stamp, and what is wrong is counted."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.benchmarks import program as benchmark
from scripts.benchmarks.modes.node import compare, first_after
from scripts.benchmarks.processes.node_client import check_sum
from scripts.benchmarks.statistics import Ints

MS = 1_000_000
COUNT = 1000


@pytest.fixture
def tcp() -> Ints:
    """A second at 1 kHz, each sample 100 µs old on arrival."""
    instant = np.arange(COUNT, dtype=np.int64) * MS + 5_000 * MS
    return np.stack([instant + 7, instant, np.arange(COUNT), instant + 100_000], axis=1)


def heard(tcp: Ints, late_ns: int = 300_000) -> Ints:
    messages = tcp.copy()
    messages[:, 1] = 0
    messages[:, 3] += late_ns
    return messages


def test_all_is_well(tcp: Ints) -> None:
    figures = compare(tcp, heard(tcp))
    assert figures["samples"] > COUNT / 2
    assert (figures["lost"], figures["repeated"], figures["decoded_wrongly"]) == (0, 0, 0)
    assert figures["tcp_age_us"][50] == 100
    assert figures["ros_age_us"][99] == 400


def test_what_is_wrong_is_counted(tcp: Ints) -> None:
    messages = heard(tcp)
    messages[500, 2] += 1
    messages = np.concatenate([messages[:400], messages[403:600], messages[599:]])
    figures = compare(tcp, messages)
    assert (figures["lost"], figures["repeated"], figures["decoded_wrongly"]) == (3, 1, 1)


def test_first_message_after_a_silence(tcp: Ints) -> None:
    messages = heard(tcp[np.r_[0:300, 700:COUNT]])
    assert first_after(messages, tcp, 300 * MS) == 400.0
    assert first_after(messages, tcp, 0) == 400.0
    with pytest.raises(AssertionError, match="no silence"):
        first_after(heard(tcp), tcp, 300 * MS)


def test_check_sum_sees_the_last_bit() -> None:
    assert check_sum((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)) != check_sum(
        (1.0, 2.0, 3.0), (4.0, 5.0, np.nextafter(6, 7))
    )


def test_it_is_an_option_of_its_own() -> None:
    options = benchmark.parse(["--node"])
    assert options.node
    assert not options.cpp
