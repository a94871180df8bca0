"""`ethercat-identify`: entry point; everything else is imported after Ctrl-C is handled."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

from bota_clients.identify.options import parse_options
from bota_clients.program import not_installed


def main(argv: Sequence[str] | None = None) -> int:
    """Identify; returns the exit code."""
    # It only reads, so Ctrl-C may end it at any time.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parse_options(argv)  # --help and wrong usage need nothing of the extra
    try:
        from bota_clients.identify.program import run  # noqa: PLC0415 - NumPy takes a while to load
    except ImportError as error:
        return not_installed("ethercat-identify", error)
    return run(argv)


if __name__ == "__main__":
    sys.exit(main())
