"""What `ethercat-export --at` does: windows of samples for each frame, from a recording into a file.

Without frames the file has all samples (`samples.py`).

Frames are stamped by a wall clock, which may be set meanwhile. Every DATA frame has the stamps of both clocks
of the server, so a recording has the history of their offset: by this the frames' stamps are put on
CLOCK_MONOTONIC, which is never set.

with open_recording(Path("run.mcap")) as recording:
    for block in windows_of(recording, Stamped(stamps_ns), Windows(32)):
        print(block["force_torque"].shape)
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
import os
import shutil
import tempfile
import zipfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.export.cli import DATASETS, PROGRAM
from bota_clients.export.samples import MOST_LOST, in_part, samples_of
from bota_clients.export.windows import Arrays, Windows, interpolated, read_tool
from bota_clients.identify.program import choose
from bota_clients.numbers import count
from bota_clients.recording.columns import REGISTERS, Ints
from bota_clients.recording.mcap_writer import moved_to
from bota_clients.recording.order import TimeAxis, in_order, longest_order
from bota_clients.recording.reader import RecordedSensor, Recording
from bota_ethercat.errors import BadMessageError, FileError
from bota_ethercat.program.command import command
from bota_ethercat.program.new_file import EXISTS
from bota_ethercat.program.version import VERSION
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.text.json_text import parse_json_object
from bota_ft_compensation.identification.parameter_file import offset_of
from bota_ft_compensation.identification.resampling import stretches
from bota_ft_compensation.stream import obstacle

_ALIGN: Final = command("ethercat-export align")
ATTRIBUTES: Final = "bota_ethercat"  # their key in a file, as JSON
_CHUNK: Final = 1024  # frames, in a file
GROUP: Final = 131_072  # samples, in a file
_UNITS: Final = {"force": "N", "torque": "Nm", "acceleration": "m/s^2", "angular_rate": "rad/s", "age": "s"}
_SECOND: Final = 1_000_000_000
_PER_SECOND: Final = {"s": _SECOND, "ms": 1_000_000, "us": 1000, "ns": 1}
_FIRST: Final = -(1 << 63)
_COARSEST_S: Final = 0.001
_DAY_NS: Final = 10**14  # after 1970: earlier times count from the start of something
_NEAR_NS: Final = 366 * 86400 * _SECOND
MOST_LEFT_OUT: Final = 0.1  # of rows or messages, for their order: with more it is the stamps that are wrong


class ForeignClock(NamedTuple):
    """Another clock than the server's, as `ethercat-export align` finds it."""

    stamp_ns: int  # of that clock, ...
    monotonic_ns: int  # ... at this instant of the server's CLOCK_MONOTONIC
    drift_ppm: float  # by which the server's is faster

    @classmethod
    def read(cls, path: Path) -> ForeignClock:
        """What `ethercat-export align` printed; RecordingError."""
        try:
            found = parse_json_object(path.read_bytes())
            return cls(int(found["stamp_ns"]), int(found["monotonic_ns"]), float(found["drift_ppm"]))
        except (OSError, BadMessageError, LookupError, TypeError, ValueError):
            raise RecordingError(f"{path} is not what '{_ALIGN}' prints") from None

    def instants(self, stamps_ns: Ints) -> Ints:
        """Of the server's CLOCK_MONOTONIC."""
        passed = stamps_ns - self.stamp_ns
        return np.asarray(
            self.monotonic_ns + passed + np.rint(passed * (self.drift_ppm * 1e-6)).astype(np.int64)
        )


class Periodic:
    """Frames at a rate, from the first sample on until the last; none in pauses of more than a second."""

    said: Sequence[str] = ()

    def __init__(self, fps: float) -> None:
        self._period_ns, self._begin_ns = _SECOND / fps, -1

    def exposed(self, stamps: Ints, instants: Ints) -> Ints:
        """As `Stamped.exposed`; the stamps are by CLOCK_REALTIME."""
        if self._begin_ns < 0:
            self._begin_ns = int(instants[0])
        made = list[Ints]()
        for part in stretches(instants, _SECOND):
            ends = (instants[[part.start, part.stop - 1]] - self._begin_ns) / self._period_ns
            numbers = np.arange(*np.ceil(ends))
            made.append(self._begin_ns + np.rint(numbers * self._period_ns).astype(np.int64))
        exposed = np.concatenate(made)
        return np.stack([interpolated(exposed, instants, stamps), exposed])


