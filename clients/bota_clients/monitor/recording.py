"""Records into a file in this folder, in a thread of its own, as `ethercat-record` does."""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path

from bota_clients.errors import RecordingError
from bota_clients.record import recorder as files
from bota_ethercat.address import Address
from bota_ethercat.errors import ProtocolError


class MonitorRecording:
    """At most one recording at a time."""

    def __init__(self, address: Address) -> None:
        self._address = address
        self._asked = threading.Event()  # to stop
        self._thread: threading.Thread | None = None
        self._said = "", False
        self.since_s = 0.0

    @property
    def running(self) -> bool:
        """Whether a recording was started and has not been reported as ended."""
        return self._thread is not None

    def toggle(self, now_s: float) -> str:
        """Start a recording, or request the end of that which runs, which `ended` reports; what to say."""
        if self.running:
            self._asked.set()
            return "Stopping the recording"
        path = Path(time.strftime("recording-%Y%m%d-%H%M%S.mcap"))
        self._asked.clear()
        self._thread = threading.Thread(target=self._run, args=(path,), name="recording")
        self._thread.start()
        self.since_s = now_s
        return f"Recording to {path}"

    def ended(self) -> tuple[str, bool] | None:
        """A message about a recording that has ended, and whether it is an error; else None."""
        if self._thread is None or self._thread.is_alive():
            return None
        self._thread = None
        return self._said

    def close(self) -> str | None:
        """Stop the recording and wait for it; a message, if there was one."""
        self._asked.set()
        if self._thread is not None:
            self._thread.join()
        found = self.ended()
        return found[0] if found else None

    def _run(self, path: Path) -> None:
        try:
            with contextlib.closing(files.RecordingClient(self._address, None)) as source:
                source.connect()
                recorder = files.Recorder(path, files.NAME, files.notes(source), overwrite=False)
                files.record(source, recorder, lambda _: "asked to stop" if self._asked.is_set() else None)
            if recorder.error is not None:
                raise recorder.error
            self._said = f"Recorded {path}: {recorder.summary}", False
        except (RecordingError, ProtocolError) as error:
            self._said = f"The recording failed: {error}", True
