"""The way of a sample from the wire to its subscribers: source lines, Python calls, system calls.

The server runs in memory and in simulated time, so the figures are the same on every machine and in every
run. Everything between two hand-outs counts: the loop, learning, what is done once a second. What stands for
the kernel, the wire and the sensors does not.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from statistics import mean, median
from types import FrameType
from typing import Any, Final

from bota_ethercat.control import request
from bota_ethercat.framing import encode_json
from ethercat_server.acquisition.start_up import AsFound
from ethercat_server.ethercat.bus import Bus
from ethercat_server.server import Server
from ethercat_server.serving.hub import Hub
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.transport import InMemoryStream, InMemoryTransport
from ethercat_server.virtual_sensor.options import SensorOptions
from scripts.benchmarks.chain import Figures

SETTLED_S: Final = 8.0
SECONDS: Final = 1.0
CLIENTS: Final = (1, 4)
# What `--dc` of the virtual sensor says for each.
CLOCKS: Final = {"with a distributed clock": "", "without": "none"}
_ROOT: Final = Path(__file__).parents[2]
_COUNTED: Final = (f"{_ROOT}/ethercat_server/", f"{_ROOT}/protocol/")
_NOT_COUNTED: Final = ("/simulation/", "/virtual_sensor/")
# What each of these is in a server that has a network interface, and TCP.
_SYSTEM_CALLS: Final = {
    (MemoryBackend, "send"): 1,
    (MemoryBackend, "receive"): 2,  # select and recv, of which a look needs the second only
    (MemoryBackend, "arrived_ns"): 1,
    (InMemoryTransport, "wait"): 1,
    (InMemoryStream, "send"): 1,
    (InMemoryStream, "recv"): 1,
}


class _Tracer:
    """Counts, and begins anew with each hand-out."""

    def __init__(self) -> None:
        self.lines = self.calls = self.system_calls = 0
        self.samples: list[tuple[int, int, int]] = []
        self.begun = False
        self._system = {getattr(owner, name).__code__: n for (owner, name), n in _SYSTEM_CALLS.items()}
        self._outside: FrameType | None = None
        self._counts: dict[str, bool] = {}

    def trace(self, frame: FrameType, _event: str, _argument: object) -> Callable[..., Any] | None:
        """For `sys.settrace`: a function is called."""
        code = frame.f_code
        if self._outside is not None or code.co_filename == __file__:
            return None
        counts = self._counts.get(code.co_filename)
        if counts is None:
            name = code.co_filename
            counts = name.startswith(_COUNTED) and not any(part in name for part in _NOT_COUNTED)
            self._counts[name] = counts
        if not counts:
            self._outside = frame
            frame.f_trace_lines = False
            return self._leaving(self._system.get(code, 0))
        if code is Hub.publish.__code__:
            if self.begun:
                self.samples.append((self.lines, self.calls, self.system_calls))
            self.begun = True
            self.lines = self.calls = self.system_calls = 0
        self.calls += 1
        return self._line

    def _line(self, _frame: FrameType, event: str, _argument: object) -> Callable[..., Any]:
        if event == "line":
            self.lines += 1
        return self._line

    def _leaving(self, system_calls: int) -> Callable[..., Any]:
        def leaves(_frame: FrameType, event: str, argument: object) -> Callable[..., Any]:
            if event == "return":
                self._outside = None
                self.system_calls += min(system_calls, 1) if argument is None else system_calls
            return leaves

        return leaves


def count(dc: str, clients: int, seconds: float = SECONDS) -> dict[str, float]:
    """Figures of a new sample of one sensor, whose controller's clock is `dc` (`--dc`), by clients.

    Most are like the median; the mean is what they cost.
    """
    backend = MemoryBackend(SensorOptions(ppm=150.0, dc=dc))
    transport = InMemoryTransport(backend.clock)
    server = Server(Bus(backend), Hub(transport, backend.clock.raw_ns), AsFound())
    streams = [transport.connect(buffer_size=1 << 24) for _ in range(clients)]
    for stream in streams:
        stream.send(encode_json(request("subscribe", 1)))

    def run(duration_s: float) -> None:
        backend.clock.at(backend.clock.now_ns + round(duration_s * 1e9), server.stop)
        server.cycle.stopping = False
        server.cycle.run()

    run(SETTLED_S)
    tracer = _Tracer()
    before = sys.gettrace()
    sys.settrace(tracer.trace)
    try:
        run(seconds)
    finally:
        sys.settrace(before)
    found = dict(zip(("lines", "calls", "system_calls"), zip(*tracer.samples, strict=True), strict=True))
    medians = {name: median(values) for name, values in found.items()}
    return medians | {f"mean_{name}": mean(values) for name, values in found.items()}


def measure() -> list[Figures]:
    """A row for each clock and number of clients."""
    return [
        {"clock": clock, "clients": clients, **count(dc, clients)}
        for clock, dc in CLOCKS.items()
        for clients in CLIENTS
    ]
