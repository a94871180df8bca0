"""The checks of machine and interface, in the order of the report: what each reads, its limits, its advice.

A check that fails does not stop the others.
"""

from __future__ import annotations

import os
import re
import shlex
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

from ethercat_server.access.adapters import Adapter
from ethercat_server.daemon.options import VIRTUAL_INTERFACE
from ethercat_server.doctor.machine import Machine, as_list, processor_list
from ethercat_server.doctor.report import (
    CannotLookError,
    Finding,
    bad,
    examine,
    graded,
    note,
    ok,
    skipped,
    warning,
)
from ethercat_server.ethercat.nic import ALLOW_IP, Routes, network_trouble

Look = Callable[[Machine], Finding | Iterable[Finding]]


class Check(NamedTuple):
    """One check of the machine or the interface."""

    subject: str
    name: str
    look: Look


def examine_machine(machine: Machine) -> Iterator[Finding]:
    """All checks that need no bus."""
    there = True
    for subject, name, look in CHECKS:
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
_MODELS: Final = ("none", "voluntary", "full", "lazy")  # of preemption
_GOOD_CLOCKS: Final = frozenset(
    {"tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page", "xen"}
)


def _preemption(machine: Machine) -> Finding:
    version = machine.text("/proc/version")
    if machine.text("/sys/kernel/realtime", "") == "1" or "PREEMPT_RT" in version:
        return ok("fully preemptible (PREEMPT_RT)", model="rt")
    dynamic = "PREEMPT_DYNAMIC" in version
    switched = re.search(r"\((\w+)\)", machine.text(_SWITCH, ""))
    asked = re.findall(rf"\bpreempt=({'|'.join(_MODELS)})\b", machine.text("/proc/cmdline", "") * dynamic)
    usual = "full" if "PREEMPT" in version.split() else "voluntary"  # what distributions build
    model = switched[1] if switched else next(iter((*asked, usual)))
    sure = bool(switched or asked or not dynamic)
    real_time_kernel = "sudo apt install linux-image-rt-amd64"
    if re.search(r"^ID=\"?ubuntu", machine.text("/etc/os-release", ""), re.MULTILINE):
        real_time_kernel = "sudo pro attach && sudo pro enable realtime-kernel"
    hidden = not sure and not machine.names("/sys/kernel/debug")
    mount = ("sudo mount -t debugfs none /sys/kernel/debug",) if hidden else ()
    unsure = f", unless changed since boot: {_SWITCH} cannot be read"
    late = "kernel code is rarely preempted: under load the server wakes milliseconds late"
    return graded(
        f"{model}{' (dynamic)' * dynamic}" + unsure * (not sure),
        (model in {"full", "lazy"}, note,
         "no real-time kernel: drivers and interrupts may delay the server by some 100 µs under load",
         real_time_kernel),
        (not dynamic, warning, late, real_time_kernel),
        (True, warning, f"{late}; to make it permanent, add preempt=full to the kernel command line",
         *mount, f"echo full | sudo tee {_SWITCH}"),
        model=model, dynamic=dynamic, certain=sure,
    )  # fmt: skip


def _clock_source(machine: Machine) -> Finding:
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = machine.text(f"{folder}/current_clocksource")
    others = machine.text(f"{folder}/available_clocksource", "").split()
    better = next((name for name in others if name in _GOOD_CLOCKS), None)
    slow = "reading the time takes microseconds, and the server does so several times per exchange"
    log = "'dmesg | grep -i tsc' says why the kernel rejects better ones"
    return graded(
        source,
        (source in _GOOD_CLOCKS, ok, ""),
        (better, warning, slow, f"echo {better} | sudo tee {folder}/current_clocksource"),
        (True, note, f"{slow}; {log}"),
        source=source,
    )


_NEEDED: Final = {12: "CAP_NET_ADMIN", 13: "CAP_NET_RAW"}
_CAPABILITIES: Final = _NEEDED | {14: "CAP_IPC_LOCK", 23: "CAP_SYS_NICE"}


def _capabilities(machine: Machine) -> Finding:
    missing = [name for bit, name in _CAPABILITIES.items() if not machine.has_capability(bit)]
    held = [name for name in _CAPABILITIES.values() if name not in missing]
    without = (
        "could not open the interface"
        if {*missing} & {*_NEEDED.values()}
        else "would have a less steady cycle"
    )
    return graded(
        f"missing: {', '.join(missing)}" if missing else f"all four: {', '.join(held)}",
        (missing, note,
         f"a server started by this user {without}, and the doctor can check less; the service has all "
         "four", f"sudo ethercat-doctor {shlex.quote(machine.asked or machine.ifname)}"),
        missing=missing, held=held,
    )  # fmt: skip


