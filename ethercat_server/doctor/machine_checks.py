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

from ethercat_server.access.adapters import Holder, owners
from ethercat_server.daemon.options import VIRTUAL_INTERFACE
from ethercat_server.doctor.machine import NOT_SUPPORTED, Machine, as_list, processor_list
from ethercat_server.doctor.report import CannotLookError, Finding, bad, examine, note, ok, skipped, warning
from ethercat_server.ethercat.nic import ALLOW_IP, Routes, network_trouble, packet_sockets

Look = Callable[[Machine], Finding | Iterable[Finding]]


class Check(NamedTuple):
    """One check of the machine or the interface."""

    subject: str
    name: str
    look: Look


CHECKS: Final[list[Check]] = []


def check(subject: str, name: str) -> Callable[[Look], Look]:
    """Add a function to the CHECKS."""

    def add(look: Look) -> Look:
        CHECKS.append(Check(subject, name, look))
        return look

    return add


def examine_machine(machine: Machine) -> Iterator[Finding]:
    """All checks that need no bus."""
    there = False
    for subject, name, look in CHECKS:
        about_the_interface = subject in {"interface", "other software"}
        if there or not about_the_interface or look is link_state:
            for finding in examine(subject, name, look, machine):
                # A virtual bus is gone when the doctor ends: nothing to fix.
                gone = about_the_interface and machine.asked == VIRTUAL_INTERFACE
                yield replace(finding, commands=()) if gone else finding
        if look is link_state:
            try:
                there = not machine.link.loopback
            except CannotLookError:
                there = False
            if not there:
                yield replace(skipped("no interface for a sensor"), subject=subject, check="the rest")


_SWITCH: Final = "/sys/kernel/debug/sched/preempt"
_MOUNT: Final = "sudo mount -t debugfs none /sys/kernel/debug"
# Preemption models and the kernel option that makes each the default.
_MODELS: Final = {
    "none": "PREEMPT_NONE", "voluntary": "PREEMPT_VOLUNTARY", "full": "PREEMPT", "lazy": "PREEMPT_LAZY",
}  # fmt: skip
_GOOD_CLOCKS: Final = frozenset(
    {"tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page", "xen"}
)
_USUAL_RUNTIME_PERCENT: Final = 95
_FINE_S: Final = 1e-6


@check("kernel", "preemption")
def preemption(machine: Machine) -> Finding:
    """Whether a high-priority program can preempt the kernel."""
    version = machine.text("/proc/version", "")
    if machine.text("/sys/kernel/realtime", "") == "1" or "PREEMPT_RT" in version:
        return ok("fully preemptible (PREEMPT_RT)", model="rt")
    dynamic = "PREEMPT_DYNAMIC" in version or "PREEMPT_DYNAMIC" in machine.config
    model, sure = _model(machine, version, dynamic)
    text = f"{model} (dynamic)" if dynamic else model
    values: dict[str, Any] = {"model": model, "dynamic": dynamic, "certain": sure}
    if not sure:
        text += f", unless changed since boot: {_SWITCH} cannot be read"
    ubuntu = re.search(r"^ID=\"?ubuntu", machine.text("/etc/os-release", ""), re.MULTILINE)
    real_time_kernel = "sudo apt install linux-image-rt-amd64"
    if ubuntu:
        real_time_kernel = "sudo pro attach && sudo pro enable realtime-kernel"
    if model in {"full", "lazy"}:
        why = (
            "sufficient for most uses; drivers and interrupts may delay the server by some 100 µs under load"
        )
        return note(f"{text}: no real-time kernel", why, real_time_kernel, **values)
    why = "kernel code is rarely preempted: under load the server wakes milliseconds late"
    if not dynamic:
        return warning(text, why, real_time_kernel, **values)
    mount = () if machine.names("/sys/kernel/debug") or sure else (_MOUNT,)
    why += "; to make it permanent, add preempt=full to the kernel command line"
    return warning(text, why, *mount, f"echo full | sudo tee {_SWITCH}", **values)


