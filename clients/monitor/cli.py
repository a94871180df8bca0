"""`ethercat-monitor`: entry point; turns errors into exit codes: 0 fine, 1 not, 2 wrong usage."""

from __future__ import annotations

import errno
import signal
import sys
from collections.abc import Sequence

from clients.program import discard_output, not_installed


def main(argv: Sequence[str] | None = None) -> int:
    """Run the monitor; returns its exit code."""
    try:
        # SIGTERM acts as Ctrl-C; the live view replaces the handler.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler)
        from clients.monitor.options import parse  # noqa: PLC0415 - Ctrl-C is heard while this loads
        from clients.monitor.program import run  # noqa: PLC0415

        options = parse(argv)
        try:
            return run(options)
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.EIO):  # the reader or the terminal was closed
                raise
            discard_output()
            return 0
        except KeyboardInterrupt:
            return 1 if options.once else 0
    except KeyboardInterrupt:
        # Before the options were parsed.
        given = sys.argv[1:] if argv is None else argv
        return int(any(len(word) > len("--") and "--once".startswith(word) for word in given))
    except ImportError as error:
        return not_installed("ethercat-monitor", error)


if __name__ == "__main__":
    sys.exit(main())
