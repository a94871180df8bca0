"""Counts batches and writes them into files in a thread of its own, so that a slow disk does not delay
reading.

The queue in between is bounded. What does not fit is counted, and an event marks where it is missing. With
rotation there are several files, `run_0.mcap`, `run_1.mcap`, ...
"""

from __future__ import annotations

import json
import math
import queue
import re
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from bota_clients.errors import DiskError
from bota_clients.record.source import Batch, lost
from bota_clients.recording.disk import DiskFile, remove
from bota_clients.recording.reader import Description, Event
from bota_clients.recording.writer import RecordingWriter
from bota_ethercat.accounting import StreamAccounting, StreamCounts
from bota_ethercat.framing import DataMessage
from bota_ethercat.program.new_file import EXISTS


@dataclass(slots=True)
class Tally:
    """What came of all sensors."""

    sensors: dict[int, StreamCounts] = field(default_factory=dict)
    """By position on the bus."""
    dropped: int = 0
    """Frames that came but could not be written."""
    _accounting: dict[int, StreamAccounting] = field(default_factory=dict)

    def count(self, frame: DataMessage) -> None:
        """Count a frame that is recorded."""
        accounting = self._accounting.get(frame.sensor)
        if accounting is None:
            accounting = self._accounting[frame.sensor] = StreamAccounting(fresh_only=False)
            self.sensors[frame.sensor] = accounting.counts
        accounting.take(frame.sequence, frame.monotonic_ns, frame.flags)

    def start_again(self) -> None:
        """A new connection: the server may have been restarted, and its numbering with it."""
        for accounting in self._accounting.values():
            accounting.begin()

    @property
    def frames(self) -> int:
        """Frames of all sensors."""
        return sum(sensor.frames for sensor in self.sensors.values())

    def brief(self) -> str:
        """The same as `losses` in few words, the sensors' counts joined by +; from any thread."""
        sensors = [sensor for _, sensor in sorted(dict(self.sensors).items())]
        missing = self.dropped + sum(sensor.withheld for sensor in sensors)
        found = [f"{missing} lost"] if missing else []
        for name, counts in (
            ("gaps", [sensor.lost for sensor in sensors]),  # without a rate, one for each GAP
            ("invalid", [sensor.invalid for sensor in sensors]),
        ):
            if any(counts):
                found.append(f"{'+'.join(map(str, counts))} {name}")
        return ", ".join(found) or "nothing lost"

    def as_json(self) -> dict[str, dict[str, int]]:
        """By position on the bus: `frames`, and the counts of `bota_ethercat.accounting`."""
        return {
            str(position): {"frames": sensor.frames, **asdict(sensor)}
            for position, sensor in sorted(self.sensors.items())
        }

    def losses(self) -> list[str]:
        """What is missing, in words; nothing if nothing is."""
        found = []
        if self.dropped:
            found.append(f"{_frames(self.dropped)} came but could not be written")
        for position, sensor in sorted(self.sensors.items()):
            if sensor.withheld:
                found.append(f"{_frames(sensor.withheld)} of sensor {position} not read in time")
            if lost := sensor.lost:
                found.append(
                    f"sensor {position}: {lost} times samples were or may have been lost on the bus (GAP)"
                )
            if sensor.invalid:
                found.append(f"{_frames(sensor.invalid)} of sensor {position} invalid")
        return found


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


class Parts:
    """Names and opens the files, and decides when to start the next."""

    def __init__(self, path: Path, *, size: int | None, seconds: float | None, overwrite: bool) -> None:
        """A new file after `size` bytes or `seconds`, whichever is first; one file if both are None."""
        self.path = path
        self.made: list[Path] = []
        self._size = size
        self._seconds = seconds
        self._overwrite = overwrite
        self._opened = 0.0

    @property
    def rotate(self) -> bool:
        """Whether there can be more than one."""
        return self._size is not None or self._seconds is not None

    def check(self) -> None:
        """DiskError if a file exists and may not be overwritten, or the folder does not exist."""
        if not self.path.parent.is_dir():
            raise DiskError(f"{self.path} cannot be created: there is no folder {self.path.parent}")
        if self.path.is_dir():
            raise DiskError(f"{self.path} is a folder: name a file in it")
        found = self._existing()
        if found and not self._overwrite:
            raise DiskError(f"{found[0]} {EXISTS}")

    def open(self) -> DiskFile:
        """The next file; DiskError."""
        if not self.made and self.rotate:
            # Leftover files of an older, longer recording would seem to belong to this one.
            remove(self._existing())
        path = self._part(len(self.made)) if self.rotate else self.path
        disk = DiskFile(path, overwrite=self._overwrite)
        self.made.append(path)
        self._opened = time.monotonic()
        return disk

    def is_full(self, size: int) -> bool:
        """Whether the file, of `size` bytes, is full."""
        full = self._size is not None and size >= self._size
        return full or (self._seconds is not None and time.monotonic() - self._opened >= self._seconds)

    def _part(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.stem}_{number}{self.path.suffix}")

    def _existing(self) -> list[Path]:
        if not self.rotate:
            return [self.path] if self.path.exists() else []
        name = re.compile(f"{re.escape(self.path.stem)}_[0-9]+{re.escape(self.path.suffix)}", re.ASCII)
        return sorted(path for path in self.path.parent.iterdir() if name.fullmatch(path.name))


