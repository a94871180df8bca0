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
from dataclasses import replace
from typing import Any, Final, NamedTuple

from bota_ethercat.address import Address
from bota_ethercat.framing import DataMessage
from bota_ethercat.health import sentences
from bota_ethercat.health.judge import judge
from bota_ethercat.health.limits import LIMITS, Level
from bota_ethercat.health.observer import StreamObserver, by_sensor
from bota_ethercat.program.command import command
from bota_ethercat.replies import DistributionStatus, Status
from ethercat_server.access.adapters import Holder, find_holder, links
from ethercat_server.access.private_server import open_interface
from ethercat_server.access.sensors import Sensors
from ethercat_server.acquisition.health import SLOW_US, cost
from ethercat_server.doctor.machine import Host
from ethercat_server.doctor.machine_checks import rising
from ethercat_server.doctor.report import (
    CannotLookError,
    CheckResult,
    bad,
    examine,
    finding,
    graded,
    note,
    ok,
    skipped,
    warning,
)
from ethercat_server.errors import InterfaceError, ServerError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.nic import CHECK_CABLE
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.sensor import models, scan
from ethercat_server.sensor.sensor import is_known_model

MOST_PORTS: Final = 4
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
        by_port = tuple(data[0:8:2]), tuple(data[1:8:2]), tuple(data[8:12])
        return cls(*by_port, data[12], data[13], tuple(data[16:20]))


class ExaminedSlave(NamedTuple):
    """One slave."""

    looked: scan.Slave  # without its SII if another master has the bus
    errors: bytes = bytes(reg.ERROR_COUNTERS_SIZE)  # the registers of its ErrorCounters
    watchdogs: int = 0  # number of expired process data watchdogs
    left_alone: bool = False  # its SII was not read, for another master has the bus

    @classmethod
    def read(cls, bus: Bus, position: int, *, in_use: bool) -> ExaminedSlave:
        """The slave at `position`; BusError if it does not answer. `in_use`: another master has the bus."""
        looked = scan.look_at(bus, position)
        return cls(
            looked if in_use else scan.with_sii(bus, looked),
            _read_errors(bus, position),
            bus.read_surely_at(position, reg.WATCHDOG_COUNTER, 1)[0],
            left_alone=in_use,
        )


def _read_errors(bus: Bus, position: int) -> bytes:
    return bus.read_surely_at(position, reg.RX_ERRORS, reg.ERROR_COUNTERS_SIZE)


def answers(ifname: str, count: int, silent: str = CHECK_CABLE) -> CheckResult:
    """Whether any slave answers; `silent` is the interface's part if none does, as of a `Backend`."""
    text = "no EtherCAT slave answers" if not count else f"{count} slave{'s' if count > 1 else ''} answer"
    why = silent
    if silent == CHECK_CABLE:
        why = (
            "check the sensor's power, that it is on the injector's LAN side, and that this is its interface"
        )
    return graded(
        text + "s" * (count == 1),
        (not count, bad, why, command(f"ethercat-sensor eeprom {ifname}")),
        slaves=count,
    )  # fmt: skip


def identity(slave: ExaminedSlave) -> CheckResult:
    """Identity, and whether the server supports it."""
    looked, al = slave.looked, slave.looked.status
    sii = looked.sii or {"name": "", "serial": 0, "vendor": 0, "product": 0}
    values = {key: sii[key] for key in ("name", "serial", "vendor", "product")}
    values |= {"sensor": looked.position, "al_state": al.state.name}
    values |= {"al_error": al.error, "al_status_code": al.code}
    if looked.at_work:
        return bad(
            f"not a Bota sensor, and in {al.state.name}: another master controls it",
            "the server does not start on this bus; use the interface that the sensor is connected to",
            **values,
        )
    if slave.left_alone:
        return warning(f"not read: in {al.state.name}, and another master has the bus", "", **values)
    if looked.problem:
        return warning(f"unknown: {looked.problem}", "its EEPROM does not answer", **values)
    text = f"{looked.name}, serial {sii['serial']}"
    if not looked.is_sensor:
        whose = f"vendor 0x{sii['vendor']:08X}, product 0x{sii['product']:08X}"
        return ok(f"{text}, {whose}: not a Bota Gen-0 sensor, the server leaves it alone", **values)
    if not is_known_model(sii["name"]):
        supported = ", ".join(models.MODELS)
        return bad(text, f"not supported by the server, which supports {supported}", **values)
    return ok(f"{text}, supported", **values)


