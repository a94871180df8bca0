"""What the benchmark's recording processes share: the record, its file, the warm-up, the scheduling.

A record is five whole numbers: position of the sensor, number of the sample, CLOCK_MONOTONIC of the sample
as it says itself, the same as the server says (0: it does not), CLOCK_MONOTONIC of its arrival.
"""

from __future__ import annotations

import os
import time
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

PORT: Final = 12001  # of the server and what is compared with it
REAL_TIME: Final = 40  # SCHED_FIFO of clients, the node among them, as the launch file's `realtime:=true`
COLUMNS: Final = 5
INPUT_BYTES: Final = 61  # process data of a virtual sensor
_NS: Final = 1_000_000_000


class ClockReading(NamedTuple):
    """Content of a sample of the signal `clock`."""

    number: int  # modulo 2**24
    instant_ns: int  # modulo 2**20 s


def decode_clock(force_torque: Sequence[float]) -> ClockReading:
    """Sample number and instant from force x, y, z and torque x of the signal `clock`.

    Takes the values as they came off the bus.
    """
    number, seconds, micros, nanos = (int(value) for value in force_torque[:4])
    return ClockReading(number, seconds * 10**9 + micros * 1000 + nanos)


class ArrivalRecorder:
    """Keeps what arrives once the warm-up is over, for a time; then writes it to `path`."""

    def __init__(self, path: Path, warm_up_s: float, seconds: float) -> None:
        self._path = path
        self._warm_up_ns, self._length_ns = int(warm_up_s * _NS), int(seconds * _NS)
        self._from_ns = self._until_ns = 0
        self._values = array("q")

    def add(self, position: int, number: int, instant_ns: int, stamp_ns: int, received_ns: int) -> bool:
        """Note one arrival; False when the time is over."""
        if received_ns < self._from_ns:
            return True
        if not self._until_ns:
            if not self._from_ns:
                self._from_ns = received_ns + self._warm_up_ns
                return True
            self._until_ns = received_ns + self._length_ns
            began(self._path).touch()
        self._values.extend((position, number, instant_ns, stamp_ns, received_ns))
        return received_ns < self._until_ns

    def write(self) -> None:
        """Write all records, so that the file is there only when it is complete."""
        unfinished = self._path.with_suffix(".unfinished")
        unfinished.write_bytes(self._values.tobytes())
        unfinished.replace(self._path)


def deadlines(period_ns: int) -> Iterator[None]:
    """Once a period at absolute instants, for a program that polls; those that have passed are left out."""
    due = time.monotonic_ns()
    while True:
        time.sleep(max(0, due - time.monotonic_ns()) * 1e-9)
        yield
        due += period_ns * (1 + max(0, time.monotonic_ns() - due) // period_ns)


def began(path: Path) -> Path:
    """The file that appears when a program begins to record into `path`."""
    return path.with_suffix(".began")


def may_be_real_time() -> bool:
    """Whether this process may have real-time scheduling."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True
