"""`ethercat-report`: entry point, progress and output."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from bota_clients.errors import ReportError
from bota_clients.program import discard_output, interrupt_on_signals, not_installed
from bota_clients.report.options import parse_options


def main(argv: Sequence[str] | None = None) -> int:
    """Make a report; returns the exit code."""
    options = parse_options(argv)
    try:
        from bota_clients.report import program  # noqa: PLC0415 - needs the extra

        interrupt_on_signals()
        with _Progress(options.seconds) as progress:
            outcome = program.make(options, progress)
    except KeyboardInterrupt:
        return _fail("stopped: no report was written")
    except ImportError as error:
        return not_installed("ethercat-report", error)
    except ReportError as error:
        return _fail(str(error))
    try:
        print(outcome.words, flush=True)
    except BrokenPipeError:
        discard_output()  # the report is written all the same
    print(f"ethercat-report: the report is in {options.output}", file=sys.stderr)
    return outcome.exit_code


class _Progress:
    """Shows the remaining time on a terminal, on a line that is cleared at the end."""

    def __init__(self, seconds: float) -> None:
        self._seconds, self._shown = seconds, -1
        self._terminal = sys.stderr.isatty()

    def __enter__(self) -> Callable[[float], None]:
        return self._show

    def __exit__(self, *_: object) -> None:
        if self._terminal and self._shown >= 0:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _show(self, passed: float) -> None:
        if self._terminal and int(passed) != self._shown:
            self._shown = int(passed)
            left = f"listening, {self._seconds - passed:.0f} s left"
            print(f"\r\x1b[K{left}", end="", file=sys.stderr, flush=True)


def _fail(sentence: str) -> int:
    print(f"ethercat-report: {sentence}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
