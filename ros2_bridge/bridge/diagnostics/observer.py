"""Sums up what reader and server know into snapshots, and keeps what "since the last report" means."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

from bridge.diagnostics.compensation_state import CompensationState
from bridge.stream.frame_selector import FrameCounts
from bridge.stream.link import Link, SensorInfo
from bridge.stream.reader import Reader
from bridge.stream.watch import Flags
from protocol.errors import ConnectionFailedError
from protocol.health.judge import Observation, emergency
from protocol.health.observer import p99
from protocol.text.json_text import JsonObject

_SHORTEST_RATE_S: Final = 0.8
"""A rate measured over less time than this says little."""
SLOW_ANSWER_S: Final = 2.0
"""A server that owes an answer for this time is stopped or overloaded."""


class Snapshot(NamedTuple):
    """What is known at one moment. "New" is since the last regular report."""

    sensor: int
    address: str
    connected: bool
    problem: str
    is_reachable: bool
    """Whether there is a server there, connected or not."""
    connection_s: float
    """How long there has been, or has not been, a connection."""
    connects: int
    new_connects: int
    info: SensorInfo | None
    lost: str | None
    silent_s: float
    """Since the last new sample, or since the connection was made."""
    rate_hz: float | None
    """Measured; None while that is not possible yet."""
    expected_hz: float
    age_us: tuple[float, float] | None
    """p50 and p99; None without samples or where the server's clock is another machine's."""
    counts: FrameCounts
    new: FrameCounts
    not_finite: int
    new_not_finite: int
    flags: Flags
    temperature: float | None
    server: Mapping[str, Any]
    """The latest `status` reply of this connection; empty if there is none yet."""
    new_server: ServerCounts
    answer_s: float
    """How long the server has owed an answer; 0 if it owes none."""
    settings: Mapping[str, object] = {}
    """The sensor's settings, as far as they are known."""
    saturated: int = 0
    new_saturated: int = 0
    """Samples whose force or torque was saturated."""
    compensation: CompensationState = CompensationState()
    new_withheld: int = 0
    """Samples that could not be compensated."""

    @property
    def observation(self) -> Observation:
        """The same as every judge of a stream wants it."""
        mode = mapping(self.server_row.get("clock")).get("mode")
        return Observation(
            seconds=1.0,
            samples=self.new.new,
            lost=max(self.new.missing, self.new_server.lost_samples),
            repeated=self.new.repeated,
            invalid=self.new.invalid,
            silent_s=self.silent_s,
            rate_hz=self.rate_hz,
            nominal_hz=self.expected_hz,
            age_p99_us=None if self.age_us is None else self.age_us[1],
            # The node checks those that it publishes, the server all.
            not_finite=max(self.new_not_finite, self.new_server.not_finite),
            warnings=self.flags.warnings,
            force_torque_saturated=self.flags.force_torque_saturated,
            acceleration_saturated=self.flags.acceleration_saturated,
            angular_rate_saturated=self.flags.angular_rate_saturated,
            temperature=self.temperature,
            locked=None if mode is None else mode == "locked",
            recoveries=self.new_server.recoveries,
            missed_deadlines=self.new_server.missed_deadlines,
            reconnects=self.new_connects if self.connects > 1 else 0,
            is_lost=self.lost is not None,
            state="?" if self.info is None else self.info.state,
            server_silent=self.answer_s > SLOW_ANSWER_S / 2,
            emergency=emergency(self.server_row.get("emergency")),
            settings=self.settings,
        )

    @property
    def server_row(self) -> Mapping[str, Any]:
        """Our sensor's row of `server`; empty if it has none."""
        return row_of(self.server.get("sensors"), self.sensor)


def mapping(value: object) -> Mapping[str, Any]:
    """`value` if it is a JSON object, else an empty one: the server's word is not trusted to have a form."""
    return value if isinstance(value, dict) else {}


def row_of(rows: object, position: int) -> Mapping[str, Any]:
    """The object at `position` of a JSON list; empty if there is none."""
    return mapping(rows[position] if isinstance(rows, list) and position < len(rows) else None)


class ServerCounts(NamedTuple):
    """What the server itself has counted, of our sensor or at all, by the names in `status`."""

    lost_samples: int = 0
    not_finite: int = 0
    recoveries: int = 0
    missed_deadlines: int = 0

    @classmethod
    def of(cls, status: Mapping[str, Any], position: int) -> ServerCounts:
        """Those in a `status` reply; 0 for what it does not say."""
        row = {**status, **row_of(status.get("sensors"), position)}
        return cls(*(value if type(value := row.get(name)) is int else 0 for name in cls._fields))

    def since(self, then: ServerCounts | None) -> ServerCounts:
        """What was added since `then`, if that is known."""
        if then is None:
            return ServerCounts()
        return ServerCounts(*(max(now - before, 0) for now, before in zip(self, then, strict=True)))


