"""A trace in a file when a sensor is lost and nothing explains it: a few files, which a thread writes.

Such a loss cannot be repeated at will; `ethercat-doctor FILE` shows what came before it.
"""

from __future__ import annotations

import logging
import threading
from itertools import cycle
from pathlib import Path
from typing import Final

from bota_ethercat.program import state
from bota_ethercat.program.command import command
from ethercat_server.process import realtime
from ethercat_server.sampling.trace import FrozenTrace
from ethercat_server.server import Server

_FILES: Final = 3  # the oldest is written over
_PAUSE_S: Final = 600  # without another trace after one
_AFTER_S: Final = 2  # a trace has what followed the loss, too
_PART: Final = 64 << 10  # bytes written at once

log = logging.getLogger(__name__)


class LossTraces:
    """Those of a server. `each_second` is to be called in the loop."""

    def __init__(self, server: Server) -> None:
        self._tracing, folder = server.cycle.tracing, state.folder()
        self._paths = cycle(folder / f"loss-{server.bus.ifname}-{n}.trace" for n in range(1, _FILES + 1))
        self._pause_s = 0  # until a loss leaves a trace again
        server.recovery.on_unexplained_loss = self._ask
        self.writing: threading.Thread | None = None

    def _ask(self) -> None:
        self._pause_s = self._pause_s or _PAUSE_S

    def each_second(self) -> None:
        """A second has passed."""
        self._pause_s = max(0, self._pause_s - 1)
        if self._pause_s == _PAUSE_S - _AFTER_S:
            # The loop freezes it, which takes a fraction of a ms; a file may take long.
            work = self._tracing.freeze(), next(self._paths)
            self.writing = threading.Thread(target=_write, args=work, name="trace", daemon=True)
            self.writing.start()


def _write(trace: FrozenTrace, path: Path) -> None:
    realtime.leave()
    try:
        state.replace(path, (trace.read(offset, _PART) for offset in range(0, trace.size, _PART)))
    except OSError as error:
        log.warning("the trace of the loss is not kept: %s", error)
    else:
        log.info("the minute of the loss is in %s: '%s' shows it", path, command(f"ethercat-doctor {path}"))
