"""The figures and clients of a server that uses the interface, instead of the bus."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from ethercat_server.doctor.finding import Finding, bad, cannot_look, note, ok, warning
from ethercat_server.doctor.verdict import age_finding, exchange_finding, wake_finding
from ethercat_server.errors import ServerError
from ethercat_server.links.remote import ServerLink
from protocol.address import Address

Examine = Callable[[str, str, Callable[[], Iterator[Finding]]], Iterator[Finding]]


class ServerView:
    """The `status` of a server before and after the measuring time."""

    def __init__(self, address: Address, holder: str, seconds: float) -> None:
        """ServerError if it does not answer."""
        self.holder, self.address = holder, address
        link = ServerLink(address)
        try:
            self.described: list[dict[str, Any]] = link.ask("describe")["sensors"]
            self.before: dict[str, Any] = link.ask("status")
            link.clock.sleep(seconds)
            self.after: dict[str, Any] = link.ask("status")
        finally:
            link.close()
        rows = [*self.described, *self.before["sensors"], *self.after["sensors"]]
        if not all(isinstance(row, dict) for row in rows):
            raise ServerError("the server's reply is not understood: install the same version of both")

    def grown(self, name: str) -> int:
        """Increase of a counter."""
        return int(self.after[name]) - int(self.before[name])

    def server(self) -> Iterator[Finding]:
        """The server itself."""
        why = "the bus is not accessed while it streams; these are the server's figures"
        hours = float(self.after["uptime_s"]) / 3600
        yield ok(
            f"{self.holder} serves it at {self.address}, up {hours:.1f} h", why, **self.address._asdict()
        )

    def sensors(self) -> Iterator[Finding]:
        """Each sensor: state, clock, losses."""
        for position, described in enumerate(self.described):
            before, after = self.before["sensors"][position], self.after["sensors"][position]
            clock = after["clock"]["mode"]
            names = ("fresh", "repeated", "invalid", "lost_samples", "recoveries")
            new = {name: int(after[name]) - int(before[name]) for name in names}
            values: dict[str, Any] = {
                "sensor": position,
                "serial": described["serial"],
                "state": described["state"],
                "clock": clock,
            }
            values |= {name: after[name] for name in names} | {f"new_{name}": new[name] for name in names}
            text = (
                f"{described['name']}, serial {described['serial']}, {described['state']} at "
                f"{described['rate_hz']} Hz, clock {clock}"
            )
            log = "see the server's log (journalctl -u 'ethercat-server@*')"
            if described["state"] != "OP" or new["invalid"]:
                yield bad(f"{text}, no valid process data", f"the sensor is lost: {log}", **values)
            elif new["lost_samples"] or new["recoveries"]:
                lost = f"{new['lost_samples']} samples lost meanwhile, {new['recoveries']} recoveries"
                yield warning(f"{text}, {lost}", f"wake-ups, exchanges or the cable: {log}", **values)
            elif clock != "locked":
                why = "its samples are polled, which takes more exchanges and makes time stamps less accurate"
                yield note(text, why, **values)
            elif after["lost_samples"] or after["recoveries"]:
                lost = (
                    f"{after['lost_samples']} samples lost and {after['recoveries']} recoveries since "
                    "its start"
                )
                yield note(f"{text}, {lost}", f"none meanwhile; {log}", **values)
            else:
                yield ok(f"{text}, nothing lost", **values)

    def wake_ups(self) -> Iterator[Finding]:
        """The server's lateness in the last ten seconds."""
        missed = self.grown("missed_deadlines")
        yield wake_finding(self.after["last_10s"]["wake_us"], missed, max(1, self.grown("cycles")))

    def exchanges(self) -> Iterator[Finding]:
        """The server's exchanges in the last ten seconds."""
        summary = self.after["last_10s"]["exchange_us"]
        lost, count = self.grown("lost_frames"), max(1, self.grown("cycles"))
        text = "".join(f"{name} {summary[key]:.0f}, " for name, key in (("p50", "p50"), ("p99", "p99")))
        yield exchange_finding(f"{text}max {summary['max']:.0f} µs in the last 10 s", summary, lost, count)

    def ages(self) -> Iterator[Finding]:
        """The age of samples when the server sends them."""
        for position, summary in enumerate(self.after["last_10s"]["age_us"]):
            if not summary or not summary.get("max"):
                cannot_look("the server reports it once it follows the sensor's clock")
            how = "the server's estimate; a message to a client takes about 50 µs more"
            yield age_finding(f"sensor {position}, when sent in the last 10 s", summary, how)

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

    def examine(self, examine: Examine) -> Iterator[Finding]:
        """All checks."""
        yield from examine("server", "server", self.server)
        yield from examine("server", "sensors", self.sensors)
        yield from examine("server", "wake-ups", self.wake_ups)
        yield from examine("server", "exchanges", self.exchanges)
        yield from examine("server", "age of data", self.ages)
        yield from examine("server", "clients", self.clients)