def _model(machine: Machine, version: str, dynamic: bool) -> tuple[str, bool]:
    """The preemption model, and whether that is certain."""
    chosen = re.search(r"\((\w+)\)", machine.text(_SWITCH, ""))
    if chosen:
        return chosen[1], True
    asked = machine.command_line.get("preempt", "")
    if dynamic and asked in _MODELS:
        return asked, True
    for model, option in _MODELS.items():
        if option in machine.config:
            return model, not dynamic
    if "PREEMPT" in version.split():
        return "full", True
    if dynamic:
        return "full", False
    if not version:
        raise CannotLookError("neither /proc/version nor the kernel's configuration can be read")
    return "voluntary", False


@check("kernel", "tick")
def tick(machine: Machine) -> Finding:
    """Whether sleeping programs wake on time, or at the kernel's next tick."""
    rate, resolution_s = machine.config.get("HZ"), machine.timer_resolution_s
    text = f"tick {rate} Hz" if rate else "tick rate unknown"
    hz = int(rate) if rate and rate.isdecimal() else None
    if resolution_s <= _FINE_S:
        why = "wake-ups do not depend on the tick"
        return ok(f"{text}, high-resolution timers", why, hz=hz, resolution_s=resolution_s)
    return bad(
        f"{text}, timers resolve {resolution_s * 1e3:.3g} ms",
        "every wake-up is late by up to that: remove highres=off and nohz=off from the kernel command line, "
        "or use a kernel with CONFIG_HIGH_RES_TIMERS",
        hz=hz, resolution_s=resolution_s,
    )  # fmt: skip


@check("kernel", "clock source")
def clock_source(machine: Machine) -> Finding:
    """The hardware that the kernel reads the time from."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = machine.text(f"{folder}/current_clocksource")
    if source in _GOOD_CLOCKS:
        return ok(source, source=source)
    others = machine.text(f"{folder}/available_clocksource", "").split()
    why = "reading the time takes microseconds, and the server does so several times per exchange"
    for better in (name for name in others if name in _GOOD_CLOCKS):
        return warning(source, why, f"echo {better} | sudo tee {folder}/current_clocksource", source=source)
    log = "'dmesg | grep -i tsc' says why the kernel rejects better ones"
    return note(source, f"{why}; {log}", source=source)


@check("kernel", "real-time throttling")
def throttling(machine: Machine) -> Finding:
    """Share of CPU time that real-time programs may use."""
    runtime = machine.number("/proc/sys/kernel/sched_rt_runtime_us")
    period = machine.number("/proc/sys/kernel/sched_rt_period_us")
    values: dict[str, Any] = {"runtime_us": runtime, "period_us": period}
    if period <= 0:
        raise CannotLookError("/proc/sys/kernel/sched_rt_period_us is not positive")
    mend = f"sudo sysctl kernel.sched_rt_runtime_us={_USUAL_RUNTIME_PERCENT * period // 100}"
    if runtime < 0:
        return note("off", "a real-time program in an endless loop blocks its processor", mend, **values)
    text = f"real-time programs may use {100 * runtime / period:.0f} % of the CPU time"
    if runtime < period // 2:
        return bad(text, "the server is suspended for the rest of it", mend, **values)
    return ok(text, "more than the server needs", **values)


@check("kernel", "real-time groups")
def group_scheduling(machine: Machine) -> Finding:
    """CONFIG_RT_GROUP_SCHED: real-time priorities only for groups with a real-time budget."""
    if not machine.config:
        raise CannotLookError(f"neither /proc/config.gz nor /boot/config-{machine.release} can be read")
    asked = machine.command_line.get("rt_group_sched")
    off = asked == "0" or ("RT_GROUP_SCHED_DEFAULT_DISABLED" in machine.config and asked != "1")
    if "RT_GROUP_SCHED" not in machine.config or off:
        return ok("no groups with real-time budgets", enabled=False)
    return note(
        "real-time budgets per group (CONFIG_RT_GROUP_SCHED)",
        "a service may get no real-time priority at all (the server logs 'not granted'): to switch it off, "
        "add rt_group_sched=0 to the kernel command line",
        enabled=True,
    )


NEEDED: Final = {12: "CAP_NET_ADMIN", 13: "CAP_NET_RAW"}
_IPC_LOCK, _SYS_NICE = 14, 23
_CAPABILITIES: Final = NEEDED | {_IPC_LOCK: "CAP_IPC_LOCK", _SYS_NICE: "CAP_SYS_NICE"}
_ENOUGH_MEMORY: Final = 256 << 20  # upper bound for the bytes that the server locks
_LIMITS_FILE: Final = "/etc/security/limits.d/90-ethercat-server.conf"


@check("rights", "capabilities")
def capabilities(machine: Machine) -> Finding:
    """The capabilities that the server's raw socket and its scheduling need."""
    missing = [name for bit, name in _CAPABILITIES.items() if not machine.has_capability(bit)]
    held = [name for name in _CAPABILITIES.values() if name not in missing]
    if not missing:
        return ok(f"all four: {', '.join(held)}", missing=missing, held=held)
    opens = missing_to_open(machine)
    without = "could not open the interface" if opens else "would have a less steady cycle"
    return note(
        f"missing: {', '.join(missing)}",
        f"a server started by this user {without}, and the doctor can check less; the service has all four",
        f"sudo ethercat-doctor {shlex.quote(machine.asked or machine.ifname)}",
        missing=missing, held=held,
    )  # fmt: skip


