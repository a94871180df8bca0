"""`scripts/demo --no-ros`, in a network namespace of its own: ethercat-monitor of a virtual sensor.

Without a terminal, what the monitor knows at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from typing import Final

from bota_clients.monitor import cli as monitor
from bota_ethercat.address import DEFAULT_PORT
from bota_ethercat.client import Client
from bota_ethercat.errors import ProtocolError
from bota_ethercat.program.arguments import number
from bota_ethercat.program.signals import interrupt_on_signals
from ethercat_server.ethercat.nic import change_flags

_IFF_UP: Final = 1
_START_TIMEOUT_S: Final = 30.0


def run(seconds: float | None) -> int:
    """The exit code: 1 if the server does not start, or the monitor finds trouble."""
    change_flags(socket.if_nametoindex("lo"), on=_IFF_UP)
    command = [sys.executable, "-m", "ethercat_server.daemon.cli", "virtual", str(DEFAULT_PORT)]
    server = subprocess.Popen(
        ["setpriv", "--pdeathsig", "SIGTERM", *command],
        stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        if not _answers(server):
            print(f"demo: the server did not start: {server.communicate()[1]}", file=sys.stderr)
            return 1
        print("a virtual sensor at 800 Hz; Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            if sys.stdin.isatty() and sys.stdout.isatty():
                monitor.main([] if seconds is None else ["--seconds", str(seconds)])
            else:
                threading.Event().wait(seconds)
        return monitor.main(["--once"])
    finally:
        server.terminate()
        server.wait()


def _answers(server: subprocess.Popen[str]) -> bool:
    end = time.monotonic() + _START_TIMEOUT_S
    while server.poll() is None:
        with (
            contextlib.suppress(ProtocolError),
            Client(DEFAULT_PORT, stream=False, reconnect=False).connect(),
        ):
            return True
        if time.monotonic() > end:
            server.terminate()
        time.sleep(0.05)
    return False


def main() -> int:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(
        prog="scripts/demo --no-ros", description="The monitor, without hardware."
    )
    time_s = number(0.5, 1e6, "a number of seconds from 0.5 to 1000000")
    parser.add_argument("--seconds", type=time_s, help="end after this number of seconds, not at Ctrl-C")
    interrupt_on_signals()
    try:
        return run(parser.parse_args().seconds)
    except KeyboardInterrupt:
        return 0
    finally:
        shutil.rmtree(os.environ.get("DEMO_DIRECTORY", ""), ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
