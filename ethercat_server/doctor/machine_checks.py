"""The checks of machine and interface, in the order of the report: what each reads, its limits, its advice.

A check that fails does not stop the others.
"""

from __future__ import annotations

import re
import shlex
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

from bota_ethercat.program.command import command
from ethercat_server.access.adapters import Adapter, is_wireless
from ethercat_server.doctor.machine import Host
from ethercat_server.doctor.report import (
    CannotLookError,
    CheckResult,
    bad,
    examine,
    graded,
    note,
    ok,
    skipped,
    warning,
)
from ethercat_server.ethercat.nic import (
    NEEDED_CAPABILITIES,
    XDP,
    Routes,
    missing_capabilities,
    network_trouble,
    xdp_removal,
)
from ethercat_server.ethercat.options import ALLOW_IP, VIRTUAL_INTERFACE

Look = Callable[[Host], CheckResult | Iterable[CheckResult]]


def examine_machine(machine: Host) -> Iterator[CheckResult]:
    """All checks that need no bus."""
    there = True
    for (subject, name), look in CHECKS.items():
        about_the_interface = subject in {"interface", "other software"}
        if about_the_interface and not there:
            continue
        for finding in examine(subject, name, look, machine):
            # A virtual bus is gone when the doctor ends: nothing to fix.
            gone = about_the_interface and machine.asked == VIRTUAL_INTERFACE
            yield replace(finding, commands=()) if gone else finding
        if look is _link_state:
            link = machine.facts["link"]
            there = isinstance(link, Adapter) and not link.loopback
    if not there:
        yield replace(skipped("no interface for a sensor"), subject="interface", check="the rest")


_SWITCH: Final = "/sys/kernel/debug/sched/preempt"


def _preemption(machine: Host) -> CheckResult:
    version, switch = machine.text("/proc/version", ""), machine.text(_SWITCH, "")
    if machine.text("/sys/kernel/realtime", "") == "1" or "PREEMPT_RT" in version:
        return ok("fully preemptible (PREEMPT_RT)", model="rt")
    dynamic = "PREEMPT_DYNAMIC" in version
    built = None if dynamic or not version else "full" if "PREEMPT" in version.split() else "voluntary"
    switched = re.search(r"\((\w+)\)", switch)
    asked = dynamic and re.search(r"\bpreempt=(\w+)", machine.text("/proc/cmdline", ""))
    if not (model := switched[1] if switched else asked[1] if asked else built):
        raise CannotLookError(f"{_SWITCH} cannot be read: it needs root and debugfs")
    real_time_kernel = "sudo apt install linux-image-rt-amd64"
    if re.search(r"^ID=\"?ubuntu", machine.text("/etc/os-release", ""), re.MULTILINE):
        real_time_kernel = "sudo pro attach && sudo pro enable realtime-kernel"
    late = "kernel code is rarely preempted: under load the server wakes milliseconds late"
    return graded(
        f"{model}{' (dynamic)' * dynamic}",
        (model in {"full", "lazy"}, note,
         "no real-time kernel: drivers and interrupts may delay the server by some 100 µs under load",
         real_time_kernel),
        (not dynamic, warning, late, real_time_kernel),
        (True, warning, f"{late}; to make it permanent, add preempt=full to the kernel command line",
         f"echo full | sudo tee {_SWITCH}"),
        model=model, dynamic=dynamic,
    )  # fmt: skip


_CAPABILITIES: Final = NEEDED_CAPABILITIES | {14: "CAP_IPC_LOCK", 23: "CAP_SYS_NICE"}


def _capabilities(machine: Host) -> CheckResult:
    missing = missing_capabilities(machine.text("/proc/self/status"), _CAPABILITIES)
    held = [name for name in _CAPABILITIES.values() if name not in missing]
    without = (
        "could not open the interface"
        if {*missing} & {*NEEDED_CAPABILITIES.values()}
        else "would have a less steady cycle"
    )
    return graded(
        f"missing: {', '.join(missing)}" if missing else f"all four: {', '.join(held)}",
        (missing, note,
         f"a server started by this user {without}, and the doctor can check less; the service has all "
         "four", command(f"sudo ethercat-doctor {shlex.quote(machine.asked or machine.ifname)}")),
        missing=missing, held=held,
    )  # fmt: skip


_CPUS: Final = "/sys/devices/system/cpu"
_LATENCY_FILE: Final = "/dev/cpu_dma_latency"
_NO_CONSTRAINT_US: Final = 1_000_000
_DEEP_US: Final = 50
_LIGHT_US: Final = 10
_PERMANENT: Final = "to make it permanent: 'tuned-adm profile latency-performance'"