def missing_to_open(machine: Machine) -> list[str]:
    """The capabilities that this process lacks to open a bus."""
    return [name for bit, name in reversed(NEEDED.items()) if not machine.has_capability(bit)]


@check("rights", "limits")
def limits(machine: Machine) -> Finding:
    """Real-time priority and locked memory, where they do not come with a capability."""
    text = machine.text("/proc/self/limits")
    priority, memory = _limit(text, "Max realtime priority"), _limit(text, "Max locked memory")
    lacking = []
    if not machine.has_capability(_SYS_NICE) and priority is not None and priority < machine.rt_priority:
        lacking.append(f"rtprio {priority}")
    if not machine.has_capability(_IPC_LOCK) and memory is not None and memory < _ENOUGH_MEMORY:
        lacking.append(f"memlock {memory // 1024} KiB")
    if not lacking:
        found = "real-time priority and locked memory are allowed"
        return ok(found, rtprio=priority, memlock_bytes=memory)
    return note(
        " and ".join(lacking),
        "a server of this user has ordinary scheduling, or memory that may be paged out: log in again "
        "afterwards, or use the service or sudo",
        f'printf \'%s - rtprio 99\\n%s - memlock unlimited\\n\' "$USER" "$USER" | sudo tee {_LIMITS_FILE}',
        rtprio=priority, memlock_bytes=memory,
    )  # fmt: skip


def _limit(text: str, name: str) -> int | None:
    """The soft limit in /proc/self/limits; None if there is none."""
    found = re.search(rf"^{name}\s+(\d+)", text, re.MULTILINE)
    return int(found[1]) if found else None


_CPUS: Final = "/sys/devices/system/cpu"
_LATENCY_FILE: Final = "/dev/cpu_dma_latency"
_NO_CONSTRAINT_US: Final = 1_000_000
_DEEP_US: Final = 50
_LIGHT_US: Final = 10


