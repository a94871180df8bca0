"""Findings about slaves: identity, AL state, error counters and the cable they point to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from ethercat_server.doctor.bus.slaves import MOST_PORTS, ErrorCounters, Slave
from ethercat_server.doctor.finding import Finding, bad, note, ok, warning
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.sensor import is_known_model

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


def sensors(slaves: Sequence[Slave]) -> Iterator[Finding]:
    """Whether there is a sensor among them."""
    if slaves and not any(slave.is_sensor or slave.left_alone or slave.sii_problem for slave in slaves):
        yield bad("no Bota Gen-0 sensor", "connect one, or name the interface that it is connected to")


def line(slaves: Sequence[Slave]) -> Iterator[Finding]:
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


def state(slave: Slave) -> Iterator[Finding]:
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


def errors(slave: Slave, count: int) -> Iterator[Finding]:
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
