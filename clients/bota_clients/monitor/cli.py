"""`ethercat-monitor`: command line, and the view that it asks for: live, a table, JSON, or a page.

Exit codes: 0 fine, 1 not, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import errno
import itertools
import math
import os
import sys
import time
from collections.abc import Sequence
from typing import Final

from bota_clients.arguments import add_imu_units, add_server, address, is_loopback, server_of
from bota_clients.monitor.model import Model
from bota_clients.monitor.reader import Reader
from bota_clients.monitor.words import json_line, verdict
from bota_clients.program import interrupt_on_signals, not_installed
from bota_ethercat.address import DEFAULT_HOST, Address
from bota_ethercat.health.limits import Level
from bota_ethercat.health.sentences import no_server
from bota_ethercat.program.arguments import Parser, seconds
from bota_ethercat.program.output import discard_output, ends_with_its_reader

DEFAULT_WEB: Final = Address(DEFAULT_HOST, 12080)
_PERIOD_S: Final = 1.0
_ONCE_S: Final = 1.0
_ANSWER_S: Final = 6.0


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
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
    except ImportError as error:  # of rich, textual, websockets, which are imported where they are used
        return not_installed("ethercat-monitor", error)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = Parser(
        "ethercat-monitor",
        "Shows the stream of ethercat-server live in the terminal. Press ? for the keys.",
        "With --once: exit code 0 if all is good or worth a look, 1 if there is trouble, or no server.",
    )
    add_server(made)
    add = made.add_argument
    add("--once", action="store_true",
        help="observe for a second, print a table and exit, as it does without a terminal")  # fmt: skip
    add("--json", action="store_true", help="print one JSON object per second; with --once, just one")
    add("--seconds", type=seconds, metavar="S", help="exit after S seconds")
    add_imu_units(made)
    add(
        "--web", type=_loopback, nargs="?", const=DEFAULT_WEB, metavar="PORT",
        help=f"show it in a browser instead, on this port of this machine (default {DEFAULT_WEB.port})",
    )  # fmt: skip
    options = made.parse_args(argv)
    options.address = server_of(made, options.server)
    if options.once and options.seconds is not None:
        made.error("--seconds cannot be combined with --once")
    if options.web is not None and (options.once or options.json):
        made.error("--web cannot be combined with --once or --json")
    return options


def _loopback(text: str) -> Address:
    where = address(text)
    if is_loopback(where.host):
        return where
    raise argparse.ArgumentTypeError(
        f"{text!r}: the page is for this machine only: give a port, and reach it from elsewhere over ssh -L"
    )


def run(options: argparse.Namespace) -> int:
    if options.web is not None:
        from bota_clients.monitor.web.server import run_web  # noqa: PLC0415

        return run_web(options.address, options.web, options.imu_units, options.seconds)
    terminal = (
        sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get("TERM", "dumb") not in {"", "dumb"}
    )
    live = terminal and not options.once and not options.json
    options.once = options.once or not (live or options.json)
    if live:
        import bota_clients.monitor.app  # noqa: PLC0415
    else:
        import bota_clients.monitor.screen  # noqa: F401, PLC0415
    interrupt_on_signals()  # the live view replaces the handler of SIGTERM
    model = Model(str(options.address), options.imu_units)
    reader = Reader(options.address, model)
    reader.start()
    try:
        if live:
            return _live(options, model)
        answered = reader.tried.wait(_ANSWER_S) and model.state(time.monotonic()).server.connected
        if options.once:
            return _once(options, model, answered=answered)
        return _each_second(options, model)
    finally:
        reader.close()


def _once(options: argparse.Namespace, model: Model, *, answered: bool) -> int:
    from bota_clients.monitor.screen import table  # noqa: PLC0415

    if answered:
        time.sleep(_ONCE_S)
    state = model.state(time.monotonic())
    if options.json:
        _say(json_line(state, time.time()))
    if not answered:
        reason = state.server.reason or no_server(options.address, "it does not answer")
        sys.stderr.write(f"ethercat-monitor: {reason}\n")
        return 1
    if not options.json:
        _say(*table(state))
    return 1 if verdict(state)[0] is Level.TROUBLE else 0


def _live(options: argparse.Namespace, model: Model) -> int:
    from bota_clients.monitor.app import Monitor  # noqa: PLC0415

    app = Monitor(model, options.address, seconds=options.seconds)
    try:
        app.run(mouse=False)
        if app.recorder.running:
            _say("Finishing the recording")
    finally:
        ended = app.recorder.close()
    if ended:
        _say(ended)
    return app.return_code or 0


def _each_second(options: argparse.Namespace, model: Model) -> int:
    for _ in itertools.count() if options.seconds is None else range(math.ceil(options.seconds)):
        time.sleep(_PERIOD_S)
        _say(json_line(model.state(time.monotonic()), time.time()))
        model.reset()  # peaks and warnings of the next line are those of its own second
    return 0


def _say(*lines: str) -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
