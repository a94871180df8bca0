"""When camera frames were taken: read from a table, a bag or a rate, and put on the server's clock.

Frames are stamped by a wall clock, which may be set meanwhile. Every DATA frame has the stamps of both clocks
of the server, so a recording has the history of their offset: by this the frames' stamps are put on
CLOCK_MONOTONIC, which is never set.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.recording.columns import Ints
from bota_ethercat.errors import BadMessageError
from bota_ethercat.text.json_text import parse_json_object

_SECOND: Final = 1_000_000_000
_LATEST_NS: Final = 4_102_444_800 * _SECOND  # the year 2100


class Clock(NamedTuple):
    """Another clock than the server's, as `ethercat-export align` finds it."""

    stamp_ns: int  # of that clock, ...
    monotonic_ns: int  # ... at this instant of the server's CLOCK_MONOTONIC
    drift_ppm: float  # by which the server's is faster

    @classmethod
    def read(cls, path: Path) -> Clock:
        """What `ethercat-export align` printed; RecordingError."""
        try:
            found = parse_json_object(path.read_bytes())
            return cls(int(found["stamp_ns"]), int(found["monotonic_ns"]), float(found["drift_ppm"]))
        except (OSError, BadMessageError, LookupError, TypeError, ValueError):
            raise RecordingError(f"{path} is not what 'ethercat-export align' prints") from None


class FrameTimes:
    """The frames' instants on the server's clock.

    Attributes:
        count: number of frames given; 0 for a rate.
        instants_ns: (f,) by CLOCK_MONOTONIC, ascending, of the frames that the recording has reached.
        stamps_ns: (count,) as given; of a rate, by CLOCK_REALTIME, as many as instants.
    """

    def __init__(
        self,
        stamps_ns: Ints | None = None,
        *,
        fps: float = 0.0,
        latency_s: float = 0.0,
        clock: Clock | None = None,
        source: str = "the frames",
    ) -> None:
        """Stamps of frames, or their rate from the first sample on; RecordingError if they cannot be used.

        `latency_s`: from the exposure to the stamp. `clock`: of the stamps, if it is not the server's
        CLOCK_REALTIME. `source` is named in errors.
        """
        none = np.zeros(0, np.int64)
        self.stamps_ns, self.instants_ns = none if stamps_ns is None else stamps_ns, none
        self.count = len(self.stamps_ns)
        self._period_ns, self._latency_ns = fps and _SECOND / fps, 0 if fps else round(latency_s * _SECOND)
        self._source = source
        self._begin = self._newest = (-1, -1)  # both stamps of the first and of the newest sample
        self._is_set_back = False  # so is the clock of the next frame, and that of the samples not yet
        if clock is not None:
            if (descents := np.flatnonzero(np.diff(self.stamps_ns) < 0)).size:
                raise self.refusal(int(descents[0]) + 1, 0)
            passed = self.stamps_ns - clock.stamp_ns
            drifted = np.rint(passed * (clock.drift_ppm * 1e-6)).astype(np.int64)
            self._take(clock.monotonic_ns + passed + drifted)

    def follow(self, stamp_ns: Ints, monotonic_ns: Ints) -> None:
        """Take both stamps of the next samples."""
        if self._begin[0] < 0:
            self._begin = self._newest = int(stamp_ns[0]), int(monotonic_ns[0])
        stamps, instants = np.append(self._newest[0], stamp_ns), np.append(self._newest[1], monotonic_ns)
        self._newest = int(stamps[-1]), int(instants[-1])
        if self._period_ns:
            last = int((instants[-1] - self._begin[1]) / self._period_ns)
            numbers = np.arange(len(self.instants_ns), last + 1)
            made = self._begin[1] + np.rint(numbers * self._period_ns).astype(np.int64)
            self._take(made)
            self.stamps_ns = np.append(self.stamps_ns, _interpolated(made, instants, stamps))
            return
        begin = 0
        for end in [*(np.flatnonzero(np.diff(stamps) < 0) + 1).tolist(), len(stamps)]:
            here, there = stamps[begin:end], instants[begin:end]
            # The clock was set between two samples, and frames of this time may be by either.
            if begin:
                there = np.append(instants[begin - 1], there)
                here = np.append(here[0] - there[1] + there[0], here)
                self._is_set_back = False
            if end < len(stamps):
                there = np.append(there, instants[end])
                here = np.append(here, here[-1] + there[-1] - there[-2])
            self._map(here, there)
            begin = end

    def _map(self, stamps: Ints, instants: Ints) -> None:
        """Take the frames between these samples, between which no clock was set back."""
        frames = self.stamps_ns[len(self.instants_ns) :]
        frames = frames[: int(np.append(np.flatnonzero(np.diff(frames) < 0), len(frames))[0]) + 1]
        if len(frames) and frames[0] >= stamps[0] and not self._is_set_back:
            ready = frames[: np.searchsorted(frames, stamps[-1], "right")]
            self._take(_interpolated(ready, stamps, instants))
            self._is_set_back = len(ready) == len(frames)

    def _take(self, instants_ns: Ints) -> None:
        self.instants_ns = np.append(self.instants_ns, instants_ns - self._latency_ns)

    def refusal(self, row: int, until_ns: int) -> RecordingError:
        """Why this frame has no window, where all before it have one; windows end at `until_ns`."""
        if not self.count:
            return RecordingError("the recording is too short for a frame")
        stamp, source = int(self.stamps_ns[row]), f"row {row} of {self._source} (counted from 0)"
        if row and stamp < self.stamps_ns[row - 1]:
            return RecordingError(
                f"{source} is before the row above it, and the server's clock was not set then: sort the rows"
            )
        end_ns = self._newest[0] + until_ns - self._newest[1]
        taken, begin, end = (np.datetime64(ns, "ns") for ns in (stamp, self._begin[0], end_ns))
        return RecordingError(
            f"{source} is of {taken}Z, and samples were measured from {begin}Z to {end}Z: leave the row out, "
            "or find the offset of its clock with 'ethercat-export align'"
        )


