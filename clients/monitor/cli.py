"""`ethercat-monitor`: entry point; turns errors into exit codes: 0 fine, 1 not, 2 wrong usage."""

from __future__ import annotations

import errno
import sys
from collections.abc import Sequence

from clients.monitor.options import parse
from clients.program import discard_output, not_installed


def main(argv: Sequence[str] | None = None) -> int:
    """Run the monitor; returns its exit code."""
    options = parse(argv)
    try:
        from clients.monitor.program import run  # noqa: PLC0415 - needs the extra

        return run(options)
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.EIO):  # the reader or the terminal was closed
            raise
        discard_output()
        return 0
    except KeyboardInterrupt:
        return 1 if options.once else 0
    except ImportError as error:
        return not_installed("ethercat-monitor", error)


if __name__ == "__main__":
    sys.exit(main())