def check_rights(machine: Machine) -> None:
    """CannotLookError unless this process may open a bus."""
    missing = [name for bit, name in reversed(_NEEDED.items()) if not machine.has_capability(bit)]
    if missing:
        raise CannotLookError(f"{' and '.join(missing)} missing; run with sudo")


_CPUS: Final = "/sys/devices/system/cpu"
_LATENCY_FILE: Final = "/dev/cpu_dma_latency"
_NO_CONSTRAINT_US: Final = 1_000_000
_DEEP_US: Final = 50
_LIGHT_US: Final = 10
_PERMANENT: Final = "to make it permanent: 'tuned-adm profile latency-performance'"


def _governor(machine: Machine) -> Finding:
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


def _idle_states(machine: Machine) -> Finding:
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
    deep = sorted({state for (state, _), latency in allowed.items() if latency > _LIGHT_US})
    commands = [f"echo 1 | sudo tee {_CPUS}/cpu*/cpuidle/{state}/disable" for state in deep]
    why = f"each wake-up may be late by that; {_PERMANENT}"
    return graded(
        text,
        (deepest > _DEEP_US, warning, why, *commands),
        (deepest > _LIGHT_US, note, why, *commands),
        deepest=name, latency_us=deepest, limit_us=limit,
    )  # fmt: skip


def _latency_limit_us(machine: Machine) -> int | None:
    """The limit that programs set in /dev/cpu_dma_latency; None if none, or only root can see it."""
    try:
        with machine.path(_LATENCY_FILE).open("rb") as file:
            (limit,) = struct.unpack("=i", file.read(4))
    except (OSError, struct.error):
        return None
    return int(limit) if 0 <= limit < _NO_CONSTRAINT_US else None


def _isolation(machine: Machine) -> Finding:
    online, apart = machine.processors, machine.isolated
    tickless = machine.text(f"{_CPUS}/nohz_full", "").replace("(null)", "")
    files = (f"{_CPUS}/cpu{number}/topology/thread_siblings_list" for number in apart)
    busy = {sibling for file in files for sibling in processor_list(machine.text(file, ""))} - set(apart)
    last = online[-1] if online else 0
    text = f"{as_list(apart)} of {len(online)} isolated" if apart else f"none of {len(online)} is isolated"
    return graded(
        f"{text}, but {as_list(busy)} shares a core with them" if busy else text,
        (len(online) == 1, warning, "other programs and interrupts delay the server: use two or more"),
        (not apart, note,
         "under load the server shares its processor; to isolate one, add "
         f"isolcpus=managed_irq,domain,{last} nohz_full={last} rcu_nocbs={last} to the kernel command "
         f"line and cpu = {last} to /etc/ethercat-server/default.toml"),
        (busy, note, "load there slows the server down: isolate it too, or disable hyper-threading",
         f"echo off | sudo tee {_CPUS}/smt/control"),
        why=f"the server's --cpu {max(apart, default=0)} uses it",
        online=len(online), isolated=apart, nohz_full=tickless,
    )  # fmt: skip


_ETHERCAT_SPEED: Final = 100
_GUEST_DRIVERS: Final = frozenset({"virtio_net", "vmxnet3", "hv_netvsc", "xen-netfront", "vif", "ena", "gve"})
_UNWANTED: Final = {
    "generic-receive-offload": "gro",
    "large-receive-offload": "lro",
    "tcp-segmentation-offload": "tso",
    "generic-segmentation-offload": "gso",
}
_DELAYS: Final = ("rx_coalesce_usecs", "tx_coalesce_usecs")
_ADAPTIVE: Final = ("use_adaptive_rx_coalesce", "use_adaptive_tx_coalesce")
_ERRORS: Final = (
    "rx_errors", "tx_errors", "rx_crc_errors", "rx_frame_errors", "rx_length_errors", "tx_carrier_errors",
    "collisions",
)  # fmt: skip
_DROPS: Final = (
    "rx_dropped", "tx_dropped", "rx_fifo_errors", "rx_missed_errors", "rx_over_errors", "tx_fifo_errors",
)  # fmt: skip
_FEW_CARRIER_CHANGES: Final = 20
_LIST: Final = "ethercat-sensor adapters"
_CORRUPTED: Final = "corrupted: check cable, connectors, shield and sources of interference"