class Stamped:
    """Frames in the order of their instants, stamped so long after the exposure.

    Attributes:
        outside: how many so far were before or after the recording, so that their windows are not valid.
        left_out: rows that are in no order, or there twice.
    """

    def __init__(
        self,
        stamps_ns: Ints,
        source: str = "the frames",
        latency_s: float = 0.0,
        clock: ForeignClock | None = None,
        *,
        strict: bool = False,
    ) -> None:
        """`source` is for errors; `clock` made the stamps, if not the server's CLOCK_REALTIME.

        `strict`: RecordingError for a frame outside of the recording.
        """
        self.outside, self.left_out, self.strict, self._early = 0, 0, strict, 0
        self.count, self._stamps, self._source, self._clock = len(stamps_ns), stamps_ns, source, clock
        self._rows, self._left = np.arange(len(stamps_ns)), stamps_ns
        self._latency_ns = round(latency_s * _SECOND)

    def exposed(self, stamps: Ints, instants: Ints) -> Ints:
        """(2, f) ns: stamps of the frames up to the last of these samples, and instants of their exposure.

        From both stamps (n,) of the samples, the last of the call before first.
        """
        if self._clock is None:
            found, self._early = self._left[: self._early] - stamps[0] + instants[0], 0
        else:
            found = self._clock.instants(self._left)
        ends = [0, *(np.flatnonzero(np.diff(stamps) < 0) + 1).tolist(), len(stamps)]
        for begin, end in itertools.pairwise(ends):
            here, there = stamps[begin:end], instants[begin:end]
            # The clock was set back between two samples, and frames of this time may be by either.
            if begin:
                there = np.append(instants[begin - 1], there)
                here = np.append(here[0] - there[1] + there[0], here)
            if end < len(stamps):
                there = np.append(there, instants[end])
                here = np.append(here, here[-1] + there[-1] - there[-2])
            rest = self._left[len(found) :]
            rest = rest[: int(np.append(np.flatnonzero(np.diff(rest) < 0), len(rest))[0]) + 1]
            if len(rest) and rest[0] >= here[0]:
                reached = rest[: np.searchsorted(rest, here[-1], "right")]
                found = np.append(found, interpolated(reached, here, there))
        made, self._left = self._left[: len(found)], self._left[len(found) :]
        return np.stack([made, found - self._latency_ns])

    def begin(self, recording: Recording, sensor: int) -> None:
        """Leave out what is in no order, and find the frames before its lowest stamp.

        Which is not its first if the clock was set.
        """
        self._leave_out(recording, sensor)
        stamps, is_near = self._stamps, self._clock is None and not self.strict
        new = (part.stamp_ns[part.fresh] for _, part in recording.batches(sensor, is_whole=True))
        first_ns = next((int(part[0]) for part in new if len(part)), 0)
        if is_near and first_ns - _NEAR_NS < stamps[0] < first_ns:
            lowest_ns = min((int(part.min(initial=first_ns)) for part in new), default=first_ns)
            ascending = stamps[: int(np.append(np.flatnonzero(np.diff(stamps) < 0), len(stamps))[0]) + 1]
            self._early = int(np.searchsorted(ascending, lowest_ns))

    def _leave_out(self, recording: Recording, sensor: int) -> None:
        """What is not later than the row before, unless the clock was set back, or it is much."""
        kept = in_order(self._stamps)
        if self._clock is None and not kept.all():
            clocks, steps = np.zeros((2, 0), np.int64), list[Ints]()
            for _, each in TimeAxis().batches(recording.batches(sensor, is_whole=True)):
                new = np.stack([each.stamp_ns, each.monotonic_ns])[:, each.fresh]
                clocks = np.hstack([clocks[:, -1:], new])
                last = np.flatnonzero(np.diff(clocks[0]) < 0)  # before each step back
                steps.append(np.stack([clocks[:, last], clocks[:, last + 1]]))
            before, after = np.concatenate([np.zeros((2, 2, 0), np.int64), *steps], axis=2)
            kept = longest_order(self._places(before, after))
        if (~kept).mean() <= MOST_LEFT_OUT:
            self.left_out = int((~kept).sum())
            self._rows, self._stamps, self._left = self._rows[kept], self._stamps[kept], self._left[kept]
            self.count -= self.left_out

    def _places(self, before: Ints, after: Ints) -> Iterator[list[int]]:
        """Of each row the stretches without a step back that it may be of, and it.

        By the samples' clocks (2, k), stamps and instants, before and after each of the k steps.
        """
        apart = after[1] - before[1]
        first = [-math.inf, *(after[0] - apart).tolist()]
        ends = [*(before[0] + apart).tolist(), math.inf]
        for row in self._stamps.tolist():
            within = enumerate(zip(first, ends, strict=True))
            yield [(number << 64) + row for number, (begin, end) in within if begin <= row <= end]

    def end(self, stamp_ns: int, instant_ns: int) -> Ints:
        """As `exposed`, of the frames after the recording's last sample, if the others are."""
        left = self._left
        if self.strict or (np.diff(left, prepend=stamp_ns) < 0).any() or (left > stamp_ns + _NEAR_NS).any():
            left = left[:0]
        return np.stack([left, left - stamp_ns + instant_ns - self._latency_ns])

    @property
    def said(self) -> list[str]:
        """What is not as it should be, in clauses."""
        outside = (
            f"those of {self.outside} of {count(self.count, 'frame')} are not valid: the frames are before "
            "or after the recording (--strict refuses them)"
        )
        left_out = f"{count(self.left_out, 'frame')} left out, not later than the row before"
        return [outside] * bool(self.outside) + [left_out] * bool(self.left_out)

    def refusal(self, row: int, begin_ns: int, end_ns: int) -> RecordingError:
        """Of this row, which was not exposed between these two stamps, or is not in its place."""
        source, stamps = f"row {self._rows[row]} of {self._source} (counted from 0)", self._stamps
        if row and stamps[row] < stamps[row - 1]:
            return RecordingError(
                f"{source} is before the row above it, and the server's clock was not set then: sort the rows"
            )
        which, bound = ("first", begin_ns) if stamps[row] < begin_ns else ("last", end_ns)
        nearest = min(max(bound, _FIRST + 1), -_FIRST - 1)  # that has a date
        taken, limit = np.array([stamps[row], nearest]).astype("datetime64[ns]")
        what = f"leave the row out, or find the offset of its clock with '{_ALIGN}'"
        if not stamps[row]:
            what = "its time was not set (0): leave the row out"
        if self._clock is None and stamps.max() < _DAY_NS:
            what = (
                "its times are of no clock (LeRobot's are frame_index / fps): keep the cameras' own, --column"
            )
        for unit, per_unit in _PER_SECOND.items():
            if unit != "ns" and abs(int(stamps[row]) * per_unit - bound) < _NEAR_NS:
                what = f"it seems to be {unit} since 1970: give integers in ns, or numbers with a point in s"
        return RecordingError(
            f"{source} is of {taken}Z, and the {which} sample was measured at {limit}Z: {what}"
        )


