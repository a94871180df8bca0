"""Checks of the bus and its slaves, and what a server measures on it: the one that uses it, or the doctor's
own.

A server's stream is judged as every client's; its wake-ups, exchanges and ages may be the cause of what is
found.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from operator import attrgetter
from typing import Any, Final, NamedTuple

from bota_ethercat.address import Address
from bota_ethercat.control import Event
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.judge import Observation, emergency, judge
from bota_ethercat.health.observer import StreamObserver
from bota_ethercat.health.verdict import LIMITS, Level
from bota_ethercat.text.untrusted import number
from ethercat_server.access.adapters import Holder, find_holder, links, promiscuity_kept
from ethercat_server.access.sensors import Sensors
from ethercat_server.acquisition.health import SLOW_US, cost
from ethercat_server.doctor.machine import Machine
from ethercat_server.doctor.machine_checks import missing_to_open, rising
from ethercat_server.doctor.report import (
    CannotLookError,
    Finding,
    bad,
    examine,
    finding,
    note,
    ok,
    skipped,
    warning,
)
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import network_trouble
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.soem import open_bus
from ethercat_server.sensor import scan
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.sensor import is_known_model

MOST_PORTS: Final = 4
_FIND_ATTEMPTS: Final = 5
_FIND_TIMEOUT_S: Final = 0.05
_PROBE_SIZE: Final = 2
_WATCHDOG_CODE: Final = 0x001B
_CABLE: Final = "check the cable, its connectors and shield, and sources of interference"


class ErrorCounters(NamedTuple):
    """Error counters of an ESC; each saturates at 255."""

    invalid: tuple[int, ...]  # by port: corrupted frames received
    physical: tuple[int, ...]  # by port: errors that the physical layer reported
    forwarded: tuple[int, ...]  # by port: frames that another slave had found corrupted
    processing_unit: int
    pdi: int
    lost_links: tuple[int, ...]  # by port

    @classmethod
    def parse(cls, data: bytes) -> ErrorCounters:
        """From the registers 0x0300 to 0x0313."""
        by_port = tuple(data[0:8:2]), tuple(data[1:8:2]), tuple(data[8:12])
        return cls(*by_port, data[12], data[13], tuple(data[16:20]))


class Slave(NamedTuple):
    """One slave."""

    looked: scan.Slave  # without its SII if another master has the bus
    errors: bytes = bytes(reg.ERROR_COUNTERS_SIZE)  # the registers of its ErrorCounters
    links: tuple[bool, ...] = (True, False, False, False)  # which ports have one
    watchdogs: int = 0  # number of expired process data watchdogs
    left_alone: bool = False  # its SII was not read, for another master has the bus

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        al, sii = self.looked.status, self.looked.sii or {"name": "", "serial": 0, "vendor": 0, "product": 0}
        return {"sensor": self.looked.position, "name": sii["name"], "serial": sii["serial"],
                "vendor": sii["vendor"], "product": sii["product"], "al_state": al.state.name,
                "al_error": al.error, "al_status_code": al.code}  # fmt: skip


def count_slaves(bus: Bus) -> int:
    """Number of slaves that answer."""
    return max(0, *(bus.count_slaves(_PROBE_SIZE, _FIND_TIMEOUT_S) for _ in range(_FIND_ATTEMPTS)))


def look_at_slave(bus: Bus, position: int, *, in_use: bool) -> Slave:
    """The slave at `position`; BusError if it does not answer. `in_use`: another master has the bus."""
    looked = scan.look_at(bus, position)
    (links,) = struct.unpack("<H", bus.read_surely_at(position, reg.DL_STATUS, 2))
    return Slave(
        looked if in_use else scan.with_sii(bus, looked),
        read_errors(bus, position),
        tuple(bool(links >> (4 + port) & 1) for port in range(MOST_PORTS)),
        bus.read_surely_at(position, reg.WATCHDOG_COUNTER, 1)[0],
        left_alone=in_use,
    )


def read_errors(bus: Bus, position: int) -> bytes:
    """The registers of the slave's error counters; BusError if it does not answer."""
    return bus.read_surely_at(position, reg.RX_ERRORS, reg.ERROR_COUNTERS_SIZE)