def _link_state(machine: Machine) -> Finding:
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


def _speed(machine: Machine) -> Finding:
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


def _driver(machine: Machine) -> Finding:
    kind, folder = machine.link.kind, f"/sys/class/net/{machine.ifname}"
    found, bus = machine.fact("driver")
    wireless = any(machine.path(f"{folder}/{mark}").exists() for mark in ("wireless", "phy80211"))
    text = f"{found} on {bus}" if bus and bus != "N/A" else found
    return graded(
        text + (f", {kind}" if kind and kind != found else ""),
        (wireless, bad, "a wireless interface: EtherCAT needs a cable", _LIST),
        (bus.startswith("usb"), warning, "USB polls an adapter every 125 µs at best: prefer a PCIe card"),
        (found in _GUEST_DRIVERS, warning,
         "a virtual card: each frame goes through the host; pass a physical card through"),
        driver=found, bus=bus,
    )  # fmt: skip


def _coalescing(machine: Machine) -> Finding:
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


def _offloads(machine: Machine) -> Finding:
    virtual, found = machine.link.kind, machine.fact("offloads")
    on = [short for name, short in _UNWANTED.items() if found.get(name)]
    text = f"{', '.join(on)} on{', without effect on a virtual interface' if virtual else ''}"
    command = f"sudo ethtool -K {machine.shown} {' '.join(f'{short} off' for short in on)}"
    why = "meant for TCP; some drivers delay other frames because of them"
    return graded(text if on else "off", (on and not virtual, note, why, command), on=on)


def _energy_efficient_ethernet(machine: Machine) -> Finding:
    enabled, active = machine.fact("EEE")
    mend = f"sudo ethtool --set-eee {machine.shown} eee off"
    return graded(
        "in use" if active else "enabled, not in use" if enabled else "off",
        (active, warning, "the link sleeps between frames, and waking takes tens of µs", mend),
        (enabled, note, "another device on the cable could negotiate it", mend),
        enabled=enabled, active=active,
    )  # fmt: skip


def _card_counters(machine: Machine) -> Finding:
    found, changes = machine.link.counters, machine.link.carrier_changes
    if not found:
        raise CannotLookError("the kernel provides no counters")
    errors = {key: found[key] for key in _ERRORS if found.get(key)}
    drops = {key: found[key] for key in _DROPS if found.get(key)}
    loose = (changes or 0) > _FEW_CARRIER_CHANGES
    command = f"ip -s -s link show {machine.shown}"
    return graded(
        _counted(errors or drops or {"carrier changes": changes or 0} if errors or drops or loose else {})
        or f"no errors in {found.get('rx_packets', 0)} frames received",
        (errors, warning, f"frames were {_CORRUPTED}", command),
        (drops, note, "includes frames of unknown protocols; see 'card meanwhile' for new ones", command),
        (loose, note, "a loose connector, or a sensor that is often power-cycled", command),
        **dict[str, Any](errors | drops, carrier_changes=changes),
    )  # fmt: skip


def rising(before: Mapping[str, int], after: Mapping[str, int]) -> Finding:
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


def _affinity(machine: Machine) -> Finding:
    numbers, apart = _interrupts(machine), machine.isolated
    if not numbers and machine.link.kind:
        return ok("none: a virtual interface", irqs=[])
    if not numbers:
        raise CannotLookError(f"/proc/interrupts lists none for {machine.ifname}")
    everywhere: set[int] = set()
    for number in numbers:
        folder = f"/proc/irq/{number}"
        text = machine.text(f"{folder}/effective_affinity_list", "")
        everywhere.update(processor_list(text or machine.text(f"{folder}/smp_affinity_list", "")))
    text = f"IRQ{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))} on processor "
    files = (f"/proc/irq/{number}/smp_affinity_list" for number in numbers)
    return graded(
        text + (as_list(everywhere) or "unknown"),
        (apart and everywhere.isdisjoint(apart), note,
         f"frames are received on another processor than the server's: {as_list(apart)} is isolated",
         *(f"echo {max(apart, default=0)} | sudo tee {file}" for file in files)),
        (apart and "irqbalance" in machine.commands_running().values(), note,
         "irqbalance runs and may move interrupts: exclude the isolated processors with "
         "IRQBALANCE_BANNED_CPULIST in /etc/default/irqbalance", "sudo systemctl restart irqbalance"),
        irqs=numbers, processors=sorted(everywhere),
    )  # fmt: skip