@check("processors", "governor")
def governor(machine: Machine) -> Finding:
    """The frequency governor of the processors."""
    files = (f"{_CPUS}/cpu{number}/cpufreq/scaling_governor" for number in machine.processors)
    found = Counter(name for file in files if (name := machine.text(file, "")))
    if not found:
        return ok("no frequency scaling that this system controls", governors=[])
    text = ", ".join(f"{name} on {count}" for name, count in found.most_common())
    if set(found) == {"performance"}:
        return ok(text, governors=list(found))
    return warning(
        text,
        "an idle processor runs slowly at first, just when the server wakes; to make performance permanent: "
        "'tuned-adm profile latency-performance'",
        f"echo performance | sudo tee {_CPUS}/cpu*/cpufreq/scaling_governor", governors=list(found),
    )  # fmt: skip


@check("processors", "idle states")
def idle_states(machine: Machine) -> Finding:
    """Exit latency of the deepest idle state."""
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
    values: dict[str, Any] = {"deepest": name, "latency_us": deepest, "limit_us": limit}
    if deepest <= _LIGHT_US:
        return ok(text, **values)
    deep = sorted({state for (state, _), latency in allowed.items() if latency > _LIGHT_US})
    commands = [f"echo 1 | sudo tee {_CPUS}/cpu*/cpuidle/{state}/disable" for state in deep]
    why = "each wake-up may be late by that; to make it permanent: 'tuned-adm profile latency-performance'"
    return (warning if deepest > _DEEP_US else note)(text, why, *commands, **values)


def _latency_limit_us(machine: Machine) -> int | None:
    """The limit that programs set in /dev/cpu_dma_latency; None if none, or only root can see it."""
    try:
        with machine.path(_LATENCY_FILE).open("rb") as file:
            (limit,) = struct.unpack("=i", file.read(4))
    except (OSError, struct.error):
        return None
    return int(limit) if 0 <= limit < _NO_CONSTRAINT_US else None


@check("processors", "isolation")
def isolation(machine: Machine) -> Finding:
    """Whether a processor is isolated for the server."""
    online, apart = machine.processors, machine.isolated
    tickless = machine.text(f"{_CPUS}/nohz_full", "").replace("(null)", "")
    values: dict[str, Any] = {"online": len(online), "isolated": apart, "nohz_full": tickless}
    if len(online) == 1:
        why = "other programs and interrupts delay the server: use two or more"
        return warning("one processor for everything", why, **values)
    if not apart:
        last = online[-1] if online else 0
        return note(
            f"none of {len(online)} is isolated",
            "under load the server shares its processor; to isolate one, add "
            f"isolcpus=managed_irq,domain,{last} nohz_full={last} rcu_nocbs={last} to the kernel command "
            f"line and cpu = {last} to /etc/ethercat-server/default.toml",
            **values,
        )
    text = f"{as_list(apart)} of {len(online)} isolated"
    files = (f"{_CPUS}/cpu{number}/topology/thread_siblings_list" for number in apart)
    busy = {sibling for file in files for sibling in processor_list(machine.text(file, ""))} - set(apart)
    if not busy:
        return ok(text, f"the server's --cpu {apart[-1]} uses it", **values)
    return note(
        f"{text}, but {as_list(busy)} shares a core with them",
        "load there slows the server down: isolate it too, or disable hyper-threading",
        f"echo off | sudo tee {_CPUS}/smt/control", **values,
    )  # fmt: skip


@check("processors", "virtualization")
def virtualization(machine: Machine) -> Iterator[Finding]:
    """Virtual machine or container."""
    container, virtual = _container(machine), _virtual_machine(machine)
    if container:
        yield note(
            f"in a container ({container})",
            "privileges (real-time priority, raw sockets) and parts of /sys may be missing: run it with "
            "--cap-add NET_RAW,NET_ADMIN,SYS_NICE,IPC_LOCK and the interface, or on the host",
            container=container,
        )
    if virtual:
        yield warning(
            f"a virtual machine ({virtual})",
            "the host may suspend it for milliseconds at any time: use a physical machine, or pin its "
            "processors and pass the network card through",
            virtual_machine=virtual,
        )
    if not container and not virtual:
        yield ok("neither a virtual machine nor a container", container="", virtual_machine="")


