"""The processors: frequency scaling, idle states, isolation, virtualization."""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator
from typing import Any, Final

from ethercat_server.doctor.finding import Finding, note, ok, warning
from ethercat_server.doctor.machine.machine import Machine, as_list, processor_list

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
