"""The histories of the sensors in files, one by serial number, which a thread writes now and then.

Sensors that share a serial number have none: after a change of cables each would have the other's.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator, Sequence
from typing import Final

from bota_ethercat.program import state
from ethercat_server.acquisition.drift import Drift
from ethercat_server.process import realtime
from ethercat_server.sensor.history import History

_EVERY_S: Final = 600.0

log = logging.getLogger(__name__)


@contextlib.contextmanager
def kept(drifts: Sequence[Drift]) -> Iterator[None]:
    """Within it the histories are those of the files, and are written there; at the end, too."""
    by_path, serials = {}, [drift.sensor.identity.serial for drift in drifts]
    for drift, serial in zip(drifts, serials, strict=True):
        if serials.count(serial) > 1:
            text = "no history is kept of sensor %d: another one has its serial number %d, too"
            log.warning(text, drift.sensor.number, serial)
            continue
        path = state.folder() / f"sensor-{serial}.json"
        by_path[path], drift.history = drift, History(state.read(path))
    ended = threading.Event()

    def write() -> None:
        for path, drift in by_path.items():
            if drift.history.changed:
                drift.history.changed = False
                try:
                    state.write(path, drift.history.as_json())
                except OSError as error:
                    drift.history.changed = True
                    log.warning("the history of sensor %d is not kept: %s", drift.sensor.number, error)

    def write_now_and_then() -> None:
        realtime.leave()
        while not ended.wait(_EVERY_S):
            write()

    thread = threading.Thread(target=write_now_and_then, name="histories", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        write()
