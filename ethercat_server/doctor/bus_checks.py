"""Checks of the bus and its slaves, and what a server measures on it: the one that uses it, or the doctor's
own.

A server's stream is judged as every client's; its wake-ups, exchanges and ages may be the cause of what is
found.
"""

from __future__ import annotations

import contextlib
import functools
import struct
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from bota_ethercat.address import Address
from bota_ethercat.control import Event
from bota_ethercat.framing import DataMessage
from bota_ethercat.health import verdict as health
from bota_ethercat.health.judge import Observation, emergency, judge
from bota_ethercat.health.observer import StreamObserver
from bota_ethercat.health.verdict import LIMITS, Level
from bota_ethercat.text.untrusted import number
from ethercat_server.access.adapters import promiscuity_kept
from ethercat_server.access.holder import Holder, find_holder
from ethercat_server.access.sensors import Sensors
from ethercat_server.acquisition.health import SLOW_US, cost
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
from ethercat_server.doctor.machine import Machine, read_counters
from ethercat_server.doctor.machine_checks import examine, rising
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import network_trouble
from ethercat_server.ethercat.open_bus import open_bus
from ethercat_server.ethercat.slave.al import AlState, AlStatus
from ethercat_server.ethercat.slave.registers import (
    AL_STATUS,
    AL_STATUS_SIZE,
    DL_STATUS,
    ERROR_COUNTERS_SIZE,
    RX_ERRORS,
    WATCHDOG_COUNTER,
)
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.objects.dictionary import is_sensor
from ethercat_server.sensor.scan import look_at, with_sii
from ethercat_server.sensor.sensor import is_known_model

MOST_PORTS: Final = 4
_ATTEMPTS: Final = 10
_FIND_ATTEMPTS: Final = 5
_FIND_TIMEOUT_S: Final = 0.05
_PROBE_SIZE: Final = 2


