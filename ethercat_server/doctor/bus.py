"""What is said of the slaves that were found: who they are, their states, where errors arise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from ethercat_server import objects
from ethercat_server.al import AlState
from ethercat_server.doctor.finding import Finding, bad, note, ok, warning
from ethercat_server.doctor.slaves import MOST_PORTS, ErrorCounters, Slave
from ethercat_server.sensor import is_known_model

_WATCHDOG_CODE: Final = 0x001B
_CABLE: Final = "check the cable, its plugs and shield, and what runs beside it"


def answers(ifname: str, count: int) -> Iterator[Finding]:
    """Whether anything is there."""
    if count:
        yield ok(f"{count} {'slave answers' if count == 1 else 'slaves answer'}", slaves=count)
        return
    yield bad(
        "no EtherCAT slave answers",
        "check that the sensor has power, that it is connected with its LAN side, and that this is "
        "its interface",
        f"ethercat-sensor eeprom {ifname}", slaves=0,
    )  # fmt: skip


def identity(slave: Slave) -> Iterator[Finding]:
    """Who it is, and whether the server knows it."""
    values = slave.as_json()
    if slave.sii_problem:
        yield warning(f"unknown: {slave.sii_problem}", "its EEPROM does not answer", **values)
        return
    text = f"{slave.name or 'nameless'}, serial {slave.serial}"
    if (slave.vendor, slave.product) != (objects.VENDOR_ID, objects.PRODUCT_CODE):
        yield bad(
            f"{text}, vendor 0x{slave.vendor:08X}, product 0x{slave.product:08X}",
            "not a Bota Gen-0 sensor, and the server starts only where all are: connect only such sensors",
            **values,
        )
    elif not is_known_model(slave.name):
        yield bad(text, "a model the server does not know: it knows " + ", ".join(objects.MODELS), **values)
    else:
        yield ok(f"{text}, a model the server knows", **values)


def line(slaves: Sequence[Slave]) -> Iterator[Finding]:
    """Whether something is connected that does not answer: cables have two ends, one is the interface's."""
    if not slaves:
        return
    values: dict[str, Any] = {"links": [list(slave.links) for slave in slaves]}
    linked = [f"port {port} of slave {slave.place}" for slave in slaves for port in _ports(slave)]
    if len(linked) > 2 * len(slaves) - 1:
        yield note(
            f"more links than slaves: {', '.join(linked)}",
            "something behind them does not answer: no EtherCAT slave, or one that is still starting",
            **values,
        )
    else:
        yield ok("a slave at the end of every link", **values)


def _ports(slave: Slave) -> list[int]:
    """Those with a link."""
    return [port for port, on in enumerate(slave.links) if on]


def state(slave: Slave) -> Iterator[Finding]:
    """Its AL state, which the doctor leaves as it is."""
    values: dict[str, Any] = {
        "al_state": slave.al.state.name,
        "al_status_code": slave.al.code,
        "watchdogs": slave.watchdogs,
    }
    text = str(slave.al)
    if slave.al.error and slave.al.code == _WATCHDOG_CODE:
        why = (
            "its last master stopped without taking it to INIT (a crash, a pulled cable); a server's "
            "start clears it"
        )
        yield note(text, why, **values)
    elif slave.al.error:
        yield warning(text, "it reports an error: power it off and on", **values)
    elif slave.al.state in {AlState.NONE, AlState.BOOT}:
        yield bad(text, "a server cannot use it there: power it off and on", **values)
    else:
        yield ok(f"{text}, without error", **values)


def errors(slave: Slave, count: int) -> Iterator[Finding]:
    """What its ESC has counted, since it was switched on or since a master last started."""
    values = slave.counters.as_json()
    texts = [
        text for port in range(MOST_PORTS) for text in _port_errors(slave.place, port, slave.counters, count)
    ]
    own = [n for name in ("invalid", "physical") for n in getattr(slave.counters, name)]
    if any(own):
        yield warning(
            "; ".join(texts),
            f"frames were damaged there since power-on or a master's last start: {_CABLE}",
            **values,
        )  # fmt: skip
    elif slave.counters.processing_unit or slave.counters.pdi:
        text = f"processing unit {slave.counters.processing_unit}, PDI {slave.counters.pdi}"
        yield note(
            text, "frames the slave could not make sense of, or errors of its own electronics", **values
        )
    elif any(slave.counters.forwarded):
        yield note(
            "; ".join(texts), "damage that arose before it; the slave that says so shows where", **values
        )
    elif any(slave.counters.lost_links):
        why = "plugged, or a neighbour switched off and on; if nobody did, check the plugs"
        yield note("; ".join(texts), why, **values)
    else:
        yield ok("none", **values)


def new_errors(
    before: Mapping[int, ErrorCounters], after: Mapping[int, ErrorCounters], count: int
) -> Iterator[Finding]:
    """What was counted while the doctor measured."""
    texts: list[str] = []
    values: dict[str, Any] = {}
    for place, now in after.items():
        new = _difference(before[place], now)
        values[str(place)] = new.as_json()
        texts += [text for port in range(MOST_PORTS) for text in _port_errors(place, port, new, count)]
    if texts:
        yield bad("; ".join(texts), f"frames are being damaged or links lost now: {_CABLE}", new=values)
    else:
        yield ok("the slaves counted no new errors", new=values)


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


def _port_errors(place: int, port: int, counters: ErrorCounters, count: int) -> Iterator[str]:
    """What one port has counted, and where that is. A counter that has come to its end may have been more."""
    where = cable(place, port, count)
    damaged = max(counters.invalid[port], counters.physical[port])
    if damaged:
        yield f"{_many(damaged)} damaged {where}"
    if counters.forwarded[port]:
        yield f"{_many(counters.forwarded[port])} damaged before it came to slave {place}, port {port}"
    if counters.lost_links[port]:
        yield f"link lost {_many(counters.lost_links[port])} times {where}"


def _many(number: int) -> str:
    return f"{number} or more" if number == 0xFF else str(number)


def cable(place: int, port: int, count: int) -> str:
    """Which cable is at a port of a slave in a line of `count`."""
    if port == 0:
        return f"between {f'slave {place - 1}' if place else 'the interface'} and slave {place}"
    if port == 1 and place + 1 < count:
        return f"between slave {place} and slave {place + 1}"
    return f"at port {port} of slave {place}"