def _governor(machine: Host) -> CheckResult:
    files = (f"{_CPUS}/cpu{number}/cpufreq/scaling_governor" for number in machine.processors)
    found = Counter(name for file in files if (name := machine.text(file, "")))
    slow = "an idle processor runs slowly at first, just when the server wakes"
    return graded(
        ", ".join(f"{name} on {count}" for name, count in found.most_common())
        or "no frequency scaling that this system controls",
        (set(found) - {"performance"}, warning, f"{slow}; {_PERMANENT}",
         f"echo performance | sudo tee {_CPUS}/cpu*/cpufreq/scaling_governor"),
        governors=list(found),
    )  # fmt: skip


def _idle_states(machine: Host) -> CheckResult:
    states: dict[tuple[str, str], int] = {}
    for number in machine.processors:
        folder = f"{_CPUS}/cpu{number}/cpuidle"
        for state in machine.names(folder):
            enabled = machine.text(f"{folder}/{state}/disable", "0") == "0"
            if enabled and machine.text(f"{folder}/{state}/latency", ""):
                key = state, machine.text(f"{folder}/{state}/name", state)
                states[key] = max(machine.number(f"{folder}/{state}/latency"), states.get(key, 0))
    if not states:
        return ok("none that this system controls", "on a virtual machine the host controls them", states={})
    limit = _latency_limit_us(machine)
    allowed = {key: latency for key, latency in states.items() if limit is None or latency <= limit}
    (_, name), deepest = max(allowed.items(), key=lambda item: item[1], default=(("", "none"), 0))
    text = f"{name}, {deepest} µs to wake"
    if limit is not None:
        text += f" (limited by a program to {limit} µs, through {_LATENCY_FILE})"
    deep = sorted({state[-1] for (state, _), latency in allowed.items() if latency > _LIGHT_US})
    command = f"echo 1 | sudo tee {_CPUS}/cpu*/cpuidle/state[{''.join(deep)}]/disable"
    why = f"each wake-up may be late by that; {_PERMANENT}"
    return graded(
        text,
        (deepest > _DEEP_US, warning, why, command),
        (deepest > _LIGHT_US, note, why, command),
        deepest=name, latency_us=deepest, limit_us=limit,
    )  # fmt: skip


def _latency_limit_us(machine: Host) -> int | None:
    """The limit that programs set in /dev/cpu_dma_latency; None if none, or only root can see it."""
    try:
        with machine.path(_LATENCY_FILE).open("rb") as file:
            (limit,) = struct.unpack("=i", file.read(4))
    except (OSError, struct.error):
        return None
    return int(limit) if 0 <= limit < _NO_CONSTRAINT_US else None


_ETHERCAT_SPEED: Final = 100
_GUEST_DRIVERS: Final = frozenset({"virtio_net", "vmxnet3", "hv_netvsc", "xen-netfront", "vif", "ena", "gve"})
_DELAYS: Final = ("rx_coalesce_usecs", "tx_coalesce_usecs")
_ADAPTIVE: Final = ("use_adaptive_rx_coalesce", "use_adaptive_tx_coalesce")
_ERRORS: Final = (
    "rx_errors", "tx_errors", "rx_crc_errors", "rx_frame_errors", "rx_length_errors", "tx_carrier_errors",
    "collisions",
)  # fmt: skip
_DROPS: Final = (
    "rx_dropped", "tx_dropped", "rx_fifo_errors", "rx_missed_errors", "rx_over_errors", "tx_fifo_errors",
)  # fmt: skip
_LIST: Final = command("ethercat-sensor adapters")
_CORRUPTED: Final = "corrupted: check cable, connectors, shield and sources of interference"


def _link_state(machine: Host) -> CheckResult:
    if machine.fact("link") is None:
        return bad(
            f"no network interface {machine.ifname!r}",
            f"available: {', '.join(machine.fact('names'))}; USB adapters change names when plugged into "
            "another port",
            _LIST, present=False,
        )  # fmt: skip
    link, name = machine.link, machine.shown
    there = "up, with carrier" + (f" ({link.kind})" if link.kind else "")
    return graded(
        "the loopback interface" if link.loopback else there if link.state == "up" else link.state,
        (link.loopback, bad, "sensors need a network card: use another interface", _LIST),
        (not link.up, bad, "it cannot send frames", f"sudo ip link set {name} up"),
        (not link.carrier, bad,
         "no link: check cable, PoE injector and its power supply; the sensor belongs on its LAN side",
         f"ip -br link show {name}"),
        present=True, up=link.up, carrier=link.carrier, kind=link.kind,
    )  # fmt: skip