def _container(machine: Machine) -> str:
    environment = machine.text("/proc/1/environ", "").split("\0")
    named = [text.partition("=")[2] for text in environment if text.startswith("container=")]
    named.append(machine.text("/run/systemd/container", ""))
    marks = {"/.dockerenv": "docker", "/run/.containerenv": "podman"}
    named += [name for mark, name in marks.items() if machine.path(mark).exists()]
    return next(filter(None, named), "")


def _virtual_machine(machine: Machine) -> str:
    if hypervisor := machine.text("/sys/hypervisor/type", ""):
        return hypervisor
    names = (machine.text(f"/sys/class/dmi/id/{name}", "") for name in ("sys_vendor", "product_name"))
    product = " ".join(filter(None, names))
    flags = re.search(r"^flags\s*:(.*)$", machine.text("/proc/cpuinfo", ""), re.MULTILINE)
    if flags and "hypervisor" in flags[1].split():
        return product or "hypervisor unknown"
    return product if re.search(r"QEMU|KVM|VMware|VirtualBox|Virtual Machine", product) else ""


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


@check("interface", "link")
def link_state(machine: Machine) -> Finding:
    """Whether the interface is there, up, and has a carrier."""
    if machine.fact("link") is None:
        return bad(
            f"no network interface {machine.ifname!r}",
            f"available: {', '.join(machine.fact('names'))}; USB adapters change names when plugged into "
            "another port",
            "ethercat-sensor adapters", present=False,
        )  # fmt: skip
    link, name = machine.link, machine.shown
    values: dict[str, Any] = {"present": True, "up": link.up, "carrier": link.carrier, "kind": link.kind}
    if link.loopback:
        why = "sensors need a network card: use another interface"
        return bad("the loopback interface", why, "ethercat-sensor adapters", **values)
    if not link.up:
        return bad("down", "it cannot send frames", f"sudo ip link set {name} up", **values)
    if not link.carrier:
        why = "no link: check cable, PoE injector and its power supply; the sensor belongs on its LAN side"
        return bad("up, no carrier", why, f"ip -br link show {name}", **values)
    return ok("up, with carrier" + (f" ({link.kind})" if link.kind else ""), **values)


@check("interface", "speed")
def speed(machine: Machine) -> Finding:
    """EtherCAT is 100 Mbit/s, full duplex."""
    if not machine.link.carrier:
        raise CannotLookError("no carrier")
    mbits, duplex = machine.fact("settings")
    values: dict[str, Any] = {"mbits": mbits, "duplex": duplex}
    text = f"{mbits or 'unknown'} Mbit/s, {duplex or 'unknown'} duplex"
    mend = f"sudo ethtool -s {machine.shown} autoneg on"
    if machine.link.kind or (mbits is None and duplex is None):
        return ok(text, "not meaningful for a virtual interface", **values)
    if duplex == "half":
        return bad(text, "EtherCAT needs full duplex", mend, **values)
    if mbits is not None and mbits < _ETHERCAT_SPEED:
        return bad(text, "EtherCAT is 100 Mbit/s: check the cable", mend, **values)
    if mbits is not None and mbits > _ETHERCAT_SPEED:
        return warning(
            text,
            "sensors use 100 Mbit/s, so there is a switch or another device in between, which delays frames: "
            "connect the sensor, or its PoE injector, directly",
            **values,
        )
    return ok(text, **values)