@dataclass(frozen=True)
class ErrorCounters:
    """Error counters of an ESC; each saturates at 255."""

    invalid: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: corrupted frames received."""
    physical: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: errors that the physical layer reported."""
    forwarded: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: frames that another slave had found corrupted."""
    processing_unit: int = 0
    pdi: int = 0
    lost_links: tuple[int, ...] = (0,) * MOST_PORTS

    @classmethod
    def parse(cls, data: bytes) -> ErrorCounters:
        """From the registers 0x0300 to 0x0313."""
        return cls(
            tuple(data[0:8:2]), tuple(data[1:8:2]), tuple(data[8:12]), data[12], data[13], tuple(data[16:20])
        )

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        return {
            name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()
        }


@dataclass(frozen=True)
class Slave:
    """One slave."""

    position: int
    al: AlStatus
    counters: ErrorCounters = ErrorCounters()
    links: tuple[bool, ...] = (True, False, False, False)
    """Which ports have a link."""
    watchdogs: int = 0
    """Number of expired process data watchdogs."""
    vendor: int = 0
    product: int = 0
    serial: int = 0
    name: str = ""
    sii_problem: str = ""
    """Why its SII, and so its identity, could not be read."""
    at_work: bool = False
    """It is no Bota sensor and in SAFEOP, OP or BOOT."""
    left_alone: bool = False
    """Its SII was not read, for another master has the bus."""

    @property
    def is_sensor(self) -> bool:
        """Whether it is a Bota Gen-0 sensor."""
        return is_sensor(self.vendor, self.product)

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        return {"sensor": self.position, "name": self.name, "serial": self.serial, "vendor": self.vendor,
                "product": self.product, "al_state": self.al.state.name, "al_error": self.al.error,
                "al_status_code": self.al.code}  # fmt: skip


def count_slaves(bus: Bus) -> int:
    """Number of slaves that answer."""
    return max(0, *(bus.count_slaves(_PROBE_SIZE, _FIND_TIMEOUT_S) for _ in range(_FIND_ATTEMPTS)))


def is_in_use(bus: Bus, count: int) -> bool:
    """Whether a slave that is no Bota sensor is in SAFEOP, OP or BOOT; BusError if one does not answer."""
    return any(look_at(bus, position).at_work for position in range(count))


def look_at_slave(bus: Bus, position: int, *, in_use: bool) -> Slave:
    """The slave at `position`; BusError if it does not answer. `in_use`: another master has the bus."""
    al = AlStatus.parse(bus.read_surely_at(position, AL_STATUS, AL_STATUS_SIZE))
    (links,) = struct.unpack("<H", bus.read_surely_at(position, DL_STATUS, 2))
    counters = read_error_counters(bus, position)
    watchdogs = bus.read_surely_at(position, WATCHDOG_COUNTER, 1)[0]
    found: dict[str, Any] = {
        "position": position, "al": al, "counters": counters, "watchdogs": watchdogs,
        "links": tuple(bool(links >> (4 + port) & 1) for port in range(MOST_PORTS)),
    }  # fmt: skip
    looked = look_at(bus, position)
    if in_use:
        return Slave(**found, at_work=looked.at_work, left_alone=True)
    looked = with_sii(bus, looked)
    if looked.sii is None:
        return Slave(**found, sii_problem=looked.problem)
    names = ("vendor", "product", "serial", "name")
    return Slave(**found, **{name: looked.sii[name] for name in names})


def read_error_counters(bus: Bus, position: int) -> ErrorCounters:
    """The error counters of the slave at `position`; BusError if it does not answer."""
    return ErrorCounters.parse(bus.read_surely_at(position, RX_ERRORS, ERROR_COUNTERS_SIZE))


_WATCHDOG_CODE: Final = 0x001B
_CABLE: Final = "check the cable, its connectors and shield, and sources of interference"


def answers(ifname: str, count: int) -> Iterator[Finding]:
    """Whether any slave answers."""
    if count:
        yield ok(f"{count} {'slave answers' if count == 1 else 'slaves answer'}", slaves=count)
        return
    yield bad(
        "no EtherCAT slave answers",
        "check the sensor's power, that it is on the injector's LAN side, and that this is its interface",
        f"ethercat-sensor eeprom {ifname}", slaves=0,
    )  # fmt: skip


def identity(slave: Slave) -> Iterator[Finding]:
    """Identity, and whether the server supports it."""
    values = slave.as_json()
    if slave.at_work:
        yield bad(
            f"not a Bota sensor, and in {slave.al.state.name}: another master controls it",
            "the server does not start on this bus; use the interface that the sensor is connected to",
            **values,
        )
        return
    if slave.left_alone:
        yield warning(f"not read: in {slave.al.state.name}, and another master has the bus", "", **values)
        return
    if slave.sii_problem:
        yield warning(f"unknown: {slave.sii_problem}", "its EEPROM does not answer", **values)
        return
    text = f"{slave.name or 'nameless'}, serial {slave.serial}"
    if not slave.is_sensor:
        yield ok(
            f"{text}, vendor 0x{slave.vendor:08X}, product 0x{slave.product:08X}: not a Bota Gen-0 sensor, "
            "the server leaves it alone",
            **values,
        )
    elif not is_known_model(slave.name):
        yield bad(
            text, "not supported by the server, which supports " + ", ".join(dictionary.MODELS), **values
        )
    else:
        yield ok(f"{text}, supported", **values)


def any_sensor(slaves: Sequence[Slave]) -> Iterator[Finding]:
    """Whether there is a sensor among them."""
    if slaves and not any(slave.is_sensor or slave.left_alone or slave.sii_problem for slave in slaves):
        yield bad("no Bota Gen-0 sensor", "connect one, or name the interface that it is connected to")


def cabling(slaves: Sequence[Slave]) -> Iterator[Finding]:
    """Whether a connected device does not answer: each cable has two ends, one of them at the interface."""
    if not slaves:
        return
    values: dict[str, Any] = {"links": [list(slave.links) for slave in slaves]}
    linked = [f"port {port} of slave {slave.position}" for slave in slaves for port in _ports(slave)]
    if len(linked) > 2 * len(slaves) - 1:
        yield note(
            f"more links than slaves: {', '.join(linked)}",
            "a device there does not answer: not an EtherCAT slave, or still starting",
            **values,
        )
    else:
        yield ok("every link leads to a slave", **values)


def _ports(slave: Slave) -> list[int]:
    """Those with a link."""
    return [port for port, on in enumerate(slave.links) if on]


def al_state(slave: Slave) -> Iterator[Finding]:
    """Its AL state, which the doctor does not change."""
    values: dict[str, Any] = {
        "al_state": slave.al.state.name,
        "al_status_code": slave.al.code,
        "watchdogs": slave.watchdogs,
    }
    text = str(slave.al)
    if slave.al.error and slave.al.code == _WATCHDOG_CODE:
        why = "its last master ended without taking it to INIT (crash, cable); starting a server clears it"
        yield note(text, why, **values)
    elif slave.al.error:
        yield warning(text, "it reports an error: power it off and on", **values)
    elif slave.al.state in {AlState.NONE, AlState.BOOT}:
        yield bad(text, "a server cannot use it in this state: power it off and on", **values)
    else:
        yield ok(f"{text}, without error", **values)


def error_counters(slave: Slave, count: int) -> Iterator[Finding]:
    """Error counters of its ESC since power-on or the last start of a master."""
    values = slave.counters.as_json()
    texts = [
        text
        for port in range(MOST_PORTS)
        for text in _port_errors(slave.position, port, slave.counters, count)
    ]
    own = [n for name in ("invalid", "physical") for n in getattr(slave.counters, name)]
    if any(own):
        yield warning(
            "; ".join(texts),
            f"frames were corrupted there since power-on or the last start of a master: {_CABLE}",
            **values,
        )  # fmt: skip
    elif slave.counters.processing_unit or slave.counters.pdi:
        text = f"processing unit {slave.counters.processing_unit}, PDI {slave.counters.pdi}"
        yield note(text, "invalid EtherCAT frames, or errors inside the slave", **values)
    elif any(slave.counters.forwarded):
        yield note(
            "; ".join(texts),
            "frames were corrupted before they reached it: see the other slaves",
            **values,
        )
    elif any(slave.counters.lost_links):
        why = "unplugged, or a neighbor was power-cycled; otherwise check the connectors"
        yield note("; ".join(texts), why, **values)
    else:
        yield ok("none", **values)


def new_errors(
    before: Mapping[int, ErrorCounters], after: Mapping[int, ErrorCounters], count: int
) -> Iterator[Finding]:
    """Errors counted during the measurement."""
    texts: list[str] = []
    values: dict[str, Any] = {}
    for position, now in after.items():
        new = _difference(before[position], now)
        values[str(position)] = new.as_json()
        texts += [text for port in range(MOST_PORTS) for text in _port_errors(position, port, new, count)]
    if texts:
        yield bad("; ".join(texts), f"frames are being corrupted or links lost: {_CABLE}", new=values)
    else:
        yield ok("no new errors", new=values)


def _difference(before: ErrorCounters, after: ErrorCounters) -> ErrorCounters:
    def ports(old: Sequence[int], new: Sequence[int]) -> tuple[int, ...]:
        return tuple(max(0, n - o) for o, n in zip(old, new, strict=True))

    return ErrorCounters(
        ports(before.invalid, after.invalid),
        ports(before.physical, after.physical),
        ports(before.forwarded, after.forwarded),
        max(0, after.processing_unit - before.processing_unit),
        max(0, after.pdi - before.pdi),
        ports(before.lost_links, after.lost_links),
    )


def _port_errors(position: int, port: int, counters: ErrorCounters, count: int) -> Iterator[str]:
    """Error counts of one port, with its cable. A counter saturates at 255."""
    where = cable(position, port, count)
    damaged = max(counters.invalid[port], counters.physical[port])
    if damaged:
        yield f"{_many(damaged)} corrupted {where}"
    if counters.forwarded[port]:
        yield f"{_many(counters.forwarded[port])} corrupted before reaching slave {position}, port {port}"
    if counters.lost_links[port]:
        yield f"link lost {_many(counters.lost_links[port])} times {where}"


def _many(number: int) -> str:
    return f"{number} or more" if number == 0xFF else str(number)


def cable(position: int, port: int, count: int) -> str:
    """The cable at a port of a slave in a line of `count`."""
    if port == 0:
        return f"between {f'slave {position - 1}' if position else 'the interface'} and slave {position}"
    if port == 1 and position + 1 < count:
        return f"between slave {position} and slave {position + 1}"
    return f"at port {port} of slave {position}"


_PERIOD_US: Final = 1250.0
"""The sample period at the factory setting, 800 Hz."""
_WAKE_NOTE_US: Final = 100
_WAKE_WARNING_US: Final = 250
_EXCHANGE_NOTE_US: Final = 250
_MANY: Final = 0.001
"""Fraction of all cycles above which late or lost ones are `bad`."""
_STEADIER: Final = "see 'A steadier cycle' in docs/operations.md"


def points(summary: Mapping[str, Any]) -> str:
    """Quantiles as text."""
    names = {"p50": "p50", "p99": "p99", "p999": "p99.9", "max": "max"}
    return ", ".join(f"{text} {float(summary[name]):.0f}" for name, text in names.items()) + " µs"


def scheduling(priority: int, *, real_time: bool) -> Iterator[Finding]:
    """Scheduling of the loop."""
    if real_time:
        yield ok(f"SCHED_FIFO {priority}", real_time=True)
    elif not priority:
        yield note("ordinary scheduling, as requested", "other programs preempt it", real_time=False)
    else:
        why = (
            "real-time priority was not granted, so other programs preempt it: run with sudo, or as a service"
        )
        yield note("ordinary scheduling", why, real_time=False)


def wake_finding(summary: Mapping[str, Any], late: int, count: int) -> Finding:
    """The finding for a summary: `late` of `count` wake-ups were late by more than a sample period."""
    text = f"late by {points(summary)}"
    values: dict[str, Any] = {**summary, "wake_ups": count, "later_than_a_period": late}
    if late:
        text += f"; {late} of {count} by more than a sample period"
        make = bad if late > _MANY * count else warning
        why = f"each loses samples; other work, or a hypervisor, used the CPU: {_STEADIER}"
        return make(text, why, **values)
    if summary["p99"] > _WAKE_WARNING_US:
        return warning(text, f"increases the age of samples: {_STEADIER}", **values)
    if summary["p99"] > _WAKE_NOTE_US:
        return note(
            text,
            f"usual without a real-time kernel; occasionally increases the age of samples: {_STEADIER}",
            **values,
        )
    return ok(text, **values)


def exchange_finding(when: str, summary: Mapping[str, Any], lost: int, count: int) -> Finding:
    """The finding for a summary: `lost` of `count` exchanges did not come back."""
    text = f"{points(summary)}{when}"
    values: dict[str, Any] = {**summary, "exchanges": count, "lost": lost}
    if lost:
        make = bad if lost > _MANY * count else warning
        why = "each may cost a sample: check the cable; a busy virtual machine loses frames, too"
        return make(f"{text}; {lost} frames lost of {count}", why, **values)
    if summary["p50"] > SLOW_US:
        why = f"slow network card or driver: {cost(summary['p50'])}; see coalescing, interrupts"
        return warning(text, why, **values)
    if summary["p99"] > _EXCHANGE_NOTE_US:
        return note(text, "network card, driver or load: see coalescing, interrupts", **values)
    return ok(text, **values)


def age_finding(what: str, summary: Mapping[str, Any], how: str) -> Finding:
    """The finding for a summary of ages; `how` it was obtained."""
    text = f"{what}: {points(summary)}"
    if summary["p99"] > _PERIOD_US:
        make = _by_age(summary["p99"])
        return make(text, f"occasionally more than a sample period ({how})", **summary)
    return ok(text, how, **summary)


def _by_age(p99_us: float) -> Callable[..., Finding]:
    """What the judge of streams would say of samples that are so late or old."""
    if p99_us >= LIMITS.age_error * 1e6:
        return bad
    return warning if p99_us >= LIMITS.age_warn * 1e6 else note


def as_cause(finding: Finding) -> Finding:
    """The same about a server that streams: its stream has a verdict, this may be the cause."""
    return replace(finding, level=min(finding.level, Level.LOOK))


Examine = Callable[[str, str, Callable[[], Iterator[Finding]]], Iterator[Finding]]

_POSITION: Final = attrgetter("sensor")
_FATES: Final = frozenset({Event.SENSOR_LOST, Event.SENSOR_BACK})
_LOG: Final = "see the server's log (journalctl -u 'ethercat-server@*')"


class ServerView:
    """The stream and the `status` of a server over the measuring time."""

    def __init__(self, sensors: Sensors, seconds: float, *, own: bool) -> None:
        """Watch for `seconds`, then close `sensors`. `own`: its figures are those since its start."""
        link, self._own = sensors, own
        try:
            rows: list[dict[str, Any]] = link.ask("describe")["sensors"]
            self.before: dict[str, Any] = link.ask("status")
            start_ns = link.clock.monotonic_ns()
            self._observers = [StreamObserver(number(row["rate_hz"]) or 0.0, start_ns) for row in rows]
            self._events = link.listen(seconds, functools.partial(self._take, link)) if seconds else []
            self._end_ns = link.clock.monotonic_ns()
            self.after: dict[str, Any] = link.ask("status")
            self.described: list[dict[str, Any]] = link.ask("describe")["sensors"]
        finally:
            link.close()
        rows = [*self.described, *self.before["sensors"], *self.after["sensors"]]
        if not all(isinstance(row, dict) for row in rows):
            raise ServerError("the server's reply is not understood: install the same version of both")

    def _take(self, link: Sensors, frames: Sequence[DataMessage]) -> None:
        now_ns = link.clock.monotonic_ns()
        for position, of_one in groupby(sorted(frames, key=_POSITION), _POSITION):
            if position < len(self._observers):
                batch = list(of_one)
                self._observers[position].take(batch, now_ns)
                if link.same_machine:
                    self._observers[position].note_age(batch[-1], now_ns)

    def observation(self, position: int) -> Observation:
        """What was seen of a sensor's stream."""
        described = self.described[position]
        before, after = self.before["sensors"][position], self.after["sensors"][position]
        settings = described.get("settings")
        fates = [event["event"] for event in self._events if event.get("sensor") == position]
        return (
            self._observers[position]
            .observation(self._end_ns)
            ._replace(
                locked=after["clock"]["mode"] == "locked",
                recoveries=max(0, int(after["recoveries"]) - int(before["recoveries"])),
                missed_deadlines=self.grown("missed_deadlines"),
                is_lost=[fate for fate in fates if fate in _FATES][-1:] == [Event.SENSOR_LOST],
                state=str(described["state"]),
                emergency=emergency(after.get("emergency")),
                settings=settings if isinstance(settings, dict) else {},
            )
        )

    def grown(self, name: str) -> int:
        """Increase of a counter."""
        return int(self.after[name]) - int(self.before[name])

    def sensors(self) -> Iterator[Finding]:
        """Each sensor: the verdict on its stream."""
        for position, described in enumerate(self.described):
            before, after = self.before["sensors"][position], self.after["sensors"][position]
            clock = after["clock"]["mode"]
            verdict = judge(self.observation(position))
            names = ("fresh", "repeated", "invalid", "lost_samples", "recoveries")
            values: dict[str, Any] = {
                "sensor": position,
                "serial": described["serial"],
                "state": described["state"],
                "clock": clock,
                "verdict": verdict.level.key,
            }
            values |= {name: after[name] for name in names}
            values |= {f"new_{name}": int(after[name]) - int(before[name]) for name in names}
            text = (
                f"{described['name']}, serial {described['serial']}, {described['state']} at "
                f"{described['rate_hz']} Hz, clock {clock}"
            )
            if verdict.findings:
                make = bad if verdict.level is health.Level.TROUBLE else warning
                found = "; ".join(each.found for each in verdict.findings)
                why = "; ".join(dict.fromkeys(each.remedy for each in verdict.findings))
                yield make(f"{text}: {found}", why, **values)
            elif after["lost_samples"] or after["recoveries"]:
                lost = f"{after['lost_samples']} samples lost and {after['recoveries']} recoveries"
                why = f"none meanwhile; {_LOG}"
                yield note(f"{text}, {lost} since its start", why, **values)
            else:
                yield ok(f"{text}: {verdict.sentence[0].lower()}{verdict.sentence[1:]}", **values)

    def _summaries(self) -> tuple[dict[str, Any], str]:
        """What it sums up, and over which time."""
        return (self.after, "") if self._own else (self.after["last_10s"], " in the last 10 s")

    def wake_ups(self) -> Iterator[Finding]:
        """Its lateness."""
        missed, (summaries, _) = self.grown("missed_deadlines"), self._summaries()
        yield as_cause(wake_finding(summaries["wake_us"], missed, max(1, self.grown("cycles"))))

    def exchanges(self) -> Iterator[Finding]:
        """How long its exchanges take, and how many are lost."""
        summaries, when = self._summaries()
        lost, count = self.grown("lost_frames"), max(1, self.grown("cycles"))
        yield as_cause(exchange_finding(when, summaries["exchange_us"], lost, count))

    def ages(self) -> Iterator[Finding]:
        """The age of samples when the server sends them."""
        summaries, when = self._summaries()
        recent = [row["age_us"] for row in self.after["sensors"]] if self._own else summaries["age_us"]
        for position, summary in enumerate(recent):
            if not summary or not summary.get("max"):
                cannot_look("the server reports it once it follows the sensor's clock")
            how = "the server's estimate; a message to a client takes about 50 µs more"
            yield age_finding(f"sensor {position}, when sent{when}", summary, how)

    def clients(self) -> Iterator[Finding]:
        """The clients, and those that are too slow."""
        rows = self.after["clients"]
        before = {row["peer"]: row["withheld"] for row in self.before["clients"]}
        slow = [row for row in rows if row["withheld"] > before.get(row["peer"], 0)]
        values: dict[str, Any] = {"clients": rows}
        # The doctor itself is one of them.
        text = f"{len(rows) - 1} beside the doctor"
        if slow:
            names = ", ".join(str(row["peer"]) for row in slow)
            why = "it reads more slowly than the sensor samples, so the server withholds frames from it"
            yield note(f"{text}; too slow: {names}", why, **values)
        else:
            yield ok(f"{text}, none too slow", **values)

    def examine(self, subject: str, examine: Examine) -> Iterator[Finding]:
        """All checks."""
        yield from examine(subject, "sensors", self.sensors)
        yield from examine(subject, "wake-ups", self.wake_ups)
        yield from examine(subject, "exchanges", self.exchanges)
        yield from examine(subject, "age of data", self.ages)
        if not self._own:
            yield from examine(subject, "clients", self.clients)


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
        found: list[Slave] = []
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
            "measurement",
            "card meanwhile",
            lambda: rising(of_card, read_counters(machine.ifname)),
        )
        before = {slave.position: slave.counters for slave in found}

        def meanwhile() -> Iterator[Finding]:
            with open_bus(machine.ifname, allow_ip=machine.allow_ip) as bus:
                after = {position: read_error_counters(bus, position) for position in before}
            yield from new_errors(before, after, count)

        yield from examine("measurement", "bus meanwhile", meanwhile)