def any_sensor(slaves: Sequence[ExaminedSlave]) -> Iterator[CheckResult]:
    """Whether there is a sensor among them."""
    may_be = (slave.looked.is_sensor or slave.left_alone or slave.looked.problem for slave in slaves)
    if slaves and not any(may_be):
        yield bad("no Bota Gen-0 sensor", "connect one, or name the interface that it is connected to")


def al_state(slave: ExaminedSlave) -> CheckResult:
    """Its AL state, which the doctor does not change."""
    al = slave.looked.status
    return graded(
        str(al) if al.error or al.state in _UNUSABLE else f"{al}, without error",
        (al.error and al.code == _WATCHDOG_CODE, note,
         "its last master ended without taking it to INIT (crash, cable); starting a server clears it"),
        (al.error, warning, "it reports an error: power it off and on"),
        (al.state in _UNUSABLE, bad, "a server cannot use it in this state: power it off and on"),
        al_state=al.state.name, al_status_code=al.code, watchdogs=slave.watchdogs,
    )  # fmt: skip


_UNUSABLE: Final = frozenset({AlState.NONE, AlState.BOOT})


def error_counters(slave: ExaminedSlave, count: int) -> CheckResult:
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
    if text:
        why = "unplugged, or a neighbor was power-cycled; otherwise check the connectors"
        return note(text, why, **values)
    return ok("none", **values)


def new_errors(before: Mapping[int, bytes], after: Mapping[int, bytes], count: int) -> CheckResult:
    """Errors counted during the measurement: registers by position, at its begin and its end."""
    new: dict[int, ErrorCounters] = {}
    for position, now in after.items():
        # Fewer than before: a master was started meanwhile, which clears them.
        grown = bytes(max(0, n - o) for o, n in zip(before[position], now, strict=True))
        new[position] = ErrorCounters.parse(grown)
    text = "; ".join(each for row in new.items() for each in _port_errors(*row, count))
    return graded(
        text or "no new errors",
        (text, bad, f"frames are being corrupted or links lost: {_CABLE}"),
        new={str(position): counters._asdict() for position, counters in new.items()},
    )


def _port_errors(position: int, counters: ErrorCounters, count: int) -> Iterator[str]:
    """Error counts of each port, with its cable. A counter saturates at 255."""
    for port in range(MOST_PORTS):
        where = _cable(position, port, count)
        if damaged := max(counters.invalid[port], counters.physical[port]):
            yield f"{_many(damaged)} corrupted {where}"
        if forwarded := counters.forwarded[port]:
            yield f"{_many(forwarded)} corrupted before reaching slave {position}, port {port}"
        if lost := counters.lost_links[port]:
            yield f"link lost {_many(lost)} times {where}"


def _many(number: int) -> str:
    return f"{number} or more" if number == 0xFF else str(number)


def _cable(position: int, port: int, count: int) -> str:
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
_STEADIER: Final = "see docs/tuning.md"


def points(summary: DistributionStatus) -> str:
    """Quantiles as text; CannotLookError if one is not known."""
    names = zip(("p50", "p99", "p99.9", "max"), summary, strict=True)
    if None in summary:
        raise CannotLookError("the server does not report it: install the same version of both")
    return ", ".join(f"{name} {value:.0f}" for name, value in names) + " µs"


def scheduling(priority: int, *, real_time: bool) -> CheckResult:
    """Scheduling of the loop."""
    return graded(
        f"SCHED_FIFO {priority}" if real_time else "ordinary scheduling",
        (not real_time and not priority, note, "as requested; other programs preempt it"),
        (not real_time, note,
         "real-time priority was not granted, so other programs preempt it: run with sudo, or as a service"),
        real_time=real_time,
    )  # fmt: skip


