"""The checks of machine and interface: one function each, and their table. A check that fails does not stop
the others."""

from __future__ import annotations

import functools
import os
import re
import shlex
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

from ethercat_server.access.holder import Holder, owners
from ethercat_server.daemon.options import VIRTUAL_INTERFACE
from ethercat_server.doctor.finding import (
    CannotLookError,
    Finding,
    bad,
    cannot_look,
    note,
    ok,
    skipped,
    warning,
)
from ethercat_server.doctor.machine import Link, Machine, as_list, known, processor_list
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.nic import ALLOW_IP, Listener, network_trouble, packet_sockets

_SWITCH: Final = "/sys/kernel/debug/sched/preempt"
_MOUNT: Final = "sudo mount -t debugfs none /sys/kernel/debug"
_MODELS: Final = {"none": "NONE", "voluntary": "VOLUNTARY", "full": "", "lazy": "LAZY"}
"""Preemption models and the kernel option that makes each the default: PREEMPT_ and this."""
_GOOD_CLOCKS: Final = frozenset(
    {"tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page", "xen"}
)
_USUAL_RUNTIME: Final = 950_000
_USUAL_PERIOD: Final = 1_000_000
_FINE_S: Final = 1e-6


def preemption(machine: Machine) -> Iterator[Finding]:
    """Whether a high-priority program can preempt the kernel."""
    version = machine.text_or("/proc/version")
    config = machine.config
    if machine.text_or("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        yield ok("fully preemptible (PREEMPT_RT)", model="rt")
        return
    dynamic = "PREEMPT_DYNAMIC" in version or "PREEMPT_DYNAMIC" in config
    model, sure = _model(machine, version, dynamic)
    text = f"{model} (dynamic)" if dynamic else model
    values: dict[str, Any] = {"model": model, "dynamic": dynamic, "certain": sure}
    if not sure:
        text += f", unless changed since boot: {_SWITCH} cannot be read"
    if model in {"full", "lazy"}:
        yield note(
            f"{text}: no real-time kernel",
            "sufficient for most uses; drivers and interrupts may delay the server by some 100 µs under load",
            _real_time_kernel(machine), **values,
        )  # fmt: skip
        return
    why = "kernel code is rarely preempted: under load the server wakes milliseconds late"
    if dynamic:
        mount = () if machine.names("/sys/kernel/debug") or sure else (_MOUNT,)
        yield warning(
            text, f"{why}; to make it permanent, add preempt=full to the kernel command line",
            *mount, f"echo full | sudo tee {_SWITCH}", **values,
        )  # fmt: skip
    else:
        yield warning(text, why, _real_time_kernel(machine), **values)


def _model(machine: Machine, version: str, dynamic: bool) -> tuple[str, bool]:
    chosen = re.search(r"\((\w+)\)", machine.text_or(_SWITCH))
    if chosen:
        return chosen[1], True
    asked = machine.command_line.get("preempt", "")
    if dynamic and asked in _MODELS:
        return asked, True
    config = machine.config
    for model, option in _MODELS.items():
        if f"PREEMPT_{option}".rstrip("_") in config:
            return model, not dynamic
    if "PREEMPT" in version.split():
        return "full", True
    if dynamic:
        return "full", False
    if not version:
        cannot_look("neither /proc/version nor the kernel's configuration can be read")
    return "voluntary", False


def _real_time_kernel(machine: Machine) -> str:
    system = machine.text_or("/etc/os-release")
    if re.search(r"^ID=\"?ubuntu", system, re.MULTILINE):
        return "sudo pro attach && sudo pro enable realtime-kernel"
    return "sudo apt install linux-image-rt-amd64"


def tick(machine: Machine) -> Iterator[Finding]:
    """Whether sleeping programs wake on time, or at the kernel's next tick."""
    rate = machine.config.get("HZ")
    text = f"tick {rate} Hz" if rate else "tick rate unknown"
    values: dict[str, Any] = {
        "hz": int(rate) if rate and rate.isdecimal() else None,
        "resolution_s": machine.timer_resolution_s,
    }
    if machine.timer_resolution_s <= _FINE_S:
        yield ok(f"{text}, high-resolution timers", "wake-ups do not depend on the tick", **values)
        return
    yield bad(
        f"{text}, timers resolve {machine.timer_resolution_s * 1e3:.3g} ms",
        "every wake-up is late by up to that: remove highres=off and nohz=off from the kernel command line, "
        "or use a kernel with CONFIG_HIGH_RES_TIMERS",
        **values,
    )


def clock_source(machine: Machine) -> Iterator[Finding]:
    """The hardware that the kernel reads the time from."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = machine.text(f"{folder}/current_clocksource")
    if source in _GOOD_CLOCKS:
        yield ok(source, source=source)
        return
    others = machine.text_or(f"{folder}/available_clocksource").split()
    better = [name for name in others if name in _GOOD_CLOCKS]
    why = "reading the time takes microseconds, and the server does so several times per exchange"
    if better:
        yield warning(source, why, f"echo {better[0]} | sudo tee {folder}/current_clocksource", source=source)
    else:
        log = "'dmesg | grep -i tsc' says why the kernel rejects better ones"
        yield note(source, f"{why}; {log}", source=source)


def throttling(machine: Machine) -> Iterator[Finding]:
    """Share of CPU time that real-time programs may use."""
    runtime = machine.number("/proc/sys/kernel/sched_rt_runtime_us")
    period = machine.number("/proc/sys/kernel/sched_rt_period_us")
    values: dict[str, Any] = {"runtime_us": runtime, "period_us": period}
    mend = f"sudo sysctl kernel.sched_rt_runtime_us={_USUAL_RUNTIME * period // _USUAL_PERIOD}"
    if period <= 0:
        cannot_look("/proc/sys/kernel/sched_rt_period_us is not positive")
    if runtime < 0:
        yield note("off", "a real-time program in an endless loop blocks its processor", mend, **values)
    elif runtime < period // 2:
        yield bad(
            f"real-time programs may use {100 * runtime / period:.0f} % of the CPU time",
            "the server is suspended for the rest of it", mend, **values,
        )  # fmt: skip
    else:
        why = "more than the server needs"
        yield ok(f"real-time programs may use {100 * runtime / period:.0f} % of the CPU time", why, **values)


def group_scheduling(machine: Machine) -> Iterator[Finding]:
    """CONFIG_RT_GROUP_SCHED: real-time priorities only for groups with a real-time budget."""
    if not machine.config:
        cannot_look(f"neither /proc/config.gz nor /boot/config-{machine.release} can be read")
    asked = machine.command_line.get("rt_group_sched")
    off = asked == "0" or ("RT_GROUP_SCHED_DEFAULT_DISABLED" in machine.config and asked != "1")
    if "RT_GROUP_SCHED" not in machine.config or off:
        yield ok("no groups with real-time budgets", enabled=False)
        return
    yield note(
        "real-time budgets per group (CONFIG_RT_GROUP_SCHED)",
        "a service may get no real-time priority at all (the server logs 'not granted'): to switch it off, "
        "add rt_group_sched=0 to the kernel command line",
        enabled=True,
    )


_NEEDED: Final = {12: "CAP_NET_ADMIN", 13: "CAP_NET_RAW"}
_WANTED: Final = {14: "CAP_IPC_LOCK", 23: "CAP_SYS_NICE"}
_ENOUGH_MEMORY: Final = 256 << 20
"""Upper bound for the bytes that the server locks."""
_LIMITS_FILE: Final = "/etc/security/limits.d/90-ethercat-server.conf"


def capabilities(machine: Machine) -> Iterator[Finding]:
    """The capabilities that the server's raw socket and its scheduling need."""
    missing = [name for bit, name in (_NEEDED | _WANTED).items() if not machine.has_capability(bit)]
    held = [name for name in (_NEEDED | _WANTED).values() if name not in missing]
    values: dict[str, Any] = {"missing": missing, "held": held}
    if not missing:
        yield ok(f"all four: {', '.join(held)}", **values)
        return
    needed = [name for name in _NEEDED.values() if name in missing]
    without = "could not open the interface" if needed else "would have a less steady cycle"
    yield note(
        f"missing: {', '.join(missing)}",
        f"a server started by this user {without}, and the doctor can check less; the service has all four",
        f"sudo ethercat-doctor {shlex.quote(machine.asked or machine.ifname)}", **values,
    )  # fmt: skip


def limits(machine: Machine) -> Iterator[Finding]:
    """Real-time priority and locked memory, where they do not come with a capability."""
    text = machine.text("/proc/self/limits")
    priority, memory = _limit(text, "Max realtime priority"), _limit(text, "Max locked memory")
    lacking = []
    if not machine.has_capability(23) and priority is not None and priority < machine.rt_priority:
        lacking.append(f"rtprio {priority}")
    if not machine.has_capability(14) and memory is not None and memory < _ENOUGH_MEMORY:
        lacking.append(f"memlock {memory // 1024} KiB")
    values: dict[str, Any] = {"rtprio": priority, "memlock_bytes": memory}
    if not lacking:
        yield ok("real-time priority and locked memory are allowed", **values)
        return
    yield note(
        " and ".join(lacking),
        "a server of this user has ordinary scheduling, or memory that may be paged out: log in again "
        "afterwards, or use the service or sudo",
        f'printf \'%s - rtprio 99\\n%s - memlock unlimited\\n\' "$USER" "$USER" | sudo tee {_LIMITS_FILE}',
        **values,
    )


def _limit(text: str, name: str) -> int | None:
    """The soft limit in /proc/self/limits; None if there is none."""
    found = re.search(rf"^{name}\s+(\d+)", text, re.MULTILINE)
    return int(found[1]) if found else None


CPUS: Final = "/sys/devices/system/cpu"
_LATENCY_FILE: Final = "/dev/cpu_dma_latency"
_NO_CONSTRAINT_US: Final = 1_000_000
_DEEP_US: Final = 50
_LIGHT_US: Final = 10
_STEADY: Final = frozenset({"performance"})


def governor(machine: Machine) -> Iterator[Finding]:
    """The frequency governor of the processors."""
    found = Counter(
        machine.text_or(f"{CPUS}/cpu{number}/cpufreq/scaling_governor") for number in machine.processors
    )
    found.pop("", None)
    if not found:
        yield ok("no frequency scaling that this system controls", governors=[])
        return
    text = ", ".join(f"{name} on {count}" for name, count in found.most_common())
    if set(found) <= _STEADY:
        yield ok(text, governors=list(found))
        return
    yield warning(
        text,
        "an idle processor runs slowly at first, just when the server wakes; to make performance permanent: "
        "'tuned-adm profile latency-performance'",
        f"echo performance | sudo tee {CPUS}/cpu*/cpufreq/scaling_governor", governors=list(found),
    )  # fmt: skip


def idle_states(machine: Machine) -> Iterator[Finding]:
    """Exit latency of the deepest idle state."""
    states: dict[tuple[str, str], int] = {}
    for number in machine.processors:
        folder = f"{CPUS}/cpu{number}/cpuidle"
        for state in machine.names(folder):
            enabled = machine.text_or(f"{folder}/{state}/disable", "0") == "0"
            if enabled and machine.text_or(f"{folder}/{state}/latency"):
                name = machine.text_or(f"{folder}/{state}/name", state)
                states[state, name] = max(
                    machine.number(f"{folder}/{state}/latency"), states.get((state, name), 0)
                )
    if not states:
        yield ok("none that this system controls", "on a virtual machine the host controls them", states={})
        return
    limit = _latency_limit_us(machine)
    allowed = {key: latency for key, latency in states.items() if limit is None or latency <= limit}
    (_, name), deepest = max(allowed.items(), key=lambda item: item[1], default=(("", "none"), 0))
    text = f"{name}, {deepest} µs to wake"
    if limit is not None and limit < _NO_CONSTRAINT_US:
        text += f" (limited by a program to {limit} µs, through {_LATENCY_FILE})"
    values: dict[str, Any] = {"deepest": name, "latency_us": deepest, "limit_us": limit}
    if deepest <= _LIGHT_US:
        yield ok(text, **values)
        return
    deep = sorted({state for (state, _), latency in allowed.items() if latency > _LIGHT_US})
    commands = [f"echo 1 | sudo tee {CPUS}/cpu*/cpuidle/{state}/disable" for state in deep]
    why = "each wake-up may be late by that; to make it permanent: 'tuned-adm profile latency-performance'"
    make = warning if deepest > _DEEP_US else note
    yield make(text, why, *commands, **values)


def _latency_limit_us(machine: Machine) -> int | None:
    """The limit that programs set in /dev/cpu_dma_latency; None if none, or only root can see it."""
    try:
        with machine.path(_LATENCY_FILE).open("rb") as file:
            raw = file.read(4)
    except OSError:
        return None
    limit = struct.unpack("=i", raw)[0] if len(raw) == 4 else -1
    return limit if 0 <= limit < _NO_CONSTRAINT_US else None


def isolated(machine: Machine) -> Iterator[Finding]:
    """Whether a processor is isolated for the server."""
    online = machine.processors
    apart = processor_list(machine.text_or(f"{CPUS}/isolated"))
    tickless = machine.text_or(f"{CPUS}/nohz_full")
    tickless = "" if tickless == "(null)" else tickless
    values: dict[str, Any] = {"online": len(online), "isolated": apart, "nohz_full": tickless}
    last = online[-1] if online else 0
    option = f"isolcpus=managed_irq,domain,{last} nohz_full={last} rcu_nocbs={last}"
    if len(online) == 1:
        yield warning(
            "one processor for everything",
            "other programs and interrupts delay the server: use two or more",
            **values,
        )
    elif not apart:
        yield note(
            f"none of {len(online)} is isolated",
            f"under load the server shares its processor; to isolate one, add {option} to the kernel command "
            f"line and cpu = {last} to /etc/ethercat-server/default.toml",
            **values,
        )
    else:
        shared = _busy_siblings(machine, apart)
        text = f"{as_list(apart)} of {len(online)} isolated"
        if shared:
            yield note(
                f"{text}, but {as_list(shared)} shares a core with them",
                "load there slows the server down: isolate it too, or disable hyper-threading",
                "echo off | sudo tee /sys/devices/system/cpu/smt/control", **values,
            )  # fmt: skip
        else:
            yield ok(text, f"the server's --cpu {apart[-1]} uses it", **values)


def _busy_siblings(machine: Machine, apart: list[int]) -> list[int]:
    found: set[int] = set()
    for number in apart:
        found.update(processor_list(machine.text_or(f"{CPUS}/cpu{number}/topology/thread_siblings_list")))
    return sorted(found - set(apart))


def virtualization(machine: Machine) -> Iterator[Finding]:
    """Virtual machine or container."""
    container = _container(machine)
    if container:
        yield note(
            f"in a container ({container})",
            "privileges (real-time priority, raw sockets) and parts of /sys may be missing: run it with "
            "--cap-add NET_RAW,NET_ADMIN,SYS_NICE,IPC_LOCK and the interface, or on the host",
            container=container,
        )
    virtual = _virtual_machine(machine)
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
    environment = machine.text_or("/proc/1/environ").split("\0")
    named = [text.partition("=")[2] for text in environment if text.startswith("container=")]
    named += [machine.text_or("/run/systemd/container")]
    for mark, name in (("/.dockerenv", "docker"), ("/run/.containerenv", "podman")):
        if machine.path(mark).exists():
            named.append(name)
    return next(filter(None, named), "")


def _virtual_machine(machine: Machine) -> str:
    product = " ".join(
        filter(
            None, (machine.text_or(f"/sys/class/dmi/id/{name}") for name in ("sys_vendor", "product_name"))
        )
    )
    flags = re.search(r"^flags\s*:(.*)$", machine.text_or("/proc/cpuinfo"), re.MULTILINE)
    if machine.text_or("/sys/hypervisor/type"):
        return machine.text_or("/sys/hypervisor/type")
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
_DAMAGE: Final = ("rx_crc_errors", "rx_frame_errors", "rx_length_errors", "tx_carrier_errors", "collisions")
_ERRORS: Final = ("rx_errors", "tx_errors", *_DAMAGE)
_DROPS: Final = (
    "rx_dropped",
    "tx_dropped",
    "rx_fifo_errors",
    "rx_missed_errors",
    "rx_over_errors",
    "tx_fifo_errors",
)
_FEW_CARRIER_CHANGES: Final = 20


def link_state(machine: Machine) -> Iterator[Finding]:
    """Whether the interface is there, up, and has a carrier."""
    facts, name = machine.facts, machine.shown
    if facts.link is None:
        yield bad(
            f"no network interface {machine.ifname!r}",
            f"available: {', '.join(facts.names)}; USB adapters change names when plugged into another port",
            "ethercat-sensor adapters", present=False,
        )  # fmt: skip
        return
    found: Link = known(facts.link)
    values: dict[str, Any] = {"present": True, "up": found.up, "carrier": found.carrier, "kind": found.kind}
    if found.loopback:
        yield bad(
            "the loopback interface",
            "sensors need a network card: use another interface",
            "ethercat-sensor adapters",
            **values,
        )
    elif not found.up:
        yield bad("down", "it cannot send frames", f"sudo ip link set {name} up", **values)
    elif not found.carrier:
        why = "no link: check cable, PoE injector and its power supply; the sensor belongs on its LAN side"
        yield bad("up, no carrier", why, f"ip -br link show {name}", **values)
    else:
        yield ok("up, with carrier" + (f" ({found.kind})" if found.kind else ""), **values)


def speed(machine: Machine) -> Iterator[Finding]:
    """EtherCAT is 100 Mbit/s, full duplex."""
    there = machine.facts.there
    if not there.carrier:
        cannot_look("no carrier")
    mbits, duplex = known(machine.facts.settings)
    values: dict[str, Any] = {"mbits": mbits, "duplex": duplex}
    text = f"{mbits or 'unknown'} Mbit/s, {duplex or 'unknown'} duplex"
    name = machine.shown
    if there.kind or (mbits is None and duplex is None):
        yield ok(text, "not meaningful for a virtual interface", **values)
    elif duplex == "half":
        yield bad(text, "EtherCAT needs full duplex", f"sudo ethtool -s {name} autoneg on", **values)
    elif mbits is not None and mbits < _ETHERCAT_SPEED:
        yield bad(
            text, "EtherCAT is 100 Mbit/s: check the cable", f"sudo ethtool -s {name} autoneg on", **values
        )
    elif mbits is not None and mbits > _ETHERCAT_SPEED:
        yield warning(
            text,
            "sensors use 100 Mbit/s, so there is a switch or another device in between, which delays frames: "
            "connect the sensor, or its PoE injector, directly",
            **values,
        )
    else:
        yield ok(text, **values)


def driver(machine: Machine) -> Iterator[Finding]:
    """The network card, and how it is connected."""
    there, name = machine.facts.there, machine.ifname
    found, bus = known(machine.facts.driver)
    values: dict[str, Any] = {"driver": found, "bus": bus}
    text = f"{found} on {bus}" if bus and bus != "N/A" else found
    if any(machine.path(f"/sys/class/net/{name}/{mark}").exists() for mark in ("wireless", "phy80211")):
        yield bad(text, "a wireless interface: EtherCAT needs a cable", "ethercat-sensor adapters", **values)
    elif bus.startswith("usb"):
        why = "USB polls an adapter every 125 µs at best: prefer a PCIe card"
        yield warning(f"{text}, USB", why, **values)
    elif found in _GUEST_DRIVERS:
        why = "a virtual card: each frame goes through the host; pass a physical card through"
        yield warning(text, why, **values)
    else:
        yield ok(text + (f", {there.kind}" if there.kind and there.kind != found else ""), **values)


def coalescing(machine: Machine) -> Iterator[Finding]:
    """Whether the card delays its interrupts."""
    machine.facts.there  # noqa: B018 - there must be one
    found = machine.facts.coalescing
    if isinstance(found, str):
        yield _not_supported(found)
        return
    on = [f"{name[:2]} {found.get(name, 0)} µs" for name in _DELAYS if found.get(name)]
    on += [f"adaptive {name.split('_')[2]}" for name in _ADAPTIVE if found.get(name)]
    values: dict[str, Any] = {name: found.get(name) for name in (*_DELAYS, *_ADAPTIVE)}
    if not on:
        yield ok("off", **values)
        return
    adaptive = " adaptive-rx off adaptive-tx off" if any(found.get(name) for name in _ADAPTIVE) else ""
    yield warning(
        ", ".join(on), "the card delays the interrupt for a received frame by up to that",
        f"sudo ethtool -C {machine.shown}{adaptive} rx-usecs 0 tx-usecs 0", **values,
    )  # fmt: skip


def offloads(machine: Machine) -> Iterator[Finding]:
    """Segmentation and receive offloads, which are for TCP."""
    there = machine.facts.there
    found: Mapping[str, bool] = known(machine.facts.offloads)
    on = [short for name, short in _UNWANTED.items() if found.get(name)]
    if not on or there.kind:
        yield ok(f"{', '.join(on)} on, without effect on a virtual interface" if on else "off", on=on)
        return
    yield note(
        f"{', '.join(on)} on", "meant for TCP; some drivers delay other frames because of them",
        f"sudo ethtool -K {machine.shown} {' '.join(f'{short} off' for short in on)}", on=on,
    )  # fmt: skip


def energy_efficient_ethernet(machine: Machine) -> Iterator[Finding]:
    """Energy-efficient Ethernet."""
    machine.facts.there  # noqa: B018 - there must be one
    found = machine.facts.eee
    if isinstance(found, str):
        yield _not_supported(found)
        return
    enabled, active = found
    values: dict[str, Any] = {"enabled": enabled, "active": active}
    mend = f"sudo ethtool --set-eee {machine.shown} eee off"
    if active:
        yield warning("in use", "the link sleeps between frames, and waking takes tens of µs", mend, **values)
    elif enabled:
        yield note("enabled, not in use", "another device on the cable could negotiate it", mend, **values)
    else:
        yield ok("off", **values)


def _not_supported(why: str) -> Finding:
    if "not support" not in why:
        cannot_look(why)
    return ok("none: the driver does not support it")


def card_counters(machine: Machine) -> Iterator[Finding]:
    """Error counters of the card since it came up."""
    there = machine.facts.there
    found, name = there.counters, machine.shown
    if not found:
        cannot_look("the kernel provides no counters")
    errors = {key: found[key] for key in _ERRORS if found.get(key)}
    drops = {key: found[key] for key in _DROPS if found.get(key)}
    values: dict[str, Any] = {**errors, **drops, "carrier_changes": there.carrier_changes}
    if errors:
        why = "frames were corrupted: check cable, connectors, shield and sources of interference"
        yield warning(_counted(errors), why, f"ip -s -s link show {name}", **values)
    elif drops:
        why = "includes frames of unknown protocols; see 'card meanwhile' for new ones"
        yield note(_counted(drops), why, f"ip -s -s link show {name}", **values)
    elif (there.carrier_changes or 0) > _FEW_CARRIER_CHANGES:
        yield note(
            f"{there.carrier_changes} carrier changes",
            "a loose connector, or a sensor that is often power-cycled",
            f"ip -s -s link show {name}", **values,
        )  # fmt: skip
    else:
        yield ok(f"no errors in {found.get('rx_packets', 0)} frames received", **values)


def rising(before: Mapping[str, int], after: Mapping[str, int]) -> Iterator[Finding]:
    """Errors that the card counted during the measurement."""
    if not before or not after:
        cannot_look("the kernel provides no counters")
    new = {key: after.get(key, 0) - before.get(key, 0) for key in (*_ERRORS, *_DROPS)}
    new = {key: count for key, count in new.items() if count > 0}
    if any(key in _ERRORS for key in new):
        why = "frames are being corrupted: check cable, connectors, shield and sources of interference"
        yield bad(_counted(new), why, **new)
    elif new:
        yield note(_counted(new), "frames of unknown protocols, or a receive buffer overflow", **new)
    else:
        yield ok("no new errors", "", **new)


def _counted(found: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in found.items())


def device_names(machine: Machine) -> set[str]:
    """Names that the interface's interrupts may have: its own, and those of its devices."""
    names = {machine.ifname}
    if machine.facts.there.parent:
        names.add(machine.facts.there.parent)
    folder = machine.path(f"/sys/class/net/{machine.ifname}/device")
    if folder.exists():
        names.add(os.path.basename(os.path.realpath(folder)))  # noqa: PTH119 - a link's target's name
    return names


_PRIORITY_FIELD: Final = 39
"""Of /proc/PID/stat, counted from 0: the real-time priority."""
_BALANCER: Final = "irqbalance"


def affinity(machine: Machine) -> Iterator[Finding]:
    """The processors that handle the card's interrupts."""
    numbers = _numbers(machine)
    if not numbers:
        if machine.facts.there.kind:
            yield ok("none: a virtual interface", irqs=[])
            return
        cannot_look(f"/proc/interrupts lists none for {machine.ifname}")
    where = {number: _processors(machine, number) for number in numbers}
    everywhere = sorted({cpu for cpus in where.values() for cpu in cpus})
    text = f"{_plural(numbers)} on processor {as_list(everywhere) or 'unknown'}"
    values: dict[str, Any] = {"irqs": numbers, "processors": everywhere}
    apart = processor_list(machine.text_or(f"{CPUS}/isolated"))
    if apart and not set(everywhere) & set(apart):
        last = apart[-1]
        yield note(
            f"{text}, the isolated ones are {as_list(apart)}",
            "frames are received on another processor than the server's",
            *(f"echo {last} | sudo tee /proc/irq/{number}/smp_affinity_list" for number in numbers), **values,
        )  # fmt: skip
    elif apart and _BALANCER in machine.commands_running().values():
        yield note(
            f"{text}; irqbalance runs",
            "it may move interrupts: exclude the isolated processors with IRQBALANCE_BANNED_CPULIST in "
            "/etc/default/irqbalance",
            "sudo systemctl restart irqbalance", **values,
        )  # fmt: skip
    else:
        yield ok(text, **values)


def threads(machine: Machine) -> Iterator[Finding]:
    """Priority of interrupt threads relative to the server."""
    numbers = _numbers(machine)
    if not numbers:
        yield ok("not applicable: no interrupts", threads={})
        return
    found = {}
    for pid, name in machine.commands_running().items():
        match = re.match(r"irq/(\d+)-", name)
        if match and int(match[1]) in numbers:
            found[pid] = _priority(machine, pid)
    if not found:
        yield ok("not threaded", threads={})
        return
    lowest = min(found.values())
    text = f"threads of SCHED_FIFO {lowest}" if lowest else "threads of ordinary scheduling"
    values: dict[str, Any] = {"threads": found}
    if lowest >= machine.rt_priority:
        yield ok(f"{text}, above the server's {machine.rt_priority}", **values)
        return
    yield note(
        f"{text}, the server has {machine.rt_priority}",
        "the server waits for the card, so the card's interrupt should have the higher priority",
        *(f"sudo chrt -f -p {min(99, machine.rt_priority + 5)} {pid}" for pid in found), **values,
    )  # fmt: skip


def _numbers(machine: Machine) -> list[int]:
    names = device_names(machine)
    found = set()
    for line in machine.text("/proc/interrupts").splitlines():
        head, _, rest = line.partition(":")
        if head.strip().isdecimal() and any(
            _is_about(word, names) for word in rest.replace(",", " ").split()
        ):
            found.add(int(head))
    return sorted(found)


def _is_about(word: str, names: set[str]) -> bool:
    """Whether a word of a line in /proc/interrupts is one of the names, with a queue's behind it or not."""
    return any(
        word == name
        or (word.startswith(name) and not word[len(name)].isalnum())
        or word.endswith(f"@pci:{name}")
        for name in names
    )


def _processors(machine: Machine, number: int) -> list[int]:
    folder = f"/proc/irq/{number}"
    text = machine.text_or(f"{folder}/effective_affinity_list") or machine.text_or(
        f"{folder}/smp_affinity_list"
    )
    return processor_list(text)


def _priority(machine: Machine, pid: int) -> int:
    # The name, in brackets, may hold spaces.
    fields = machine.text_or(f"/proc/{pid}/stat").rpartition(")")[2].split()
    at = _PRIORITY_FIELD - 2
    return int(fields[at]) if len(fields) > at and fields[at].isdecimal() else 0


def _plural(numbers: list[int]) -> str:
    return f"IRQ{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"


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


_ABOUT_THE_INTERFACE: Final = frozenset({"interface", "other software"})


class Check(NamedTuple):
    """One check of the machine or the interface."""

    subject: str
    name: str
    look: Callable[[Machine], Iterator[Finding]]


CHECKS: Final = (
    Check("kernel", "preemption", preemption),
    Check("kernel", "tick", tick),
    Check("kernel", "clock source", clock_source),
    Check("kernel", "real-time throttling", throttling),
    Check("kernel", "real-time groups", group_scheduling),
    Check("rights", "capabilities", capabilities),
    Check("rights", "limits", limits),
    Check("processors", "governor", governor),
    Check("processors", "idle states", idle_states),
    Check("processors", "isolation", isolated),
    Check("processors", "virtualization", virtualization),
    Check("interface", "link", link_state),
    Check("interface", "speed", speed),
    Check("interface", "driver", driver),
    Check("interface", "coalescing", coalescing),
    Check("interface", "offloads", offloads),
    Check("interface", "EEE", energy_efficient_ethernet),
    Check("interface", "counters", card_counters),
    Check("interface", "interrupts", affinity),
    Check("interface", "interrupt threads", threads),
    Check("other software", "managers", managers),
    Check("other software", "addresses", addresses),
    Check("other software", "membership", membership),
    Check("other software", "listeners", listeners),
)


def examine(subject: str, name: str, look: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """The findings of one check, with its name; an error in the check is a finding too."""
    try:
        for finding in look():
            yield replace(finding, subject=subject, check=name)
    except CannotLookError as error:
        yield replace(skipped(str(error)), subject=subject, check=name)
    except ServerError as error:
        yield replace(bad(str(error), ""), subject=subject, check=name)
    except OSError as error:
        yield replace(skipped(error.strerror or str(error)), subject=subject, check=name)
    except Exception as error:  # noqa: BLE001 - a check that fails must not stop the others
        text = f"{type(error).__name__}: {error}; an error in ethercat-doctor, please report it"
        yield replace(skipped(text), subject=subject, check=name)


def examine_machine(machine: Machine) -> Iterator[Finding]:
    """All checks that need no bus."""
    link = machine.facts.link
    there = isinstance(link, Link) and not link.loopback
    for check in CHECKS:
        if there or check.subject not in _ABOUT_THE_INTERFACE or check.look is link_state:
            for finding in examine(check.subject, check.name, functools.partial(check.look, machine)):
                # A virtual bus is gone when the doctor ends: nothing to fix.
                gone = check.subject in _ABOUT_THE_INTERFACE and machine.asked == VIRTUAL_INTERFACE
                yield replace(finding, commands=()) if gone else finding
        if check.look is link_state and not there:
            yield replace(skipped("no interface for a sensor"), subject=check.subject, check="the rest")
