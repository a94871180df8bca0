"""Where clients come in: the listening sockets, how many may come, and which users they are."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from typing import Final

from ethercat_server.connection import Connection
from ethercat_server.listeners import listen
from ethercat_server.socket_owner import open_diagnostics, peer_uid

MAX_CLIENTS: Final = 64
RESERVED: Final = 16
"""So many of them are for users who may control: strangers cannot take all."""
MOST_OF_A_STRANGER: Final = 16
"""So many one user who may not control can have."""
_ACCEPTS_AT_ONCE: Final = 2

log = logging.getLogger(__name__)


class Door:
    """The listeners of one port, until `shut`; the kernel can be asked who is there until `close`.

    Attributes:
        control_uids: users who may change something.
    """

    def __init__(self, hosts: Sequence[str], port: int) -> None:
        """Binds at once; ServerError if it cannot."""
        self._listeners = listen(hosts, port)
        self._diagnostics = open_diagnostics()
        self.control_uids: frozenset[int] = frozenset({0})

    def fds(self) -> list[int]:
        """To be watched for clients that come."""
        return [listener.fileno() for listener in self._listeners]

    def accept(self, fd: int, there: Iterable[Connection]) -> list[Connection]:
        """The clients that have come to the listener `fd`, some at a time, for whom there is room."""
        listener = next((item for item in self._listeners if item.fileno() == fd), None)
        if listener is None:
            return []
        inside, new = list(there), []
        for _ in range(_ACCEPTS_AT_ONCE):
            try:
                sock, _ = listener.accept()
            except OSError:
                break
            uid = peer_uid(self._diagnostics, sock)
            connection = Connection(sock, uid)
            if not self._has_room_for(uid, inside):
                log.warning("%s refused: there are %d clients already", connection, len(inside))
                connection.close()
                continue
            inside.append(connection)
            new.append(connection)
        return new

    def _has_room_for(self, uid: int | None, inside: Sequence[Connection]) -> bool:
        if uid in self.control_uids:
            return len(inside) < MAX_CLIENTS
        of_this_user = sum(connection.uid == uid for connection in inside)
        return of_this_user < MOST_OF_A_STRANGER and len(inside) < MAX_CLIENTS - RESERVED

    def may_control(self, connection: Connection) -> bool:
        """Whether the user at the other end may change something. What is not known is refused."""
        if connection.uid is None:
            connection.uid = peer_uid(self._diagnostics, connection.sock)
        return connection.uid in self.control_uids

    def shut(self) -> None:
        """Nobody comes in any more."""
        for listener in self._listeners:
            listener.close()
        self._listeners = []

    def close(self) -> None:
        """Ask nothing any more."""
        self._diagnostics.close()
