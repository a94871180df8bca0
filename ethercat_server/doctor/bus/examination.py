"""Checks of the bus, and the measurement; or the figures of a server that uses the interface."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from ethercat_server.access.adapters import promiscuity_kept
from ethercat_server.access.holder import Holder, find_holder
from ethercat_server.doctor import verdict
from ethercat_server.doctor.bus import findings as on_bus
from ethercat_server.doctor.bus import slaves
from ethercat_server.doctor.bus.measurement import Exchange, Measured, measure
from ethercat_server.doctor.bus.through_server import ServerView
from ethercat_server.doctor.examination import examine
from ethercat_server.doctor.finding import CannotLookError, Finding, bad, cannot_look, skipped
from ethercat_server.doctor.machine import nic
from ethercat_server.doctor.machine.facts import read_counters
from ethercat_server.doctor.machine.machine import Machine
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, Clock
from ethercat_server.ethercat.nic.ip import network_trouble
from ethercat_server.ethercat.open_bus import open_bus
from protocol.address import Address

if TYPE_CHECKING:
    from ethercat_server.ethercat.bus import Bus

_PROCESS_DATA_SIZE: Final = 62
"""Bytes of a sensor's outputs and its usual inputs."""
_LONGEST_PROBE: Final = 256
"""Registers up to here can be read without side effects."""
_EXCHANGE_TIMEOUT_S: Final = 0.01
_NET_ADMIN, _NET_RAW = 12, 13


class Request(NamedTuple):
    """Options of the measurement."""

    seconds: float = 10.0
    cpu: int | None = None
    announce: Callable[[str], None] = lambda _: None
    """Called with a progress message."""


def examine_bus(machine: Machine, request: Request) -> Iterator[Finding]:
    """The bus itself, or the figures of its server; and the measurement."""
    holder = find_holder(machine.ifname)
    if holder is not None and holder.address is not None:
        yield from _through_server(machine, holder, holder.address, request)
        return
    try:
        _check_may_look(machine, holder)
    except CannotLookError as error:
        yield replace(_no_bus(holder, str(error)), subject="bus", check="slaves")
        yield from _measured(_measure(machine, request, None), 0)
        return
    yield from _on_bus(machine, request)


def check_rights(machine: Machine) -> None:
    """CannotLookError unless this process may open a bus."""
    needed = ((_NET_RAW, "CAP_NET_RAW"), (_NET_ADMIN, "CAP_NET_ADMIN"))
    missing = [name for bit, name in needed if not machine.has_capability(bit)]
    if missing:
        cannot_look(f"{' and '.join(missing)} missing; run with sudo")


def _check_may_look(machine: Machine, holder: Holder | None) -> None:
    """CannotLookError if the bus must not be accessed."""
    if holder is not None and holder.pid is not None:
        cannot_look(f"{holder} uses it as an EtherCAT master and serves no port")
    if holder is not None:
        cannot_look("an EtherCAT master of another user has it: run with sudo to see which")
    there = machine.facts.there
    check_rights(machine)
    if there.loopback:
        cannot_look("it is the loopback interface")
    routes = machine.facts.routes
    if not machine.allow_ip:
        if isinstance(routes, str):
            cannot_look(f"its IP configuration is unknown ({routes}), so no frame is sent there")
        if problem := network_trouble(machine.shown, routes):
            cannot_look(problem)
    if there.master or there.upper:
        cannot_look("it is part of a bridge, bond or VLAN, so no frame is sent there")
    if not there.up or not there.carrier:
        cannot_look("it is down" if not there.up else "it has no carrier")


def _no_bus(holder: Holder | None, why: str) -> Finding:
    if holder is None or holder.pid is None:
        return skipped(why)
    return bad(why, "two masters disturb each other: stop it", f"sudo kill {holder.pid}")