class ServerStatus:
    """Polls the server's `status` and `describe`: `ask` once a second, `collect` often. It never waits."""

    def __init__(self) -> None:
        self.status: Mapping[str, Any] = {}
        self._link: Link | None = None
        self._connects = 0
        self._waiting: dict[str, Future[JsonObject]] = {}
        self._asked_s = 0.0

    def collect(self, link: Link) -> JsonObject | None:
        """Take what was answered; returns a `describe` reply, once."""
        if not link.is_connected or link.connects != self._connects:
            self._connects, self.status, self._waiting = link.connects, {}, {}
        self._link = link
        described = None
        for action in [action for action, reply in self._waiting.items() if reply.done()]:
            reply = self._waiting.pop(action)
            if reply.exception() is not None or reply.result().get("ok") is not True:
                continue
            if action == "status":
                self.status = reply.result()
            else:
                described = reply.result()
        return described

    def ask(self, now_s: float) -> None:
        """Ask again, unless an answer is still owed."""
        if self._link is None or not self._link.is_connected or self._waiting:
            return
        self._asked_s = now_s
        try:
            for action in ("status", "describe"):
                self._waiting[action] = self._link.client.request(action)
        except ConnectionFailedError:
            self._waiting = {}  # the reader will notice

    def owed_s(self, now_s: float) -> float:
        """How long an answer has been owed."""
        return now_s - self._asked_s if self._waiting else 0.0


class Observer:
    """Call `look` often; after a regular report call `begin_interval`."""

    def __init__(self, reader: Reader, compensation: Callable[[], CompensationState]) -> None:
        """`compensation` tells how it is."""
        self._reader, self._link, self._compensation = reader, reader.link, compensation
        self._poll = ServerStatus()
        self._flags = Flags()
        self._age_us: tuple[float, float] | None = None
        self._rate_hz: float | None = None
        self._fresh, self._fresh_s, self._epoch = 0, self._link.clock.monotonic(), -1
        """The last number of fresh samples, when it changed, and the link's epoch."""
        self._rate_fresh, self._rate_s, self._rate_ns = 0, self._fresh_s, -1
        """Where the rate is measured from: samples, time here, and the newest one's stamp."""
        self._then, self._then_not_finite = FrameCounts(), 0
        self._then_connects = self._then_withheld = self._then_saturated = 0
        self._then_server: ServerCounts | None = None

    def look(self, now_s: float) -> Snapshot:
        """How things are now."""
        link, reader = self._link, self._reader
        described = self._poll.collect(link)
        if described is not None:
            link.described(described)
        counts = dataclasses.replace(reader.counts)
        if link.epoch != self._epoch:
            self._epoch, self._rate_hz = link.epoch, None
            self._rate_fresh, self._rate_s, self._rate_ns = counts.new, now_s, reader.newest_ns
        if counts.new != self._fresh:
            self._fresh, self._fresh_s = counts.new, now_s
        self._flags = self._flags.merge(reader.watch.take_flags())
        status = self._poll.status
        counted = ServerCounts.of(status, link.sensor).since(self._then_server) if status else ServerCounts()
        silent_since_s = max(self._fresh_s, link.since_s)
        sample, compensation = reader.watch.sample, self._compensation()
        return Snapshot(
            sensor=link.sensor,
            address=link.address,
            connected=link.is_connected,
            problem=link.problem,
            is_reachable=link.is_reachable,
            connection_s=now_s - link.since_s,
            connects=link.connects,
            new_connects=link.connects - self._then_connects,
            info=link.info,
            lost=link.lost,
            silent_s=max(now_s - silent_since_s, 0.0),
            rate_hz=self._rate_hz,
            expected_hz=link.rate_hz,
            age_us=self._age_us,
            counts=counts,
            new=_difference(counts, self._then),
            not_finite=reader.not_finite,
            new_not_finite=reader.not_finite - self._then_not_finite,
            flags=self._flags,
            temperature=None if sample is None else sample.temperature,
            server=status,
            new_server=counted,
            answer_s=self._poll.owed_s(now_s),
            settings=link.settings,
            saturated=reader.watch.saturated,
            new_saturated=reader.watch.saturated - self._then_saturated,
            compensation=compensation,
            new_withheld=compensation.withheld - self._then_withheld,
        )

    def measure(self, now_s: float) -> None:
        """Work out rate and ages of the interval that ends; before `look`."""
        ages = self._reader.watch.take_ages()
        self._age_us = None
        if ages and self._link.is_connected and self._link.client.session.same_machine:
            self._age_us = ages[len(ages) // 2] / 1e3, (p99(ages) or 0) / 1e3
        if self._link.epoch != self._epoch:
            return
        fresh, elapsed_s, newest_ns = self._reader.counts.new, now_s - self._rate_s, self._reader.newest_ns
        # By the stamps, as a delay here is none of the sensor's; by the clock if it has become silent.
        span_s = (newest_ns - self._rate_ns) * 1e-9 if self._rate_ns >= 0 else 0.0
        span_s = span_s if span_s >= _SHORTEST_RATE_S else elapsed_s
        self._rate_hz = (fresh - self._rate_fresh) / span_s if elapsed_s >= _SHORTEST_RATE_S else None
        self._rate_fresh, self._rate_s, self._rate_ns = fresh, now_s, newest_ns

    def begin_interval(self, reported: Snapshot, now_s: float) -> None:
        """`reported` was a regular report: what is new counts from there on. Asks the server again."""
        self._flags = Flags()
        self._then, self._then_not_finite = reported.counts, reported.not_finite
        self._then_connects, self._then_withheld = reported.connects, reported.compensation.withheld
        self._then_saturated = reported.saturated
        if reported.server:
            self._then_server = ServerCounts.of(reported.server, self._link.sensor)
        elif not reported.connected:
            self._then_server = None  # the next server counts from 0
        self._poll.ask(now_s)


def _difference(now: FrameCounts, then: FrameCounts) -> FrameCounts:
    return FrameCounts(
        **{
            field.name: getattr(now, field.name) - getattr(then, field.name)
            for field in dataclasses.fields(FrameCounts)
        }
    )
