"""A server of this process's own, for a program on an interface that no server uses.

The program talks to it as to any other, over a connected pair of sockets. It sets nothing: the sensors stream
as they are set, and go to INIT at the end.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import socket
import threading
from collections.abc import Iterator
from typing import Final

from bota_ethercat.client.channel import RECEIVE_BUFFER, TcpChannel
from bota_ethercat.program.signals import asking
from ethercat_server.acquisition.start_up import AsFound
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.options import VIRTUAL_INTERFACE
from ethercat_server.ethercat.soem import open_bus
from ethercat_server.process import realtime
from ethercat_server.server import Server
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.transport import SocketStream, SocketTransport
from ethercat_server.virtual_sensor.virtual_bus import VirtualBus

STOPPED: Final = "stopped before it was done"
_END_S: Final = 5.0


@contextlib.contextmanager
def open_interface(ifname: str, *, allow_ip: bool = False) -> Iterator[Bus]:
    """The open bus on `ifname`, or on a virtual bus for `virtual`."""
    with contextlib.ExitStack() as cleanup:
        if ifname == VIRTUAL_INTERFACE:
            ifname = cleanup.enter_context(VirtualBus()).ifname
        yield cleanup.enter_context(open_bus(ifname, allow_ip=allow_ip))


class PrivateServer:
    """Runs in a thread until `close`.

    Attributes:
        channel: the only connection to it.
        error: what ended it, if it ended by itself.
        real_time: whether its thread has real-time scheduling.
    """

    def __init__(
        self,
        ifname: str,
        *,
        force: bool = False,
        allow_ip: bool = False,
        rt_priority: int = realtime.DEFAULT_PRIORITY,
        cpu: int | None = None,
    ) -> None:
        """ServerError if a sensor cannot be brought to OP; `force` takes over a bus in use.

        `rt_priority` and `cpu` are as the server's.
        """
        with contextlib.ExitStack() as cleanup:
            bus = cleanup.enter_context(open_interface(ifname, allow_ip=allow_ip))
            own, servers = socket.socketpair()
            transport = _PairTransport(servers)
            hub = Hub(transport)
            cleanup.callback(hub.close)
            self.channel = _PairChannel(own)
            self.error: Exception | None = None
            self._server = Server(bus, hub, AsFound(force=force))
            self._rt_priority, self._cpu = rt_priority, cpu
            self.real_time = False
            self._cleanup = cleanup.pop_all()
        self._thread = threading.Thread(target=self._run, name="server", daemon=True)
        self._thread.start()

    def interrupt(self) -> None:
        """Have what is being done on a sensor undone; its request fails."""
        self._server.jobs.interrupt(STOPPED)

    def close(self) -> None:
        """The sensors go to INIT, the interface is released."""
        self._server.stop()
        self._thread.join(_END_S)
        self._cleanup.close()
        gc.unfreeze()
        gc.enable()

    def _run(self) -> None:
        # Python handles signals in the main thread; they must interrupt its system calls.
        signal.pthread_sigmask(signal.SIG_BLOCK, asking())
        try:
            realtime.prepare(self._rt_priority, self._cpu)
            self.real_time = os.sched_getscheduler(0) == os.SCHED_FIFO
            self._server.run()
        except Exception as error:  # noqa: BLE001 - for the main thread, which finds the connection closed
            self.error = error
            self._server.hub.close()


class _PairTransport(SocketTransport):
    """Has one client, at the other end of a pair of sockets."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__((), 0)
        self._listeners = {sock.fileno(): sock}

    def accept(self, fd: int) -> SocketStream | None:
        return _PairStream(self._listeners.pop(fd), None) if fd in self._listeners else None


class _PairStream(SocketStream):
    def peer_uid(self) -> int | None:
        return os.geteuid()


class _PairChannel(TcpChannel):
    """The program's end of the pair."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__("", 0)
        self._sock, self.same_address = sock, True

    def _prepare(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
