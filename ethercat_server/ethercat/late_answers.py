"""Waits longer while answers come late, so that a slow machine reads its sensors slowly, not never.

An answer that nobody waits for any more says how long a frame takes now.
"""

from __future__ import annotations

from typing import Final

from ethercat_server.ethercat.clock import Clock
from ethercat_server.ethercat.wire import DATAGRAM_INDEX

_LONGEST_TIMEOUT_S: Final = 0.25
# On a bus whose answers come late the timeout is this many times the longest recent round trip.
_LATE_FACTOR: Final = 2.0
# Below it, frames are in time.
_SHORTEST_TIMEOUT_S: Final = 0.0003


class LateAnswers:
    """The timeout of frames, of which `count` numbered from `first_index` on are told apart."""

    def __init__(self, clock: Clock, first_index: int, count: int) -> None:
        self.timeout_s = 0.0
        """The timeout at least; 0 on a bus that is in time."""
        self._first_index = first_index
        self._monotonic_ns = clock.monotonic_ns
        self.pending_ns = [0] * count
        """By index less the first: when a frame was sent that is not back; else 0."""

    def note(self, answer: bytes) -> None:
        """An answer, not the one that is waited for."""
        index = answer[DATAGRAM_INDEX] - self._first_index if len(answer) > DATAGRAM_INDEX else -1
        if 0 <= index < len(self.pending_ns) and self.pending_ns[index]:
            self.timeout_s = min(max(self.timeout_s, _LATE_FACTOR * self._took_s(index)), _LONGEST_TIMEOUT_S)
            self.pending_ns[index] = 0

    def in_time(self, index: int) -> None:
        """The answer that is waited for: wait less from now on, if it came sooner."""
        timeout_s = min(max(self.timeout_s / 2, _LATE_FACTOR * self._took_s(index)), _LONGEST_TIMEOUT_S)
        self.timeout_s = timeout_s if timeout_s > _SHORTEST_TIMEOUT_S else 0.0

    def _took_s(self, index: int) -> float:
        return (self._monotonic_ns() - self.pending_ns[index]) * 1e-9
