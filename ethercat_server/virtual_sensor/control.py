"""Sources of fault commands: a text stream (stdin), answered on standard output, and a Unix stream socket."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
from pathlib import Path
from typing import Final, Self, TextIO

from ethercat_server.virtual_sensor.bus import Bus
from ethercat_server.virtual_sensor.faults.table import LONGEST_LINE, QuitCommand, obey

_MOST_CONNECTIONS: Final = 16
_CHUNK = 4096


class ControlError(Exception):
    """The control socket cannot be created."""


class CommandChannel:
    """Reads commands and writes one line of answer to each.

    Attributes:
        ended: the text stream has ended.
    """

    def __init__(
        self, bus: Bus, poller: select.poll, control_path: str | None, commands: TextIO | None
    ) -> None:
        """ControlError if `control_path` cannot be used."""
        self._bus = bus
        self._poller = poller
        self._path = control_path
        self._listener: socket.socket | None = None
        self._connections: dict[int, socket.socket] = {}
        self._pending: dict[int, bytes] = {}
        self.ended = False
        self._commands: int | None = None
        if control_path is not None:
            self._listener = _listen(control_path)
            poller.register(self._listener, select.POLLIN)
        if commands is not None:
            with contextlib.suppress(OSError, ValueError):  # a stream without a descriptor cannot be polled
                self._commands = commands.fileno()
                self._pending[self._commands] = b""
                poller.register(self._commands, select.POLLIN)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for connection in self._connections.values():
            connection.close()
        self._connections.clear()
        if self._listener is not None and self._path is not None:
            self._listener.close()
            with contextlib.suppress(OSError):
                Path(self._path).unlink()

    def handle(self, descriptor: int, _event: int) -> None:
        """Handle an event on `descriptor`. QuitCommand if the command was `quit`."""
        if self._listener is not None and descriptor == self._listener.fileno():
            self._accept()
        elif descriptor == self._commands:
            self._from_stream(descriptor)
        elif descriptor in self._connections:
            self._from_connection(descriptor)

    def _accept(self) -> None:
        assert self._listener is not None
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        if len(self._connections) >= _MOST_CONNECTIONS:
            connection.close()
            return
        connection.setblocking(False)
        self._connections[connection.fileno()] = connection
        self._pending[connection.fileno()] = b""
        self._poller.register(connection, select.POLLIN)

    def _from_stream(self, descriptor: int) -> None:
        try:
            data = os.read(descriptor, _CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._poller.unregister(descriptor)
            self._commands = None
            self.ended = True
            data = b"\n" if self._pending[descriptor] else b""
        for line in self._lines(descriptor, data):
            try:
                answer = obey(self._bus, line)
            except QuitCommand:
                self._tell("ok")
                raise
            self._tell(answer)

    @staticmethod
    def _tell(answer: str) -> None:
        with contextlib.suppress(OSError):
            os.write(1, answer.encode() + b"\n")

    def _from_connection(self, descriptor: int) -> None:
        connection = self._connections[descriptor]
        try:
            data = connection.recv(_CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        ended = not data
        try:
            for line in self._lines(descriptor, data or (b"\n" if self._pending[descriptor] else b"")):
                try:
                    answer = obey(self._bus, line)
                except QuitCommand:
                    connection.sendall(b"ok\n")
                    raise
                connection.sendall(answer.encode() + b"\n")
        except OSError:
            ended = True  # disconnected, or not reading: its commands are executed nevertheless
        if ended:
            self._poller.unregister(descriptor)
            del self._connections[descriptor], self._pending[descriptor]
            connection.close()

    def _lines(self, descriptor: int, data: bytes) -> list[str]:
        *lines, rest = (self._pending[descriptor] + data).split(b"\n")
        if len(rest) > LONGEST_LINE:
            lines.append(rest)
            rest = b""
        self._pending[descriptor] = rest
        return [line[:LONGEST_LINE].decode(errors="replace") for line in lines if line.strip()]


def _listen(path: str) -> socket.socket:
    with contextlib.suppress(OSError):
        # Remove a stale socket, left by a killed process; nothing else.
        if stat.S_ISSOCK(Path(path).stat().st_mode) and not _answers(path):
            Path(path).unlink()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(path)
        Path(path).chmod(0o600)
        listener.listen()
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise ControlError(f"cannot create the control socket {path!r}: {error.strerror or error}") from None
    return listener


def _answers(path: str) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(path)
        except OSError:
            return False
        return True