FLUSH_S: Final = 0.4
"""Longest time until received frames are in the file."""
MAX_BACKLOG: Final = 200_000
"""Maximum number of queued frames: a minute of two sensors at 1600 Hz, some 80 MB."""
_END_S: Final = 3.0
"""Longest time for writing what is queued when it is to stop: ros2 launch sends the next signal after 5 s."""


class Recorder:
    """Records batches into files until it is stopped or a file cannot be written.

    Attributes:
        tally: counters of what was recorded and lost.
        error: why nothing more can be written, or None.
        saved: number of frames in the files, including the next flush.
        bytes_written: size of all files.
    """

    def __init__(self, parts: Parts, library: str, notes: Mapping[str, str]) -> None:
        """Create the first file; DiskError. `notes` become its metadata."""
        self.tally = Tally()
        self.error: DiskError | None = None
        self.saved = 0
        self._parts = parts
        self._library = library
        self._notes = notes
        self._queue: queue.SimpleQueue[Batch | None] = queue.SimpleQueue()
        self._backlog = 0
        self._overflow = 0
        self._description: Description | None = None
        self._finished_bytes = 0
        self._unflushed = 0
        self._flush_at = 0.0
        self._disk: DiskFile
        self._writer: RecordingWriter
        self._open_part()
        self._reason = ""
        self._end_by = math.inf
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    @property
    def failed(self) -> bool:
        """Whether the recorder has stopped; `error` says why."""
        return not self._thread.is_alive()

    @property
    def bytes_written(self) -> int:
        """Size of all files."""
        return self._finished_bytes + self._writer.size

    def put(self, batch: Batch) -> None:
        """Queue a batch; never blocks."""
        if not batch:
            return
        if self._backlog + len(batch) > MAX_BACKLOG:
            self._overflow += sum(isinstance(item, DataMessage) for item in batch)
            return
        if self._overflow:
            batch = [lost(self._overflow, "the disk did not keep up"), *batch]
            self._overflow = 0
        self._backlog += len(batch)
        self._queue.put(batch)

    def stop(self, reason: str) -> None:
        """Write what is queued, for a bounded time, and finish the file; `error` is set if that failed."""
        if self._overflow:
            self._queue.put([lost(self._overflow, "the disk did not keep up")])
        self._reason = reason
        self._end_by = time.monotonic() + _END_S
        self._queue.put(None)
        self._thread.join()
        while not self._queue.empty():  # queued after a failure
            self.tally.dropped += sum(isinstance(item, DataMessage) for item in self._queue.get() or ())

    # -- the thread

    def _run(self) -> None:
        try:
            self._record()
            self._end_part(self._reason)
        except DiskError as error:
            self.error = error
            # The failed flush was truncated; of a file that was removed nothing is left.
            missing = self._writer.frames if self._disk.removed else self._unflushed
            self.tally.dropped += missing
            self.saved -= missing
        finally:
            self._disk.close()

    def _record(self) -> None:
        self._flush_at = time.monotonic() + FLUSH_S
        too_late = 0
        while True:
            try:
                batch = self._queue.get(timeout=max(0.0, self._flush_at - time.monotonic()))
            except queue.Empty:
                batch = []
            if batch is None:
                if too_late:
                    self._write(lost(too_late, "there was no time left to write them"))
                return
            self._backlog -= len(batch)
            if time.monotonic() >= self._end_by:
                too_late += sum(isinstance(item, DataMessage) for item in batch)
                batch = [item for item in batch if not isinstance(item, DataMessage)]
            for item in batch:
                self._write(item)
            if time.monotonic() >= self._flush_at:
                self._flush_at = time.monotonic() + FLUSH_S
                self._writer.flush()
                self._unflushed = 0
                if self._parts.is_full(self._writer.size):
                    self._end_part("rotated")
                    self._finished_bytes += self._writer.size
                    self._open_part()

    def _write(self, item: DataMessage | Description | Event) -> None:
        writer = self._writer
        if isinstance(item, DataMessage):
            self._unflushed += 1
            self.saved += 1
            self.tally.count(item)
            writer.frame(item)
        elif isinstance(item, Description):
            self._description = item
            writer.describe(item.stamp_ns, item.reply)
        else:
            if item.by_recorder and item.name == "lost":
                self.tally.dropped += int(item.event["frames"])
            elif item.by_recorder:
                self.tally.start_again()
            writer.event(item.stamp_ns, item.event)

    def _open_part(self) -> None:
        self._disk = self._parts.open()
        notes = {**self._notes, "part": str(len(self._parts.made) - 1)}
        self._writer = RecordingWriter(self._disk, self._library, notes)
        if self._description is not None:
            self._writer.describe(time.time_ns(), self._description.reply)

    def _end_part(self, reason: str) -> None:
        sensors = json.dumps(self.tally.as_json())
        self._writer.finish({"reason": reason, "dropped": str(self.tally.dropped), "sensors": sensors})
        self._unflushed = 0
        self._disk.close()