def answers(ifname: str, count: int) -> Finding:
    """Whether any slave answers."""
    if count:
        return ok(f"{count} {'slave answers' if count == 1 else 'slaves answer'}", slaves=count)
    return bad(
        "no EtherCAT slave answers",
        "check the sensor's power, that it is on the injector's LAN side, and that this is its interface",
        f"ethercat-sensor eeprom {ifname}", slaves=0,
    )  # fmt: skip


def identity(slave: Slave) -> Finding:
    """Identity, and whether the server supports it."""
    values, looked = slave.as_json(), slave.looked
    if looked.at_work:
        return bad(
            f"not a Bota sensor, and in {looked.status.state.name}: another master controls it",
            "the server does not start on this bus; use the interface that the sensor is connected to",
            **values,
        )
    if slave.left_alone:
        state = looked.status.state.name
        return warning(f"not read: in {state}, and another master has the bus", "", **values)
    if looked.problem:
        return warning(f"unknown: {looked.problem}", "its EEPROM does not answer", **values)
    text = f"{looked.name}, serial {values['serial']}"
    if not looked.is_sensor:
        whose = f"vendor 0x{values['vendor']:08X}, product 0x{values['product']:08X}"
        return ok(f"{text}, {whose}: not a Bota Gen-0 sensor, the server leaves it alone", **values)
    if not is_known_model(values["name"]):
        supported = ", ".join(dictionary.MODELS)
        return bad(text, f"not supported by the server, which supports {supported}", **values)
    return ok(f"{text}, supported", **values)


def any_sensor(slaves: Sequence[Slave]) -> Iterator[Finding]:
    """Whether there is a sensor among them."""
    may_be = (slave.looked.is_sensor or slave.left_alone or slave.looked.problem for slave in slaves)
    if slaves and not any(may_be):
        yield bad("no Bota Gen-0 sensor", "connect one, or name the interface that it is connected to")


def cabling(slaves: Sequence[Slave]) -> Iterator[Finding]:
    """Whether a connected device does not answer: each cable has two ends, one of them at the interface."""
    values: dict[str, Any] = {"links": [list(slave.links) for slave in slaves]}
    linked = [
        f"port {port} of slave {slave.looked.position}"
        for slave in slaves for port, on in enumerate(slave.links) if on
    ]  # fmt: skip
    if slaves and len(linked) > 2 * len(slaves) - 1:
        why = "a device there does not answer: not an EtherCAT slave, or still starting"
        yield note(f"more links than slaves: {', '.join(linked)}", why, **values)
    elif slaves:
        yield ok("every link leads to a slave", **values)


def al_state(slave: Slave) -> Finding:
    """Its AL state, which the doctor does not change."""
    al, text = slave.looked.status, str(slave.looked.status)
    values: dict[str, Any] = {
        "al_state": al.state.name, "al_status_code": al.code, "watchdogs": slave.watchdogs,
    }  # fmt: skip
    if al.error and al.code == _WATCHDOG_CODE:
        why = "its last master ended without taking it to INIT (crash, cable); starting a server clears it"
        return note(text, why, **values)
    if al.error:
        return warning(text, "it reports an error: power it off and on", **values)
    if al.state in {AlState.NONE, AlState.BOOT}:
        return bad(text, "a server cannot use it in this state: power it off and on", **values)
    return ok(f"{text}, without error", **values)


def error_counters(slave: Slave, count: int) -> Finding:
    """Error counters of its ESC since power-on or the last start of a master."""
    counters = ErrorCounters.parse(slave.errors)
    values, text = counters._asdict(), "; ".join(_port_errors(slave.looked.position, counters, count))
    if any((*counters.invalid, *counters.physical)):
        why = f"frames were corrupted there since power-on or the last start of a master: {_CABLE}"
        return warning(text, why, **values)
    if counters.processing_unit or counters.pdi:
        text = f"processing unit {counters.processing_unit}, PDI {counters.pdi}"
        return note(text, "invalid EtherCAT frames, or errors inside the slave", **values)
    if any(counters.forwarded):
        return note(text, "frames were corrupted before they reached it: see the other slaves", **values)
    if any(counters.lost_links):
        why = "unplugged, or a neighbor was power-cycled; otherwise check the connectors"
        return note(text, why, **values)
    return ok("none", **values)