@check("interface", "driver")
def driver(machine: Machine) -> Finding:
    """The network card, and how it is connected."""
    kind, name = machine.link.kind, machine.ifname
    found, bus = machine.fact("driver")
    values: dict[str, Any] = {"driver": found, "bus": bus}
    text = f"{found} on {bus}" if bus and bus != "N/A" else found
    if any(machine.path(f"/sys/class/net/{name}/{mark}").exists() for mark in ("wireless", "phy80211")):
        return bad(text, "a wireless interface: EtherCAT needs a cable", "ethercat-sensor adapters", **values)
    if bus.startswith("usb"):
        why = "USB polls an adapter every 125 µs at best: prefer a PCIe card"
        return warning(f"{text}, USB", why, **values)
    if found in _GUEST_DRIVERS:
        why = "a virtual card: each frame goes through the host; pass a physical card through"
        return warning(text, why, **values)
    return ok(text + (f", {kind}" if kind and kind != found else ""), **values)


@check("interface", "coalescing")
def coalescing(machine: Machine) -> Finding:
    """Whether the card delays its interrupts."""
    if (found := _if_supported(machine, "coalescing")) is None:
        return ok(f"none: {NOT_SUPPORTED}")
    adaptive = [name.split("_")[2] for name in _ADAPTIVE if found.get(name)]
    on = [f"{name[:2]} {found[name]} µs" for name in _DELAYS if found.get(name)]
    on += [f"adaptive {way}" for way in adaptive]
    values: dict[str, Any] = {name: found.get(name) for name in (*_DELAYS, *_ADAPTIVE)}
    if not on:
        return ok("off", **values)
    why = "the card delays the interrupt for a received frame by up to that"
    off = "adaptive-rx off adaptive-tx off " if adaptive else ""
    return warning(
        ", ".join(on), why, f"sudo ethtool -C {machine.shown} {off}rx-usecs 0 tx-usecs 0", **values
    )


@check("interface", "offloads")
def offloads(machine: Machine) -> Finding:
    """Segmentation and receive offloads, which are for TCP."""
    virtual, found = machine.link.kind, machine.fact("offloads")
    on = [short for name, short in _UNWANTED.items() if found.get(name)]
    if not on or virtual:
        return ok(f"{', '.join(on)} on, without effect on a virtual interface" if on else "off", on=on)
    return note(
        f"{', '.join(on)} on", "meant for TCP; some drivers delay other frames because of them",
        f"sudo ethtool -K {machine.shown} {' '.join(f'{short} off' for short in on)}", on=on,
    )  # fmt: skip


@check("interface", "EEE")
def energy_efficient_ethernet(machine: Machine) -> Finding:
    """Energy-efficient Ethernet."""
    if (found := _if_supported(machine, "EEE")) is None:
        return ok(f"none: {NOT_SUPPORTED}")
    enabled, active = found
    values: dict[str, Any] = {"enabled": enabled, "active": active}
    mend = f"sudo ethtool --set-eee {machine.shown} eee off"
    if active:
        return warning(
            "in use", "the link sleeps between frames, and waking takes tens of µs", mend, **values
        )
    if enabled:
        return note("enabled, not in use", "another device on the cable could negotiate it", mend, **values)
    return ok("off", **values)


def _if_supported(machine: Machine, fact: str) -> Any:
    """A fact of the interface; None if the driver does not support it."""
    machine.link  # noqa: B018 - there must be one
    try:
        return machine.fact(fact)
    except CannotLookError as error:
        if "not support" not in str(error):
            raise
        return None


@check("interface", "counters")
def card_counters(machine: Machine) -> Finding:
    """Error counters of the card since it came up."""
    found, changes = machine.link.counters, machine.link.carrier_changes
    if not found:
        raise CannotLookError("the kernel provides no counters")
    errors = {key: found[key] for key in _ERRORS if found.get(key)}
    drops = {key: found[key] for key in _DROPS if found.get(key)}
    values: dict[str, Any] = {**errors, **drops, "carrier_changes": changes}
    command = f"ip -s -s link show {machine.shown}"
    if errors:
        why = "frames were corrupted: check cable, connectors, shield and sources of interference"
        return warning(_counted(errors), why, command, **values)
    if drops:
        why = "includes frames of unknown protocols; see 'card meanwhile' for new ones"
        return note(_counted(drops), why, command, **values)
    if (changes or 0) > _FEW_CARRIER_CHANGES:
        why = "a loose connector, or a sensor that is often power-cycled"
        return note(f"{changes} carrier changes", why, command, **values)
    return ok(f"no errors in {found.get('rx_packets', 0)} frames received", **values)


