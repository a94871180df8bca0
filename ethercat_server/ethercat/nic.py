"""The network interface: what the kernel says of it, who has packet sockets on it, the lock that keeps it for
one master, and the check of all that before the bus is opened. SOEM itself would say only that it failed,
and open it beside another master.

Asked by netlink (linux/rtnetlink.h), not of /sys, which shows the namespace it was mounted in, and not by
pyroute2, which would double the locked memory of the server. The packet sockets are found by inodes: those in
/proc/net, and those of each process in /proc/PID/fd, where only root sees other users' descriptors.
"""

from __future__ import annotations

import contextlib
import difflib
import fcntl
import functools
import ipaddress
import os
import socket
import struct
import sys
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from ethercat_server.errors import LIST_ADAPTERS, InterfaceError
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.options import ALLOW_IP, VIRTUAL_INTERFACE
from ethercat_server.ethercat.wire import ETHERTYPE


class Listener(NamedTuple):
    """A packet socket, which receives a copy of frames."""

    protocol: int  # Ethernet type; 3 for all
    ifindex: int  # interface; 0 for all
    inode: int


class Process(NamedTuple):
    """A process that has sockets."""

    pid: int
    name: str
    sockets: set[int]  # inodes of all its sockets


def master_sockets(ifname: str) -> set[int]:
    """Inodes of the EtherCAT sockets on `ifname`; empty if there is none, or no such interface."""
    try:
        index = look_up(ifname).ifindex
    except InterfaceError:
        return set()
    return {row.inode for row in packet_sockets() if (row.protocol, row.ifindex) == (ETHERTYPE, index)}


def packet_sockets() -> list[Listener]:
    """The packet sockets of this network namespace, from the kernel's table of them."""
    return [Listener(int(row[3], 16), int(row[4]), int(row[-1])) for row in table("/proc/self/net/packet")]


_SIOCGSTAMPNS: Final = 0x80108907
_TIMESPEC: Final = struct.Struct("=qq")


def arrived_ns(fd: int) -> int:
    """CLOCK_MONOTONIC_RAW when the packet that was received last from the socket `fd` had arrived.

    0 if the kernel does not say, as at the first call, which has it stamp packets. The stamp is in
    CLOCK_REALTIME: it is wrong if that was set in between, and off by a slew of what it has waited.
    """
    try:
        seconds, ns = _TIMESPEC.unpack(fcntl.ioctl(fd, _SIOCGSTAMPNS, bytes(_TIMESPEC.size)))
    except OSError:
        return 0
    waited_ns = time.time_ns() - int(seconds * 1_000_000_000 + ns)
    return SYSTEM_CLOCK.raw_ns() - waited_ns  # if anything comes between the two clocks, it is too late


def users_of(inodes: set[int]) -> Iterator[Process]:
    """The visible processes that have one of these sockets."""
    for process in Path("/proc").iterdir():
        if process.name.isdecimal() and (sockets := set(_sockets(process))) & inodes:
            yield Process(int(process.name), _name_of(process), sockets)