def _interpolated(at: Ints, here: Ints, there: Ints) -> Ints:
    """One clock by another, in ns, without loss of digits."""
    return np.asarray(
        there[0] + np.rint(np.interp(at - here[0], here - here[0], there - there[0])).astype(np.int64)
    )


def read_stamps(path: Path, column: str = "timestamp", topic: str | None = None) -> Ints:
    """The frames' stamps, ns since 1970: of a column, or the `header.stamp` of a topic; RecordingError.

    A column has times (ISO 8601), integers, ns since 1970, or other numbers, s since 1970.
    """
    if topic is None:
        stamps = _read_column(path, column)
    else:
        stamps = np.array([stamp for stamp, _ in messages(path, topic)], np.int64)
    if not len(stamps):
        raise RecordingError(f"{path} has no frames")
    if (wrong := np.flatnonzero((stamps < 0) | (stamps > _LATEST_NS))).size:
        raise RecordingError(f"row {wrong[0]} of {path} (counted from 0) is no time since 1970")
    return stamps


def _read_column(path: Path, column: str) -> Ints:
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`
    from pyarrow import csv, parquet  # noqa: PLC0415

    try:
        table = parquet.read_table(path) if path.suffix == ".parquet" else csv.read_csv(path)
        found = table[column]
        if pa.types.is_timestamp(found.type):
            found = found.cast(pa.timestamp("ns", found.type.tz)).cast("int64")
        elif not pa.types.is_integer(found.type):
            found = pa.array(np.rint(found.cast("float64").to_numpy() * _SECOND).astype(np.int64))
        return np.asarray(found.to_numpy().astype(np.int64))
    except (OSError, KeyError, pa.ArrowInvalid) as error:
        raise RecordingError(
            f"{path} has no times in a column {column} (choose one with --column; of a bag, --topic): {error}"
        ) from None


def messages(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """`header.stamp`, ns since 1970, and message, of a topic of a ROS bag (folder, .mcap, .db3, .bag).

    RecordingError.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 - of the extra `dataset`
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
            chosen = [each for each in bag.connections if each.topic == topic]
            if not chosen:
                there = ", ".join(sorted({each.topic for each in bag.connections}))
                raise RecordingError(f"{path} has no topic {topic}, but {there}")
            for connection, _, data in bag.messages(chosen):
                message: Any = bag.deserialize(data, connection.msgtype)
                stamp = message.header.stamp
                yield int(stamp.sec) * _SECOND + int(stamp.nanosec), message
    except AttributeError:
        raise RecordingError(f"messages of {topic} in {path} have no header, so no time") from None
    except (AnyReaderError, FileNotFoundError) as error:
        raise RecordingError(f"{path} cannot be read as a bag: {error}") from None
