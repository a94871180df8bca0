"""Other software on the interface: network managers, IP, bridges, packet sockets."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

from ethercat_server.access.holder import Holder, owners
from ethercat_server.doctor.finding import Finding, bad, cannot_look, note, ok, warning
from ethercat_server.doctor.machine.facts import known
from ethercat_server.doctor.machine.machine import Machine
from ethercat_server.ethercat.nic.interface import ALLOW_IP, network_trouble
from ethercat_server.ethercat.nic.packet_sockets import Listener, packet_sockets

_ETHERCAT: Final = 0x88A4
_EVERYTHING: Final = 3
_CLIENTS: Final = frozenset({"dhclient", "dhcpcd", "udhcpc", "connmand", "wicked"})


def managers(machine: Machine) -> Iterator[Finding]:
    """Network managers that configure the interface."""
    index = machine.facts.there.index
    name, found = machine.shown, []
    state = machine.text_or(f"/run/NetworkManager/devices/{index}")
    if re.search(r"^managed=(true|1)$", state, re.MULTILINE):
        found.append(("NetworkManager", f"sudo nmcli device set {name} managed no"))
    state = machine.text_or(f"/run/systemd/netif/links/{index}")
    networkd = re.search(r"^ADMIN_STATE=(\S+)$", state, re.MULTILINE)
    if networkd and networkd[1] not in {"unmanaged", "initialized", "pending", "linger"}:
        found.append((f"systemd-networkd ({networkd[1]})", f"sudo scripts/install-service {name}"))
    if re.search(
        rf"^\s*iface\s+{re.escape(machine.ifname)}\s+inet6?\s+(?!manual)", _ifupdown(machine), re.MULTILINE
    ):
        found.append(("ifupdown", "sudoedit /etc/network/interfaces"))
    for pid, command in machine.commands_running().items():
        arguments = machine.text_or(f"/proc/{pid}/cmdline").split("\0")
        if command in _CLIENTS and machine.ifname in arguments:
            found.append((f"{command} ({pid})", f"sudo kill {pid}"))
    values: dict[str, Any] = {"managers": [who for who, _ in found]}
    if not found:
        yield ok("no network manager configures it", **values)
        return
    yield warning(
        ", ".join(values["managers"]),
        "it sends frames of its own and may take the interface down; scripts/install-service configures "
        "NetworkManager and systemd-networkd permanently",
        *(command for _, command in found), **values,
    )  # fmt: skip


def _ifupdown(machine: Machine) -> str:
    folder = "/etc/network/interfaces.d"
    files = ["/etc/network/interfaces", *(f"{folder}/{name}" for name in machine.names(folder))]
    return "\n".join(machine.text_or(name) for name in files)


def addresses(machine: Machine) -> Iterator[Finding]:
    """IP on the interface."""
    machine.facts.there  # noqa: B018 - there must be one
    found = known(machine.facts.routes)
    name = machine.shown
    values: dict[str, Any] = {
        "addresses": [*found.addresses, *found.link_local],
        "routes": list(found.others),
        "default_route": found.default,
    }
    why = "IP traffic delays the sensor's frames"
    text = ", ".join([*found.addresses, *(f"route to {route}" for route in found.others)])
    if not machine.allow_ip and network_trouble(name, found):
        text = f"the machine's default route ({text or 'no address'})" if found.default else text
        command = "ethercat-sensor adapters" if found.default else f"sudo ip address flush dev {name}"
        why = f"the server refuses it (without {ALLOW_IP}): use another interface"
        yield bad(text, why + ("" if found.default else ", or remove its addresses"), command, **values)
    elif found.default:
        yield warning(f"the machine's default route ({text or 'no address'})", why, **values)
    elif text:
        yield warning(text, why, f"sudo ip address flush dev {name}", **values)
    elif found.link_local:
        yield note(
            f"only {', '.join(found.link_local)}",
            "the kernel's own IPv6 address: now and then it asks for routers and neighbours there",
            f"echo 1 | sudo tee /proc/sys/net/ipv6/conf/{name}/disable_ipv6", **values,
        )  # fmt: skip
    else:
        yield ok("no address, no route", **values)


def membership(machine: Machine) -> Iterator[Finding]:
    """Bridges, bonds, VLANs."""
    there, name = machine.facts.there, machine.shown
    values: dict[str, Any] = {"master": there.master, "upper": list(there.upper)}
    if there.master:
        yield bad(
            f"part of {there.master}", "a bridge or bond intercepts the sensor's frames and sends others",
            f"sudo ip link set {name} nomaster", **values,
        )  # fmt: skip
    elif there.upper:
        yield warning(
            f"below {', '.join(there.upper)}", "they (VLANs, for instance) send through it",
            *(f"sudo ip link delete {upper}" for upper in there.upper), **values,
        )  # fmt: skip
    else:
        yield ok("no bridge, bond or VLAN", **values)


def listeners(machine: Machine) -> Iterator[Finding]:
    """Other programs with a packet socket; the EtherCAT master has a check of its own."""
    index = machine.facts.there.index
    try:
        rows = packet_sockets(machine.path("/proc/self/net/packet"))
    except (OSError, ValueError, IndexError) as error:
        cannot_look(f"/proc/self/net/packet: {getattr(error, 'strerror', None) or error}")
    heard = [
        row for row in rows if row.ifindex in {index, 0} and row.protocol != _ETHERCAT and _hears(row, index)
    ]
    if not heard:
        yield ok("no other program receives frames", listeners=[])
        return
    found = list(owners({row.inode for row in heard}, machine.path("/proc")))
    text = (
        ", ".join(_name(who) for who in found)
        or f"{len(heard)} packet sockets of processes that only root can see"
    )
    copies = any(row.protocol == _EVERYTHING for row in heard)
    why = (
        "it receives a copy of every frame, which delays the server"
        if copies
        else "it expects frames of other protocols on this interface"
    )
    commands = [f"sudo kill {who.pid}" for who in found]
    make = warning if copies else note
    yield make(text, why, *commands, listeners=[_name(who) for who in found])


def _hears(row: Listener, index: int) -> bool:
    """A socket for all interfaces counts only if it takes every frame."""
    return row.ifindex == index or row.protocol == _EVERYTHING


def _name(who: Holder) -> str:
    return f"{who.name} ({who.pid})"