def wake_finding(summary: DistributionStatus, late: int, count: int) -> CheckResult:
    """The finding for a summary: `late` of `count` wake-ups were late by more than a sample period.

    It may be the cause of the verdict on the stream, and is not trouble itself.
    """
    text = f"late by {points(summary)}"
    return graded(
        f"{text}; {late} of {count} by more than a sample period" if late else text,
        (late, warning, f"each loses samples; other work, or a hypervisor, used the CPU: {_STEADIER}"),
        ((summary.p99 or 0) > _WAKE_WARNING_US, warning, f"increases the age of samples: {_STEADIER}"),
        ((summary.p99 or 0) > _WAKE_NOTE_US, note,
         f"usual without a real-time kernel; occasionally increases the age of samples: {_STEADIER}"),
        **{**summary._asdict(), "wake_ups": count, "later_than_a_period": late},
    )  # fmt: skip


def exchange_finding(when: str, summary: DistributionStatus, lost: int, count: int) -> CheckResult:
    """The finding for a summary: `lost` of `count` exchanges did not come back. A cause, too."""
    text = f"{points(summary)}{when}"
    return graded(
        f"{text}; {lost} frames lost of {count}" if lost else text,
        (lost, warning, "each may cost a sample: check the cable; a busy virtual machine loses frames, too"),
        ((summary.p50 or 0) > SLOW_US, warning,
         f"slow network card or driver: {cost(summary.p50 or 0)}; see coalescing"),
        ((summary.p99 or 0) > _EXCHANGE_NOTE_US, note,
         "network card, driver or load: see coalescing"),
        **{**summary._asdict(), "exchanges": count, "lost": lost},
    )  # fmt: skip


def age_finding(what: str, summary: DistributionStatus) -> CheckResult:
    """The finding for a summary of ages, by the limits of streams."""
    how = "the server's estimate; a message to a client takes about 50 µs more"
    p99_s = (summary.p99 or 0) * 1e-6
    old = f"occasionally more than a sample period ({how})"
    return graded(
        f"{what}: {points(summary)}",
        (p99_s >= LIMITS.age_error, bad, old),
        (p99_s >= LIMITS.age_warn, warning, old),
        (p99_s * 1e6 > _PERIOD_US, note, old),
        why=how, **summary._asdict(),
    )  # fmt: skip


_LOG: Final = "see the server's log (journalctl -u 'ethercat-server@*')"
_COUNTS: Final = ("fresh", "repeated", "invalid", "lost_samples", "recoveries")


def increase(before: int | None, after: int | None) -> int:
    """That of a counter; 0 if it is not known, or the server was started anew."""
    return 0 if before is None or after is None else max(0, after - before)