def new_errors(before: Mapping[int, bytes], after: Mapping[int, bytes], count: int) -> Finding:
    """Errors counted during the measurement: registers by position, at its begin and its end."""
    texts: list[str] = []
    values: dict[str, Any] = {}
    for position, now in after.items():
        # Fewer than before: a master was started meanwhile, which clears them.
        grown = bytes(max(0, n - o) for o, n in zip(before[position], now, strict=True))
        new = ErrorCounters.parse(grown)
        values[str(position)] = new._asdict()
        texts += _port_errors(position, new, count)
    if texts:
        return bad("; ".join(texts), f"frames are being corrupted or links lost: {_CABLE}", new=values)
    return ok("no new errors", new=values)


def _port_errors(position: int, counters: ErrorCounters, count: int) -> Iterator[str]:
    """Error counts of each port, with its cable. A counter saturates at 255."""
    for port in range(MOST_PORTS):
        where = cable(position, port, count)
        if damaged := max(counters.invalid[port], counters.physical[port]):
            yield f"{_many(damaged)} corrupted {where}"
        if forwarded := counters.forwarded[port]:
            yield f"{_many(forwarded)} corrupted before reaching slave {position}, port {port}"
        if lost := counters.lost_links[port]:
            yield f"link lost {_many(lost)} times {where}"


def _many(number: int) -> str:
    return f"{number} or more" if number == 0xFF else str(number)


def cable(position: int, port: int, count: int) -> str:
    """The cable at a port of a slave in a line of `count`."""
    if port == 0:
        return f"between {f'slave {position - 1}' if position else 'the interface'} and slave {position}"
    if port == 1 and position + 1 < count:
        return f"between slave {position} and slave {position + 1}"
    return f"at port {port} of slave {position}"


_PERIOD_US: Final = 1250.0  # the sample period at the factory setting, 800 Hz
_WAKE_NOTE_US: Final = 100
_WAKE_WARNING_US: Final = 250
_EXCHANGE_NOTE_US: Final = 250
_MANY: Final = 0.001  # fraction of all cycles above which late or lost ones are `bad`
_STEADIER: Final = "see 'A steadier cycle' in docs/operations.md"


def points(summary: Mapping[str, Any]) -> str:
    """Quantiles as text."""
    names = {"p50": "p50", "p99": "p99", "p999": "p99.9", "max": "max"}
    return ", ".join(f"{text} {float(summary[name]):.0f}" for name, text in names.items()) + " µs"


def scheduling(priority: int, *, real_time: bool) -> Finding:
    """Scheduling of the loop."""
    if real_time:
        return ok(f"SCHED_FIFO {priority}", real_time=True)
    if not priority:
        return note("ordinary scheduling, as requested", "other programs preempt it", real_time=False)
    why = "real-time priority was not granted, so other programs preempt it: run with sudo, or as a service"
    return note("ordinary scheduling", why, real_time=False)


def wake_finding(summary: Mapping[str, Any], late: int, count: int) -> Finding:
    """The finding for a summary: `late` of `count` wake-ups were late by more than a sample period."""
    text = f"late by {points(summary)}"
    values: dict[str, Any] = {**summary, "wake_ups": count, "later_than_a_period": late}
    if late:
        text += f"; {late} of {count} by more than a sample period"
        why = f"each loses samples; other work, or a hypervisor, used the CPU: {_STEADIER}"
        return (bad if late > _MANY * count else warning)(text, why, **values)
    if summary["p99"] > _WAKE_WARNING_US:
        return warning(text, f"increases the age of samples: {_STEADIER}", **values)
    if summary["p99"] > _WAKE_NOTE_US:
        why = "usual without a real-time kernel; occasionally increases the age of samples"
        return note(text, f"{why}: {_STEADIER}", **values)
    return ok(text, **values)


def exchange_finding(when: str, summary: Mapping[str, Any], lost: int, count: int) -> Finding:
    """The finding for a summary: `lost` of `count` exchanges did not come back."""
    text = f"{points(summary)}{when}"
    values: dict[str, Any] = {**summary, "exchanges": count, "lost": lost}
    if lost:
        why = "each may cost a sample: check the cable; a busy virtual machine loses frames, too"
        make = bad if lost > _MANY * count else warning
        return make(f"{text}; {lost} frames lost of {count}", why, **values)
    if summary["p50"] > SLOW_US:
        why = f"slow network card or driver: {cost(summary['p50'])}; see coalescing, interrupts"
        return warning(text, why, **values)
    if summary["p99"] > _EXCHANGE_NOTE_US:
        return note(text, "network card, driver or load: see coalescing, interrupts", **values)
    return ok(text, **values)


