"""The order of samples and messages in time: across restarts of the server's machine, and without strays."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from bota_clients.numbers import count
from bota_clients.recording.columns import Bools, Columns, Ints
from bota_ethercat.stream.timeline import InForce

_SECOND: Final = 1_000_000_000
_MAX: Final = (1 << 63) - 1


def in_order(stamps: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """(n,) The most that can be kept so that each stamp is later than the one before."""
    if (stamps[1:] > stamps[:-1]).all():
        return np.ones(len(stamps), bool)
    return longest_order([stamp] for stamp in stamps.tolist())


def longest_order(places: Iterable[Iterable[int]]) -> npt.NDArray[np.bool_]:
    """The same of rows that may be at any of their places."""
    lasts, ends = list[int](), list[int]()  # of the best sequence of each length: last place, and its number
    # Of each place: its row, and what is before it in its sequence.
    numbers, count = list[tuple[int, int]](), 0
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
        shift_ns: place of the latest frame less its CLOCK_MONOTONIC.
    """

    def __init__(self) -> None:
        self.restarts = self.left_out = self.shift_ns = self._stamp_ns = 0
        self._last_ns = self._before_ns = -1  # of the latest frame, and of the one before
        self._newest_ns = dict[int, int]()  # of each sensor's samples
        self._undo: tuple[int, int] | None = None  # what was before a restart, which may be a stray stamp

    def places(self, monotonic_ns: Ints, stamp_ns: Ints) -> Ints:
        """Where the next frames (n,) are, ns."""
        now = np.concatenate([(self._before_ns, self._last_ns), monotonic_ns])
        shifts: Any = self.shift_ns
        if self._undo or ((now[2:] <= now[:-2]) & (now[1:-1] - now[2:] > _SECOND)).any():
            passed = np.diff(stamp_ns, prepend=self._stamp_ns).tolist()
            rows = zip(now.tolist(), now[1:].tolist(), monotonic_ns.tolist(), passed, strict=False)
            shifts = np.array([self._shift(*row) for row in rows], np.int64)
        if len(monotonic_ns):
            self._before_ns, self._last_ns, self._stamp_ns = int(now[-2]), int(now[-1]), int(stamp_ns[-1])
        places: Ints = np.minimum(monotonic_ns, _MAX - shifts) + shifts
        return places

    def _shift(self, before_ns: int, last_ns: int, now_ns: int, passed_ns: int) -> int:
        """What is added to the next frame, by the two before it and the time passed by CLOCK_REALTIME."""
        undo, self._undo = self._undo, None
        if undo and now_ns > undo[0]:  # else the latest one was the stray
            self.restarts -= 1
            self.shift_ns = undo[1]
        elif before_ns >= now_ns < last_ns - _SECOND:
            self.restarts += 1
            self._undo = last_ns, self.shift_ns
            self.shift_ns = min(self.shift_ns + last_ns - now_ns + max(_SECOND, passed_ns), _MAX)
        return self.shift_ns

    def is_later(self, places: Ints, sensor: int = 0) -> Bools:
        """(n,) Which of a sensor's next samples, at these places, come in order; counts the others."""
        newest_ns = self._newest_ns.get(sensor, -1)
        found: Bools = in_order(np.append(newest_ns, places))[1:] & (places > newest_ns)
        self.left_out += int((~found).sum())
        self._newest_ns[sensor] = int(places[found][-1:].max(initial=newest_ns))
        return found

    def batches(self, batches: Iterable[tuple[InForce, Columns]]) -> Iterator[tuple[InForce, Columns]]:
        """Those of one sensor with their places as `monotonic_ns`, without samples out of order."""
        for in_force, batch in batches:
            places, is_kept = self.places(batch.monotonic_ns, batch.stamp_ns), ~batch.fresh
            is_kept[~is_kept] = self.is_later(places[~is_kept])
            found = replace(batch, monotonic_ns=places)
            if is_kept.any():
                yield in_force, found if is_kept.all() else found.where(is_kept)

    @property
    def said(self) -> list[str]:
        """What is not as it should be, in clauses."""
        restarted = (
            f"the server's machine was restarted {count(self.restarts, 'time')} meanwhile, and time goes "
            "on by its wall clock"
        )
        strays = f"{count(self.left_out, 'sample')} out of order left out"
        return [restarted] * bool(self.restarts) + [strays] * bool(self.left_out)
