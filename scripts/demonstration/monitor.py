"""`scripts/demo --no-ros`, in a network namespace of its own: ethercat-monitor of a virtual sensor.

Without a terminal, what the monitor knows at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import sys

from bota_clients.monitor import cli as monitor
from bota_ethercat.address import DEFAULT_PORT
from bota_ethercat.program.arguments import number
from scripts.chain import Chain, Stopped, loopback_up, stoppable


def run(seconds: float | None) -> int:
    """The exit code: 1 if the monitor finds trouble. ScriptError or Stopped end it early."""
    loopback_up()
    with Chain() as chain:
        chain.python("ethercat-server", "ethercat_server.daemon.cli", "virtual", DEFAULT_PORT)
        chain.connect(1)
        print("a virtual sensor at 800 Hz; Ctrl-C ends it", flush=True)
        with contextlib.suppress(Stopped):
            if sys.stdin.isatty() and sys.stdout.isatty():
                monitor.main([] if seconds is None else ["--seconds", str(seconds)])
            else:
                chain.sleep(seconds or float("inf"))
        return monitor.main(["--once"])


def _demo() -> int:
    parser = argparse.ArgumentParser(
        prog="scripts/demo --no-ros", description="The monitor, without hardware."
    )
    time_s = number(0.5, 1e6, "a number of seconds")
    parser.add_argument("--seconds", type=time_s, help="end after this number of seconds, not at Ctrl-C")
    return run(parser.parse_args().seconds)


if __name__ == "__main__":
    sys.exit(stoppable(_demo, "demo", "stopped before anything was measured", 0))