def _through_server(
    machine: Machine, holder: Holder, address: Address, request: Request
) -> Iterator[Finding]:
    view: list[ServerView] = []
    if request.seconds:
        request.announce(f"watching the server for {request.seconds:g} s ...")

    def reach() -> Iterator[Finding]:
        view.append(ServerView(address, str(holder), request.seconds))
        yield from view[0].server()

    yield from examine("server", "server", reach)
    if view:
        yield from view[0].examine(examine)
    else:
        yield from _measured(_measure(machine, request, None), 0)


def _on_bus(machine: Machine, request: Request) -> Iterator[Finding]:

    with contextlib.ExitStack() as cleanup:
        cleanup.enter_context(promiscuity_kept(machine.ifname))
        try:
            bus = cleanup.enter_context(open_bus(machine.ifname, allow_ip=machine.allow_ip))
        except ServerError as error:
            yield replace(bad(str(error), ""), subject="bus", check="slaves")
            return
        count = slaves.count(bus)
        yield from examine("bus", "slaves", functools.partial(on_bus.answers, machine.shown, count))
        found: list[slaves.Slave] = []
        in_use = slaves.in_use(bus, count)
        for position in range(count):
            yield from _slave(bus, position, count, found, in_use=in_use)
        if len(found) == count:
            yield from examine("bus", "sensors", functools.partial(on_bus.sensors, found))
            yield from examine("bus", "line", functools.partial(on_bus.line, found))
        yield from _measured_on_bus(machine, request, bus, count, found)


def _slave(
    bus: Bus, position: int, count: int, found: list[slaves.Slave], *, in_use: bool
) -> Iterator[Finding]:
    """One slave, which is added to `found` if it answers."""

    def identify() -> Iterator[Finding]:
        found.append(slaves.look(bus, position, in_use=in_use))
        yield from on_bus.identity(found[-1])

    yield from examine("bus", f"slave {position}", identify)
    if found and found[-1].position == position:
        yield from examine("bus", f"slave {position} state", functools.partial(on_bus.state, found[-1]))
        yield from examine(
            "bus", f"slave {position} errors", functools.partial(on_bus.errors, found[-1], count)
        )


def _measured_on_bus(
    machine: Machine, request: Request, bus: Bus, count: int, found: list[slaves.Slave]
) -> Iterator[Finding]:
    size = min(_LONGEST_PROBE, _PROCESS_DATA_SIZE * max(1, count))
    of_card = read_counters(machine.ifname)
    exchange = (lambda: bus.count_slaves(size, _EXCHANGE_TIMEOUT_S) == count) if count else None
    measured = _measure(machine, request, exchange, bus.clock)
    yield from _measured(measured, size)
    if measured is None:
        return
    yield from examine(
        "measurement", "card meanwhile", lambda: nic.rising(of_card, read_counters(machine.ifname))
    )
    if found:
        before = {slave.position: slave.counters for slave in found}

        def meanwhile() -> Iterator[Finding]:
            after = {position: slaves.read_counters(bus, position) for position in before}
            yield from on_bus.new_errors(before, after, count)

        yield from examine("measurement", "bus meanwhile", meanwhile)


def _measure(
    machine: Machine, request: Request, exchange: Exchange | None, clock: Clock = SYSTEM_CLOCK
) -> Measured | None:
    if not request.seconds:
        return None
    request.announce(f"measuring for {request.seconds:g} s ...")
    return measure(request.seconds, exchange, machine.rt_priority, request.cpu, clock)


def _measured(measured: Measured | None, size: int) -> Iterator[Finding]:
    if measured is None:
        yield replace(skipped("disabled by --seconds 0"), subject="measurement", check="all")
        return
    yield from examine("measurement", "scheduling", lambda: verdict.scheduling(measured))
    yield from examine("measurement", "wake-ups", lambda: verdict.wake_ups(measured))
    yield from examine("measurement", "exchanges", lambda: verdict.exchanges(measured, size))
    yield from examine("measurement", "messages", lambda: verdict.messages(measured))
    yield from examine("measurement", "age of data", lambda: verdict.age(measured))
