"""The examination: one table of checks of the machine and the interface, then the bus or its server."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final, NamedTuple

from ethercat_server.doctor import bus as on_bus
from ethercat_server.doctor import company, cpu, interrupts, kernel, nic, rights, slaves, verdict
from ethercat_server.doctor.facts import Link, promiscuity_kept, read_counters
from ethercat_server.doctor.finding import CannotLookError, Finding, bad, cannot_look, skipped
from ethercat_server.doctor.machine import Machine
from ethercat_server.doctor.measurement import Measured, measure
from ethercat_server.doctor.through_server import ServerView
from ethercat_server.errors import ServerError
from ethercat_server.options import VIRTUAL_INTERFACE
from ethercat_server.tool.holder import Holder, find_holder

_ABOUT_THE_INTERFACE: Final = frozenset({"interface", "who else"})
_PROCESS_DATA_SIZE: Final = 62
"""Bytes of a sensor's outputs and its usual inputs."""
_LONGEST_PROBE: Final = 256
"""Registers up to here are information that anyone may read."""
_EXCHANGE_TIMEOUT_S: Final = 0.01
_NET_ADMIN, _NET_RAW = 12, 13


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
    Check("processors", "virtualisation", cpu.virtualisation),
    Check("interface", "link", nic.link),
    Check("interface", "speed", nic.speed),
    Check("interface", "driver", nic.driver),
    Check("interface", "coalescing", nic.coalescing),
    Check("interface", "offloads", nic.offloads),
    Check("interface", "EEE", nic.energy_efficient_ethernet),
    Check("interface", "counters", nic.counters),
    Check("interface", "interrupts", interrupts.affinity),
    Check("interface", "interrupt threads", interrupts.threads),
    Check("who else", "managers", company.managers),
    Check("who else", "addresses", company.addresses),
    Check("who else", "membership", company.membership),
    Check("who else", "listeners", company.listeners),
)


