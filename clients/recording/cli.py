"""`ethercat-record`: hears signals from the first moment on, says what is not installed."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from clients.endings import not_installed
from clients.signals import Signals


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code."""
    signals = Signals()
    try:
        # Takes a moment, in which Ctrl-C is to be heard already.
        from clients.recording.program import run  # noqa: PLC0415
    except ImportError as error:
        return not_installed("ethercat-record", error)
    return run(argv, signals)


if __name__ == "__main__":
    sys.exit(main())