def rising(before: Mapping[str, int], after: Mapping[str, int]) -> Finding:
    """Errors that the card counted during the measurement."""
    if not before or not after:
        raise CannotLookError("the kernel provides no counters")
    new = {key: after.get(key, 0) - before.get(key, 0) for key in (*_ERRORS, *_DROPS)}
    new = {key: count for key, count in new.items() if count > 0}
    if any(key in _ERRORS for key in new):
        why = "frames are being corrupted: check cable, connectors, shield and sources of interference"
        return bad(_counted(new), why, **new)
    if new:
        return note(_counted(new), "frames of unknown protocols, or a receive buffer overflow", **new)
    return ok("no new errors")


def _counted(found: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in found.items())


_PRIORITY_FIELD: Final = 39  # of /proc/PID/stat, counted from 0: the real-time priority
_BALANCER: Final = "irqbalance"


@check("interface", "interrupts")
def affinity(machine: Machine) -> Finding:
    """The processors that handle the card's interrupts."""
    numbers = _interrupts(machine)
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
    text += as_list(everywhere) or "unknown"
    values: dict[str, Any] = {"irqs": numbers, "processors": sorted(everywhere)}
    apart = machine.isolated
    if apart and everywhere.isdisjoint(apart):
        return note(
            f"{text}, the isolated ones are {as_list(apart)}",
            "frames are received on another processor than the server's",
            *(f"echo {apart[-1]} | sudo tee /proc/irq/{number}/smp_affinity_list" for number in numbers),
            **values,
        )
    if apart and _BALANCER in machine.commands_running().values():
        return note(
            f"{text}; irqbalance runs",
            "it may move interrupts: exclude the isolated processors with IRQBALANCE_BANNED_CPULIST in "
            "/etc/default/irqbalance",
            "sudo systemctl restart irqbalance", **values,
        )  # fmt: skip
    return ok(text, **values)


