"""`ethercat-server`: hears signals from the first moment on, runs the server, makes errors exit codes."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

from ethercat_server.errors import ServerError, StopRequestedError
from ethercat_server.logs import set_up_logging
from ethercat_server.signals import Signals

log = logging.getLogger(__name__)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the server; returns its exit code."""
    signals = Signals()
    set_up_logging()
    # Takes a moment, in which Ctrl-C is to be heard already.
    from ethercat_server.server import serve  # noqa: PLC0415

    try:
        serve(argv, signals)
    except StopRequestedError:
        log.info("stopped before it was up")
    except ServerError as error:
        log.error("%s", error)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
