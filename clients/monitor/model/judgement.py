"""What the judge of streams says of one sensor, second by second, and what it said before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from clients.monitor.model.state import Alert
from protocol.framing import DataMessage
from protocol.health.judge import Observation, emergency, judge, saturated_axes
from protocol.health.limits import LIMITS
from protocol.health.observer import StreamObserver
from protocol.health.verdict import NOTHING_WRONG, Finding
from protocol.text.json_text import JsonObject
from protocol.text.untrusted import number, text, whole

WINDOW_S: Final = 1.0
"""What a verdict looks back on."""


class Judgement:
    """Judges whenever something comes, so that nothing is missed between two looks."""

    def __init__(self) -> None:
        self.verdict = NOTHING_WRONG
        self.saturated: list[str] = []
        """The axes that are."""
        self._row: JsonObject = {}
        self._status: JsonObject = {}
        self._observer: StreamObserver | None = None
        """None before the first description."""
        self._grown: dict[str, tuple[int, float]] = {}
        """By how much and when what `status` counts last grew; when the connection was last interrupted."""
        self._now: tuple[Finding, ...] = ()
        """The findings of the newest verdict, with the server's words."""
        self._emergency = "", 0.0
        self._emergencies: int | None = 0
        """How many the sensor had sent when `_emergency` was the last one."""
        self._seen: dict[str, tuple[Finding, float]] = {}
        """All findings since the reset, each at its worst, and when it was last there."""

    def reset(self) -> None:
        """Forget what is past."""
        self._seen, self._grown, self._emergency = {}, {}, ("", 0.0)
        if self._observer is not None:
            self._observer.forget()

    def describe(self, row: JsonObject, now_s: float) -> None:
        """Take the sensor's row of `describe`."""
        names = ("rate_hz", "serial")
        changed = any(row.get(name) != self._row.get(name) for name in names)
        self._row = row
        if changed or self._observer is None:
            self._begin(now_s)

    def restart(self, now_s: float, *, again: bool) -> None:
        """The monitor has connected; `again`: not for the first time."""
        self._status = {}
        self._begin(now_s)
        if again:
            self._grown["reconnects"] = 1, now_s

    def _begin(self, now_s: float) -> None:
        rate_hz = number(self._row.get("rate_hz")) or 0.0
        self._observer = StreamObserver(rate_hz, _ns(now_s), window_ns=_ns(WINDOW_S))

    def take_status(self, row: JsonObject, now_s: float) -> None:
        """Take the sensor's row of `status`, with the server's missed deadlines."""
        for name in ("not_finite", "recoveries", "missed_deadlines"):
            before, after = whole(self._status.get(name)), whole(row.get(name))
            if before is not None and after is not None and after > before:
                self._grown[name] = after - before, now_s
        count, last = whole(row.get("emergencies")), row.get("emergency")
        if count != self._emergencies and isinstance(last, dict):
            ago_s = number(last.get("ago_s")) or 0.0
            self._emergencies, self._emergency = count, (emergency(last), now_s - ago_s)
        self._status = row

    def take(self, frames: Sequence[DataMessage], now_s: float, *, lost: str | None) -> None:
        """Frames of this sensor as they came, oldest first."""
        if self._observer is not None:
            self._observer.take(frames, _ns(now_s))
        self.judge(now_s, lost=lost)

    def note_age(self, frame: DataMessage, now_ns: int) -> None:
        """This frame arrived exactly at this CLOCK_MONOTONIC."""
        if self._observer is not None:
            self._observer.note_age(frame, now_ns)

    def judge(self, now_s: float, *, lost: str | None) -> None:
        """Judge the second up to now. `lost`: the server's words of why it has lost the sensor, if it has."""
        seen = self._observation(now_s, is_lost=lost is not None)
        self.verdict = judge(seen)
        self.saturated = [axis for axes in saturated_axes(seen).values() for axis in axes]
        self._now = tuple(_explained(finding, lost) for finding in self.verdict.findings)
        for finding in self._now:
            known, _ = self._seen.get(finding.key, (finding, 0.0))
            worst = max(finding, known, key=lambda one: (one.level, one.size))
            self._seen[finding.key] = worst, now_s

    def _observation(self, now_s: float, *, is_lost: bool) -> Observation:
        if self._observer is None:
            return Observation()
        clock: Any = self._status.get("clock")
        mode = clock.get("mode") if isinstance(clock, dict) else None
        settings = self._row.get("settings")
        said, at_s = self._emergency
        grown = {name: by for name, (by, then_s) in self._grown.items() if now_s - then_s < WINDOW_S}
        seen = self._observer.observation(_ns(now_s))
        return seen._replace(
            not_finite=seen.not_finite + ("not_finite" in grown),
            recoveries=int("recoveries" in grown),
            missed_deadlines=grown.get("missed_deadlines", 0),
            reconnects=int("reconnects" in grown),
            locked=None if mode is None else mode == "locked",
            is_lost=is_lost,
            state=text(self._row.get("state")),
            emergency=said if now_s - at_s < LIMITS.emergency_s else "",
            settings=settings if isinstance(settings, dict) else {},
        )

    def alerts(self, now_s: float, *, present: bool) -> list[Alert]:
        """What is there now, if `present`, the worst first; then what is past, the latest first."""
        now = self._now if present else ()
        keys = {finding.key for finding in now}
        past = [entry for key, entry in self._seen.items() if key not in keys]
        past.sort(key=lambda entry: -entry[1])
        return [
            *(Alert(finding.level, finding.found, finding.remedy, None) for finding in now),
            *(Alert(finding.level, finding.found, finding.remedy, now_s - at_s) for finding, at_s in past),
        ]


def _explained(finding: Finding, lost: str | None) -> Finding:
    """With the server's words of why it has lost the sensor, which may say what to do."""
    if lost is None or finding.key != "silence":
        return finding
    return finding._replace(remedy=lost if "check " in lost else f"{finding.remedy} ({lost})")


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