class ServerView:
    """The stream and the `status` of a server over the measuring time."""

    def __init__(self, sensors: Sensors, seconds: float) -> None:
        """Watch for `seconds`, then close `sensors`. A private server's figures are those since its start."""
        self.own, clock, private = sensors.private is not None, sensors.clock, sensors.private
        with contextlib.closing(sensors):
            self._observers = {
                info.sensor: StreamObserver(info.rate_hz, clock.monotonic_ns())
                for info in sensors.describe().sensors
            }
            self.before = self._read_status(sensors)
            end = Deadline(clock, seconds)
            for frames in sensors.stream(fresh_only=False) if seconds else ():
                self._observe(frames, clock.monotonic_ns(), same_machine=sensors.client.session.same_machine)
                unread = sensors.client.take_unread()
                for each in self._observers.values():
                    each.note_unread(unread, clock.monotonic_ns())
                if end.passed:
                    sensors.ask("unsubscribe")
                    break
            self.real_time = private is not None and private.real_time
            self._end_ns = clock.monotonic_ns()
            self.after = self._read_status(sensors)
            self.described = sensors.describe().sensors
        for position, observer in self._observers.items():
            observer.in_force = sensors.client.session.timeline[position]
        self._when = "" if self.own else " in the last 10 s"
        self._summaries = self.after if self.own else self.after.last_10s

    def _read_status(self, sensors: Sensors) -> Status:
        status = sensors.status()
        for position, observer in self._observers.items():
            observer.add_status(status, position, sensors.clock.monotonic_ns())
        return status

    def _observe(self, frames: Sequence[DataMessage], now_ns: int, *, same_machine: bool) -> None:
        for position, batch in by_sensor(frames).items():
            if position in self._observers:
                self._observers[position].add_frames(batch, now_ns)
                if same_machine:
                    self._observers[position].note_age(batch[-1], now_ns)

    def _grown(self, name: str) -> int:
        return increase(getattr(self.before, name), getattr(self.after, name))

    def sensors(self) -> Iterator[CheckResult]:
        for info in self.described:
            if (observer := self._observers.get(info.sensor)) is None:
                continue  # it was not there before
            before, after = self.before.find(info.sensor), self.after.find(info.sensor)
            verdict = judge(observer.observation(self._end_ns))
            clock = after.clock.mode or "unknown"
            values: dict[str, Any] = {name: getattr(after, name) for name in _COUNTS}
            values |= {f"new_{name}": increase(getattr(before, name), values[name]) for name in _COUNTS}
            values |= {"serial": info.serial, "state": info.state, "sensor": info.sensor}
            values |= {"clock": clock, "verdict": verdict.level.key}
            text = f"{info.name}, serial {info.serial}, {info.state} at {info.rate_hz:g} Hz, clock {clock}"
            if verdict.findings:
                found = "; ".join(each.found for each in verdict.findings)
                why = "; ".join(dict.fromkeys(each.remedy for each in verdict.findings))
                yield finding(max(verdict.level, Level.LOOK), f"{text}: {found}", why, **values)
            elif after.lost_samples or after.recoveries:
                lost = f"{after.lost_samples} samples lost and {after.recoveries} recoveries"
                yield note(f"{text}, {lost} since its start", f"none meanwhile; {_LOG}", **values)
            else:
                yield ok(f"{text}: {verdict.sentence[0].lower()}{verdict.sentence[1:]}", **values)
            past, overloaded = sentences.overload(after)
            if overloaded:
                yield note(f"sensor {info.sensor} {past}", "have it checked")

    def wake_ups(self) -> CheckResult:
        late, count = self._grown("missed_deadlines"), max(1, self._grown("cycles"))
        return wake_finding(self._summaries.wake_us, late, count)

    def exchanges(self) -> CheckResult:
        lost, count = self._grown("lost_frames"), max(1, self._grown("cycles"))
        return exchange_finding(self._when, self._summaries.exchange_us, lost, count)

    def ages(self) -> Iterator[CheckResult]:
        for row in self.after.sensors:
            summary = row.age_us if self.own else self.after.recent_age_us(row.sensor)
            if not summary.max:
                raise CannotLookError("the server reports it once it follows the sensor's clock")
            yield age_finding(f"sensor {row.sensor}, when sent{self._when}", summary)

    def clients(self) -> CheckResult:
        rows = self.after.clients
        before = {row.peer: row.withheld for row in self.before.clients}
        slow = [row.peer for row in rows if increase(before.get(row.peer, 0), row.withheld)]
        # The doctor itself is one of them.
        return graded(
            f"{len(rows) - 1} beside the doctor; too slow: {', '.join(slow) or 'none'}",
            (slow, note,
             "it reads more slowly than the sensor samples, so the server withholds frames from it"),
            clients=[row._asdict() for row in rows],
        )  # fmt: skip


def watched(
    subject: str, check: str, open_sensors: Callable[[], Sensors], seconds: float,
    describe: Callable[[ServerView], CheckResult],
) -> Iterator[CheckResult]:  # fmt: skip
    """The checks of a server's figures; `describe` is the first one."""
    views: list[ServerView] = []

    def watch() -> CheckResult:
        views.append(ServerView(open_sensors(), seconds))
        return describe(views[0])

    yield from examine(subject, check, watch)
    for view in views:
        yield from examine(subject, "sensors", view.sensors)
        yield from examine(subject, "wake-ups", view.wake_ups)
        yield from examine(subject, "exchanges", view.exchanges)
        yield from examine(subject, "age of data", view.ages)
        if not view.own:
            yield from examine(subject, "clients", view.clients)


def examine_bus(machine: Host, seconds: float, announce: Callable[[str], None]) -> Iterator[CheckResult]:
    """The bus itself, or the figures of its server; and the measurement. `announce` is told the progress."""
    holder, found = find_holder(machine.ifname), None
    if holder is not None and holder.address is not None:
        if seconds:
            announce(f"watching the server for {seconds:g} s ...")
        yield from _through_server(holder, holder.address, seconds)
        return
    if holder is not None and holder.pid is not None:
        text = f"{holder} uses it as an EtherCAT master and serves no port"
        found = bad(text, "two masters disturb each other: stop it", f"sudo kill {holder.pid}")
    elif holder is not None:
        found = skipped(
            "an EtherCAT master of another user, or outside of this container, has it: "
            "run with sudo, or on the host, to see which"
        )
    elif isinstance(unknown := machine.facts.get("link"), CannotLookError):
        found = skipped(str(unknown))
    if found is None:
        yield from _on_bus(machine, seconds, announce)
    else:
        yield from _left_alone(found)


