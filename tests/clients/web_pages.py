"""`ethercat-monitor --web` in a thread: real sockets, and a model that the test feeds."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from types import SimpleNamespace
from typing import cast

from bota_clients.monitor.recording import MonitorRecording
from bota_clients.monitor.tare import Say
from bota_clients.monitor.web.pages import Pages, WebModel
from bota_clients.monitor.web.server import serving
from bota_ethercat.address import Address
from tests.clients import monitor_states as made
from tests.clients.monitor_states import START_S
from tests.server.running import PATIENCE_S


class Web:
    """A monitor that is connected to a server with one sensor, or with sensors of these names, at START_S.

    A tare goes on until it is ended.
    """

    def __init__(self, *names: str) -> None:
        self.model = WebModel(made.ADDRESS)
        made.connect(self.model, made.description(*[names] * bool(names)), made.OWN_PEER, START_S)
        self.recorder = MonitorRecording(Address("localhost", 1))
        self.pages = Pages(self.model, self.tare, self.recorder)
        self.port = 0
        self.tared: list[tuple[int, str]] = []  # the positions that were to be tared, and the way
        self.taring_now = True

    def tare(self, position: int, say: Say, way: str) -> threading.Thread:
        self.tared.append((position, way))
        say(f"Sensor {position} was tared", False)
        return cast("threading.Thread", SimpleNamespace(is_alive=lambda: self.taring_now))

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """On the same port when it is served again."""
        ready, loop, stop = Future[int](), asyncio.new_event_loop(), asyncio.Event()

        async def serve() -> None:
            async with serving(self.pages, "localhost", self.port, lambda: START_S) as at:
                ready.set_result(at)
                await stop.wait()

        def run() -> None:
            with asyncio.Runner(loop_factory=lambda: loop) as runner:
                runner.run(serve())

        thread = threading.Thread(target=run, name="web")
        thread.start()
        try:
            self.port = ready.result(PATIENCE_S)
            yield
        finally:
            loop.call_soon_threadsafe(stop.set)
            thread.join(PATIENCE_S)
            assert not thread.is_alive()
