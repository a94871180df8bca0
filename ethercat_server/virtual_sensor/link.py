"""The raw socket: frames from a network interface go through the bus; commands come by a stream.

One thread, which polls for frames and commands, and checks watchdogs.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import select
import socket
import threading
import time
from collections.abc import Callable, Iterable
from typing import Final, TextIO

from ethercat_server.ethercat.nic import look_up
from ethercat_server.ethercat.raw_socket import arrived_ns
from ethercat_server.ethercat.wire import BYTE_NS, ETHERTYPE
from ethercat_server.virtual_sensor.bus import Bus
from ethercat_server.virtual_sensor.faults import LONGEST_LINE, QuitCommand, obey
from ethercat_server.virtual_sensor.options import SlaveOptions

LONGEST_NAME: Final = 15  # characters in the name of a network interface
_BUFFER = 2048
_IDLE_MS = 10
_FRAMES_PER_TURN = 64
_FIRST_HALF_NS: Final = 20_000.0
# A frame that seems to have waited for longer has no usable time stamp: CLOCK_REALTIME was set.
_LONGEST_WAIT_NS: Final = 100_000_000
_STEP: Final = 0.001
# Quantile of half the time that an answer takes, followed in steps of `_STEP`: a master estimates the round
# trip from its quickest frames.
_QUICK: Final = 1 / 16
_CHUNK: Final = 4096


class LinkError(Exception):
    """The interface cannot be used, or no longer."""


def open_interface(ifname: str) -> socket.socket:
    """A raw socket for EtherCAT frames on `ifname`; LinkError if it cannot be opened."""
    if not ifname or len(ifname.encode()) > LONGEST_NAME:
        raise LinkError(f"interface name {ifname!r}: it must have 1 to {LONGEST_NAME} characters")
    if not _index(ifname):
        raise LinkError(f"no network interface {ifname!r}: see `ip link`")
    if not look_up(ifname).is_up:
        raise LinkError(f"interface {ifname} is down: bring it up with `ip link set {ifname} up`")
    try:
        # No protocol yet: with one, it would receive frames of all interfaces until it is bound.
        raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    except PermissionError:
        raise LinkError(
            f"not allowed to open a raw socket on {ifname}: it needs CAP_NET_RAW, so run it as root"
        ) from None
    try:
        raw.bind((ifname, ETHERTYPE))
        raw.setblocking(False)
    except OSError as error:
        raw.close()
        raise LinkError(f"interface {ifname} cannot be used: {error.strerror}") from None
    return raw


def _index(ifname: str) -> int:
    """Of the interface; 0 if there is none."""
    try:
        return socket.if_nametoindex(ifname)
    except OSError:
        return 0


def run(
    ifname: str,
    slaves: Iterable[SlaveOptions],
    *,
    commands: TextIO | None = None,
    exit_on_eof: bool = False,
    on_open: Callable[[], None] = lambda: None,
    on_ready: Callable[[], None] = lambda: None,
    stop: threading.Event,
) -> None:
    """Answer EtherCAT frames on `ifname` until stopped.

    Stops when `stop` is set (checked every 10 ms), on the command `quit`, and at the end of `commands` if
    `exit_on_eof`. LinkError if the interface cannot be used, or disappears; one that is down is waited for.
    """
    with open_interface(ifname) as raw, contextlib.suppress(QuitCommand):
        on_open()
        bus = Bus(slaves, time.monotonic_ns())
        poller, channel = select.poll(), _Commands(bus, commands)
        poller.register(raw, select.POLLIN)
        if channel.descriptor >= 0:
            poller.register(channel.descriptor, select.POLLIN)
        # All that is loaded need never be looked through again, which takes some 20 ms.
        gc.collect()
        gc.freeze()
        on_ready()
        answers, index, up = _Answers(raw, bus, ifname), _index(ifname), True
        while not stop.is_set() and not (exit_on_eof and channel.ended):
            ready = [descriptor for descriptor, _ in poller.poll(_IDLE_MS)]
            if not ready:
                bus.idle(time.monotonic_ns())
                # Down is like an unplugged cable: it may come back, unless the interface was deleted.
                if not up and _index(ifname) != index:
                    raise LinkError(f"interface {ifname} has disappeared: create it again, and restart")
            if channel.descriptor in ready:
                bus.set_time(time.monotonic_ns())
                channel.take()
                if channel.ended:
                    poller.unregister(channel.descriptor)
            if raw.fileno() in ready:
                up = answers.waiting()


class _Commands:
    """Commands from a stream, a line each, with one line of answer to each on standard output."""

    def __init__(self, bus: Bus, stream: TextIO | None) -> None:
        self._bus = bus
        self._pending = b""  # the beginning of a line
        self.descriptor = -1
        self.ended = False
        if stream is not None:
            with contextlib.suppress(OSError, ValueError):  # a stream without a descriptor cannot be polled
                self.descriptor = stream.fileno()

    def take(self) -> None:
        """Execute what has come. QuitCommand if a command was `quit`."""
        try:
            data = os.read(self.descriptor, _CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        self.ended = not data
        *lines, self._pending = (self._pending + (data or b"\n")).split(b"\n")
        if len(self._pending) > LONGEST_LINE:
            lines.append(self._pending)
            self._pending = b""
        for line in lines:
            if line.strip():
                self._execute(line[:LONGEST_LINE].decode(errors="replace"))

    def _execute(self, line: str) -> None:
        answer = "ok"
        try:
            answer = obey(self._bus, line)
        finally:
            with contextlib.suppress(OSError):  # nobody reads the answers
                os.write(1, answer.encode() + b"\n")


class _Answers:
    """Answers the frames that arrive.

    The middle of a frame passes the slaves halfway between its arrival and its answer: as on a wire, where
    slaves take no time, the way out is then as long as the way back.
    """

    def __init__(self, raw: socket.socket, bus: Bus, ifname: str) -> None:
        self._raw, self._bus, self._ifname = raw, bus, ifname
        self._buffer = bytearray(_BUFFER)
        self._half_ns = _FIRST_HALF_NS

    def waiting(self) -> bool:
        """Answer a bounded number of waiting frames; False if the interface is down."""
        raw, bus, buffer = self._raw, self._bus, self._buffer
        view, descriptor = memoryview(buffer), raw.fileno()
        for _ in range(_FRAMES_PER_TURN):
            try:
                size = raw.recv_into(buffer)
                arrived, now = arrived_ns(descriptor), time.monotonic_ns()
                if not now - _LONGEST_WAIT_NS < arrived < now:
                    arrived = now
                middle = (arrived + now) // 2 + int(self._half_ns)
                if bus.process(buffer, size, middle - size * BYTE_NS // 2):
                    half_ns = (time.monotonic_ns() - now) / 2
                    raw.send(view[:size])
                    self._half_ns *= 1 + _STEP if half_ns > self._half_ns else 1 - _STEP / _QUICK
            except BlockingIOError:
                bus.prepare()
                return True
            except OSError as error:
                if error.errno in (errno.ENOBUFS, errno.EMSGSIZE, errno.EINTR):
                    continue  # the frame is lost, as on a cable
                if error.errno in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO):
                    return False
                raise LinkError(f"interface {self._ifname} failed: {error.strerror}") from None
        return True
