"""The order of samples and messages in time: across restarts of the server's machine, and without strays."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from bota_clients.numbers import count
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.framing import DataMessage
from bota_ethercat.stream.timeline import InForce

_SECOND: Final = 1_000_000_000
_MAX: Final = (1 << 63) - 1


def in_order(stamps: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """(n,) The most that can be kept so that each stamp is later than the one before."""
    if (np.diff(stamps) > 0).all():
        return np.ones(len(stamps), bool)
    return longest_order([stamp] for stamp in stamps.tolist())


def longest_order(places: Iterable[Iterable[int]]) -> npt.NDArray[np.bool_]:
    """The same of rows that may be at any of their places."""
    lasts, ends = list[int](), list[int]()  # of the best sequence of each length: last place, and its number
    numbers, count = (
        list[tuple[int, int]](),
        0,
    )  # of each place: its row, and what is before it in its sequence
    for row, each in enumerate(places):
        count = row + 1
        for place in sorted(each, reverse=True):
            length = bisect_left(lasts, place)
            lasts[length : length + 1], ends[length : length + 1] = [place], [len(numbers)]
            numbers.append((row, ends[length - 1] if length else -1))
    kept, at = np.zeros(count, bool), ends[-1] if ends else -1
    while at >= 0:
        row, at = numbers[at]
        kept[row] = True
    return kept


class TimeAxis:
    """One axis of time for frames: CLOCK_MONOTONIC, which from a restart of the server's machine on goes on
    by CLOCK_REALTIME.

    Attributes:
        restarts: how many there were so far.
        left_out: new samples so far that were not later than the one before.
    """

    def __init__(self) -> None:
        self.restarts = self.left_out = 0
        self._shift_ns = self._stamp_ns = 0
        self._last_ns = self._before_ns = -1  # of the latest frame, and of the one before
        self._newest_ns = -1
        self._undo: tuple[int, int] | None = None  # what was before a restart, which may be a stray stamp

    def place(self, frame: DataMessage) -> int:
        """Where the next frame is, ns."""
        now_ns, last_ns, undo, self._undo = frame.monotonic_ns, self._last_ns, self._undo, None
        if undo and now_ns > undo[0]:
            self.restarts -= 1
            self._shift_ns = undo[1]
        elif self._before_ns >= now_ns < last_ns - _SECOND:  # else the latest one was the stray
            self.restarts += 1
            self._undo = last_ns, self._shift_ns
            self._shift_ns += last_ns - now_ns + max(_SECOND, frame.stamp_ns - self._stamp_ns)
        self._before_ns, self._last_ns, self._stamp_ns = last_ns, now_ns, frame.stamp_ns
        return min(now_ns + self._shift_ns, _MAX)

    def batches(
        self, batches: Iterable[tuple[InForce, list[DataMessage]]]
    ) -> Iterator[tuple[InForce, list[DataMessage]]]:
        """Those of one sensor with their places as `monotonic_ns`, without samples out of order."""
        for in_force, batch in batches:
            found = [each._replace(monotonic_ns=self.place(each)) for each in batch]
            new = [number for number, each in enumerate(found) if not each.flags & NOT_NEW]
            places = np.array([self._newest_ns, *(found[number].monotonic_ns for number in new)], np.int64)
            later = in_order(places)[1:] & (places[1:] > self._newest_ns)
            self._newest_ns = int(places[1:][later].max(initial=self._newest_ns))
            if strays := {
                number for number, is_later in zip(new, later.tolist(), strict=True) if not is_later
            }:
                self.left_out += len(strays)
                found = [each for number, each in enumerate(found) if number not in strays]
            if found:
                yield in_force, found

    @property
    def said(self) -> list[str]:
        """What is not as it should be, in clauses."""
        restarted = (
            f"the server's machine was restarted {count(self.restarts, 'time')} meanwhile, and time goes "
            "on by its wall clock"
        )
        strays = f"{count(self.left_out, 'sample')} out of order left out"
        return [restarted] * bool(self.restarts) + [strays] * bool(self.left_out)
