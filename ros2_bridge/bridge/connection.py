"""One TCP connection to the server: connect, ask, receive. Everything that can go wrong is one exception.

One thread, the reader, receives. Any thread may `request`; the reader finds the reply and wakes it up.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import struct
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

from protocol.control import PROTOCOL_VERSION, request
from protocol.errors import ProtocolError, SettingError
from protocol.framing import DataMessage, FrameDecoder, JsonObject, encode_json
from protocol.settings import SETTINGS, SettingValue

CONNECT_TIMEOUT_S: Final = 2.0
SILENCE_S: Final = 1.0
"""`receive` gives up waiting after this time, so that silence can be reported."""
_REPLY_TIMEOUT_S: Final = 3.0
_MOST_HZ: Final = 1e6
_KEEPALIVE: Final = ((socket.TCP_KEEPIDLE, 2), (socket.TCP_KEEPINTVL, 1), (socket.TCP_KEEPCNT, 3))


class ConnectionFailedError(Exception):
    """The connection cannot be made or used any more; the text says why. Close it."""


class UnreachableError(ConnectionFailedError):
    """There is no server at that address, as far as can be told."""


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

    def __str__(self) -> str:
        """One phrase for the log."""
        return f"sensor {self.sensor} ({self.name}, serial {self.serial}, {self.rate_hz} Hz, {self.state})"


def printable(value: object, limit: int = 200) -> str:
    """Text from the other side as it may appear in a log: one line, no control characters, not endless."""
    text = "".join(c if c.isprintable() else "?" for c in str(value)[: limit + 1])
    return text if len(text) <= limit else text[: limit - 3] + "..."


class Connection:
    """A connection to the server at `host`:`port`.

    `same_machine` tells whether the server's CLOCK_MONOTONIC is ours.
    """

    def __init__(self, host: str, port: int, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        """Connect; UnreachableError if there is nothing to connect to."""
        self._decoder = FrameDecoder()
        self._replies: dict[object, Future[JsonObject]] = {}
        self._ids = itertools.count(1)
        self._send_lock = threading.Lock()
        try:
            self._socket = socket.create_connection((host, port), timeout=timeout_s)
        except (OSError, UnicodeError) as error:  # UnicodeError: a host name that cannot be one
            reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
            raise UnreachableError(reason) from None
        try:
            self._prepare_socket()
        except OSError as error:
            self._socket.close()
            raise UnreachableError(str(error)) from None

    def _prepare_socket(self) -> None:
        ours, theirs = self._socket.getsockname(), self._socket.getpeername()
        if ours == theirs:  # a free port of the ephemeral range may connect to itself
            raise OSError("nothing listens there")
        self.same_machine: bool = ours[0] == theirs[0]
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # Finds out that a machine is gone, which sends no goodbye.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE:
            self._socket.setsockopt(socket.IPPROTO_TCP, option, value)
        # The kernel's own timeouts cost no system call per read, as settimeout() would.
        self._socket.settimeout(None)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _timeval(SILENCE_S))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _timeval(SILENCE_S))

    def receive(self, *, wait: bool = True) -> bool | None:
        """Take what has arrived, at most one buffer full, blocking for the first byte if `wait`.

        True if more may be waiting, False if that was all, None if nothing came within SILENCE_S (or, not
        waiting, there is nothing). Then read `messages`. ConnectionFailedError when the connection is over.
        """
        with self._decoder.get_buffer() as buffer:
            try:
                count = self._socket.recv_into(buffer, 0, 0 if wait else socket.MSG_DONTWAIT)
            except BlockingIOError:
                return None
            except OSError as error:
                raise ConnectionFailedError(error.strerror or str(error)) from None
            if count == 0:
                raise ConnectionFailedError("the server closed it")
            self._decoder.received(count)
            return count == len(buffer)

    def next_message(self) -> DataMessage | JsonObject | None:
        """The next whole message received; ConnectionFailedError if the bytes are not this protocol."""
        try:
            return self._decoder.next_message()
        except ProtocolError as error:
            raise ConnectionFailedError(f"what came is not this protocol: {printable(error)}") from None

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
        try:
            with self._send_lock:
                self._socket.sendall(encode_json(request(action, identifier, **values)))
        except OSError as error:
            raise ConnectionFailedError(f"cannot send: {error.strerror or error}") from None
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
        deadline = time.monotonic() + _REPLY_TIMEOUT_S
        future = self.send_request(action, **values)
        while not future.done():
            if time.monotonic() > deadline:
                raise ConnectionFailedError(f"no reply to {action} within {_REPLY_TIMEOUT_S:g} s")
            if self.receive() is None:
                continue
            # Stop at the reply: what follows it is the stream's.
            while not future.done() and (message := self.next_message()) is not None:
                if not isinstance(message, DataMessage):
                    self.take_reply(message)
        reply = future.result()
        if reply.get("ok") is not True:
            raise ConnectionFailedError(f"the server refused {action}: {refusal(reply)}")
        return reply

    def subscribe(self, sensor: int) -> SensorInfo:
        """Check that the server is one we understand and has that sensor, and start its stream."""
        description = self.ask("describe")
        version = description.get("protocol")
        if version != PROTOCOL_VERSION or isinstance(version, bool):
            raise ConnectionFailedError(
                f"the server speaks protocol {printable(version, 20)} and this node {PROTOCOL_VERSION}: "
                "install the same version of both"
            )
        info = find_sensor(description, sensor)
        self.ask("subscribe", sensors=[sensor])
        return info

    def shutdown(self) -> None:
        """End the connection from any thread; a blocked `receive` returns."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the socket; whoever waits for a reply is told that none will come."""
        self.shutdown()
        self._socket.close()
        for identifier in list(self._replies):
            future = self._replies.pop(identifier, None)
            if future is not None:
                future.set_exception(ConnectionFailedError("the connection ended before the reply"))


def _timeval(seconds: float) -> bytes:
    return struct.pack("@ll", int(seconds), int(seconds % 1 * 1e6))


def refusal(reply: Mapping[str, Any]) -> str:
    """The server's own words for why it refused."""
    error = reply.get("error")
    if not isinstance(error, dict):
        return "it gave no reason"
    return printable(f"{error.get('message', 'no message')} ({error.get('code', 'no code')})")


def known_settings(settings: object) -> dict[str, SettingValue]:
    """Those of `settings`, a message's, that are in the table and have a value that they can have."""
    found: dict[str, SettingValue] = {}
    for name, value in settings.items() if isinstance(settings, dict) else ():
        if name in SETTINGS:
            with contextlib.suppress(SettingError):
                found[name] = SETTINGS[name].check(value)
    return found


def find_sensor(description: Mapping[str, Any], sensor: int) -> SensorInfo:
    """The row of `sensor` in a `describe` reply; ConnectionFailedError if there is none."""
    rows = description.get("sensors")
    found = [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    for row in found:
        if row.get("sensor") == sensor and not isinstance(row.get("sensor"), bool):
            name, serial, rate, state, hardware, firmware = (
                printable(row.get(key, "?"), 40)
                for key in ("name", "serial", "rate_hz", "state", "hardware", "firmware")
            )
            hz = row.get("rate_hz")
            number = float(hz) if isinstance(hz, int | float) and 0 < hz <= _MOST_HZ else 0.0
            settings = known_settings(row.get("settings"))
            return SensorInfo(sensor, name, serial, rate, state, hardware, firmware, number, settings)
    there = ", ".join(printable(row.get("sensor"), 10) for row in found[:16]) or "none"
    raise ConnectionFailedError(
        f"the server has no sensor {sensor} (it has: {there}): set the parameter 'sensor' to one it has"
    )
