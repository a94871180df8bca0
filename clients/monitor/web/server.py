"""The sockets: serves the page's files and its stream. The only file that uses websockets."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import socket
import time
from collections.abc import AsyncIterator, Callable
from typing import Final

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from clients.monitor.web.files import Files
from clients.monitor.web.hub import TOO_MANY, Hub, WebModel
from clients.monitor.web.viewer import MOST_BYTES

STATE_S: Final = 0.2
_CLOSING_S: Final = 0.5
_NO_IPV6: Final = (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT)
_POLICY_VIOLATION: Final = 1008
_TRY_AGAIN_LATER: Final = 1013

# What a peer does wrong is no business of the terminal's, and requests are not logged.
_QUIET: Final = logging.Logger(__name__, logging.CRITICAL)


PageHub = Hub[ServerConnection]


class WebServer:
    """Serves the pages of a hub while `serving`."""

    def __init__(self, hub: PageHub, model: WebModel, clock: Callable[[], float] = time.monotonic) -> None:
        self._hub = hub
        self._model = model
        self._clock = clock
        self._files = Files()

    @contextlib.asynccontextmanager
    async def serving(self, host: str, port: int) -> AsyncIterator[int]:
        """Serve on a loopback address, `localhost` on both; gives the port. OSError if it cannot be had."""
        listening = _listen(host, port)
        loop = asyncio.get_running_loop()

        def points_are_due() -> None:  # in the thread that feeds the model
            loop.call_soon_threadsafe(self._send_points)

        self._model.on_points = points_are_due
        async with contextlib.AsyncExitStack() as stack:
            for sock in listening:
                await stack.enter_async_context(self._serve(sock))
            states = asyncio.create_task(self._send_states())
            try:
                yield listening[0].getsockname()[1]
            finally:
                self._model.on_points = lambda: None
                states.cancel()

    def _serve(self, sock: socket.socket) -> contextlib.AbstractAsyncContextManager[object]:
        return serve(
            self._converse,
            sock=sock,
            process_request=self._answer,
            compression=None,
            max_size=MOST_BYTES,
            max_queue=4,
            open_timeout=5.0,
            close_timeout=_CLOSING_S,
            server_header=None,
            logger=_QUIET,
        )

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        answer = self._files.answer(
            request.path,
            hosts[0] if len(hosts) == 1 else None,
            origins[0] if len(origins) == 1 else None,
        )
        if answer is None:
            return None
        status, headers, body = answer
        return Response(status.value, status.phrase, Headers(headers), body)

    async def _converse(self, page: ServerConnection) -> None:
        viewer = self._hub.join(page)
        if viewer is None:
            await page.close(_TRY_AGAIN_LATER, TOO_MANY)
            return
        self._send_state()
        self._send_kept(page)
        try:
            async for text in page:
                sensor = viewer.sensor
                reply = self._hub.hear(page, text)
                if viewer.sensor != sensor:
                    self._send_kept(page)
                if viewer.end:
                    await page.close(_POLICY_VIOLATION, viewer.end)
                elif reply is not None:
                    broadcast([page], reply)
        except ConnectionClosed:
            pass
        finally:
            self._hub.leave(page)

    async def _send_states(self) -> None:
        while True:
            self._send_state()
            self._send_points()
            await asyncio.sleep(STATE_S)

    def _send_state(self) -> None:
        for pages, text in self._hub.states(self._clock()):
            broadcast(pages, text)

    def _send_kept(self, page: ServerConnection) -> None:
        for batch in self._hub.kept(page):
            broadcast([page], batch)

    def _send_points(self) -> None:
        for pages, batch in self._hub.points(self._clock()):
            broadcast(pages, batch)


def _listen(host: str, port: int) -> list[socket.socket]:
    """For `localhost` both addresses, so that no other program answers under one of them."""
    if host != "localhost":
        return [_bound(host, port)]
    first = _bound("127.0.0.1", port)
    try:
        return [first, _bound("::1", first.getsockname()[1])]
    except OSError as error:
        if error.errno in _NO_IPV6:
            return [first]
        first.close()
        raise


def _bound(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family)
