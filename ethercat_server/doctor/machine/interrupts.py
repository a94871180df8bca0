"""Interrupts of the network card: their processors, and the priority of interrupt threads."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

from ethercat_server.doctor.finding import Finding, cannot_look, note, ok
from ethercat_server.doctor.machine.cpu import CPUS
from ethercat_server.doctor.machine.machine import Machine, as_list, processor_list
from ethercat_server.doctor.machine.nic import device_names

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