def _name_of(process: Path) -> str:
    with contextlib.suppress(OSError):  # it has just ended
        return (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
    return ""


def table(path: str | Path) -> Iterator[list[str]]:
    """The rows of a table in /proc/net."""
    for line in Path(path).read_text(encoding="ascii").splitlines()[1:]:
        yield line.split()


def _sockets(process: Path) -> Iterator[int]:
    with contextlib.suppress(OSError):  # it has ended, or is another user's
        for descriptor in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                target = str(descriptor.readlink())
                if target.startswith("socket:["):
                    yield int(target[8:-1])


LEAST_MTU: Final = 1500  # bytes: an EtherCAT frame may be as long as any Ethernet frame
CHECK_CABLE: Final = "check cable and power"

_GET_LINK, _GET_ADDRESS, _GET_ROUTE = 18, 22, 26
_REQUEST, _DUMP = 0x1, 0x300
_ERROR, _DONE = 2, 3
_HEADER: Final = struct.Struct("=IHHII")  # length, type, flags, sequence number, port
_ATTRIBUTE: Final = struct.Struct("=HH")
_TYPE: Final = 0x3FFF
_BUFFER: Final = 65536
_LINK: Final = struct.Struct("=BxHiII")  # family, type, index, flags, change mask
_ETHERNET: Final = 1
_ALL_PROTOCOLS: Final = 3
_IFLA_ADDRESS, _IFLA_NAME, _IFLA_MTU, _IFLA_LINK, _IFLA_MASTER = 1, 3, 4, 5, 10
_IFLA_INFO, _IFLA_STATS = 18, 23
_IFLA_CARRIER, _IFLA_LINK_NAMESPACE, _IFLA_XDP, _IFLA_NAMESPACE, _IFLA_ALTERNATIVE_NAME = 33, 37, 43, 46, 53
_XDP_MODES: Final = {5: "xdpdrv", 6: "xdpgeneric", 7: "xdpoffload"}  # attributes of a program, and ip's words
_INFO_KIND: Final = 1
_IFF_UP, _IFF_LOOPBACK, _IFF_RUNNING = 0x1, 0x8, 0x40
IFF_PROMISC: Final = 0x100
_SIOCGIFFLAGS, _SIOCSIFFLAGS = 0x8913, 0x8914
_FLAGS: Final = struct.Struct("16sH14x")
_ADDRESS: Final = struct.Struct("=BBBBI")  # family, length of the prefix, flags, scope, interface
_IFA_ADDRESS, _IFA_LOCAL = 1, 2
_IFA_F_PERMANENT: Final = 0x80
# Family, length of the destination, of the source, TOS, table, who made it, scope, kind, flags.
_ROUTE: Final = struct.Struct("=BBBBBBBBI")
_RTA_DST, _RTA_OIF, _RTA_MULTIPATH = 1, 4, 9
_RTA_GATEWAYS: Final = frozenset({5, 18})  # the second: one of the other family
_NEXT_HOP: Final = struct.Struct("=HxxI")  # length, interface
# Objects (`ip nexthop`), to which a route only refers if net.ipv4.nexthop_compat_mode is 0: family, scope,
# who made it, flags; and of a group the number and weight of each member.
_GET_NEXT_HOP, _RTA_NEXT_HOP = 106, 30
_OBJECT, _MEMBER = struct.Struct("=BBBxI"), struct.Struct("=I4x")
_NHA_ID, _NHA_GROUP, _NHA_OIF, _NHA_GATEWAY = 1, 2, 5, 6
_UNICAST, _CACHED = 1, 0x200
_MADE_BY_KERNEL: Final = 2
# The shortest prefix of a single network; the whole address space is also routed by halves, or other parts.
_NETWORK_BITS: Final[dict[int, int]] = {socket.AF_INET: 8, socket.AF_INET6: 7}
_LINK_SCOPE: Final = 253
_SIOCETHTOOL: Final = 0x8946
_IFREQ: Final = struct.Struct("16sP16x")
# A request of linux/ethtool.h, and its answer: the speed's low half, duplex, the speed's high half.
_GET_SETTINGS: Final = 0x01, struct.Struct("=12xHB13xH14x")
_UNKNOWN_MBITS: Final = frozenset({0, 0xFFFF, 0xFFFFFFFF})
_ETHERCAT_MBITS: Final = 100
_BRIDGE: Final = "bridge"
_DROPS: Final = "a bridge, which drops EtherCAT frames because their source address is a group's"
_FAMILIES: Final = (socket.AF_INET, socket.AF_INET6)


@dataclass(frozen=True)
class Interface:
    """An interface as it is now; the index stays while it is there, its names may change."""

    name: str  # the one that is no alternative
    ifindex: int = 0
    up: bool = True
    loopback: bool = False
    carrier: bool = True  # it is linked, and ready to send
    mtu: int = LEAST_MTU
    master_index: int = 0  # of the bridge or bond that it is part of, 0 if none
    address: bytes = b""  # of the hardware
    kind: str = ""  # of a virtual one, such as veth or bridge; empty for a network card
    link: int = 0  # index of what it stands on, or of a veth pair's other end
    namespace: bytes = b""  # of that, as the kernel numbers namespaces; empty if it is this one
    ethernet: bool = True
    stats: bytes = b""  # struct rtnl_link_stats64
    # Where XDP programs are attached, as ip calls it: xdpdrv, xdpgeneric, xdpoffload.
    xdp: tuple[str, ...] = ()


def look_up(interface: str | int) -> Interface:
    """The interface with this index, or name: any that the kernel takes; InterfaceError if there is none."""
    try:
        return _look_up(interface)
    except (OSError, struct.error):
        names = [name for _, name in socket.if_nameindex()]
        close = difflib.get_close_matches(str(interface), [*names, VIRTUAL_INTERFACE], n=1)
        raise InterfaceError(
            f"no network interface {interface!r} on this machine: there are {', '.join(names)}, and "
            f"'{VIRTUAL_INTERFACE}' for a virtual sensor{f'; did you mean {close[0]!r}?' if close else ''}"
        ) from None


def _look_up(interface: str | int, namespace: bytes = b"") -> Interface:
    """As `look_up`, in another network `namespace` if one is given; OSError or struct.error."""
    index, attributes = (interface, b"") if isinstance(interface, int) else (0, _named(interface))
    if namespace:
        attributes += _attribute(_IFLA_NAMESPACE, namespace)
    return _interface(
        *next(_ask(_GET_LINK, _LINK, 0, 0, index, 0, 0, attributes=attributes, dump=False)), namespace
    )


def interfaces() -> list[Interface]:
    """All of this network namespace; OSError or struct.error."""
    return [_interface(*found) for found in _ask(_GET_LINK, _LINK, *(0,) * 5)]


def _interface(fixed: tuple[int, ...], found: dict[int, bytes], namespace: bytes = b"") -> Interface:
    _, kind, index, flags, _ = fixed
    mtu, link, master, carrier = (
        int.from_bytes(found.get(name, b""), sys.byteorder)
        for name in (_IFLA_MTU, _IFLA_LINK, _IFLA_MASTER, _IFLA_CARRIER)
    )
    return Interface(
        _text(found.get(_IFLA_NAME, b"")),
        index,
        up=bool(flags & _IFF_UP),
        loopback=bool(flags & _IFF_LOOPBACK),
        carrier=bool(carrier and flags & _IFF_RUNNING),  # the flag may follow the driver a second later
        mtu=mtu,
        master_index=master,
        address=found.get(_IFLA_ADDRESS, b""),
        kind=_text(_attributes(found.get(_IFLA_INFO, b"")).get(_INFO_KIND, b"")),
        link=link,
        namespace=found.get(_IFLA_LINK_NAMESPACE, namespace),
        ethernet=kind == _ETHERNET,
        stats=found.get(_IFLA_STATS, b""),
        xdp=tuple(
            mode for kind, mode in _XDP_MODES.items() if kind in _attributes(found.get(_IFLA_XDP, b""))
        ),
    )


def _named(name: str) -> bytes:
    """The attribute that asks for a name; the kernel compares it with both sorts."""
    return _attribute(_IFLA_ALTERNATIVE_NAME, os.fsencode(name) + b"\0")


def _text(name: bytes) -> str:
    return os.fsdecode(name.partition(b"\0")[0])


def own_name(interface: str | int, otherwise: str = "") -> str:
    """The interface's name that is no alternative one; `otherwise`, or what was given, if there is none."""
    try:
        return look_up(interface).name
    except InterfaceError:
        return otherwise or str(interface)


def name_trouble(ifname: str) -> str | None:
    """Why no interface can be called so; None if one can, or is, by an alternative name."""
    if (0 < len(os.fsencode(ifname)) <= _MAX_NAME_LENGTH and "/" not in ifname) or own_name(ifname) != ifname:
        return None
    return (
        f"{ifname!r} is not an interface name: it must have 1 to {_MAX_NAME_LENGTH} characters; "
        f"'{LIST_ADAPTERS}' lists them"
    )


def trouble(interface: str | int) -> str | None:
    """What prevents frames from passing an interface, and what to do; None if nothing does."""
    found = look_up(interface)
    name = found.name
    if found.kind == _BRIDGE:
        return f"{name} is {_DROPS}: name the interface that the sensor is connected to"
    if not found.up:
        return f"{name} is down: bring it up with 'sudo ip link set {name} up'"
    if found.master_index:
        master = own_name(found.master_index, f"interface {found.master_index}")
        return (
            f"{name} is part of {master} (a bridge or bond), which takes its frames: remove it with "
            f"'sudo ip link set {name} nomaster', or use another interface"
        )
    if found.mtu < LEAST_MTU:
        return (
            f"{name} has an MTU of {found.mtu} bytes, too few for EtherCAT: "
            f"'sudo ip link set {name} mtu {LEAST_MTU}'"
        )
    if not found.carrier:
        return f"{name} has no carrier: check the cable, the PoE injector and its power supply"
    return None


def in_between(interface: str | int) -> str | None:
    """What an interface is connected to, and what to do, if that is no slave; None if that is not known.

    A slave has 100 Mbit/s; a bridge is found behind a veth pair, or below a VLAN or the like.
    """
    found = look_up(interface)
    if found.link and (found.namespace or found.link != found.ifindex):
        with contextlib.suppress(OSError, struct.error):  # it may not look into the other's namespace
            port = other = _look_up(found.link, found.namespace)
            if other.kind != _BRIDGE and other.master_index:
                other = _look_up(other.master_index, found.namespace)
            if other.kind == _BRIDGE:
                removed = f", or 'sudo ip link set {port.name} nomaster'" if port.name != other.name else ""
                return (
                    f"{found.name} is connected to {other.name}, {_DROPS}: connect the sensor to "
                    f"{found.name} itself{removed}"
                )
    elif not found.kind and (mbits := _link_mbits(found.name)) > _ETHERCAT_MBITS:
        return (
            f"{found.name} is linked at {mbits} Mbit/s, so it is connected to no EtherCAT slave but to a "
            "switch or a computer: connect the sensor, or its PoE injector, directly, for managed switches "
            "drop EtherCAT frames"
        )
    return None


def ethtool(name: str, command: int, layout: struct.Struct) -> tuple[Any, ...]:
    """The answer to a request of linux/ethtool.h; OSError if the driver does not know it."""
    answer = array("B", struct.pack("=I", command).ljust(layout.size, b"\0"))
    request = _IFREQ.pack(os.fsencode(name), answer.buffer_info()[0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        fcntl.ioctl(asked, _SIOCETHTOOL, request)
    return layout.unpack(answer)


def link_settings(name: str) -> tuple[int, int]:
    """Mbit/s, 0 if the driver does not say, and duplex (0 half, 1 full); OSError."""
    low, duplex, high = ethtool(name, *_GET_SETTINGS)
    mbits = low | high << 16
    return 0 if mbits in _UNKNOWN_MBITS else mbits, duplex


def _link_mbits(name: str) -> int:
    try:
        return link_settings(name)[0]
    except OSError:
        return 0


XDP: Final = "an XDP program, which may drop its frames and stays when the program that loaded it has ended"


def xdp_removal(name: str, modes: Iterable[str]) -> tuple[str, ...]:
    """The commands that remove the XDP programs from the interface `name`; `modes` are `Interface.xdp`."""
    return tuple(f"sudo ip link set dev {name} {mode} off" for mode in modes)


def receivers(index: int) -> Iterator[tuple[Process | None, bool]]:
    """Those that get a copy of all frames of an interface, and whether it is the only one they listen on.

    None for processes that this user cannot see.
    """
    bound = {
        row.inode: row.ifindex == index
        for row in packet_sockets()
        if row.protocol == _ALL_PROTOCOLS and row.ifindex in {0, index}
    }
    unknown = {*bound}
    for process in users_of({*bound}) if bound else ():
        own = process.sockets & bound.keys()
        unknown -= own
        yield process, any(bound[inode] for inode in own)
    if unknown:
        yield None, any(bound[inode] for inode in unknown)


def why_silent(interface: str | int) -> str:
    """The interface's part in frames not coming back, and what to do."""
    try:
        found = look_up(interface)
        if problem := trouble(interface) or in_between(interface):
            return problem
        if found.xdp:
            return f"{found.name} has {XDP}: '{xdp_removal(found.name, found.xdp)[0]}'"
        return CHECK_CABLE
    except InterfaceError as error:
        return str(error)


def check_present(index: int, ifname: str) -> None:
    """Raise InterfaceError unless the interface that was opened is still there; `ifname` was its name."""
    if index not in dict(socket.if_nameindex()):
        raise InterfaceError(f"the interface {ifname} has disappeared: connect it and start the server again")


class Routes(NamedTuple):
    """Addresses and routes on an interface."""

    addresses: tuple[str, ...] = ()  # with the length of their prefix; link-local ones are not among them
    link_local: tuple[str, ...] = ()  # those that every interface may give itself, without a network
    # A default route goes here, in any table, by one of several next hops, or through an interface on top.
    default: bool = False
    others: tuple[str, ...] = ()  # destinations of the other routes that the kernel did not make
    # Those of the addresses that a network gave for some time: DHCP, or an IPv6 router.
    leased: tuple[str, ...] = ()
    beyond: tuple[str, ...] = ()  # those of the others that are behind a gateway

    def __str__(self) -> str:
        """What makes it part of a network; empty if nothing does."""
        beyond = tuple(f"route to {destination}" for destination in self.beyond)
        return ", ".join((*("default route",) * self.default, *beyond, *self.addresses))

    @property
    def elsewhere(self) -> str:
        """The route to other networks that goes here; empty if none does."""
        if self.default:
            return "the machine's default route"
        return f"the route to {self.beyond[0]}, through a gateway" if self.beyond else ""


def find_routes(index: int) -> Routes:
    """What is on the interface now; OSError if the kernel does not say."""
    try:
        carried, objects = _carried_by(index), functools.cache(_next_hop_objects)
        addresses = [
            (f"{ipaddress.ip_address(found.get(_IFA_LOCAL) or found[_IFA_ADDRESS])}/{length}", scope, flags)
            for (family, length, flags, scope, its), found in _ask(_GET_ADDRESS, _ADDRESS, *(0,) * 5)
            if its == index and family in _FAMILIES
        ]
        routes = [
            (_destination(family, length, found), made_by, gateway)
            for (family, length, _, _, _, made_by, _, kind, flags), found in _ask(
                _GET_ROUTE, _ROUTE, *(0,) * 9
            )
            if family in _FAMILIES and kind == _UNICAST and not flags & _CACHED
            for index, gateway in _hops(found, objects)
            if index in carried
        ]
    except (LookupError, ValueError, struct.error) as error:
        raise OSError(f"unknown answer: {error}") from error
    others = {text: gateway for text, made_by, gateway in routes if text and made_by != _MADE_BY_KERNEL}
    return Routes(
        addresses=tuple(text for text, scope, _ in addresses if scope != _LINK_SCOPE),
        link_local=tuple(sorted(text for text, scope, _ in addresses if scope == _LINK_SCOPE)),
        default=any(not text for text, *_ in routes),
        others=tuple(others),
        leased=tuple(
            text for text, scope, flags in addresses if scope != _LINK_SCOPE and not flags & _IFA_F_PERMANENT
        ),
        beyond=tuple(text for text, gateway in others.items() if gateway),
    )


def _destination(family: int, length: int, route: dict[int, bytes]) -> str:
    """Empty for a default route, or a part of one."""
    if not length:
        return ""
    address = ipaddress.ip_address(route[_RTA_DST])
    return f"{address}/{length}" if length >= _NETWORK_BITS[family] or address.is_multicast else ""


def _carried_by(index: int) -> set[int]:
    """The interface, and those that stand on it, such as VLANs, and the bridge that it is a part of."""
    rows, carried = interfaces(), {index}
    for _ in rows:
        carried |= {
            row.ifindex for row in rows if row.link in carried and not row.namespace and row.kind != "veth"
        }
        carried |= {row.master_index for row in rows if row.ifindex in carried and row.master_index}
    return carried


def _next_hop_objects() -> dict[bytes, dict[int, bytes]]:
    """By number."""
    return {found[_NHA_ID]: found for _, found in _ask(_GET_NEXT_HOP, _OBJECT, *(0,) * 4)}


def _hops(
    route: dict[int, bytes], objects: Callable[[], dict[bytes, dict[int, bytes]]]
) -> Iterator[tuple[int, bool]]:
    """Of each next hop of a route the interface, and whether there is a gateway.

    `objects` gives those to which a route may refer; there may be many such routes.
    """
    if _RTA_OIF in route:
        yield int.from_bytes(route[_RTA_OIF], sys.byteorder), not _RTA_GATEWAYS.isdisjoint(route)
    hops = route.get(_RTA_MULTIPATH, b"")
    while len(hops) >= _NEXT_HOP.size:
        size, index = _NEXT_HOP.unpack_from(hops)
        yield index, not _RTA_GATEWAYS.isdisjoint(_attributes(hops[_NEXT_HOP.size : size]))
        hops = hops[max(_NEXT_HOP.size, size + 3 & ~3) :]
    if _RTA_NEXT_HOP in route and not {_RTA_OIF, _RTA_MULTIPATH} & route.keys():
        there = objects()
        named = there[route[_RTA_NEXT_HOP]]
        group = named.get(_NHA_GROUP, b"")
        members = [there[group[at : at + 4]] for at in range(0, len(group), _MEMBER.size)]
        for each in members or [named]:
            yield int.from_bytes(each.get(_NHA_OIF, b""), sys.byteorder), _NHA_GATEWAY in each


def network_trouble(ifname: str, routes: Routes) -> str | None:
    """Why `ifname` must not carry EtherCAT frames, and what to do; None if it may."""
    other = f"name the sensor's interface ('{LIST_ADAPTERS}' lists them)"
    anyway = f"{ALLOW_IP} overrides this"
    if elsewhere := routes.elsewhere:
        return f"{ifname} has {elsewhere}, so it is not for a sensor: {other}; {anyway}"
    if routes.leased:
        return (
            f"{ifname} has the IP address {routes.leased[0]} by DHCP, so it is part of a network: {other}, "
            f"or, if only the sensor is on it, 'sudo ip address flush dev {ifname}'; {anyway}"
        )
    return None


def _ask(
    kind: int, layout: struct.Struct, *values: int, attributes: bytes = b"", dump: bool = True
) -> Iterator[tuple[tuple[int, ...], dict[int, bytes]]]:
    """The kernel's answers: fixed part and attributes, by type. OSError or struct.error if it refuses."""
    request = layout.pack(*values) + attributes
    request = _HEADER.pack(_HEADER.size + len(request), kind, _REQUEST | _DUMP * dump, 0, 0) + request
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as asked:
        asked.setblocking(False)  # the kernel answers before send returns
        asked.send(request)
        while True:
            data = asked.recv(_BUFFER)
            at = 0
            while at + _HEADER.size <= len(data):
                size, found, *_ = _HEADER.unpack_from(data, at)
                if found == _DONE:
                    return
                if found == _ERROR or size < _HEADER.size:
                    raise OSError("the kernel refuses the request")
                body = data[at + _HEADER.size : at + size]
                yield layout.unpack_from(body), _attributes(body[layout.size :])
                at += size + 3 & ~3
            if not dump:
                return


def _attribute(kind: int, value: bytes) -> bytes:
    size = _ATTRIBUTE.size + len(value)
    return (_ATTRIBUTE.pack(size, kind) + value).ljust(size + 3 & ~3, b"\0")


def _attributes(data: bytes) -> dict[int, bytes]:
    found, at = {}, 0
    while at + _ATTRIBUTE.size <= len(data):
        length, attribute = _ATTRIBUTE.unpack_from(data, at)
        found[attribute & _TYPE] = data[at + _ATTRIBUTE.size : at + length]
        at += max(_ATTRIBUTE.size, length + 3 & ~3)
    return found


# RuntimeDirectory= of the service, which then owns it. Only root and the service can enter it, so that no
# other user can take a lock.
DIRECTORY: Final = Path("/run/ethercat-server")
_FOLDER: Final = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


@contextlib.contextmanager
def locked(ifname: str, index: int) -> Iterator[None]:
    """Within it no other process has the lock of the interface `index`; InterfaceError if one has it.

    The lock is a folder's, one for each interface; the kernel releases it with the process. The root of a
    user namespace may not make one, and takes an abstract socket of its network namespace instead.
    """
    try:
        lock = _open_lock(f"{Path('/proc/self/ns/net').stat().st_ino}-{index}")
    except OSError:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as name:
            try:
                name.bind(f"\0ethercat-server/ifindex/{index}")
            except OSError:
                raise _in_use(ifname) from None
            yield
        return
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise _in_use(ifname, _owner(lock)) from None
        yield
    finally:
        os.close(lock)


def _open_lock(name: str) -> int:
    """The folder that is the lock, open; OSError if it cannot be had, or other users could have it."""
    with contextlib.suppress(FileExistsError):
        DIRECTORY.mkdir(mode=0o700)
    parent = os.open(DIRECTORY, _FOLDER)
    try:
        mode = os.fstat(parent).st_mode
        if mode & 0o022:
            raise PermissionError(f"{DIRECTORY} is writable for others")
        if mode & 0o077:  # an older version made it
            os.fchmod(parent, 0o700)
        with contextlib.suppress(FileExistsError):
            os.mkdir(name, 0o755, dir_fd=parent)
        return os.open(name, _FOLDER, dir_fd=parent)
    finally:
        os.close(parent)


def _owner(lock: int) -> int:
    """The process that has the lock; 0 if it is not visible."""
    inode = f":{os.fstat(lock).st_ino}"
    with contextlib.suppress(OSError):  # a service does not see them
        for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
            _, kind, _, _, process, file, *_ = line.split()
            if kind == "FLOCK" and file.endswith(inode):
                return int(process)
    return 0


def _in_use(ifname: str, process: int = 0, who: str = "another EtherCAT master") -> InterfaceError:
    """The error to be raised; `process` has the interface, 0 if that is not known."""
    if process > 0 and (name := _name_of(Path(f"/proc/{process}"))):
        who += f", process {process} ({name})"
    return InterfaceError(f"{ifname} is in use by {who}: stop that one first")


def check_unused(ifname: str) -> None:
    """InterfaceError if an EtherCAT master or a virtual sensor has the interface, which may not be there."""
    if not (inodes := master_sockets(ifname)):
        return
    index = look_up(ifname).ifindex
    of_slaves = {
        row.inode for row in packet_sockets() if (row.protocol, row.ifindex) == (_ALL_PROTOCOLS, index)
    }
    for process in users_of(inodes):
        what = "a virtual sensor" if process.sockets & of_slaves else "another EtherCAT master"
        raise _in_use(ifname, process.pid, what)
    raise _in_use(ifname, 0, "another EtherCAT master, or a virtual sensor")


_MAX_NAME_LENGTH: Final = 15  # of a name that is no alternative one
_CARRIER_TIMEOUT_S: Final = 5.0
NEEDED_CAPABILITIES: Final = {12: "CAP_NET_ADMIN", 13: "CAP_NET_RAW"}


@contextlib.contextmanager
def claimed(ifname: str, *, allow_ip: bool = False) -> Iterator[None]:
    """Within it the bus may be opened on `ifname`, by nobody else of this project.

    InterfaceError unless the interface exists, is free, can carry EtherCAT frames, may be opened, and is not
    one of the machine's network, which `allow_ip` permits.
    """
    index = _check_allowed(ifname, allow_ip=allow_ip)
    # Of two that start at once neither has the bus open yet, so looking for that is not enough.
    with locked(ifname, index):
        check_unused(ifname)
        _wait_usable(ifname)
        yield


def _check_allowed(ifname: str, *, allow_ip: bool) -> int:
    if problem := name_trouble(ifname):
        raise InterfaceError(problem)
    check_network(found := look_up(ifname), ifname, allow_ip=allow_ip)
    if missing := missing_capabilities():
        raise InterfaceError(
            f"not allowed to open {ifname}: {' and '.join(missing)} missing; run with sudo, or "
            "give the service CAP_NET_RAW and CAP_NET_ADMIN"
        )
    return found.ifindex


def check_network(found: Interface, ifname: str, *, allow_ip: bool) -> None:
    """InterfaceError for one of the machine's network, which `allow_ip` permits, and for loopback."""
    if found.loopback:
        raise InterfaceError(f"{ifname} is the loopback interface: name the sensor's")
    if allow_ip:
        return
    try:
        routes = find_routes(found.ifindex)
    except OSError as error:
        raise InterfaceError(
            f"the kernel does not say whether {ifname} has an IP address ({error}): {ALLOW_IP} "
            "overrides this check"
        ) from None
    if problem := network_trouble(ifname, routes):
        raise InterfaceError(problem)


def _wait_usable(ifname: str) -> None:
    # A link that was just brought up takes a moment, with a real network card up to some seconds.
    deadline = time.monotonic() + _CARRIER_TIMEOUT_S
    while (found := look_up(ifname)).up and not found.carrier and time.monotonic() < deadline:
        time.sleep(0.02)
    if problem := trouble(ifname):
        raise InterfaceError(problem)


def missing_capabilities(
    status: str | None = None, needed: Mapping[int, str] = NEEDED_CAPABILITIES
) -> list[str]:
    """Those of the `needed` ones, by bit, that are not in a /proc/PID/status, by default this process's."""
    lines = (Path("/proc/self/status").read_text() if status is None else status).splitlines()
    effective = next((int(line.split()[1], 16) for line in lines if line.startswith("CapEff:")), 0)
    return [name for bit, name in needed.items() if not effective >> bit & 1]


def change_flags(index: int, *, on: int = 0, off: int = 0) -> int:
    """Change the flags of an interface (linux/if.h), if it is there and that is allowed; what they were."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket, contextlib.suppress(OSError):
        name = socket.if_indextoname(index).encode()
        answer = fcntl.ioctl(any_socket, _SIOCGIFFLAGS, _FLAGS.pack(name, 0))
        flags: int = _FLAGS.unpack(answer)[1]
        if (wanted := (flags | on) & ~off) != flags:
            fcntl.ioctl(any_socket, _SIOCSIFFLAGS, _FLAGS.pack(name, wanted))
        return flags
    return 0