def _interrupts(machine: Machine) -> list[int]:
    """The numbers of the interface's interrupts, which have its name, or that of a device of its own."""
    names = {machine.ifname, machine.link.parent} - {""}
    folder = machine.path(f"/sys/class/net/{machine.ifname}/device")
    if folder.exists():
        names.add(os.path.basename(os.path.realpath(folder)))  # noqa: PTH119 - a link's target's name
    any_name = "|".join(map(re.escape, names))
    # A queue's interrupt has more behind the name, such as ens5-rx-0.
    about = re.compile(rf"(?:{any_name})(?![^\W_])|.*@pci:(?:{any_name})$")
    rows = (line.partition(":") for line in machine.text("/proc/interrupts").splitlines())
    return sorted(
        int(head) for head, _, rest in rows
        if head.strip().isdecimal() and any(map(about.match, rest.replace(",", " ").split()))
    )  # fmt: skip


_DHCP_CLIENTS: Final = frozenset({"dhclient", "dhcpcd", "udhcpc", "connmand", "wicked"})
_LEFT_ALONE: Final = frozenset({"unmanaged", "initialized", "pending", "linger"})  # by systemd-networkd


def _managers(machine: Machine) -> Finding:
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
    for pid, command in machine.commands_running().items():
        arguments = machine.text(f"/proc/{pid}/cmdline", "").split("\0")
        if command in _DHCP_CLIENTS and machine.ifname in arguments:
            found[f"{command} ({pid})"] = f"sudo kill {pid}"
    why = "it sends frames of its own and may take the interface down; scripts/install-service configures "
    return graded(
        ", ".join(found) or "no network manager configures it",
        (found, warning, f"{why}NetworkManager and systemd-networkd permanently", *found.values()),
        managers=list(found),
    )


def _addresses(machine: Machine) -> Finding:
    found: Routes = machine.fact("routes")
    name, delays = machine.shown, "IP traffic delays the sensor's frames"
    text = ", ".join([*found.addresses, *(f"route to {route}" for route in found.others)])
    mend = () if found.default else (f"sudo ip address flush dev {name}",)
    shown = text or (f"only {', '.join(found.link_local)}" if found.link_local else "no address, no route")
    refused = not machine.allow_ip and network_trouble(name, found)
    another = f"the server refuses it (without {ALLOW_IP}): use another interface"
    return graded(
        f"the machine's default route ({text or 'no address'})" if found.default else shown,
        (refused and found.default, bad, another, _LIST),
        (refused, bad, f"{another}, or remove its addresses", *mend),
        (text or found.default, warning, delays, *mend),
        (found.link_local, note,
         "the kernel's own IPv6 address: now and then it asks for routers and neighbors there",
         f"echo 1 | sudo tee /proc/sys/net/ipv6/conf/{name}/disable_ipv6"),
        addresses=[*found.addresses, *found.link_local], routes=list(found.others),
        default_route=found.default,
    )  # fmt: skip


def _membership(machine: Machine) -> Finding:
    link, name = machine.link, machine.shown
    above, below = f"part of {link.master}", f"below {', '.join(link.upper)}"
    return graded(
        above if link.master else below if link.upper else "no bridge, bond or VLAN",
        (link.master, bad, "a bridge or bond intercepts the sensor's frames and sends others",
         f"sudo ip link set {name} nomaster"),
        (link.upper, warning, "they (VLANs, for instance) send through it",
         *(f"sudo ip link delete {upper}" for upper in link.upper)),
        master=link.master, upper=list(link.upper),
    )  # fmt: skip


_BY_SUBJECT: Final[Mapping[str, Mapping[str, Look]]] = {
    "kernel": {"preemption": _preemption, "clock source": _clock_source},
    "rights": {"capabilities": _capabilities},
    "processors": {"governor": _governor, "idle states": _idle_states, "isolation": _isolation},
    "interface": {"link": _link_state, "speed": _speed, "driver": _driver, "coalescing": _coalescing,
                  "offloads": _offloads, "EEE": _energy_efficient_ethernet, "counters": _card_counters,
                  "interrupts": _affinity},
    "other software": {"managers": _managers, "addresses": _addresses, "membership": _membership},
}  # fmt: skip
CHECKS: Final = tuple(
    Check(subject, name, look) for subject, checks in _BY_SUBJECT.items() for name, look in checks.items()
)
