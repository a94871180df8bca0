"""`ethercat-server`: handles signals from the start, runs the server, turns errors into exit codes."""

from __future__ import annotations

import contextlib
import errno
import logging
import sys
from collections.abc import Sequence

from bota_ethercat.program.output import ends_with_its_reader
from bota_ethercat.program.signals import Signals
from ethercat_server.daemon.options import parse_options
from ethercat_server.errors import ServerError, StopRequestedError
from ethercat_server.ethercat.options import VIRTUAL_INTERFACE
from ethercat_server.process.logs import set_up_logging

log = logging.getLogger(__name__)


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    """Run the server; returns its exit code."""
    signals = Signals()
    set_up_logging()
    try:
        options = parse_options(argv)
        with contextlib.ExitStack() as cleanup:
            virtual = None
            if options.ifname == VIRTUAL_INTERFACE:
                from ethercat_server.virtual_sensor.virtual_bus import VirtualBus  # noqa: PLC0415 - for this only

                # By the port two such servers have different sensors, each the same every time.
                server = options.server
                virtual = VirtualBus(
                    options.virtual_arguments, server["rt_priority"], server["user"], options.port
                )
                cleanup.callback(virtual.end)
                virtual.start()  # it takes as long as what follows
            # Loading it takes a moment: Ctrl-C must work already, and --help need not wait for it.
            from ethercat_server.daemon.server import serve  # noqa: PLC0415

            serve(options, signals, virtual)
    except StopRequestedError:
        log.info("stopped during start-up")
    except ServerError as error:
        log.error("%s", error)
        return error.exit_code
    except OSError as error:
        if error.errno not in (errno.EMFILE, errno.ENFILE):
            raise
        log.error("the server may open too few files (ulimit -n): allow it 256 at least")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
