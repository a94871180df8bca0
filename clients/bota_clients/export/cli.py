"""`ethercat-export`: entry point; Ctrl-C ends it at any time and leaves no file."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from bota_clients.export.options import parse_options
from bota_clients.program import interrupt_on_signals, not_installed, say

_PROGRAM = "ethercat-export"


def main(argv: Sequence[str] | None = None) -> int:
    """Export; returns the exit code."""
    options = parse_options(argv)
    try:
        from bota_clients.export.program import run  # noqa: PLC0415 - needs the extra
    except ImportError as error:
        return not_installed(_PROGRAM, error)
    try:
        interrupt_on_signals()
        return run(options)
    except KeyboardInterrupt:
        say(_PROGRAM, "stopped: nothing was written")
        return 1


if __name__ == "__main__":
    sys.exit(main())