def _left_alone(found: CheckResult) -> Iterator[CheckResult]:
    yield replace(found, subject="bus", check="slaves")
    yield _not_measured("the bus is not accessed")


def _not_measured(why: str) -> CheckResult:
    return skipped(why, subject="measurement", check="all")


def _through_server(holder: Holder, address: Address, seconds: float) -> Iterator[CheckResult]:
    """What the server that uses the interface says."""

    def describe(view: ServerView) -> CheckResult:
        why = "the bus is not accessed while it streams; these are the server's figures"
        hours = (view.after.uptime_s or 0.0) / 3600
        return ok(f"{holder} serves it at {address}, up {hours:.1f} h", why, **address._asdict())

    yield from watched("server", "server", lambda: Sensors.through(address), seconds, describe)


def _on_bus(machine: Host, seconds: float, announce: Callable[[str], None]) -> Iterator[CheckResult]:
    """The slaves, as they are; then what a server of the doctor's own measures, and the new errors."""
    of_card, found = _card_counters(machine.ifname), list[ExaminedSlave]()
    try:
        with open_interface(machine.ifname, allow_ip=machine.allow_ip) as bus:
            count = yield from _slaves(machine, bus, found)
    except InterfaceError as error:  # the server would refuse it as well
        yield from _left_alone(skipped(str(error)))
        return
    except ServerError as error:
        yield replace(bad(str(error)), subject="bus", check="slaves")
        return
    if not seconds:
        yield _not_measured("disabled by --seconds 0")
        return
    if not any(slave.looked.is_sensor for slave in found) or any(slave.left_alone for slave in found):
        yield _not_measured("there is no sensor to measure with, or another master has the bus")
        return
    announce(f"measuring for {seconds:g} s ...")
    open_sensors = functools.partial(
        Sensors.on_interface, machine.ifname,
        allow_ip=machine.allow_ip, rt_priority=machine.rt_priority, cpu=machine.cpu,
    )  # fmt: skip
    yield from watched(
        "measurement", "scheduling", open_sensors, seconds,
        lambda view: scheduling(machine.rt_priority, real_time=view.real_time),
    )  # fmt: skip

    def meanwhile() -> CheckResult:
        before = {slave.looked.position: slave.errors for slave in found}
        with open_interface(machine.ifname, allow_ip=machine.allow_ip) as bus:
            return new_errors(before, {position: _read_errors(bus, position) for position in before}, count)

    now = _card_counters(machine.ifname)
    yield from examine("measurement", "card meanwhile", rising, of_card, now)
    yield from examine("measurement", "bus meanwhile", meanwhile)


def _card_counters(ifname: str) -> Mapping[str, int]:
    """The present counters of the interface; empty if they cannot be read."""
    with contextlib.suppress(OSError, struct.error):
        return next((row.counters for row in links() if row.name == ifname), {})
    return {}


def _slaves(machine: Host, bus: Bus, found: list[ExaminedSlave]) -> Generator[CheckResult, None, int]:
    """Those that answer, which are added to `found`; returns how many there are."""
    count = bus.count_slaves()
    silent = CHECK_CABLE if count else bus.backend.why_silent()
    yield from examine("bus", "slaves", answers, machine.shown, count, silent)
    in_use = any(scan.look_at(bus, position).at_work for position in range(count))
    for position in range(count):

        def identify(position: int = position) -> CheckResult:
            found.append(ExaminedSlave.read(bus, position, in_use=in_use))
            return identity(found[-1])

        yield from examine("bus", f"slave {position}", identify)
        if found and found[-1].looked.position == position:
            yield from examine("bus", f"slave {position} state", al_state, found[-1])
            yield from examine("bus", f"slave {position} errors", error_counters, found[-1], count)
    if len(found) == count:
        yield from examine("bus", "sensors", any_sensor, found)
    return count
