"""The table of a connection's states: every state is reached and can be left, and any can end at once."""

from __future__ import annotations

import pytest

from ethercat_server.serving.connection import TRANSITIONS, Connection, State
from ethercat_server.serving.in_memory import InMemoryTransport, ManualClock


def test_the_table_has_a_row_for_every_state() -> None:
    assert set(TRANSITIONS) == set(State)


@pytest.mark.parametrize("state", [s for s in State if s is not State.CLOSED])
def test_every_state_can_end_in_closed_at_once(state: State) -> None:
    assert State.CLOSED in TRANSITIONS[state]


@pytest.mark.parametrize("state", [s for s in State if s is not State.READING])
def test_every_state_is_reached_from_another(state: State) -> None:
    assert any(state in following for following in TRANSITIONS.values())


def test_an_ending_connection_takes_no_request_any_more() -> None:
    for state in State:
        if state.ending:
            assert all(following.ending for following in TRANSITIONS[state])


def test_a_step_that_is_not_in_the_table_is_refused() -> None:
    transport = InMemoryTransport(ManualClock())
    transport.connect()
    stream = transport.accept(0)
    assert stream is not None
    connection = Connection(stream, 0, ManualClock().monotonic_ns)
    with pytest.raises(AssertionError, match="READING"):
        connection.answer_later()
