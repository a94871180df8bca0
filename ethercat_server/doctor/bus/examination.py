"""Checks of the bus, and what a server measures on it: the one that uses it, or the doctor's own."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from ethercat_server.access.adapters import promiscuity_kept
from ethercat_server.access.holder import Holder, find_holder
from ethercat_server.access.sensors import Sensors
from ethercat_server.doctor import verdict
from ethercat_server.doctor.bus import findings as on_bus
from ethercat_server.doctor.bus import slaves
from ethercat_server.doctor.bus.server_view import ServerView
from ethercat_server.doctor.examination import examine
from ethercat_server.doctor.finding import CannotLookError, Finding, bad, cannot_look, ok, skipped
from ethercat_server.doctor.machine import nic
from ethercat_server.doctor.machine.facts import read_counters
from ethercat_server.doctor.machine.machine import Machine
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.nic.interface import network_trouble
from ethercat_server.ethercat.open_bus import open_bus
from protocol.address import Address

if TYPE_CHECKING:
    from ethercat_server.ethercat.bus import Bus

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
        yield from _through_server(holder, holder.address, request)
        return
    try:
        _check_may_look(machine, holder)
    except CannotLookError as error:
        yield replace(_no_bus(holder, str(error)), subject="bus", check="slaves")
        yield _not_measured("the bus is not accessed")
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


def _through_server(holder: Holder, address: Address, request: Request) -> Iterator[Finding]:
    if request.seconds:
        request.announce(f"watching the server for {request.seconds:g} s ...")
    views: list[ServerView] = []

    def watch() -> Iterator[Finding]:
        views.append(ServerView(Sensors.through(address), request.seconds, own=False))
        why = "the bus is not accessed while it streams; these are the server's figures"
        hours = float(views[0].after["uptime_s"]) / 3600
        yield ok(f"{holder} serves it at {address}, up {hours:.1f} h", why, **address._asdict())

    yield from examine("server", "server", watch)
    for view in views:
        yield from view.examine("server", examine)


def _on_bus(machine: Machine, request: Request) -> Iterator[Finding]:
    """The slaves, as they are; then what a server of the doctor's own measures, and the new errors."""
    of_card = read_counters(machine.ifname)
    with contextlib.ExitStack() as cleanup:
        cleanup.enter_context(promiscuity_kept(machine.ifname))
        found: list[slaves.Slave] = []
        try:
            with open_bus(machine.ifname, allow_ip=machine.allow_ip) as bus:
                count = yield from _slaves(machine, bus, found)
        except ServerError as error:
            yield replace(bad(str(error), ""), subject="bus", check="slaves")
            return
        if not request.seconds:
            yield _not_measured("disabled by --seconds 0")
            return
        if not any(slave.is_sensor for slave in found) or any(slave.left_alone for slave in found):
            yield _not_measured("there is no sensor to measure with, or another master has the bus")
            return
        yield from _measured(machine, request)
        yield from examine(
            "measurement", "card meanwhile", lambda: nic.rising(of_card, read_counters(machine.ifname))
        )
        before = {slave.position: slave.counters for slave in found}

        def meanwhile() -> Iterator[Finding]:
            with open_bus(machine.ifname, allow_ip=machine.allow_ip) as bus:
                after = {position: slaves.read_counters(bus, position) for position in before}
            yield from on_bus.new_errors(before, after, count)

        yield from examine("measurement", "bus meanwhile", meanwhile)


def _not_measured(why: str) -> Finding:
    return replace(skipped(why), subject="measurement", check="all")


def _slaves(machine: Machine, bus: Bus, found: list[slaves.Slave]) -> Generator[Finding, None, int]:
    """Those that answer, which are added to `found`; returns how many there are."""
    count = slaves.count(bus)
    yield from examine("bus", "slaves", functools.partial(on_bus.answers, machine.shown, count))
    in_use = slaves.in_use(bus, count)
    for position in range(count):
        yield from _slave(bus, position, count, found, in_use=in_use)
    if len(found) == count:
        yield from examine("bus", "sensors", functools.partial(on_bus.sensors, found))
        yield from examine("bus", "line", functools.partial(on_bus.line, found))
    return count


def _measured(machine: Machine, request: Request) -> Iterator[Finding]:
    """What a server measures here, with the sensors set as they are."""
    request.announce(f"measuring for {request.seconds:g} s ...")
    views: list[ServerView] = []

    def watch() -> Iterator[Finding]:
        sensors = Sensors.on_interface(
            machine.ifname, allow_ip=machine.allow_ip, rt_priority=machine.rt_priority, cpu=request.cpu
        )
        views.append(ServerView(sensors, request.seconds, own=True))
        yield from verdict.scheduling(machine.rt_priority, real_time=sensors.real_time)

    yield from examine("measurement", "scheduling", watch)
    for view in views:
        yield from view.examine("measurement", examine)


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
