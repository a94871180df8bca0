"""The table of checks of machine and interface. A check that fails does not stop the others."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final, NamedTuple

from ethercat_server.daemon.options import VIRTUAL_INTERFACE
from ethercat_server.doctor.finding import CannotLookError, Finding, bad, skipped
from ethercat_server.doctor.machine import cpu, interrupts, kernel, nic, other_software, rights
from ethercat_server.doctor.machine.facts import Link
from ethercat_server.doctor.machine.machine import Machine
from ethercat_server.errors import ServerError

_ABOUT_THE_INTERFACE: Final = frozenset({"interface", "other software"})


class Check(NamedTuple):
    """One check of the machine or the interface."""

    subject: str
    name: str
    look: Callable[[Machine], Iterator[Finding]]


CHECKS: Final = (
    Check("kernel", "preemption", kernel.preemption),
    Check("kernel", "tick", kernel.tick),
    Check("kernel", "clock source", kernel.clock_source),
    Check("kernel", "real-time throttling", kernel.throttling),
    Check("kernel", "real-time groups", kernel.group_scheduling),
    Check("rights", "capabilities", rights.capabilities),
    Check("rights", "limits", rights.limits),
    Check("processors", "governor", cpu.governor),
    Check("processors", "idle states", cpu.idle_states),
    Check("processors", "isolation", cpu.isolated),
    Check("processors", "virtualization", cpu.virtualization),
    Check("interface", "link", nic.link),
    Check("interface", "speed", nic.speed),
    Check("interface", "driver", nic.driver),
    Check("interface", "coalescing", nic.coalescing),
    Check("interface", "offloads", nic.offloads),
    Check("interface", "EEE", nic.energy_efficient_ethernet),
    Check("interface", "counters", nic.counters),
    Check("interface", "interrupts", interrupts.affinity),
    Check("interface", "interrupt threads", interrupts.threads),
    Check("other software", "managers", other_software.managers),
    Check("other software", "addresses", other_software.addresses),
    Check("other software", "membership", other_software.membership),
    Check("other software", "listeners", other_software.listeners),
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
        if there or check.subject not in _ABOUT_THE_INTERFACE or check.look is nic.link:
            for finding in examine(check.subject, check.name, functools.partial(check.look, machine)):
                # A virtual bus is gone when the doctor ends: nothing to fix.
                gone = check.subject in _ABOUT_THE_INTERFACE and machine.asked == VIRTUAL_INTERFACE
                yield replace(finding, commands=()) if gone else finding
        if check.look is nic.link and not there:
            yield replace(skipped("no interface for a sensor"), subject=check.subject, check="the rest")
