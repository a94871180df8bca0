"""Which sample an exchange brought, by a table; every change of what event times are worth is in another."""

from __future__ import annotations

import itertools

import pytest

from ethercat_server.sampling.association import (
    SILENT_PERIODS,
    Association,
    Expected,
    Read,
    associate_by_event,
    associate_by_polls,
    count_steps,
)
from ethercat_server.sampling.trust import TRANSITIONS, Evidence, Trust, TrustState

PERIOD_NS, LEAST_NS = 1_000_000, 50_000
# The next sample is expected at 0; times below are in µs from then.


def brought(
    before: float, sent: float, took: float = 50, *, doubt: float = 20, is_doubtful: bool = False,
    has_events: bool = False, lost_track: bool = False,
) -> Association:  # fmt: skip
    expected = Expected(0.0, PERIOD_NS, doubt * 1e3, is_doubtful)
    read = Read(round(before * 1e3), round(sent * 1e3), round((sent + took) * 1e3), LEAST_NS)
    return associate_by_polls(expected, read, has_events=has_events, lost_track=lost_track)


@pytest.mark.parametrize(
    ("given", "number", "uncertain"),
    [
        pytest.param({"before": -900, "sent": 60}, 1, False, id="the next"),
        pytest.param({"before": -100, "sent": 60}, 1, False, id="the next, between two close reads"),
        pytest.param({"before": -900, "sent": 1060}, 2, False, id="one passed"),
        pytest.param({"before": -900, "sent": 4060}, 5, False, id="four passed"),
        pytest.param(
            {"before": -900, "sent": 990}, 1, True, id="this or the next: the phase is not so exact"
        ),
        pytest.param({"before": -900, "sent": 960, "took": 150}, 2, True, id="read before or after it came"),
        pytest.param(
            {"before": -900, "sent": 60, "took": 2050}, 1, True, id="held up after the read, or before"
        ),
        pytest.param({"before": -900, "sent": 960, "doubt": 100}, 1, True, id="the phase is hardly known"),
        pytest.param({"before": -900, "sent": 60, "is_doubtful": True}, 1, True, id="so was the one before"),
        pytest.param({"before": -1900, "sent": 60, "lost_track": True}, 1, True, id="without an event"),
        pytest.param({"before": -100, "sent": 60, "lost_track": True}, 1, False, id="only one can have come"),
        pytest.param({"before": -600, "sent": -550, "has_events": True}, 0, False, id="too early"),
    ],
)
def test_which_sample_it_is_by_polls(given: dict[str, float], number: int, uncertain: bool) -> None:
    found = brought(**given)  # type: ignore[arg-type]
    assert (found.number, found.uncertain) == (number, uncertain)


@pytest.mark.parametrize(("late", "number"), [(0.0, 1), (0.4, 1), (-0.4, 1), (0.6, 2), (3.1, 4), (-0.9, 0)])
def test_which_sample_it_is_by_its_event(late: float, number: int) -> None:
    assert associate_by_event(late, uncertain=False).number == number


@pytest.mark.parametrize(
    ("number", "late", "is_doubtful", "absent", "unchanged", "expected"),
    [
        pytest.param(1, 0.0, False, 0, 1.0, (1, 1), id="the next"),
        pytest.param(3, 2.0, False, 0, 3.0, (3, 3), id="two lost"),
        pytest.param(0, -0.9, False, 0, 1.0, (1, 1), id="too early for the next: it is that"),
        pytest.param(0, -0.9, True, 0, 1.0, (0, 0), id="one too many was counted before"),
        pytest.param(1, 0.0, False, 2, 3.0, (1, 3), id="two were polled for and did not come"),
        pytest.param(1, -0.6, False, 1, 2.0, (1, 1), id="the one polled for came late"),
        pytest.param(1, 0.0, False, SILENT_PERIODS, 5.0, (1, 1), id="a silent sensor loses nothing"),
        pytest.param(1, 0.0, False, SILENT_PERIODS, 0.5, (1, 4), id="held up by the slave, not silent"),
    ],
)
def test_how_many_samples_passed(
    number: int, late: float, is_doubtful: bool, absent: int, unchanged: float, expected: tuple[int, int]
) -> None:
    found = Association(number, late, False)
    got = count_steps(found, is_doubtful=is_doubtful, absent=absent, unchanged_periods=unchanged)
    assert got == expected


@pytest.mark.parametrize(("state", "evidence"), [*itertools.product(TrustState, Evidence)])
def test_what_event_times_are_worth_changes_by_the_table_only(state: TrustState, evidence: Evidence) -> None:
    trust = Trust()
    trust.state = state
    if (state, evidence) in TRANSITIONS:
        trust._enter(evidence)
        assert trust.state is TRANSITIONS[state, evidence]
    else:
        with pytest.raises(KeyError):
            trust._enter(evidence)
        assert trust.state is state
