"""Takes all that the server sends, in order and across reconnects, counts it and writes it into a file.

In batches, because waking up for each frame would cost more than all other work on it; and writing has a
thread of its own, so that a slow disk does not delay reading. The queue in between is bounded. What does not
fit is counted, and an event marks where it is missing.
"""

from __future__ import annotations

import json
import math
import queue
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final

from rich.filesize import decimal

from bota_clients.errors import RecordingError
from bota_clients.numbers import count
from bota_clients.recording.file_format import RECORDER, Note, RecordedDescription, RecordedEvent
from bota_clients.recording.mcap_writer import DiskFile
from bota_clients.recording.writer import RecordingWriter
from bota_ethercat.accounting import StreamAccounting, StreamCounts
from bota_ethercat.address import Address
from bota_ethercat.client import Client, Connected, Disconnected
from bota_ethercat.framing import DataMessage
from bota_ethercat.program.version import VERSION
from bota_ethercat.replies import SensorInfo
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import printable, rows

NAME: Final = f"ethercat-record {VERSION}"
Batch = list[DataMessage | Note]

BATCH_S: Final = 0.02  # two sensors at 1600 Hz make 64 frames in this time
# Bytes that the kernel may buffer, as far as it allows: seconds in which nothing is lost.
_RECEIVE_BUFFER: Final = 4 * 1024 * 1024
FLUSH_S: Final = 0.4  # longest time until received frames are in the file
# Maximum number of queued frames: a minute of two sensors at 1600 Hz, some 80 MB.
MAX_BACKLOG: Final = 200_000
# Longest time for writing what is queued when it is to stop: ros2 launch sends the next signal after 5 s.
_END_S: Final = 3.0


class RecordingClient(Client):
    """A client that renews its subscription whenever the connection ends, to those sensors that are there."""

    def __init__(self, address: Address, sensors: Sequence[int] | None) -> None:
        """`sensors` are positions on the bus, None for all."""
        # REPEATED frames too: they show that a sensor was silent.
        super().__init__(
            address.port, address.host, sensors=sensors, fresh_only=False, raw=True,
            receive_buffer=_RECEIVE_BUFFER,
        )  # fmt: skip
        self._problem = ""

    def batch(self, timeout_s: float = 0.0) -> Batch:
        """Everything received meanwhile, waiting at most `timeout_s` for the first."""
        batch: Batch = []
        for item in self.poll_all(timeout_s):
            if isinstance(item, DataMessage):
                batch.append(item)
            elif isinstance(item, Connected):
                self._problem = ""
                missing = ", ".join(map(str, item.missing))
                said = {"message": f"without sensor {missing}"} if missing else {}
                same_machine = self.session.same_machine
                batch.append(_noted("connected", server=str(self.address), same_machine=same_machine, **said))
                batch.append(RecordedDescription(time.time_ns(), item.description))
            elif isinstance(item, Disconnected):
                if item.was_connected:
                    batch.append(_noted("disconnected", reason=item.reason))
                elif item.reachable and item.reason != self._problem:
                    # A server that was started again without one of its sensors, say: it is tried again.
                    self._problem = item.reason
                    batch.append(_noted("refused", message=item.reason))
            elif not isinstance(item, InForce):
                if item.get("source") == RECORDER:
                    del item["source"]  # reserved for the recorder's own events
                batch.append(RecordedEvent(time.time_ns(), item))
        return batch


def _noted(name: str, **values: object) -> RecordedEvent:
    return RecordedEvent(time.time_ns(), {"event": name, "source": RECORDER, **values})


def notes(source: RecordingClient) -> dict[str, str]:
    """The notes at the beginning of a recording of a source that is connected."""
    wanted = source.session.wanted
    return {
        "recorder": NAME,
        "server": str(source.address),
        "server_version": printable(source.description.get("version"), 40),
        "host": socket.gethostname(),
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **({"sensors": " ".join(map(str, wanted))} if wanted else {}),
    }


