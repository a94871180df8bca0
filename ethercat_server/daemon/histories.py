"""The files with the histories of the sensors, one by serial number, which a thread writes now and then.

In $STATE_DIRECTORY, which systemd gives a service, else below ~/.local/state of the user that the server is.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pwd
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from bota_ethercat.errors import FileError
from bota_ethercat.program.new_file import NewFile
from ethercat_server.acquisition.drift import Drift
from ethercat_server.process import realtime
from ethercat_server.sensor.history import LONGEST, History

_EVERY_S: Final = 600.0

log = logging.getLogger(__name__)


@contextlib.contextmanager
def kept(drifts: Sequence[Drift]) -> Iterator[None]:
    """Within it the histories are those of the files, and are written there; at the end, too."""
    by_path = {_folder() / f"sensor-{drift.sensor.identity.serial}.json": drift for drift in drifts}
    for path, drift in by_path.items():
        drift.history = History(_read(path))
    ended = threading.Event()

    def write_now_and_then() -> None:
        realtime.leave()
        while not ended.wait(_EVERY_S):
            _write(by_path)

    thread = threading.Thread(target=write_now_and_then, name="histories", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        for drift in drifts:
            drift.end_run()
        _write(by_path)


def _folder() -> Path:
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given)
    try:
        home = pwd.getpwuid(os.geteuid()).pw_dir
    except KeyError:
        home = "/nonexistent"
    return Path(home) / ".local/state/bota-ethercat-bridge"


def _read(path: Path) -> str:
    """Its text; empty if there is none, or it cannot be one of ours."""
    try:
        if path.is_file() and path.stat().st_size <= LONGEST:
            return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        pass
    return ""


def _write(by_path: dict[Path, Drift]) -> None:
    for path, drift in by_path.items():
        if not drift.history.changed:
            continue
        drift.history.changed = False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with NewFile(path, force=True) as file:
                file.write(drift.history.text())
                file.finish()
        except (OSError, FileError) as error:
            log.warning("the history of sensor %d is not kept: %s", drift.sensor.number, error)