@check("interface", "interrupt threads")
def threads(machine: Machine) -> Finding:
    """Priority of interrupt threads relative to the server."""
    numbers = _interrupts(machine)
    if not numbers:
        return ok("not applicable: no interrupts", threads={})
    found = {}
    for pid, name in machine.commands_running().items():
        match = re.match(r"irq/(\d+)-", name)
        if match and int(match[1]) in numbers:
            found[pid] = _priority(machine, pid)
    if not found:
        return ok("not threaded", threads={})
    lowest = min(found.values())
    text = f"threads of SCHED_FIFO {lowest}" if lowest else "threads of ordinary scheduling"
    if lowest >= machine.rt_priority:
        return ok(f"{text}, above the server's {machine.rt_priority}", threads=found)
    return note(
        f"{text}, the server has {machine.rt_priority}",
        "the server waits for the card, so the card's interrupt should have the higher priority",
        *(f"sudo chrt -f -p {min(99, machine.rt_priority + 5)} {pid}" for pid in found), threads=found,
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


def _priority(machine: Machine, pid: int) -> int:
    # The name, in brackets, may hold spaces.
    fields = machine.text(f"/proc/{pid}/stat", "").rpartition(")")[2].split()
    at = _PRIORITY_FIELD - 2
    return int(fields[at]) if len(fields) > at and fields[at].isdecimal() else 0


_ETHERCAT: Final = 0x88A4
_EVERYTHING: Final = 3
_DHCP_CLIENTS: Final = frozenset({"dhclient", "dhcpcd", "udhcpc", "connmand", "wicked"})
_LEFT_ALONE: Final = frozenset({"unmanaged", "initialized", "pending", "linger"})  # by systemd-networkd


@check("other software", "managers")
def managers(machine: Machine) -> Finding:
    """Network managers that configure the interface."""
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
    if not found:
        return ok("no network manager configures it", managers=[])
    return warning(
        ", ".join(found),
        "it sends frames of its own and may take the interface down; scripts/install-service configures "
        "NetworkManager and systemd-networkd permanently",
        *found.values(), managers=list(found),
    )  # fmt: skip


@check("other software", "addresses")
def addresses(machine: Machine) -> Finding:
    """IP on the interface."""
    machine.link  # noqa: B018 - there must be one
    found: Routes = machine.fact("routes")
    name, flush = machine.shown, f"sudo ip address flush dev {machine.shown}"
    values: dict[str, Any] = {
        "addresses": [*found.addresses, *found.link_local], "routes": list(found.others),
        "default_route": found.default,
    }  # fmt: skip
    why = "IP traffic delays the sensor's frames"
    text = ", ".join([*found.addresses, *(f"route to {route}" for route in found.others)])
    if found.default:
        text = f"the machine's default route ({text or 'no address'})"
    if not machine.allow_ip and network_trouble(name, found):
        why = f"the server refuses it (without {ALLOW_IP}): use another interface"
        if found.default:
            return bad(text, why, "ethercat-sensor adapters", **values)
        return bad(text, f"{why}, or remove its addresses", flush, **values)
    if text:
        return warning(text, why, *(() if found.default else (flush,)), **values)
    if found.link_local:
        return note(
            f"only {', '.join(found.link_local)}",
            "the kernel's own IPv6 address: now and then it asks for routers and neighbours there",
            f"echo 1 | sudo tee /proc/sys/net/ipv6/conf/{name}/disable_ipv6", **values,
        )  # fmt: skip
    return ok("no address, no route", **values)


@check("other software", "membership")
def membership(machine: Machine) -> Finding:
    """Bridges, bonds, VLANs."""
    link, name = machine.link, machine.shown
    values: dict[str, Any] = {"master": link.master, "upper": list(link.upper)}
    if link.master:
        why = "a bridge or bond intercepts the sensor's frames and sends others"
        return bad(f"part of {link.master}", why, f"sudo ip link set {name} nomaster", **values)
    if link.upper:
        commands = (f"sudo ip link delete {upper}" for upper in link.upper)
        why = "they (VLANs, for instance) send through it"
        return warning(f"below {', '.join(link.upper)}", why, *commands, **values)
    return ok("no bridge, bond or VLAN", **values)


@check("other software", "listeners")
def listeners(machine: Machine) -> Finding:
    """Other programs with a packet socket; the EtherCAT master has a check of its own."""
    index = machine.link.ifindex
    try:
        rows = packet_sockets(machine.path("/proc/self/net/packet"))
    except (OSError, ValueError, IndexError) as error:
        why = getattr(error, "strerror", None) or error
        raise CannotLookError(f"/proc/self/net/packet: {why}") from None
    # A socket for all interfaces counts only if it takes every frame.
    heard = [
        row for row in rows
        if row.protocol != _ETHERCAT
        and (row.ifindex == index or (row.ifindex == 0 and row.protocol == _EVERYTHING))
    ]  # fmt: skip
    if not heard:
        return ok("no other program receives frames", listeners=[])
    found: list[Holder] = list(owners({row.inode for row in heard}, machine.path("/proc")))
    names = [f"{who.name} ({who.pid})" for who in found]
    text = ", ".join(names) or f"{len(heard)} packet sockets of processes that only root can see"
    commands = [f"sudo kill {who.pid}" for who in found]
    if any(row.protocol == _EVERYTHING for row in heard):
        why = "it receives a copy of every frame, which delays the server"
        return warning(text, why, *commands, listeners=names)
    why = "it expects frames of other protocols on this interface"
    return note(text, why, *commands, listeners=names)