def examine(subject: str, name: str, look: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """The findings of one check, with its name; whatever keeps it from looking is a finding too."""
    try:
        for finding in look():
            yield replace(finding, subject=subject, check=name)
    except CannotLookError as error:
        yield replace(skipped(str(error)), subject=subject, check=name)
    except ServerError as error:
        yield replace(bad(str(error), ""), subject=subject, check=name)
    except OSError as error:
        yield replace(skipped(error.strerror or str(error)), subject=subject, check=name)
    except Exception as error:  # noqa: BLE001 - one check that fails must not take the others along
        text = f"{type(error).__name__}: {error}; a fault of the doctor's, please report it"
        yield replace(skipped(text), subject=subject, check=name)


def examine_machine(machine: Machine) -> Iterator[Finding]:
    """Everything that needs no bus."""
    there = isinstance(machine.facts.link, Link)
    for check in CHECKS:
        if there or check.subject not in _ABOUT_THE_INTERFACE or check.look is nic.link:
            for finding in examine(check.subject, check.name, functools.partial(check.look, machine)):
                # Nobody mends what is gone when the doctor ends.
                gone = check.subject in _ABOUT_THE_INTERFACE and machine.asked == VIRTUAL_INTERFACE
                yield replace(finding, commands=()) if gone else finding
        if check.look is nic.link and not there:
            yield replace(
                skipped("without it there is nothing to see"), subject=check.subject, check="the rest"
            )


def examine_bus(machine: Machine, seconds: float, cpu_number: int | None) -> Iterator[Finding]:
    """The bus itself, or what its server says; and the measurement."""
    holder = find_holder(machine.ifname)
    if holder is not None and holder.address is not None:
        yield from _through_server(machine, holder, seconds, cpu_number)
        return
    try:
        _check_may_look(machine, holder)
    except CannotLookError as error:
        yield replace(_no_bus(holder, str(error)), subject="bus", check="slaves")
        yield from _measured(measure(seconds, None, machine.rt_priority, cpu_number) if seconds else None, 0)
        return
    yield from _on_bus(machine, seconds, cpu_number)


def _no_bus(holder: Holder | None, why: str) -> Finding:
    if holder is None or holder.pid is None:
        return skipped(why)
    return bad(why, "two masters would wreck one another: stop it", f"sudo kill {holder.pid}")


def _check_may_look(machine: Machine, holder: Holder | None) -> None:
    """CannotLookError if the bus must be left alone, with the reason."""
    if holder is not None and holder.pid is not None:
        cannot_look(f"{holder} has it as an EtherCAT master and serves no port")
    if holder is not None:
        cannot_look("an EtherCAT master has it, and only root can see which: run with sudo")
    there = machine.facts.there
    check_rights(machine)
    if there.loopback:
        cannot_look("it is the loopback interface")
    routes = machine.facts.routes
    if isinstance(routes, str):
        cannot_look(f"whether it is the machine's network is not known ({routes}), so no frame is sent there")
    if routes.default or routes.addresses or there.master:
        cannot_look("it carries IP or is part of a bridge or bond: no frame is sent into that network")
    if not there.up or not there.carrier:
        cannot_look("it is down" if not there.up else "it has no carrier")


def check_rights(machine: Machine) -> None:
    """CannotLookError unless this process may open a bus."""
    needed = ((_NET_RAW, "CAP_NET_RAW"), (_NET_ADMIN, "CAP_NET_ADMIN"))
    missing = [name for bit, name in needed if not machine.has_capability(bit)]
    if missing:
        cannot_look(f"{' and '.join(missing)} missing; run with sudo")


def _through_server(
    machine: Machine, holder: Holder, seconds: float, cpu_number: int | None
) -> Iterator[Finding]:
    assert holder.address is not None
    address = holder.address
    view: list[ServerView] = []

    def reach() -> Iterator[Finding]:
        view.append(ServerView(address, str(holder), seconds))
        yield from view[0].holds()

    yield from examine("server", "server", reach)
    if view:
        yield from view[0].examine(examine)
    elif seconds:
        yield from _measured(measure(seconds, None, machine.rt_priority, cpu_number), 0)


def _on_bus(machine: Machine, seconds: float, cpu_number: int | None) -> Iterator[Finding]:
    from ethercat_server.tool.direct import open_bus  # noqa: PLC0415 - loads pysoem, which only this needs

    with contextlib.ExitStack() as cleanup:
        cleanup.enter_context(promiscuity_kept(machine.ifname))
        try:
            bus = open_bus(machine.ifname, cleanup)
        except ServerError as error:
            yield replace(bad(str(error), ""), subject="bus", check="slaves")
            return
        count = slaves.count(bus)
        yield from examine("bus", "slaves", lambda: on_bus.answers(machine.shown, count))
        before: dict[int, slaves.ErrorCounters] = {}
        for place in range(count):
            found: list[slaves.Slave] = []

            def identify(place: int = place, found: list[slaves.Slave] = found) -> Iterator[Finding]:
                found.append(slaves.look(bus, place))
                yield from on_bus.identity(found[0])

            yield from examine("bus", f"slave {place}", identify)
            if found:
                before[place] = found[0].counters
                slave = found[0]
                yield from examine("bus", f"slave {place} state", functools.partial(on_bus.state, slave))
                yield from examine(
                    "bus", f"slave {place} errors", functools.partial(on_bus.errors, slave, count)
                )
        if not seconds:
            yield from _measured(None, 0)
            return
        size = min(_LONGEST_PROBE, _PROCESS_DATA_SIZE * max(1, count))
        counters = read_counters(machine.ifname)
        exchange = (lambda: bus.count_slaves(size, _EXCHANGE_TIMEOUT_S) == count) if count else None
        measured = measure(seconds, exchange, machine.rt_priority, cpu_number)
        yield from _measured(measured, size)
        yield from examine(
            "measurement", "card meanwhile", lambda: nic.rising(counters, read_counters(machine.ifname))
        )
        if before:
            yield from examine(
                "measurement",
                "bus meanwhile",
                lambda: on_bus.new_errors(
                    before, {place: slaves.read_counters(bus, place) for place in before}, count
                ),
            )


def _measured(measured: Measured | None, size: int) -> Iterator[Finding]:
    if measured is None:
        yield replace(skipped("--seconds 0 asks for no measurement"), subject="measurement", check="all")
        return
    yield from examine("measurement", "scheduling", lambda: verdict.scheduling(measured))
    yield from examine("measurement", "wake-ups", lambda: verdict.wake_ups(measured))
    yield from examine("measurement", "exchanges", lambda: verdict.exchanges(measured, size))
    yield from examine("measurement", "messages", lambda: verdict.messages(measured))
    yield from examine("measurement", "age of data", lambda: verdict.age(measured))
