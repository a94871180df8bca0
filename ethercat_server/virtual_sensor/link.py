"""The raw socket: frames from a network interface go through the bus; commands and a world come by others.

One thread, which polls for frames and commands, and checks watchdogs.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import gc
import os
import select
import socket
import stat
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

from bota_ethercat.world import DATAGRAM, decode
from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, StampClocks
from ethercat_server.ethercat.nic import arrived_ns, check_network, look_up, master_sockets
from ethercat_server.ethercat.wire import BYTE_NS, ETHERTYPE
from ethercat_server.virtual_sensor.bus import SlaveChain
from ethercat_server.virtual_sensor.faults import LONGEST_LINE, obey
from ethercat_server.virtual_sensor.options import SlaveOptions
from ethercat_server.virtual_sensor.world import ExternalWorld

_BUFFER = 2048
_SOL_PACKET, _PACKET_AUXDATA, _ETH_P_ALL = 263, 8, 3
_AUXDATA: Final = struct.Struct("=I12xHH")  # status, VLAN tag: control information and type
_VLAN_VALID: Final = 0x10
_ADDRESSES: Final = 12  # bytes of an Ethernet frame before its VLAN tag
_IDLE_MS = 10
_FRAMES_PER_TURN = 64
_DATAGRAMS_PER_TURN = 16
_FIRST_HALF_NS: Final = 20_000.0
# A frame that seems to have waited for longer has no usable time stamp: CLOCK_REALTIME was set.
_LONGEST_WAIT_NS: Final = 100_000_000
_STEP: Final = 0.001
# Quantile of half the time that an answer takes, followed in steps of `_STEP`: a master estimates the round
# trip from its quickest frames.
_QUICK: Final = 1 / 16
_CHUNK: Final = 1 << 16
_ANSWER_S: Final = 5.0
_LONGEST_ANSWER: Final = 1 << 20


class LinkError(Exception):
    """The interface cannot be used, or no longer, or a Unix socket cannot be created."""


def open_interface(ifname: str, protocol: int = _ETH_P_ALL) -> socket.socket:
    """A raw socket for frames on `ifname`; LinkError if it cannot be opened.

    The kernel removes VLAN tags; what they were it says only to sockets for all protocols.
    """
    try:
        found = look_up(ifname)
    except InterfaceError as error:
        raise LinkError(str(error)) from None
    if not found.up:
        raise LinkError(f"interface {ifname} is down: bring it up with `ip link set {ifname} up`")
    try:
        # No protocol yet: with one, it would receive frames of all interfaces until it is bound.
        raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    except PermissionError:
        raise LinkError(
            f"not allowed to open a raw socket on {ifname}: it needs CAP_NET_RAW, so run it as root"
        ) from None
    try:
        raw.setsockopt(_SOL_PACKET, _PACKET_AUXDATA, 1)
        raw.bind((found.name, protocol))
        raw.setblocking(False)
    except OSError as error:
        raw.close()
        raise LinkError(f"interface {ifname} cannot be used: {error.strerror}") from None
    return raw


def run(
    args: argparse.Namespace,
    slaves: Iterable[SlaveOptions],
    on_open: Callable[[], None],
    on_ready: Callable[[str], None],
    stop: threading.Event,
) -> None:
    """Answer EtherCAT frames on `args.iface` until stopped.

    Stops when `stop` is set (checked every 10 ms), on the command `quit`, and at the end of standard input if
    `exit_on_eof`. LinkError if the interface cannot be used, or disappears (one that is only down is waited
    for), or a path cannot; without `control` `own_socket` is used, and `on_ready` told if that cannot be.
    """
    ifname, control_path = args.iface, args.control
    try:
        check_network(look_up(ifname), ifname, allow_ip=args.allow_ip)
    except InterfaceError as error:
        raise LinkError(str(error)) from None
    if master_sockets(ifname):  # two that answer each other's answers would take all of the processors
        raise LinkError(f"{ifname} is in use by another virtual sensor or master: stop that one first")
    with contextlib.ExitStack() as stack:
        raw = stack.enter_context(open_interface(ifname))
        # By it others see that the interface is in use for EtherCAT; nobody reads it.
        shown = stack.enter_context(open_interface(ifname, ETHERTYPE))
        shown.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)
        on_open()
        bus = SlaveChain(slaves, SYSTEM_CLOCK.raw_ns(), StampClocks(SYSTEM_CLOCK).monotonic_ns)
        poller = select.poll()
        poller.register(raw, select.POLLIN)
        heard: dict[int, Callable[[], object]] = {}  # besides the frames: what to do, by descriptor
        note = ""
        try:
            control = stack.enter_context(bound(control_path or own_socket()))
            heard[control.fileno()] = lambda: _obey(control, bus)
        except LinkError as error:
            if control_path is not None:
                raise
            note = f"--send does not reach this virtual sensor, {error}: give it --control PATH"
        if args.world:
            world = stack.enter_context(bound(args.world))
            heard[world.fileno()] = lambda: _hear(world, bus)
        # None without a standard input, which cannot be polled without a descriptor either.
        with contextlib.suppress(AttributeError, OSError, ValueError):
            typed, begun = sys.stdin.fileno(), bytearray()
            heard[typed] = lambda: obey_lines(typed, begun, bus, poller, args.exit_on_eof)
        for descriptor in heard:
            poller.register(descriptor, select.POLLIN)
        # All that is loaded need never be looked through again, which takes some 20 ms.
        gc.collect()
        gc.freeze()
        on_ready(note)
        answers, index, up = _Answers(raw, bus, ifname), look_up(ifname).ifindex, True
        while not stop.is_set() and not bus.quit:
            ready = [descriptor for descriptor, _ in poller.poll(_IDLE_MS)]
            for descriptor in ready:
                if descriptor in heard:
                    heard[descriptor]()
            if raw.fileno() in ready:
                up = answers.waiting()
                continue
            bus.idle(SYSTEM_CLOCK.raw_ns())
            # Down is like an unplugged cable: it may come back, unless the interface was deleted.
            if not up and index not in dict(socket.if_nameindex()):
                raise LinkError(f"interface {ifname} has disappeared: create it again, and restart")


def _obey(control: socket.socket, bus: SlaveChain) -> None:
    """Execute the command in the next datagram; who sent it gets the answer, if it has an address."""
    bus.set_time(SYSTEM_CLOCK.raw_ns())
    with contextlib.suppress(OSError):
        line, sender = control.recvfrom(LONGEST_LINE)
        answer = obey(bus, line.decode(errors="replace"))
        if sender:
            control.sendto(answer.encode(), sender)


def obey_lines(
    descriptor: int, begun: bytearray, bus: SlaveChain, poller: select.poll, exit_on_eof: bool
) -> None:
    """Execute the commands that were typed; `begun` is the line that has not ended yet."""
    bus.set_time(SYSTEM_CLOCK.raw_ns())
    try:
        data = os.read(descriptor, _CHUNK)
    except OSError:  # of a terminal, to a job in the background
        data = b""
    *lines, begun[:] = (begun + (data or b"\n")).split(b"\n")
    del begun[LONGEST_LINE:]
    for line in filter(bytearray.strip, lines):
        answer = obey(bus, line[:LONGEST_LINE].decode(errors="replace"))
        with contextlib.suppress(OSError):  # nobody reads the answers
            os.write(1, answer.encode() + b"\n")
    if not data:
        poller.unregister(descriptor)
        bus.quit |= exit_on_eof


def _hear(world: socket.socket, bus: SlaveChain) -> None:
    """Tell the sensors what waiting datagrams say, some at a time; what is none of ours is dropped."""
    with contextlib.suppress(BlockingIOError):
        for _ in range(_DATAGRAMS_PER_TURN):
            content = decode(world.recv(DATAGRAM.size + 1))
            if content is not None and content[0] < len(bus.sensors):
                sensor, time_s, felt = content
                if isinstance(external := bus.sensors[sensor].options.world, ExternalWorld):
                    external.update(time_s, felt, time.monotonic())


@contextlib.contextmanager
def bound(path: str) -> Iterator[socket.socket]:
    """A socket for datagrams of this user's programs, at `path` until the end; LinkError if it cannot be."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        # Remove a stale socket, left by a killed process; nothing else.
        if probe.connect_ex(path) == errno.ECONNREFUSED and stat.S_ISSOCK(Path(path).stat().st_mode):
            Path(path).unlink()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        try:
            made.bind(path)
            Path(path).chmod(0o600)
            made.setblocking(False)
        except OSError as error:
            raise LinkError(f"cannot create the Unix socket {path!r}: {error.strerror or error}") from None
        try:
            yield made
        finally:
            with contextlib.suppress(OSError):
                Path(path).unlink()