def age_finding(what: str, summary: Mapping[str, Any], how: str) -> Finding:
    """The finding for a summary of ages, by the limits of streams; `how` it was obtained."""
    text, p99_us = f"{what}: {points(summary)}", summary["p99"]
    if p99_us <= _PERIOD_US:
        return ok(text, how, **summary)
    limits = ((LIMITS.age_error, bad), (LIMITS.age_warn, warning), (0.0, note))
    make = next(make for limit_s, make in limits if p99_us >= limit_s * 1e6)
    return make(text, f"occasionally more than a sample period ({how})", **summary)


_POSITION: Final = attrgetter("sensor")
_FATES: Final = frozenset({Event.SENSOR_LOST, Event.SENSOR_BACK})
_LOG: Final = "see the server's log (journalctl -u 'ethercat-server@*')"


class ServerView:
    """The stream and the `status` of a server over the measuring time."""

    def __init__(self, sensors: Sensors, seconds: float, *, own: bool) -> None:
        """Watch for `seconds`, then close `sensors`. `own`: its figures are those since its start."""
        self._own = own
        with contextlib.closing(sensors):
            rows: list[dict[str, Any]] = sensors.ask("describe")["sensors"]
            self.before: dict[str, Any] = sensors.ask("status")
            start_ns = sensors.clock.monotonic_ns()
            self._observers = [StreamObserver(number(row["rate_hz"]) or 0.0, start_ns) for row in rows]

            def take(frames: Sequence[DataMessage]) -> None:
                now_ns = sensors.clock.monotonic_ns()
                for position, of_one in groupby(sorted(frames, key=_POSITION), _POSITION):
                    if position < len(self._observers):
                        batch = list(of_one)
                        self._observers[position].take(batch, now_ns)
                        if sensors.same_machine:
                            self._observers[position].note_age(batch[-1], now_ns)

            self._events = sensors.listen(seconds, take) if seconds else []
            self._end_ns = sensors.clock.monotonic_ns()
            self.after: dict[str, Any] = sensors.ask("status")
            self.described: list[dict[str, Any]] = sensors.ask("describe")["sensors"]
        rows = [*self.described, *self.before["sensors"], *self.after["sensors"]]
        if not all(isinstance(row, dict) for row in rows):
            raise ServerError("the server's reply is not understood: install the same version of both")
        self._when = "" if own else " in the last 10 s"

    def observation(self, position: int) -> Observation:
        """What was seen of a sensor's stream."""
        described = self.described[position]
        before, after = self.before["sensors"][position], self.after["sensors"][position]
        settings = described.get("settings")
        fates = [event["event"] for event in self._events if event.get("sensor") == position]
        seen = self._observers[position].observation(self._end_ns)
        return seen._replace(
            locked=after["clock"]["mode"] == "locked",
            recoveries=max(0, int(after["recoveries"]) - int(before["recoveries"])),
            missed_deadlines=self.grown("missed_deadlines"),
            is_lost=[fate for fate in fates if fate in _FATES][-1:] == [Event.SENSOR_LOST],
            state=str(described["state"]),
            emergency=emergency(after.get("emergency")),
            settings=settings if isinstance(settings, dict) else {},
        )

    def grown(self, name: str) -> int:
        """Increase of a counter."""
        return int(self.after[name]) - int(self.before[name])

    @property
    def _summaries(self) -> dict[str, Any]:
        found: dict[str, Any] = self.after if self._own else self.after["last_10s"]
        return found

    def sensors(self) -> Iterator[Finding]:
        """Each sensor: the verdict on its stream."""
        for position, described in enumerate(self.described):
            before, after = self.before["sensors"][position], self.after["sensors"][position]
            verdict = judge(self.observation(position))
            serial, state, clock = described["serial"], described["state"], after["clock"]["mode"]
            values: dict[str, Any] = {"sensor": position, "serial": serial, "state": state, "clock": clock}
            values["verdict"] = verdict.level.key
            names = ("fresh", "repeated", "invalid", "lost_samples", "recoveries")
            values |= {name: after[name] for name in names}
            values |= {f"new_{name}": int(after[name]) - int(before[name]) for name in names}
            text = (
                f"{described['name']}, serial {serial}, {state} at {described['rate_hz']} Hz, clock {clock}"
            )
            if verdict.findings:
                found = "; ".join(each.found for each in verdict.findings)
                why = "; ".join(dict.fromkeys(each.remedy for each in verdict.findings))
                yield finding(max(verdict.level, Level.LOOK), f"{text}: {found}", why, **values)
            elif after["lost_samples"] or after["recoveries"]:
                lost = f"{after['lost_samples']} samples lost and {after['recoveries']} recoveries"
                yield note(f"{text}, {lost} since its start", f"none meanwhile; {_LOG}", **values)
            else:
                yield ok(f"{text}: {verdict.sentence[0].lower()}{verdict.sentence[1:]}", **values)

    def wake_ups(self) -> Finding:
        """Its lateness, which may be the cause of the verdict on the stream, and is not trouble itself."""
        missed, count = self.grown("missed_deadlines"), max(1, self.grown("cycles"))
        found = wake_finding(self._summaries["wake_us"], missed, count)
        return replace(found, level=min(found.level, Level.LOOK))

    def exchanges(self) -> Finding:
        """How long its exchanges take, and how many are lost: a cause, too."""
        lost, count = self.grown("lost_frames"), max(1, self.grown("cycles"))
        found = exchange_finding(self._when, self._summaries["exchange_us"], lost, count)
        return replace(found, level=min(found.level, Level.LOOK))

    def ages(self) -> Iterator[Finding]:
        """The age of samples when the server sends them."""
        recent = [row["age_us"] for row in self.after["sensors"]] if self._own else self._summaries["age_us"]
        for position, summary in enumerate(recent):
            if not summary or not summary.get("max"):
                raise CannotLookError("the server reports it once it follows the sensor's clock")
            how = "the server's estimate; a message to a client takes about 50 µs more"
            yield age_finding(f"sensor {position}, when sent{self._when}", summary, how)

    def clients(self) -> Finding:
        """The clients, and those that are too slow."""
        rows = self.after["clients"]
        before = {row["peer"]: row["withheld"] for row in self.before["clients"]}
        slow = [str(row["peer"]) for row in rows if row["withheld"] > before.get(row["peer"], 0)]
        # The doctor itself is one of them.
        text = f"{len(rows) - 1} beside the doctor"
        if slow:
            why = "it reads more slowly than the sensor samples, so the server withholds frames from it"
            return note(f"{text}; too slow: {', '.join(slow)}", why, clients=rows)
        return ok(f"{text}, none too slow", clients=rows)

    def examine(self, subject: str) -> Iterator[Finding]:
        """All checks."""
        yield from examine(subject, "sensors", self.sensors)
        yield from examine(subject, "wake-ups", self.wake_ups)
        yield from examine(subject, "exchanges", self.exchanges)
        yield from examine(subject, "age of data", self.ages)
        if not self._own:
            yield from examine(subject, "clients", self.clients)