def read_stamps(path: Path, name: str = "timestamp") -> Ints:
    """The frames' stamps, ns since 1970: a column, or the `header.stamp` of a bag's topic; RecordingError.

    A column has times (ISO 8601), integers, ns since 1970, or other numbers, s since 1970.
    """
    if path.suffix in (".csv", ".parquet"):
        stamps = _read_column(path, name)
    else:
        stamps = np.array([stamp for stamp, _ in messages(path, name)], np.int64)
    if not len(stamps):
        raise RecordingError(f"{path} has no frames")
    if len(stamps) > 1 and not stamps.any():
        raise RecordingError(
            f"the times of {name} in {path} are all 0: what wrote them, a camera's driver or a simulation "
            "without a clock, set none; have it stamp its frames and record again"
        )
    if (again := np.flatnonzero(np.diff(stamps) == 0)).size > MOST_LEFT_OUT * len(stamps):
        raise RecordingError(
            f"row {again[0] + 1} of {path} (counted from 0) has the time of the row above it: its times are "
            "too coarse for the frames, or the row is there twice; give times of at least 1 ms resolution"
        )
    return stamps


def _read_column(path: Path, column: str) -> Ints:
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`
    from pyarrow import csv, parquet  # noqa: PLC0415

    def refused(why: object) -> RecordingError:
        return RecordingError(f"{path} has no times in a column {column} (choose one with --column): {why}")

    try:
        if path.suffix == ".parquet":
            found = parquet.read_table(path)[column].combine_chunks()
        else:  # an empty line may be a row, but for those at the end
            options = csv.ParseOptions(ignore_empty_lines=False)
            table = csv.read_csv(path, parse_options=options)
            nulls = [each.is_null().to_numpy() for each in table.columns]
            ends = np.flatnonzero(~np.logical_and.reduce(nulls))[-1:].max(initial=-1) + 1
            found = table[column].combine_chunks()[:ends]
        if pa.types.is_dictionary(found.type):
            found = found.dictionary_decode()
    except (FileNotFoundError, PermissionError) as error:
        raise RecordingError(f"{path} cannot be read: {os.strerror(error.errno or 0)}") from None
    except (OSError, KeyError, ValueError) as error:  # ArrowInvalid among them
        raise refused(error) from None
    kind, types = found.type, pa.types
    is_text = types.is_string(kind) or types.is_large_string(kind) or types.is_string_view(kind)
    per_unit = 1
    if found.null_count:
        raise refused(
            f"row {found.is_null().to_numpy(False).argmax()} (counted from 0) is empty or no number"
        )
    if types.is_timestamp(kind):
        values, per_unit = found.cast("int64").to_pylist(), _PER_SECOND[kind.unit]
    elif types.is_integer(kind):
        values = found.to_pylist()
    elif is_text or types.is_decimal(kind) or types.is_floating(kind):
        values = [_nanoseconds(value) for value in found.to_pylist()]
    else:
        raise refused(f"it has {kind}, and times have a date and a time of day, or are numbers since 1970")
    for row, value in enumerate(values):
        if not isinstance(value, int) or not _FIRST < value * per_unit < -_FIRST:
            text = value if isinstance(value, str) else f"{found[row]}, which is too far from now"
            raise refused(
                f"row {row} (counted from 0) is {text}; integers are ns, other numbers s since 1970, and "
                "texts ISO 8601"
            )
    if types.is_float16(kind) or types.is_float32(kind):
        off_s = np.spacing(np.abs(found.to_numpy(False)).astype(kind.to_pandas_dtype()))
        if (coarse := off_s.astype(float) > _COARSEST_S).any():
            row = int(coarse.argmax())
            raise refused(
                f"row {row} (counted from 0) is known to {off_s[row]:g} s only: write float64, or ns"
            )
    return np.array(values, np.int64) * per_unit


def _nanoseconds(value: Any) -> int | str:
    """Of s since 1970, or of ISO 8601; a text: of what it is instead."""
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`

    if isinstance(value, str):
        for zone in ("UTC", None):
            with contextlib.suppress(pa.ArrowInvalid):
                taken = pa.scalar(value.strip()).cast(pa.timestamp("ns", zone))
                return int(taken.value) if ":" in value else f"{value[:40]}, without a time of day"
        return f"{value[:40]!r}"
    if not math.isfinite(value):
        return str(value)
    return round(Decimal(str(value)) * _SECOND)  # the number as it was written


