"""`ethercat-monitor`: makes ends and errors exit codes: 0 ended or fine, 1 not, 2 wrong usage."""

from __future__ import annotations

import errno
import signal
import sys
from collections.abc import Sequence

from clients.endings import hush, not_installed


def main(argv: Sequence[str] | None = None) -> int:
    """Run the monitor; returns its exit code."""
    try:
        # SIGTERM ends what prints lines as Ctrl-C does; the live view takes it over.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        from clients.monitor.options import parse  # noqa: PLC0415 - Ctrl-C is heard while this loads
        from clients.monitor.program import run  # noqa: PLC0415

        options = parse(argv)
        try:
            return run(options)
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.EIO):  # the reader, or the terminal, is gone
                raise
            hush()
            return 0
        except KeyboardInterrupt:
            return 1 if options.once else 0
    except KeyboardInterrupt:
        # The options are not known yet, or wrong.
        given = sys.argv[1:] if argv is None else argv
        return int(any(len(word) > len("--") and "--once".startswith(word) for word in given))
    except ImportError as error:
        return not_installed("ethercat-monitor", error)


if __name__ == "__main__":
    sys.exit(main())