class Request(NamedTuple):
    """Options of the measurement."""

    seconds: float = 10.0
    cpu: int | None = None
    announce: Callable[[str], None] = lambda _: None  # called with a progress message


def examine_bus(machine: Machine, request: Request) -> Iterator[Finding]:
    """The bus itself, or the figures of its server; and the measurement."""
    holder = find_holder(machine.ifname)
    if holder is not None and holder.address is not None:
        yield from _through_server(holder, holder.address, request)
        return
    try:
        _check_may_look(machine, holder)
    except CannotLookError as error:
        found = skipped(str(error))
        if holder is not None and holder.pid is not None:
            found = bad(str(error), "two masters disturb each other: stop it", f"sudo kill {holder.pid}")
        yield replace(found, subject="bus", check="slaves")
        yield _not_measured("the bus is not accessed")
        return
    yield from _on_bus(machine, request)


def check_rights(machine: Machine) -> None:
    """CannotLookError unless this process may open a bus."""
    if missing := missing_to_open(machine):
        raise CannotLookError(f"{' and '.join(missing)} missing; run with sudo")


def _check_may_look(machine: Machine, holder: Holder | None) -> None:
    """CannotLookError if the bus must not be accessed."""
    if holder is not None and holder.pid is not None:
        raise CannotLookError(f"{holder} uses it as an EtherCAT master and serves no port")
    if holder is not None:
        raise CannotLookError("an EtherCAT master of another user has it: run with sudo to see which")
    link = machine.link
    check_rights(machine)
    if link.loopback:
        raise CannotLookError("it is the loopback interface")
    if not machine.allow_ip:
        try:
            routes = machine.fact("routes")
        except CannotLookError as error:
            why = f"its IP configuration is unknown ({error}), so no frame is sent there"
            raise CannotLookError(why) from None
        if problem := network_trouble(machine.shown, routes):
            raise CannotLookError(problem)
    if link.master or link.upper:
        raise CannotLookError("it is part of a bridge, bond or VLAN, so no frame is sent there")
    if not link.up or not link.carrier:
        raise CannotLookError("it is down" if not link.up else "it has no carrier")