def messages(path: Path, topic: str, most: int | None = None) -> Iterator[tuple[int, Any]]:
    """`header.stamp`, ns since 1970, and message, of a topic of a ROS bag (folder, .mcap, .db3, .bag).

    Where they are more than `most`, only each second, third, ... RecordingError.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 - of the extra `dataset`
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    paths = [path]
    if path.is_dir() and not (path / "metadata.yaml").exists():  # whose recorder was killed
        paths = sorted(each for each in path.iterdir() if each.suffix in (".mcap", ".db3")) or paths
    try:
        with AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
            chosen = [each for each in bag.connections if each.topic == topic]
            if not chosen:
                there = ", ".join(sorted({each.topic for each in bag.connections}))
                raise RecordingError(f"{path} has no topic {topic}, but {there}")
            _refuse_two_definitions(path, chosen[0], bag.connections)
            step = 1 + sum(each.msgcount for each in chosen) // most if most else 1
            for connection, _, data in itertools.islice(bag.messages(chosen), None, None, step):
                message: Any = bag.deserialize(data, connection.msgtype)
                stamp = message.header.stamp
                yield int(stamp.sec) * _SECOND + int(stamp.nanosec), message
    except AttributeError:
        raise RecordingError(f"messages of {topic} in {path} have no header, so no time") from None
    except (AnyReaderError, FileNotFoundError) as error:
        which, what = ", ".join(map(str, paths)), ""
        if paths != [path]:
            what = "; its folder has no metadata.yaml, so its recorder was killed: try 'mcap recover'"
        raise RecordingError(f"{which} cannot be read as a bag: {error}{what}") from None


def _refuse_two_definitions(path: Path, chosen: Any, connections: Iterable[Any]) -> None:
    """RecordingError if the bag has two definitions of a type of the topic: rosbags decodes all with one."""
    from rosbags.interfaces import MessageDefinitionFormat  # noqa: PLC0415 - of the extra `dataset`
    from rosbags.typesys import get_types_from_msg  # noqa: PLC0415

    if chosen.msgdef.format is not MessageDefinitionFormat.MSG:
        return
    own = get_types_from_msg(chosen.msgdef.data, chosen.msgtype)
    for each in connections:
        if each.msgdef.format is MessageDefinitionFormat.MSG and each.msgdef.data != chosen.msgdef.data:
            for name, definition in get_types_from_msg(each.msgdef.data, each.msgtype).items():
                if own.get(name, definition) != definition:
                    raise RecordingError(
                        f"{path} defines {name} in two ways, for {chosen.topic} and {each.topic}: "
                        f"make a bag of {chosen.topic} alone"
                    )


def windows_of(
    recording: Recording, frames: Periodic | Stamped, windows: Windows, sensor: int = 0
) -> Iterator[Arrays]:
    """Blocks of f frames: `stamp_ns` as given, `monotonic_ns` of the exposure, and their `Windows.at`.

    RecordingError for a frame that has no place among the samples and is not merely before or after them.
    """
    stamped, outside = frames if isinstance(frames, Stamped) else None, 0
    if stamped is not None:
        stamped.begin(recording, sensor)
    done, first, clocks, waiting = 0, *(np.zeros((2, 0), np.int64) for _ in range(3))
    batches = recording.batches(sensor, windows.imu_units, is_whole=True)
    for samples in itertools.chain(windows.follow(batches), [None]):
        until_ns = windows.until_ns
        if samples is not None:
            clocks = np.hstack([clocks[:, -1:], (samples.stamp_ns, samples.monotonic_ns)])
            if clocks.size:
                waiting = np.hstack([waiting, frames.exposed(*clocks)])
            # What comes next may put the latest samples in doubt.
            until_ns = windows.until_ns - windows.doubt_ns
        ready = waiting[:, : np.searchsorted(waiting[1], until_ns, "right")]
        first = first if done else ready[:, :1]
        if (is_early := ready[1] < windows.begin_ns)[:1].any():
            if stamped is None or stamped.strict or done > outside:
                break
            outside += int(is_early.sum())
        for begin in range(0, len(ready[0]), _CHUNK):  # in a pause there may be many
            stamp_ns, instants = ready[:, begin : begin + _CHUNK]
            yield {"stamp_ns": stamp_ns, "monotonic_ns": instants, **windows.at(instants)}
        done, waiting = done + len(ready[0]), waiting[:, len(ready[0]) :]
        windows.forget(min([until_ns, *waiting[1, :1].tolist()]))
    if not clocks.size:
        raise RecordingError(f"{recording.path} has no new and valid samples")
    if stamped is not None:
        late = np.hstack([waiting, stamped.end(*clocks[:, -1].tolist())])
        has_all = done + len(late[0]) == stamped.count and (late[1] > windows.until_ns).all()
        if done == outside or (late.size and stamped.strict) or not has_all:
            row = 0 if done == stamped.count else done
            pairs = [waiting, clocks[:, -1:]] if row or not first.size else [first]
            stamp_ns, instant_ns = np.hstack(pairs)[:, 0].tolist()
            bounds = (bound + stamp_ns - instant_ns for bound in (windows.begin_ns, windows.until_ns))
            raise stamped.refusal(row, *bounds)
        stamped.outside = outside + len(late[0])
        if late.size:
            empty = windows.at(np.full(len(late[0]), _FIRST >> 1))
            yield {"stamp_ns": late[0], "monotonic_ns": late[1], **empty}
    if not done:
        raise RecordingError("the recording is too short for a frame")


def windows_for(
    options: argparse.Namespace, recording: Recording, sensor: RecordedSensor, length: int
) -> Windows:
    """With the tool that is asked for; RecordingError if it cannot compensate anything in the recording."""
    tool = options.tool and read_tool(options.tool)
    if tool and any(tool.get("bias", ())):  # is it known what it is with the sensor's own offset?
        if offset_of(tool) is None:
            raise RecordingError(
                f"{options.tool} does not say with which offset of the sensor its bias was measured: "
                "identify the tool again, add sensor_offset if you know it, or leave the bias out"
            )
        if all(row.info.offset is None for row in sensor.offsets):
            raise RecordingError(
                f"{recording.path} does not have the sensor's own offset, so the bias of {options.tool} is "
                "not known: record with a newer server, or leave the bias out"
            )
    windows = Windows(length, tool=tool, imu_units=options.imu_units)
    if (stream := windows.stream) is not None:  # else what is compensated is marked, stretch by stretch
        has_tool = stream.plan.has_tool
        whys = {obstacle(row.info.settings, has_tool=has_tool, by_imu=True) for row in sensor.history}
        if whys and "" not in whys:
            raise RecordingError(f"the wrench cannot be compensated: {min(whys)}; or omit --tool")
    return windows


def write(options: argparse.Namespace, recording: Recording) -> str:
    """All samples, or windows for the frames that are asked for, into a file; says what it has."""
    clock = options.clock and ForeignClock.read(options.clock)
    length, sensor, path = int(options.window), choose(recording, options.sensor), options.output
    frames: Periodic | Stamped | None = Periodic(options.fps) if options.fps else None
    if options.at is not None:
        stamps = read_stamps(options.at, options.column)
        frames = Stamped(stamps, str(options.at), options.latency, clock, strict=options.strict)
    windows = windows_for(options, recording, sensor, length if frames else MOST_LOST)
    said = about(options, recording, sensor, windows.tool, clock)
    if path.exists() and not (options.force and (path.is_file() or (path / "zarr.json").exists())):
        raise FileError(f"{path} {EXISTS}")
    tally = Counter[bool]()
    with moved_to(path) as made:
        if frames:
            blocks = in_part(recording, windows, windows_of(recording, frames, windows, sensor.sensor))
        else:
            blocks = in_part(recording, windows, samples_of(recording, windows, sensor.sensor))
            blocks = _tallied(blocks, tally)
        blocks = in_chunks(blocks, _CHUNK if frames else GROUP)
        _WRITERS[options.suffix](made, said, blocks)
        if path.is_dir():
            shutil.rmtree(path)
    if not frames:
        rows = f"{count(tally.total(), 'sample')}, {tally[False]} of them not valid"
        return "; ".join([rows, *windows.axis.said])
    return "; ".join([f"windows of {count(length, 'sample')}", *windows.axis.said, *frames.said])


def about(
    options: argparse.Namespace,
    recording: Recording,
    sensor: RecordedSensor,
    tool: Mapping[str, Any] | None,
    clock: ForeignClock | None = None,
) -> str:
    """The attributes of a file, JSON."""
    found = {
        "program": f"{PROGRAM} {VERSION}",
        "options": vars(options) | {"imu_units": options.imu_units.value},
        "recording": recording.metadata,
        # In force from `stamp_ns` on, with delays of the filters; null: unknown, and taken to be 0.
        "settings": [
            {
                "stamp_ns": row.stamp_ns, **row.info._asdict(), "offset": None,
                "delay_ms": delays_ms(row.info.settings, row.info.rate_hz),
            }
            for row in sensor.history
        ],
        "offsets": [{"stamp_ns": row.stamp_ns, "offset": row.info.offset} for row in sensor.offsets],
        "units": _UNITS,
        "frames": {"force_torque": "ft_sensor", "imu": "ft_sensor_imu"},
        "clock": clock and clock._asdict(),
        "tool": tool,
    }  # fmt: skip
    return json.dumps(found, default=str)


def _tallied(blocks: Iterable[Arrays], tally: Counter[bool]) -> Iterator[Arrays]:
    """The same; counted is which of the rows are valid."""
    for block in blocks:
        valid = int(block["valid"].sum())
        tally.update({True: valid, False: len(block["valid"]) - valid})
        yield block


def in_chunks(blocks: Iterable[Arrays], size: int) -> Iterator[Arrays]:
    """The same in larger blocks: for each small one Zarr rewrites a chunk, and Parquet has a row group."""
    held, count = list[Arrays](), 0
    for block in blocks:
        held.append(block)
        count += len(block["monotonic_ns"])
        if count >= size:
            whole, count = _as_one(held), count % size
            end = len(whole["monotonic_ns"]) - count
            for begin in range(0, end, size):
                yield {name: array[begin : begin + size] for name, array in whole.items()}
            held = [{name: array[end:].copy() for name, array in whole.items()}]
    if count:
        yield _as_one(held)


def _as_one(blocks: Sequence[Arrays]) -> Arrays:
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _parquet(path: Path, about: str, blocks: Iterable[Arrays]) -> None:
    """One row for each frame or sample; a window is a fixed-size list, sample by sample."""
    write_parquet(path, (arrow_of(block, about) for block in blocks))


def arrow_of(block: Arrays, about: str) -> Any:
    """A `pyarrow.Table` of the same rows, with the attributes."""
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`

    columns: dict[str, Any] = {}
    for name, array in block.items():
        flat, size = pa.array(array.reshape(-1)), array[0].size
        if name == "sequence":
            flat = pa.array(array, mask=array < 0)
        elif array.dtype.kind == "M":
            flat = flat.cast(pa.timestamp("ns", "UTC"))
        columns[name] = flat if array.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    return pa.table(columns, metadata={ATTRIBUTES: about})


def write_parquet(path: Path, tables: Iterator[Any], more: Mapping[str, str] = {}) -> int:
    """Write tables of one schema, with more metadata; how many rows."""
    from pyarrow import parquet  # noqa: PLC0415 - of the extra `dataset`

    first, rows = next(tables), 0
    schema, is_samples = first.schema, "valid" in first.schema.names
    # A dictionary of measured numbers costs most of the time and saves nothing.
    few = [name for name in (*REGISTERS, "recording") if name in schema.names]
    with parquet.ParquetWriter(
        path, schema.with_metadata({**schema.metadata, **more}),
        compression="snappy" if is_samples else "zstd", use_dictionary=few if is_samples else True,
    ) as writer:  # fmt: skip
        for table in itertools.chain([first], tables):
            writer.write_table(table)
            rows += len(table)
    return rows


def _npz(path: Path, about: str, blocks: Iterable[Arrays]) -> None:
    """An array for each name, and `attributes`, text; in memory is a block."""
    rows, block = 0, Arrays()
    with contextlib.ExitStack() as stack, zipfile.ZipFile(path, "w") as made:
        parts = defaultdict[str, Any](lambda: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)))
        for block in blocks:
            rows += len(block["monotonic_ns"])
            for name, array in block.items():
                parts[name].write(array.tobytes())
        with made.open("attributes.npy", "w") as member:
            np.lib.format.write_array(member, np.array(about))
        for name, array in block.items():
            head = np.lib.format.header_data_from_array_1_0(array)
            head |= {"fortran_order": False, "shape": (rows, *array.shape[1:])}
            with made.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, head)
                parts[name].seek(0)
                shutil.copyfileobj(parts[name], member)


def _zarr(path: Path, about: str, blocks: Iterable[Arrays]) -> None:
    """A group with an array for each name."""
    import zarr  # noqa: PLC0415 - of the extra `dataset`

    group: Any = zarr.open_group(str(path), mode="w", attributes={ATTRIBUTES: json.loads(about)})
    for block in blocks:
        for name, array in block.items():
            if name not in group:
                shape, chunks = (0, *array.shape[1:]), (_CHUNK, *array.shape[1:])
                # Zarr reads a chunk that is missing, of an incomplete copy, as this; its default is 0.
                missing = np.nan if array.dtype.kind == "f" else 0
                group.create_array(name, shape=shape, chunks=chunks, dtype=array.dtype, fill_value=missing)
            group[name].append(array)


_WRITERS: Final = dict(zip(DATASETS, (_parquet, _zarr, _npz), strict=True))
