"""`ethercat-replay`: entry point; catches signals while the rest is imported."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from bota_clients.program import Signals, not_installed
from bota_clients.replay.options import parse_options


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code."""
    signals = Signals()
    parse_options(argv)  # --help and wrong usage need nothing of the extra
    try:
        from bota_clients.replay.program import run  # noqa: PLC0415 - after the signals
    except ImportError as error:
        return not_installed("ethercat-replay", error)
    return run(argv, signals)


if __name__ == "__main__":
    sys.exit(main())