def own_socket() -> str:
    """Where this user's virtual sensor takes commands if no other place is given."""
    folder = f"/run/user/{os.geteuid()}"
    if not os.access(folder, os.W_OK):  # none, or hidden from a service by ProtectHome=
        folder = tempfile.gettempdir()
    return f"{folder}/ethercat-virtual-sensor-{os.geteuid()}"


def send(path: str, command: str) -> str:
    """The answer to a command of a virtual sensor that listens there, this user's or root's; OSError."""
    if Path(path).stat().st_uid not in (0, os.geteuid()):
        raise PermissionError(errno.EPERM, "it is another user's")
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock,
    ):
        sock.bind(f"{folder}/answer")
        sock.settimeout(_ANSWER_S)
        sock.connect(path)
        sock.send(command.encode())
        return sock.recv(_LONGEST_ANSWER).decode()


class _Answers:
    """Answers the frames that arrive.

    The middle of a frame passes the slaves halfway between its arrival and its answer: as on a wire, where
    slaves take no time, the way out is then as long as the way back.
    """

    def __init__(self, raw: socket.socket, bus: SlaveChain, ifname: str) -> None:
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
                arrived, now = arrived_ns(descriptor), SYSTEM_CLOCK.raw_ns()
                if not now - _LONGEST_WAIT_NS < arrived < now:
                    arrived = now
                middle = (arrived + now) // 2 + int(self._half_ns)
                if bus.process(buffer, size, middle - size * BYTE_NS // 2):
                    half_ns = (SYSTEM_CLOCK.raw_ns() - now) / 2
                    status, control, kind = _AUXDATA.unpack(messages[0][2])
                    if status & _VLAN_VALID:
                        tag = struct.pack("!HH", kind, control)
                        raw.sendmsg((view[:_ADDRESSES], tag, view[_ADDRESSES:size]))
                    else:
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
