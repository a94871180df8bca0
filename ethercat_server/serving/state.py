"""The states of a client's connection, and which state may follow which.

    READING <-> READY <-> ANSWERING          a client that may ask
       |          |           |
       v          |           |
    HALF_CLOSED   |           |              it has closed its side and still receives its subscription
       |          |           |
       +----------+-----------+
                  v
       CLOSING -> LINGERING -> CLOSED        the server closes: sends what waits, then waits for the client
           \\-> FLUSHING ------^              the client has closed its side: only what waits is sent

From every state a connection that breaks goes to CLOSED at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final


class State(Enum):
    """What a connection does now."""

    READING = "waits for the client's next request"
    READY = "has received bytes that may contain whole requests; reads no more until they are taken"
    ANSWERING = "its last request is not answered yet; what the client sent after it waits"
    HALF_CLOSED = "the client has closed its side, but is subscribed"
    CLOSING = "sends what waits and discards what the client still sends"
    FLUSHING = "sends what waits; the client has closed its side"
    LINGERING = "everything is sent and this side is closed; discards until the client has closed its own"
    CLOSED = "nothing is left but to close the socket"

    def __init__(self, _meaning: str) -> None:
        # Read for every connection in each turn: an attribute costs less than looking a member up in a set.
        self.reads = self.name in {"READING", "CLOSING", "LINGERING"}
        """Whether to wait for bytes of the client."""
        self.ending = self.name in {"CLOSING", "FLUSHING", "LINGERING", "CLOSED"}
        """Whether no more requests are taken."""


_ENDINGS: Final = frozenset({State.CLOSING, State.FLUSHING, State.CLOSED})

TRANSITIONS: Final[Mapping[State, frozenset[State]]] = {
    State.READING: _ENDINGS | {State.READY, State.HALF_CLOSED},
    State.READY: _ENDINGS | {State.READING, State.ANSWERING},
    State.ANSWERING: _ENDINGS | {State.READY},
    State.HALF_CLOSED: _ENDINGS - {State.CLOSING},
    State.CLOSING: frozenset({State.FLUSHING, State.LINGERING, State.CLOSED}),
    State.FLUSHING: frozenset({State.CLOSED}),
    State.LINGERING: frozenset({State.CLOSED}),
    State.CLOSED: frozenset(),
}
"""The states that may follow each."""
