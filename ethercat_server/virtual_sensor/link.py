"""The raw socket: passes frames from a network interface through the bus, and executes commands.

One thread, which polls for frames and commands, and checks watchdogs.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Final, TextIO

from ethercat_server.ethercat.nic import look_up
from ethercat_server.ethercat.raw_socket import arrived_ns
from ethercat_server.ethercat.wire import BYTE_NS, ETHERTYPE
from ethercat_server.virtual_sensor.bus import Bus
from ethercat_server.virtual_sensor.control import CommandChannel
from ethercat_server.virtual_sensor.faults.table import QuitCommand
from ethercat_server.virtual_sensor.options import BusOptions

LONGEST_NAME: Final = 15
"""Characters in the name of a network interface."""
_BUFFER = 2048
_SOL_PACKET, _PACKET_AUXDATA, _ETH_P_ALL = 263, 8, 3
_AUXDATA: Final = struct.Struct("=I12xHH")
"""Status, VLAN tag: control information and type."""
_VLAN_VALID: Final = 0x10
_ADDRESSES: Final = 12
"""Bytes of an Ethernet frame before its VLAN tag."""
_IDLE_MS = 10
_FRAMES_PER_TURN = 64
_FIRST_HALF_NS: Final = 20_000.0
_LONGEST_WAIT_NS: Final = 100_000_000
"""A frame that seems to have waited for longer has no usable time stamp: CLOCK_REALTIME was set."""
_STEP: Final = 0.001
_QUICK: Final = 1 / 16
"""Quantile of half the time that an answer takes, followed in steps of `_STEP`: a master estimates the round
trip from its quickest frames."""


class LinkError(Exception):
    """The interface cannot be used, or no longer."""


def open_interface(ifname: str, protocol: int = _ETH_P_ALL) -> socket.socket:
    """A raw socket for frames on `ifname`; LinkError if it cannot be opened.

    The kernel removes VLAN tags; what they were it says only to sockets for all protocols.
    """
    if not ifname or len(ifname.encode()) > LONGEST_NAME:
        raise LinkError(f"interface name {ifname!r}: it must have 1 to {LONGEST_NAME} characters")
    _index(ifname)
    try:
        # No protocol yet: with one, it would receive frames of all interfaces until it is bound.
        raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    except PermissionError:
        raise LinkError(
            f"not allowed to open a raw socket on {ifname}: it needs CAP_NET_RAW, so run it as root"
        ) from None
    try:
        if not look_up(ifname).is_up:
            raise LinkError(f"interface {ifname} is down: bring it up with `ip link set {ifname} up`")
        raw.setsockopt(_SOL_PACKET, _PACKET_AUXDATA, 1)
        raw.bind((ifname, protocol))
        raw.setblocking(False)
    except OSError as error:
        raw.close()
        raise LinkError(f"interface {ifname} cannot be used: {error.strerror}") from None
    except LinkError:
        raw.close()
        raise
    return raw


def _index(ifname: str) -> int:
    try:
        return socket.if_nametoindex(ifname)
    except OSError:
        raise LinkError(f"no network interface {ifname!r}: see `ip link`") from None


def run(
    ifname: str,
    options: BusOptions,
    *,
    control_path: str | None = None,
    commands: TextIO | None = None,
    exit_on_eof: bool = False,
    on_open: Callable[[], None] = lambda: None,
    on_ready: Callable[[], None] = lambda: None,
    should_stop: threading.Event | Callable[[], bool] = lambda: False,
) -> None:
    """Answer EtherCAT frames on `ifname` until stopped.

    Stops when `should_stop` is set or returns true (checked every 10 ms), on the command `quit`, and at
    the end of `commands` if `exit_on_eof`. LinkError if the interface cannot be
    used, or disappears (one that is only down is waited for); ControlError if `control_path` cannot be used.
    """
    stop = should_stop.is_set if isinstance(should_stop, threading.Event) else should_stop
    with contextlib.ExitStack() as stack:
        raw = stack.enter_context(open_interface(ifname))
        # By it others see that the interface is in use for EtherCAT; nobody reads it.
        shown = stack.enter_context(open_interface(ifname, ETHERTYPE))
        shown.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)
        on_open()
        bus = Bus(options, time.monotonic_ns())
        poller = select.poll()
        poller.register(raw, select.POLLIN)
        channel = stack.enter_context(CommandChannel(bus, poller, control_path, commands))
        # All that is loaded need never be looked through again, which takes some 20 ms.
        gc.collect()
        gc.freeze()
        on_ready()
        with contextlib.suppress(QuitCommand):
            _serve(raw, bus, poller, channel, ifname, stop, exit_on_eof)


def _serve(
    raw: socket.socket,
    bus: Bus,
    poller: select.poll,
    channel: CommandChannel,
    ifname: str,
    stop: Callable[[], bool],
    exit_on_eof: bool,
) -> None:
    descriptor = raw.fileno()
    answers = _Answers(raw, bus, ifname)
    index = _index(ifname)
    up = True
    while not stop():
        if exit_on_eof and channel.ended:
            return
        events = poller.poll(_IDLE_MS)
        if not events:
            bus.idle(time.monotonic_ns())
            if not up:  # like an unplugged cable: it may come back, unless the interface was deleted
                _check_there(ifname, index)
            continue
        for ready, event in events:
            if ready != descriptor:
                bus.set_time(time.monotonic_ns())
                channel.handle(ready, event)
        if any(ready == descriptor for ready, _ in events):
            up = answers.waiting()


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
        view, descriptor, space = memoryview(buffer), raw.fileno(), socket.CMSG_SPACE(_AUXDATA.size)
        for _ in range(_FRAMES_PER_TURN):
            try:
                size, messages, _, _ = raw.recvmsg_into((buffer,), space)
                arrived, now = arrived_ns(descriptor), time.monotonic_ns()
                if not now - _LONGEST_WAIT_NS < arrived < now:
                    arrived = now
                middle = (arrived + now) // 2 + int(self._half_ns)
                if bus.process(buffer, size, middle - size * BYTE_NS // 2):
                    half_ns = (time.monotonic_ns() - now) / 2
                    status, control, kind = _AUXDATA.unpack(messages[0][2])
                    tag = struct.pack("!HH", kind, control) if status & _VLAN_VALID else b""
                    raw.sendmsg((view[:_ADDRESSES], tag, view[_ADDRESSES:size]))
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


def _check_there(ifname: str, index: int) -> None:
    """LinkError if the interface is no longer the one that was opened."""
    with contextlib.suppress(OSError):
        if socket.if_nametoindex(ifname) == index:
            return
    raise LinkError(f"interface {ifname} has disappeared: create it again and restart the virtual sensor")