def _not_measured(why: str) -> Finding:
    return replace(skipped(why), subject="measurement", check="all")


def _slaves(machine: Machine, bus: Bus, found: list[Slave]) -> Generator[Finding, None, int]:
    """Those that answer, which are added to `found`; returns how many there are."""
    count = count_slaves(bus)
    yield from examine("bus", "slaves", functools.partial(answers, machine.shown, count))
    in_use = is_in_use(bus, count)
    for position in range(count):
        yield from _slave(bus, position, count, found, in_use=in_use)
    if len(found) == count:
        yield from examine("bus", "sensors", functools.partial(any_sensor, found))
        yield from examine("bus", "line", functools.partial(cabling, found))
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
        yield from scheduling(machine.rt_priority, real_time=sensors.real_time)

    yield from examine("measurement", "scheduling", watch)
    for view in views:
        yield from view.examine("measurement", examine)


def _slave(bus: Bus, position: int, count: int, found: list[Slave], *, in_use: bool) -> Iterator[Finding]:
    """One slave, which is added to `found` if it answers."""

    def identify() -> Iterator[Finding]:
        found.append(look_at_slave(bus, position, in_use=in_use))
        yield from identity(found[-1])

    yield from examine("bus", f"slave {position}", identify)
    if found and found[-1].position == position:
        yield from examine("bus", f"slave {position} state", functools.partial(al_state, found[-1]))
        yield from examine(
            "bus", f"slave {position} errors", functools.partial(error_counters, found[-1], count)
        )
