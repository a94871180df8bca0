"""The node's connection to the server: what the reader asks it, and what every other thread may ask.

One thread, the reader, receives. Any thread may `request`; the reader finds the reply and wakes it up.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

from bridge.clock import SYSTEM_CLOCK, Clock
from protocol.client.connection import CONNECT_TIMEOUT_S, FramedConnection
from protocol.control import check_version, request, six_numbers
from protocol.errors import ConnectionFailedError, RefusedError, SettingError
from protocol.framing import DataMessage
from protocol.settings import SETTINGS, SettingValue
from protocol.text.json_text import JsonObject
from protocol.text.untrusted import rows
from protocol.text.visible import printable

_REPLY_TIMEOUT_S: Final = 3.0
_MOST_HZ: Final = 1e6


class SensorInfo(NamedTuple):
    """What the server says about the sensor, made safe to print."""

    sensor: int
    name: str
    serial: str
    rate_hz: str
    state: str
    hardware: str = "?"
    firmware: str = "?"
    rate: float = 0.0
    """`rate_hz` as a number; 0 if it is none."""
    settings: Mapping[str, SettingValue] = {}
    settling: bool = False
    """Whether its data has not settled."""
    offset: tuple[float, ...] | None = None
    """Its own force/torque offset, N and Nm; None if the server does not say."""

    def __str__(self) -> str:
        """One phrase for the log."""
        return f"sensor {self.sensor} ({self.name}, serial {self.serial}, {self.rate_hz} Hz, {self.state})"


class RefusalError(ConnectionFailedError):
    """The server refused what the connection cannot do without."""


class Connection(FramedConnection):
    """A framed connection that several threads may ask over."""

    clock: Clock = SYSTEM_CLOCK

    def __init__(self, host: str, port: int, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        """Connect; UnreachableError if there is nothing to connect to."""
        self._replies: dict[object, Future[JsonObject]] = {}
        self._ids = itertools.count(1)
        self._send_lock = threading.Lock()
        super().__init__(host, port, timeout_s)

    def take_reply(self, message: JsonObject) -> bool:
        """Hand `message` to the thread that waits for it; False if it is no reply that someone waits for."""
        if "reply" not in message:
            return False
        identifier = message.get("id")
        future = self._replies.pop(identifier, None) if isinstance(identifier, int) else None
        if future is None:
            return False
        future.set_result(message)
        return True

    def send_request(self, action: str, **values: object) -> Future[JsonObject]:
        """Send a request; the future gets the reply once the reader has seen it."""
        identifier = next(self._ids)
        future = self._replies[identifier] = Future()
        with self._send_lock:
            self.send(request(action, identifier, **values))
        return future

    def forget(self, future: Future[JsonObject]) -> None:
        """Nobody waits for this reply any more."""
        for identifier, waiting in list(self._replies.items()):
            if waiting is future:
                self._replies.pop(identifier, None)

    def ask(self, action: str, **values: object) -> JsonObject:
        """Send a request and receive until its reply is there; DATA on the way is dropped.

        For the reader only, before the stream runs. ConnectionFailedError also for a refusal.
        """
        deadline = self.clock.monotonic() + _REPLY_TIMEOUT_S
        future = self.send_request(action, **values)
        while not future.done():
            if self.clock.monotonic() > deadline:
                raise ConnectionFailedError(f"no reply to {action} within {_REPLY_TIMEOUT_S:g} s")
            if self.receive() is None:
                continue
            # Stop at the reply: what follows it is the stream's.
            while not future.done() and (message := self.next_message()) is not None:
                if not isinstance(message, DataMessage):
                    self.take_reply(message)
        reply = future.result()
        if reply.get("ok") is not True:
            raise RefusalError(f"the server refused {action}: {refusal(reply)}")
        return reply

    def subscribe(self, sensor: int) -> SensorInfo:
        """Check that the server is one we understand and has that sensor, and start its stream."""
        description = self.ask("describe")
        check_version(description)
        self.take_description(description)
        info = find_sensor(description, sensor)
        self.ask("subscribe", sensors=[sensor])
        return info

    def close(self) -> None:
        """Close the socket; whoever waits for a reply is told that none will come."""
        super().close()
        for identifier in list(self._replies):
            future = self._replies.pop(identifier, None)
            if future is not None:
                future.set_exception(ConnectionFailedError("the connection ended before the reply"))


def refusal(reply: Mapping[str, Any]) -> str:
    """The server's own words for why it refused."""
    error = RefusedError.of(reply)
    return printable(f"{error} ({error.code})")


def known_settings(settings: object) -> dict[str, SettingValue]:
    """Those of `settings`, a message's, that are in the table and have a value that they can have."""
    found: dict[str, SettingValue] = {}
    for name, value in settings.items() if isinstance(settings, dict) else ():
        if name in SETTINGS:
            with contextlib.suppress(SettingError):
                found[name] = SETTINGS[name].check(value)
    return found


def known_rate(rate_hz: object) -> float:
    """The sampling rate that a message gives, Hz; 0 if it is none."""
    return float(rate_hz) if isinstance(rate_hz, int | float) and 0 < rate_hz <= _MOST_HZ else 0.0


def known_offset(offset: object) -> tuple[float, ...] | None:
    """The sensor's own offset from a message; None if missing or invalid."""
    try:
        return six_numbers(offset)
    except ValueError:
        return None


def find_sensor(description: Mapping[str, Any], sensor: int) -> SensorInfo:
    """The row of `sensor` in a `describe` reply; ConnectionFailedError if there is none."""
    found = rows(description.get("sensors"))
    for row in found:
        if row.get("sensor") == sensor and not isinstance(row.get("sensor"), bool):
            name, serial, rate, state, hardware, firmware = (
                printable(row.get(key, "?"), 40)
                for key in ("name", "serial", "rate_hz", "state", "hardware", "firmware")
            )
            number = known_rate(row.get("rate_hz"))
            settings, settling = known_settings(row.get("settings")), row.get("settling") is True
            offset = known_offset(row.get("offset"))
            return SensorInfo(
                sensor, name, serial, rate, state, hardware, firmware, number, settings, settling, offset
            )
    there = ", ".join(printable(row.get("sensor"), 10) for row in found[:16]) or "none"
    raise ConnectionFailedError(
        f"the server has no sensor {sensor} (it has: {there}): set the parameter 'sensor' to one it has"
    )
