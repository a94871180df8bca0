"""`ethercat-monitor --web`: serves page and stream on this machine. The only file that uses websockets.

A page of another site can make a browser send requests here, even under a host name of its own that resolves
to this machine (DNS rebinding). Then Host or Origin has that name. Requests are answered only under a name of
this machine, any port, because `ssh -L` may forward another one; the stream only to the page itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
import logging
import sys
import time
from collections.abc import AsyncIterator, Callable
from functools import partial
from http import HTTPStatus
from importlib.resources import files
from typing import Any, Final
from urllib.parse import urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from bota_clients.arguments import is_loopback
from bota_clients.monitor.reader import MonitorReader
from bota_clients.monitor.recording import MonitorRecording
from bota_clients.monitor.tare import start_tare
from bota_clients.monitor.web.pages import MOST_BYTES, TOO_MANY, Page, Pages, WebModel
from bota_clients.program import call_on, say
from bota_ethercat.address import Address
from bota_ethercat.pdo import ImuUnits

POINTS_S: Final = 1 / 30
POINTS_A_STATE: Final = 6
STREAM: Final = "/stream"  # where the page opens its WebSocket
HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}  # of every response
_TYPES: Final = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
_FOREIGN_HOST: Final = (
    "The page is for this machine only: open http://localhost:PORT/, from elsewhere over ssh -L."
)
_FOREIGN_ORIGIN: Final = "The stream is for the page that is served here, and not for others."
_NO_ADDRESS: Final = (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT, None)  # asyncio may lose the number
_POLICY_VIOLATION: Final = 1008
_TRY_AGAIN_LATER: Final = 1013
_WHY: Final = {
    errno.EADDRINUSE: "is in use",
    errno.EACCES: "is reserved for root",
    **dict.fromkeys(_NO_ADDRESS, "is no address of this machine"),
}

# Neither requests nor errors of clients are written to the terminal.
_QUIET: Final = logging.Logger(__name__, logging.CRITICAL)


def run_web(address: Address, where: Address, imu_units: ImuUnits, seconds: float | None) -> int:
    """Serve the page of the server at `address` until a signal or for `seconds`; returns the exit code."""
    recorder = MonitorRecording(address)
    try:
        asyncio.run(_run(address, where, imu_units, seconds, recorder))
    except OSError as error:
        if error.errno not in _WHY:
            raise
        say("ethercat-monitor", f"{where} {_WHY[error.errno]}: choose another port with --web PORT")
        return 1
    finally:
        if ended := recorder.close():
            sys.stdout.write(f"{ended}\n")
    return 0


async def _run(
    address: Address, where: Address, imu_units: ImuUnits, seconds: float | None, recorder: MonitorRecording
) -> None:
    stop = asyncio.Event()
    call_on(asyncio.get_running_loop(), stop.set, "SIGINT", "SIGTERM", "SIGHUP")
    model = WebModel(str(address), imu_units)
    pages = Pages(model, partial(start_tare, address), recorder)
    reader = MonitorReader(address, model, POINTS_S)
    async with serving(pages, *where) as port:
        sys.stdout.write(
            f"Open http://{Address(where.host, port)}/#token={pages.token}\n"
            "With this link the page can tare and record; without #token=... it only shows. Ctrl-C ends it.\n"
        )
        sys.stdout.flush()
        reader.start()
        try:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), seconds)
        finally:
            reader.close()


@contextlib.asynccontextmanager
async def serving(
    pages: Pages, host: str, port: int, clock: Callable[[], float] = time.monotonic
) -> AsyncIterator[int]:
    """Serve on a loopback address; yields the port. OSError if it cannot be bound.

    For `localhost` on both addresses, so that no other program answers under one of them.
    """
    page_files = read_page()
    options: dict[str, Any] = {
        "process_request": lambda _, request: respond(page_files, request),
        "compression": None, "max_size": MOST_BYTES, "max_queue": 4, "open_timeout": 5.0,
        "close_timeout": 0.5, "server_header": None, "logger": _QUIET,
    }  # fmt: skip

    async def converse(connection: ServerConnection) -> None:
        page = pages.join()
        if page is None:
            await connection.close(_TRY_AGAIN_LATER, TOO_MANY)
            return
        sending = asyncio.create_task(send(connection, page))
        try:
            async for text in connection:
                if answer := pages.handle(page, text):
                    await connection.send(answer)
                if page.end:
                    await connection.close(_POLICY_VIOLATION, page.end)
        except ConnectionClosed:
            pass
        finally:
            sending.cancel()
            pages.connected.discard(page)

    async def send(connection: ServerConnection, page: Page) -> None:
        """As fast as the page reads: what it has no time for waits in the pages."""
        with contextlib.suppress(ConnectionClosed):
            for count in itertools.count():
                if count % POINTS_A_STATE == 0:
                    await connection.send(pages.state(clock()))
                for text in pages.points(page):
                    await connection.send(text)
                await asyncio.sleep(POINTS_S)

    async def collect() -> None:
        while True:
            pages.collect(clock())
            await asyncio.sleep(POINTS_S)

    async with contextlib.AsyncExitStack() as stack:
        missing = 0
        for address in (addresses := ("127.0.0.1", "::1") if host == "localhost" else (host,)):
            try:
                server = await stack.enter_async_context(serve(converse, address, port, **options))
                port = next(iter(server.sockets)).getsockname()[1]
            except OSError as error:
                missing += 1
                if missing == len(addresses) or error.errno not in _NO_ADDRESS:
                    raise
        collecting = asyncio.create_task(collect())
        try:
            yield port
        finally:
            collecting.cancel()


def read_page() -> dict[str, tuple[bytes, str]]:
    """Body and type of each file of the page by its path."""
    page = files("bota_clients.monitor.web") / "page"
    found = {}
    for folder, path in ((page, "/"), (page / "uplot", "/uplot/")):
        for entry in folder.iterdir():
            if kind := _TYPES.get(entry.name.rpartition(".")[2]):
                text = "" if kind.startswith("image") else "; charset=utf-8"
                found[path + entry.name] = entry.read_bytes(), kind + text
    found["/"] = found.pop("/index.html")
    return found


def respond(page_files: dict[str, tuple[bytes, str]], request: Request) -> Response | None:
    """The answer to a GET; None for a stream that may be opened."""
    path = request.path.partition("?")[0]
    host, origin = (_only(request.headers.get_all(name)) for name in ("Host", "Origin"))
    status, kind = HTTPStatus.FORBIDDEN, "text/plain; charset=utf-8"
    if not _is_this_machine(host):
        body = f"{_FOREIGN_HOST}\n".encode()
    elif path == STREAM:
        if origin.lower() == f"http://{host.lower()}":
            return None
        body = f"{_FOREIGN_ORIGIN}\n".encode()
    elif path in page_files:
        status, (body, kind) = HTTPStatus.OK, page_files[path]
    else:
        status, body = HTTPStatus.NOT_FOUND, b"There is no such file.\n"
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), **HEADERS})
    return Response(status.value, status.phrase, headers, body)


def _only(values: list[str]) -> str:
    return values[0] if len(values) == 1 else ""


def _is_this_machine(host: str) -> bool:
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False
