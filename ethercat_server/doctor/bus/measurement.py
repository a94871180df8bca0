"""Measures latencies that a server would have here: wake-ups, exchanges, messages to a client.

The loop resembles the server's: sleep to an absolute deadline with the same scheduling, exchange a frame as
long as the process data, send a message to a client. The frame only reads registers.
"""

from __future__ import annotations

import contextlib
import gc
import os
import socket
import subprocess
import sys
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from ethercat_server.acquisition.histogram import Distribution
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming
from ethercat_server.acquisition.timing.margin import margin_ns
from ethercat_server.doctor.bus.receiver import MESSAGE
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, Clock
from ethercat_server.process import realtime

PERIOD_NS: Final = 1_250_000
"""The sample period at the factory setting, 800 Hz."""
_WARM_UP: Final = 100
_CONNECT_TIMEOUT_S: Final = 10.0

Exchange = Callable[[], bool]
"""One exchange on the bus; returns whether all slaves answered."""


@dataclass
class Measured:
    """Measured values of each cycle, in ns."""

    late: list[int] = field(default_factory=list)
    exchanges: list[int] = field(default_factory=list)
    """Duration; -1 for a lost frame."""
    messages: dict[int, int] = field(default_factory=dict)
    """Latency to the client, by number of the cycle."""
    real_time: bool = False
    """Whether real-time scheduling was granted."""
    priority: int = 0

    @property
    def lost(self) -> int:
        """Number of lost frames."""
        return self.exchanges.count(-1)

    def margin_ns(self) -> float:
        """The margin that the server would have taken in the end."""
        timing, now_ns = ExchangeTiming(), 1
        for late, exchange in zip(self.late, self.exchanges, strict=True):
            now_ns += PERIOD_NS
            timing.woke(late)
            if exchange >= 0:
                timing.took(now_ns - exchange, now_ns)
        return margin_ns(timing, PERIOD_NS, 0.0)

    def ages(self) -> tuple[list[float], list[float]]:
        """Age that each cycle's sample would have had when sent, and at a client: docs/doctor.md.

        The server times each exchange so that the sensor, half-way through it, reads its data some margin
        after the sample's instant, and compensates its deadlines for its usual lateness.
        """
        whole = [time_ns for time_ns in self.exchanges if time_ns >= 0]
        if not whole:
            return [], []
        usual_late = sorted(self.late)[len(self.late) // 2]
        usual_look = sum(whole) / len(whole) / 2
        margin = self.margin_ns()
        handed_out, arrived = [], []
        for number, (late, exchange) in enumerate(zip(self.late, self.exchanges, strict=True)):
            if exchange >= 0:
                looked = max(0.0, margin + late - usual_late + exchange / 2 - usual_look)
                handed_out.append(looked + exchange / 2)
                if number in self.messages:
                    arrived.append(handed_out[-1] + self.messages[number])
        return handed_out, arrived


def summary_us(values: list[int] | list[float]) -> dict[str, float]:
    """p50, p99, p999 and max in microseconds, as `status` gives them."""
    distribution = Distribution()
    for value in values:
        distribution.record(int(value))
    return distribution.summary_us()


def measure(
    seconds: float, exchange: Exchange | None, priority: int, cpu: int | None, clock: Clock = SYSTEM_CLOCK
) -> Measured:
    """Measure for `seconds` with the server's scheduling, which is restored afterwards."""
    found = Measured(priority=priority)
    with _client() as client, _like_the_server(priority, cpu):
        found.real_time = os.sched_getscheduler(0) == os.SCHED_FIFO
        _run(found, seconds, exchange, client.send, clock)
    found.messages = client.result
    return found


def _run(
    found: Measured,
    seconds: float,
    exchange: Exchange | None,
    send: Callable[[bytes], None],
    clock: Clock,
) -> None:
    monotonic_ns, sleep = clock.monotonic_ns, clock.sleep
    due = monotonic_ns()
    end = due + int(seconds * 1e9) + _WARM_UP * PERIOD_NS
    warm = due + _WARM_UP * PERIOD_NS
    while due < end:
        left = due - monotonic_ns()
        if left > 0:
            sleep(left * 1e-9)
        woke = monotonic_ns()
        came = exchange is None or exchange()
        back = monotonic_ns()
        if due >= warm:
            send(MESSAGE.pack(len(found.late), monotonic_ns()))
            found.late.append(woke - due)
            if exchange is not None:
                found.exchanges.append(back - woke if came else -1)
        # Skip deadlines that have passed: later ones must not count as late because of them.
        due += PERIOD_NS * (1 + max(0, back - due) // PERIOD_NS)


class _Client:
    """The receiving process; nothing is sent where there is no loopback."""

    def __init__(self, connection: socket.socket | None) -> None:
        self._connection = connection
        self.result: dict[int, int] = {}

    def send(self, message: bytes) -> None:
        """Hand a message over; one that does not fit is left out, as a slow client's would be."""
        if self._connection is not None:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                if self._connection.send(message) < len(message):
                    self._connection = None  # the rest of it would be taken for the next


@contextlib.contextmanager
def _client() -> Iterator[_Client]:
    with contextlib.ExitStack() as cleanup:
        try:
            receiver, connection = _start_receiver(cleanup)
        except OSError:
            yield _Client(None)
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        client = _Client(connection)
        yield client
        connection.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            data, _ = receiver.communicate(timeout=_CONNECT_TIMEOUT_S)
            figures = array("q", data[: len(data) // 16 * 16])
            client.result = dict(zip(figures[::2], figures[1::2], strict=True))


def _start_receiver(cleanup: contextlib.ExitStack) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """The receiving process and the connection to it; OSError if there can be none."""
    # It listens no longer than it must: a process with an EtherCAT socket that listens is taken for a server.
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(_CONNECT_TIMEOUT_S)
        port = str(listener.getsockname()[1])
        receiver = cleanup.enter_context(
            subprocess.Popen(
                [sys.executable, "-P", "-m", "ethercat_server.doctor.bus.receiver", port],
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        )  # fmt: skip
        cleanup.callback(receiver.kill)
        connection, _ = listener.accept()
    return receiver, cleanup.enter_context(connection)


@contextlib.contextmanager
def _like_the_server(priority: int, cpu: int | None) -> Iterator[None]:
    """Scheduled as the server is; as before afterwards."""
    processors, interval = os.sched_getaffinity(0), sys.getswitchinterval()
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        realtime.prepare(priority, cpu)
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, policy, parameters)
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, processors)
        sys.setswitchinterval(interval)
        gc.enable()
        gc.unfreeze()
