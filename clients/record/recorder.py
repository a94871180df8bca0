"""Writes batches in a thread of its own, so that a slow disk does not delay reading.

The queue in between is bounded. What does not fit is counted, and an event marks where it is missing.
"""

from __future__ import annotations

import json
import math
import queue
import threading
import time
from collections.abc import Mapping
from typing import Final

from clients.errors import DiskError
from clients.record.parts import Parts
from clients.record.source import Batch, lost
from clients.record.tally import Tally
from clients.recording.disk import DiskFile
from clients.recording.reader import Description, Event
from clients.recording.writer import RecordingWriter
from protocol.framing import DataMessage

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
