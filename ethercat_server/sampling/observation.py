"""What a frame says of a sensor's slave controller when it passes."""

from __future__ import annotations

from typing import NamedTuple

# DC system time when the frame arrived, a working counter; DC local time of the event PDI buffer change, a
# working counter. Both times are modulo 2**32 ns.
Latched = tuple[int, int, int, int]


class DistributedClock(NamedTuple):
    """The distributed clock of one slave controller, as another master has set it."""

    offset: int  # DC system time less local time: system time offset less propagation delay, modulo 2**32 ns
    loop_delay_ns: int  # from when a frame arrives at the slave until it is there again on its way back
    reading_ns: int  # from when a frame arrives until it has read what is latched, at most