def _not_measured(why: str) -> Finding:
    return replace(skipped(why), subject="measurement", check="all")


def _through_server(holder: Holder, address: Address, request: Request) -> Iterator[Finding]:
    """What the server that uses the interface says."""
    if request.seconds:
        request.announce(f"watching the server for {request.seconds:g} s ...")
    views: list[ServerView] = []

    def watch() -> Finding:
        views.append(ServerView(Sensors.through(address), request.seconds, own=False))
        why = "the bus is not accessed while it streams; these are the server's figures"
        hours = float(views[0].after["uptime_s"]) / 3600
        return ok(f"{holder} serves it at {address}, up {hours:.1f} h", why, **address._asdict())

    yield from examine("server", "server", watch)
    for view in views:
        yield from view.examine("server")


def _measured(machine: Machine, request: Request) -> Iterator[Finding]:
    """What a server measures here, with the sensors set as they are."""
    request.announce(f"measuring for {request.seconds:g} s ...")
    views: list[ServerView] = []

    def watch() -> Finding:
        sensors = Sensors.on_interface(
            machine.ifname, allow_ip=machine.allow_ip, rt_priority=machine.rt_priority, cpu=request.cpu
        )
        views.append(ServerView(sensors, request.seconds, own=True))
        return scheduling(machine.rt_priority, real_time=sensors.real_time)

    yield from examine("measurement", "scheduling", watch)
    for view in views:
        yield from view.examine("measurement")


def _on_bus(machine: Machine, request: Request) -> Iterator[Finding]:
    """The slaves, as they are; then what a server of the doctor's own measures, and the new errors."""
    of_card = _card_counters(machine.ifname)
    with promiscuity_kept(machine.ifname):
        found: list[Slave] = []
        try:
            with open_bus(machine.ifname, allow_ip=machine.allow_ip) as bus:
                count = yield from _slaves(machine, bus, found)
        except ServerError as error:
            yield replace(bad(str(error)), subject="bus", check="slaves")
            return
        if not request.seconds:
            yield _not_measured("disabled by --seconds 0")
            return
        if not any(slave.looked.is_sensor for slave in found) or any(slave.left_alone for slave in found):
            yield _not_measured("there is no sensor to measure with, or another master has the bus")
            return
        yield from _measured(machine, request)

        def meanwhile() -> Finding:
            with open_bus(machine.ifname, allow_ip=machine.allow_ip) as bus:
                after = {slave.looked.position: read_errors(bus, slave.looked.position) for slave in found}
            return new_errors({slave.looked.position: slave.errors for slave in found}, after, count)

        now = _card_counters(machine.ifname)
        yield from examine("measurement", "card meanwhile", rising, of_card, now)
        yield from examine("measurement", "bus meanwhile", meanwhile)


def _card_counters(ifname: str) -> Mapping[str, int]:
    """The present counters of the interface; empty if they cannot be read."""
    with contextlib.suppress(Exception):  # pyroute2's errors share no base
        return next((row.counters for row in links() if row.name == ifname), {})
    return {}


def _slaves(machine: Machine, bus: Bus, found: list[Slave]) -> Generator[Finding, None, int]:
    """Those that answer, which are added to `found`; returns how many there are."""
    count = count_slaves(bus)
    yield from examine("bus", "slaves", answers, machine.shown, count)
    in_use = any(scan.look_at(bus, position).at_work for position in range(count))
    for position in range(count):

        def identify(position: int = position) -> Finding:
            found.append(look_at_slave(bus, position, in_use=in_use))
            return identity(found[-1])

        yield from examine("bus", f"slave {position}", identify)
        if found and found[-1].looked.position == position:
            yield from examine("bus", f"slave {position} state", al_state, found[-1])
            yield from examine("bus", f"slave {position} errors", error_counters, found[-1], count)
    if len(found) == count:
        yield from examine("bus", "sensors", any_sensor, found)
        yield from examine("bus", "line", cabling, found)
    return count
