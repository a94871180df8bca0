"""When each frame of a recording is due, and with which sequence number and stamps.

- The time between frames is that of their `monotonic_ns`, divided by the speed, never negative.
- Where the recorder reconnected, the server may have another monotonic clock: the time between the frames
  before and after is that of their `stamp_ns`.
- Stamps are moved: the first frame's are now, and the others keep their distance to it, exactly at speed 1.
  Sequence numbers continue when the recording starts again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, NamedTuple

from bota_ethercat.framing import DataMessage

_MAX: Final = (1 << 64) - 1


class Due(NamedTuple):
    """A frame and the CLOCK_MONOTONIC at which to send it."""

    at_ns: int
    frame: DataMessage


class Pacing:
    """Turns recorded frames into those to send."""

    def __init__(
        self,
        speed: float,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        realtime_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """`speed` 1 is the original timing."""
        self._speed = speed
        self._monotonic_ns = monotonic_ns
        self._realtime_ns = realtime_ns
        self._begun = self._reconnected = False
        # Of the first frame: when it was due, on our clock; its stamp, recorded and moved.
        self._first_at_ns = self._first_stamp_ns = self._moved_stamp_ns = 0
        self._base_ns = 0  # the recording's `monotonic_ns` that is `_first_at_ns` on ours
        self._last_at_ns = self._last_stamp_ns = 0
        # By sensor: offset of its sequence numbers, None if not known yet, and the next number.
        self._sequence: dict[int, tuple[int | None, int]] = {}
        self._moments: dict[int, int] = {}  # by sensor: recorded time of its last frame
        self._step_ns = 0  # last replayed interval between two frames of one sensor

    def reconnected(self) -> None:
        """The recorder reconnected here: the clocks before and after may differ."""
        self._reconnected = self._begun

    def begin_again(self) -> None:
        """The recording starts again: its first frame is due one interval after the last."""
        self._begun = self._reconnected = False
        self._sequence = {sensor: (None, number) for sensor, (_, number) in self._sequence.items()}

    def now(self, frame: DataMessage) -> DataMessage:
        """The frame as it is sent now, whenever it was due."""
        return self._numbered(frame, self._realtime_ns(), self._monotonic_ns())

    def due(self, frame: DataMessage) -> Due:
        """When the next frame is due, and the frame to send."""
        if not self._begun:
            self._begun = True
            self._base_ns, self._first_stamp_ns = frame.monotonic_ns, frame.stamp_ns
            self._first_at_ns = max(self._monotonic_ns(), self._last_at_ns + self._step_ns)
            self._moments.clear()
            self._moved_stamp_ns = self._realtime_ns() + self._first_at_ns - self._monotonic_ns()
            self._last_at_ns = self._first_at_ns
        elif self._reconnected:
            self._reconnected = False
            pause_ns = max(0, frame.stamp_ns - self._last_stamp_ns)
            passed_ns = round((self._last_at_ns - self._first_at_ns) * self._speed)
            self._base_ns = frame.monotonic_ns - passed_ns - pause_ns
        self._last_stamp_ns = frame.stamp_ns
        since_ns = frame.monotonic_ns - self._moments.get(frame.sensor, frame.monotonic_ns)
        self._moments[frame.sensor] = frame.monotonic_ns
        if since_ns > 0:
            self._step_ns = self._scaled(since_ns)
        moment_ns = self._first_at_ns + self._scaled(frame.monotonic_ns - self._base_ns)
        self._last_at_ns = max(self._last_at_ns, moment_ns)
        stamp_ns = self._moved_stamp_ns + self._scaled(frame.stamp_ns - self._first_stamp_ns)
        return Due(self._last_at_ns, self._numbered(frame, stamp_ns, moment_ns))

    def _scaled(self, duration_ns: int) -> int:
        # A float would lose nanoseconds in a long recording.
        return duration_ns if self._speed == 1 else round(duration_ns / self._speed)

    def _numbered(self, frame: DataMessage, stamp_ns: int, monotonic_ns: int) -> DataMessage:
        offset, next_number = self._sequence.get(frame.sensor, (0, 0))
        if offset is None:
            offset = next_number - frame.sequence
        sequence = (frame.sequence + offset) & _MAX
        self._sequence[frame.sensor] = offset, sequence + 1
        return frame._replace(
            sequence=sequence,
            stamp_ns=min(max(stamp_ns, 0), _MAX),
            monotonic_ns=min(max(monotonic_ns, 0), _MAX),
        )