class Recorder:
    """Records batches into a file until it is stopped or the file cannot be written; `with` stops it.

    Attributes:
        dropped: frames that came but could not be written.
        disconnections: of the server; what it sent meanwhile is not counted as lost.
        error: why nothing more can be written, or None.
        saved: number of frames in the file, including the next flush.
    """

    def __init__(self, path: Path, library: str, notes: Mapping[str, str], *, overwrite: bool) -> None:
        """Create the file; RecordingError. `notes` become its metadata."""
        self.dropped = self.disconnections = 0
        # By position on the bus.
        self._streams = defaultdict[int, StreamAccounting](partial(StreamAccounting, fresh_only=False))
        self.error: RecordingError | None = None
        self.saved = 0
        self._queue: queue.SimpleQueue[Batch | None] = queue.SimpleQueue()
        self._backlog = self._overflow = self._unflushed = 0
        self._disk = DiskFile(path, overwrite=overwrite)
        self._writer = RecordingWriter(self._disk, library, notes)
        self._reason = ""
        self._end_by = math.inf
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if not self._reason:
            self.stop("an error ended it")

    @property
    def failed(self) -> bool:
        """Whether the recorder has stopped; `error` says why."""
        return not self._thread.is_alive()

    @property
    def summary(self) -> str:
        """What is recorded and what was lost, in words."""
        frames = f"{self.saved} frames of {count(len(self._counts()), 'sensor')}"
        found = [f"{count(self.dropped, 'frame')} came but could not be written"] if self.dropped else []
        for position, sensor in self._counts().items():
            for number, thing, what in (
                (sensor.withheld, "frame", "not read in time"),
                (sensor.lost, "sample", "lost on the bus (estimated)"),
                (sensor.invalid, "frame", "invalid"),
            ):
                if number:
                    found.append(f"{count(number, thing)} of sensor {position} {what}")
        gone = ""
        if self.disconnections:
            gone = f"; not counted: what came during {count(self.disconnections, 'disconnection')}"
        return f"{frames}, {decimal(self._disk.tell())}; {', '.join(found) or 'nothing was lost'}{gone}"

    def _counts(self) -> dict[int, StreamCounts]:
        counts = {position: stream.counts for position, stream in sorted(dict(self._streams).items())}
        return {position: each for position, each in counts.items() if each.frames}

    def put(self, batch: Batch) -> None:
        """Queue a batch; never blocks."""
        if not batch:
            return
        if self._backlog + len(batch) > MAX_BACKLOG:
            self._overflow += _frames_in(batch)
            return
        self._backlog += len(batch)
        self._put_overflow()
        self._queue.put(batch)

    def stop(self, reason: str) -> None:
        """Write what is queued, for a bounded time, and finish the file; `error` is set if that failed."""
        self._put_overflow()
        self._reason = reason
        self._end_by = time.monotonic() + _END_S
        self._queue.put(None)
        self._thread.join()
        while not self._queue.empty():  # queued after a failure
            self.dropped += _frames_in(self._queue.get() or ())

    def _put_overflow(self) -> None:
        if self._overflow:
            self._backlog += 1
            self._queue.put([_noted("lost", frames=self._overflow, reason="the disk did not keep up")])
            self._overflow = 0

    # -- the thread

    def _run(self) -> None:
        try:
            self._record()
            counts = {at: {"frames": each.frames, **asdict(each)} for at, each in self._counts().items()}
            last = {"reason": self._reason, "dropped": str(self.dropped), "sensors": json.dumps(counts)}
            self._writer.finish(last)
        except RecordingError as error:
            self._fail(error)
        except BaseException as error:
            self._fail(RecordingError(f"a fault of this program ended the recording: {error!r}"))
            raise
        finally:
            self._disk.close()

    def _fail(self, error: RecordingError) -> None:
        self.error = error
        # The failed flush was truncated; of a file that was removed nothing is left.
        missing = self._writer.frames if self._disk.removed else self._unflushed
        self.dropped += missing
        self.saved -= missing

    def _record(self) -> None:
        flush_at = time.monotonic() + FLUSH_S
        too_late = 0
        while True:
            try:
                batch = self._queue.get(timeout=max(0.0, flush_at - time.monotonic()))
            except queue.Empty:
                batch = []
            if batch is None:
                if too_late:
                    self._write(
                        _noted("lost", frames=too_late, reason="there was no time left to write them")
                    )
                return
            self._backlog -= len(batch)
            if time.monotonic() >= self._end_by:
                too_late += _frames_in(batch)
                batch = [item for item in batch if not isinstance(item, DataMessage)]
            for item in batch:
                self._write(item)
            if time.monotonic() >= flush_at:
                flush_at = time.monotonic() + FLUSH_S
                self._writer.flush()
                self._unflushed = 0

    def _write(self, item: DataMessage | Note) -> None:
        if isinstance(item, DataMessage):
            self._unflushed += 1
            self.saved += 1
            self._streams[item.sensor].count(item.sequence, item.monotonic_ns, item.flags)
            self._writer.frame(item)
            return
        self._writer.note(item)
        if isinstance(item, RecordedDescription):
            self._take_rates(rows(item.reply.get("sensors")))
        elif not item.by_recorder:
            self._take_rates([item.event])
        elif item.name == "lost":
            self.dropped += int(item.event["frames"])
        else:  # the server may have been restarted, and its numbering with it
            self.disconnections += item.name == "disconnected"
            for stream in self._streams.values():
                stream.begin()

    def _take_rates(self, told: Sequence[JsonObject]) -> None:
        """By them the samples that are missing are counted."""
        for row in told:
            if (info := SensorInfo.parse(row)) is not None:
                stream = self._streams[info.sensor]
                stream.rate_hz = info.rate_hz or stream.rate_hz


def record(source: RecordingClient, recorder: Recorder, until: Callable[[Batch], str | None]) -> None:
    """Record what a connected source gives, and close both.

    Until `until`, which is told each batch, has a reason to end, or nothing more can be written.
    """
    with recorder:
        reason = None
        while not (reason or recorder.failed):
            recorder.put(batch := source.batch())
            reason = until(batch)
            if not reason:
                time.sleep(BATCH_S)
        source.close()
        recorder.stop(reason or "")


def _frames_in(batch: Iterable[object]) -> int:
    return sum(isinstance(item, DataMessage) for item in batch)
