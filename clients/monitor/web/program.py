"""`ethercat-monitor --web`: puts reader, model and web server together, and ends them."""

from __future__ import annotations

import asyncio
import errno
import sys
from functools import partial
from typing import Final

from clients.monitor.options import Options
from clients.monitor.reader import Reader
from clients.monitor.tare import start_tare
from clients.monitor.web.access import Token
from clients.monitor.web.hub import WebModel
from clients.monitor.web.server import PageHub, WebServer
from clients.program import call_on, say
from protocol.address import Address

POINTS_S: Final = 1 / 30
_WHY: Final = {
    errno.EADDRINUSE: "is in use",
    errno.EACCES: "is reserved for root",
    errno.EADDRNOTAVAIL: "cannot be had: this machine has no such address",
}


def run_web(options: Options, where: Address) -> int:
    """Serve the page until a signal or the time limit; returns the exit code."""
    try:
        asyncio.run(_serve(options, where))
    except OSError as error:
        if error.errno not in _WHY:
            raise
        say("ethercat-monitor", f"{where} {_WHY[error.errno]}: choose another port with --web PORT")
        return 1
    return 0


async def _serve(options: Options, where: Address) -> None:
    stop = asyncio.Event()
    call_on(asyncio.get_running_loop(), stop.set, "SIGINT", "SIGTERM", "SIGHUP")
    token, model = Token(), WebModel(str(options.address), options.imu_units)
    hub = PageHub(model, token, partial(start_tare, options.address))
    reader = Reader(options.address, model, POINTS_S)
    async with WebServer(hub, model).serving(*where) as port:
        sys.stdout.write(
            f"Open http://{Address(where.host, port)}/#token={token.text}\n"
            "With this link the page can tare the sensor; without #token=... it only shows. Ctrl-C ends it.\n"
        )
        sys.stdout.flush()
        reader.start()
        try:
            async with asyncio.timeout(options.seconds):
                await stop.wait()
        except TimeoutError:
            pass
        finally:
            reader.close()