def _speed(machine: Host) -> CheckResult:
    if not machine.link.carrier:
        raise CannotLookError("no carrier")
    mbits, duplex = machine.fact("settings")
    virtual = machine.link.kind or (mbits is None and duplex is None)
    mend = f"sudo ethtool -s {machine.shown} autoneg on"
    return graded(
        f"{mbits or 'unknown'} Mbit/s, {duplex or 'unknown'} duplex",
        (virtual, ok, "not meaningful for a virtual interface"),
        (duplex == "half", bad, "EtherCAT needs full duplex", mend),
        ((mbits or _ETHERCAT_SPEED) < _ETHERCAT_SPEED, bad, "EtherCAT is 100 Mbit/s: check the cable", mend),
        ((mbits or 0) > _ETHERCAT_SPEED, warning,
         "sensors use 100 Mbit/s, so there is a switch or another device in between, which delays "
         "frames: connect the sensor, or its PoE injector, directly"),
        mbits=mbits, duplex=duplex,
    )  # fmt: skip


def _driver(machine: Host) -> CheckResult:
    kind, (found, bus) = machine.link.kind, machine.fact("driver")
    wireless = is_wireless(machine.path(f"/sys/class/net/{machine.ifname}"))
    text = f"{found} on {bus}" if bus and bus != "N/A" else found
    return graded(
        text + (f", {kind}" if kind and kind != found else ""),
        (wireless, bad, "a wireless interface: EtherCAT needs a cable", _LIST),
        (bus.startswith("usb"), warning, "USB polls an adapter every 125 µs at best: prefer a PCIe card"),
        (found in _GUEST_DRIVERS, warning,
         "a virtual card: each frame goes through the host; pass a physical card through"),
        driver=found, bus=bus,
    )  # fmt: skip


def _coalescing(machine: Host) -> CheckResult:
    found = machine.fact("coalescing")
    adaptive = [name.split("_")[2] for name in _ADAPTIVE if found.get(name)]
    on = [f"{name[:2]} {found[name]} µs" for name in _DELAYS if found.get(name)]
    on += [f"adaptive {way}" for way in adaptive]
    off = "adaptive-rx off adaptive-tx off " if adaptive else ""
    command = f"sudo ethtool -C {machine.shown} {off}rx-usecs 0 tx-usecs 0"
    return graded(
        ", ".join(on) or "off",
        (on, warning, "the card delays the interrupt for a received frame by up to that", command),
        **{name: found.get(name) for name in (*_DELAYS, *_ADAPTIVE)},
    )


def _energy_efficient_ethernet(machine: Host) -> CheckResult:
    enabled, active = machine.fact("EEE")
    mend = f"sudo ethtool --set-eee {machine.shown} eee off"
    return graded(
        "in use" if active else "enabled, not in use" if enabled else "off",
        (active, warning, "the link sleeps between frames, and waking takes tens of µs", mend),
        (enabled, note, "another device on the cable could negotiate it", mend),
        enabled=enabled, active=active,
    )  # fmt: skip


def rising(before: Mapping[str, int], after: Mapping[str, int]) -> CheckResult:
    """Errors that the card counted during the measurement."""
    if not before or not after:
        raise CannotLookError("the kernel provides no counters")
    new = {key: after.get(key, 0) - before.get(key, 0) for key in (*_ERRORS, *_DROPS)}
    new = {key: count for key, count in new.items() if count > 0}
    return graded(
        _counted(new) or "no new errors",
        (new.keys() & set(_ERRORS), bad, f"frames are being {_CORRUPTED}"),
        (new, note, "frames of unknown protocols, or a receive buffer overflow"),
        **dict[str, Any](new),
    )


def _counted(found: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in found.items())


_DHCP_CLIENTS: Final = frozenset({"dhclient", "dhcpcd", "udhcpc", "connmand", "wicked"})
_LEFT_ALONE: Final = frozenset({"unmanaged", "initialized", "pending", "linger"})  # by systemd-networkd


