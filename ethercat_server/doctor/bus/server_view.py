"""What a server measures: the one that uses the interface, or the doctor's own.

Its stream is judged as every client's; its wake-ups, exchanges and ages may be the cause of what is found.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from typing import Any, Final

from ethercat_server.access.sensors import Sensors
from ethercat_server.doctor.finding import Finding, bad, cannot_look, note, ok, warning
from ethercat_server.doctor.verdict import age_finding, as_cause, exchange_finding, wake_finding
from ethercat_server.errors import ServerError
from protocol.control import Event
from protocol.framing import DataMessage
from protocol.health import verdict as health
from protocol.health.judge import Observation, emergency, judge
from protocol.health.observer import StreamObserver
from protocol.text.untrusted import number

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