def _managers(machine: Host) -> Iterator[CheckResult]:
    index, name, found = machine.link.ifindex, machine.shown, {}
    state = machine.text(f"/run/NetworkManager/devices/{index}", "")
    if re.search(r"^managed=(true|1)$", state, re.MULTILINE):
        found["NetworkManager"] = f"sudo nmcli device set {name} managed no"
    state = machine.text(f"/run/systemd/netif/links/{index}", "")
    networkd = re.search(r"^ADMIN_STATE=(\S+)$", state, re.MULTILINE)
    if networkd and networkd[1] not in _LEFT_ALONE:
        found[f"systemd-networkd ({networkd[1]})"] = f"sudo scripts/install-service {name}"
    folder = "/etc/network/interfaces.d"
    files = ["/etc/network/interfaces", *(f"{folder}/{file}" for file in machine.names(folder))]
    ifupdown = "\n".join(machine.text(file, "") for file in files)
    configured = rf"^\s*iface\s+{re.escape(machine.ifname)}\s+inet6?\s+(?!manual)"
    if re.search(configured, ifupdown, re.MULTILINE):
        found["ifupdown"] = "sudoedit /etc/network/interfaces"
    for pid in filter(str.isdecimal, machine.names("/proc")):
        command = machine.text(f"/proc/{pid}/comm", "")
        arguments = machine.text(f"/proc/{pid}/cmdline", "").split("\0")
        if command in _DHCP_CLIENTS and machine.ifname in arguments:
            found[f"{command} ({pid})"] = f"sudo kill {pid}"
    if not found:
        yield ok("no network manager configures it")
    for manager, command in found.items():
        yield warning(
            manager,
            "it sends frames of its own and may take the interface down; scripts/install-service configures "
            "NetworkManager and systemd-networkd permanently",
            command,
        )


def _addresses(machine: Host) -> CheckResult:
    found: Routes = machine.fact("routes")
    name, delays = machine.shown, "IP traffic delays the sensor's frames"
    text = ", ".join([*found.addresses, *(f"route to {route}" for route in found.others)])
    mend = () if found.elsewhere else (f"sudo ip address flush dev {name}",)
    shown = text or (f"only {', '.join(found.link_local)}" if found.link_local else "no address, no route")
    refused = not machine.allow_ip and network_trouble(name, found)
    another = f"the server refuses it (without {ALLOW_IP}): use another interface"
    return graded(
        f"{found.elsewhere} ({text or 'no address'})" if found.elsewhere else shown,
        (refused and found.elsewhere, bad, another, _LIST),
        (refused, bad, f"{another}, or remove its addresses", *mend),
        (text or found.elsewhere, warning, delays, *mend),
        (found.link_local, note,
         "the kernel's own IPv6 address: now and then it asks for routers and neighbors there",
         f"echo 1 | sudo tee /proc/sys/net/ipv6/conf/{name}/disable_ipv6"),
        addresses=[*found.addresses, *found.link_local], routes=list(found.others),
        default_route=found.default,
    )  # fmt: skip


def _membership(machine: Host) -> Iterator[CheckResult]:
    link, name = machine.link, machine.shown
    if link.master:
        yield bad(
            f"part of {link.master}",
            "a bridge or bond intercepts the sensor's frames and sends others",
            f"sudo ip link set {name} nomaster",
        )
    for upper in link.upper:
        yield warning(
            f"below {upper}", "it (a VLAN, for instance) sends through it", f"sudo ip link delete {upper}"
        )
    between = machine.fact("between") if link.kind else [""]  # of a card `_speed` says it
    if between[0]:
        yield bad(*between)
    if not (link.master or link.upper or between[0]):
        yield ok("no bridge, bond or VLAN")


def _xdp(machine: Host) -> CheckResult:
    found = machine.link.xdp
    return graded(
        f"a program is attached ({', '.join(found)})" if found else "no program",
        (found, warning,
         f"{XDP}; if the command says that it is busy, end that program", *xdp_removal(machine.shown, found)),
        modes=list(found),
    )  # fmt: skip


def _receivers(machine: Host) -> Iterator[CheckResult]:
    for process, only_this in machine.fact("receivers"):
        yield (warning if only_this else note)(
            f"process {process.pid} ({process.name})"
            if process
            else "a process of another user, or outside of this container",
            "it has a packet socket that gets a copy of each frame: a capture program, or another master",
            f"sudo kill {process.pid}" if process else "sudo ss --packet --processes",
        )
    if not machine.fact("receivers"):
        yield ok("no other program gets the frames")


CHECKS: Final[Mapping[tuple[str, str], Look]] = {
    ("kernel", "preemption"): _preemption,
    ("rights", "capabilities"): _capabilities,
    ("processors", "governor"): _governor,
    ("processors", "idle states"): _idle_states,
    ("interface", "link"): _link_state,
    ("interface", "speed"): _speed,
    ("interface", "driver"): _driver,
    ("interface", "coalescing"): _coalescing,
    ("interface", "EEE"): _energy_efficient_ethernet,
    ("other software", "managers"): _managers,
    ("other software", "addresses"): _addresses,
    ("other software", "membership"): _membership,
    ("other software", "XDP"): _xdp,
    ("other software", "packet sockets"): _receivers,
}  # by subject and name, in the order of the report
