"""Sums up what reader and server know into snapshots, and keeps what is new since the last report. No ROS."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.health.judge import Observation, emergency
from bota_ethercat.health.observer import p99
from bota_ethercat.text.json_text import JsonObject
from bridge.stream.link import Link, SensorInfo
from bridge.stream.reader import Reader
from bridge.stream.watch import Flags
from ft_compensation.quantities import NO_WRENCH, Payload, Wrench

_SHORTEST_RATE_S: Final = 0.8
"""A rate measured over less time than this says little."""
SLOW_ANSWER_S: Final = 2.0
"""A server that owes an answer for this time is stopped or overloaded."""


class CompensationState(NamedTuple):
    """How the compensation is at one moment."""

    has_subscribers: bool = False
    published: int = 0
    withheld: int = 0
    """Samples since the node started that were compensated, and that could not be."""
    why_stopped: str | None = None
    """Why the latest sample was not compensated, or would not be with a subscriber; None: it was."""
    why_partly: str = ""
    """Why single topics have stopped, a sentence; empty if none has."""
    source: str = "none"
    age_s: float = math.inf
    """Of the orientation."""
    bound: float | None = None
    """N: in 95 % of cases the accelerometer's own errors are a smaller force; None where it is not used."""
    payload: Payload = Payload()
    bias: Wrench = NO_WRENCH
    origin: str = "parameter"
    """Where the bias comes from."""
    is_ramping: bool = False
    keep: bool = False
    """Whether the bias is to survive a restart."""
    stops_on_saturation: bool = False
    problem: str = ""
    """What is not as it should be, a sentence."""

    @property
    def good(self) -> str:
        """What to say when all is well."""
        parts = ["bias"] if self.bias != NO_WRENCH else []
        if self.payload.mass:
            parts += ["weight and inertia of the tool"] if self.source == "imu" else ["weight of the tool"]
        if not parts:
            text = "nothing is subtracted: there is no bias and no tool_mass"
        else:
            text = f"subtracted: {', '.join(parts)}"
        return text if self.has_subscribers else f"{text}; nobody has subscribed"

    @property
    def values(self) -> dict[str, object]:
        """By name."""
        uses_source = bool(self.payload.mass) and self.has_subscribers
        return {
            "gravity_source": self.source,
            "orientation_age_s": round(self.age_s, 4) if uses_source and math.isfinite(self.age_s) else "",
            "accelerometer_force": "" if self.bound is None else round(self.bound, 3),
            "tool_mass": round(self.payload.mass, 4),
            "tool_center_of_gravity": _numbers(self.payload.center),
            "tared": self.bias != NO_WRENCH,
            "bias": _numbers(self.bias.values),
            "bias_from": self.origin,
            "bias_ramping": self.is_ramping,
            "bias_keep": self.keep,
            "subscribed": self.has_subscribers,
            "compensated": self.published,
            "withheld": self.withheld,
        }


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.4f}" for value in values)


class Counts(NamedTuple):
    """What was counted since the node and, of the server's, the server started, or in some time."""

    connects: int = 0
    samples: int = 0
    lost: int = 0
    """And withheld."""
    stale: int = 0
    limited: int = 0
    repeated: int = 0
    invalid: int = 0
    not_finite: int = 0
    saturated: int = 0
    """Samples whose force or torque was saturated."""
    uncompensated: int = 0
    """Samples that could not be compensated."""
    server_lost_samples: int = 0
    server_not_finite: int = 0
    server_recoveries: int = 0
    server_missed_deadlines: int = 0

    def with_server(self, status: Mapping[str, Any], position: int) -> Counts:
        """With those of a `status` reply, of our sensor or of all; 0 for what it does not say."""
        row = {**status, **row_of(status.get("sensors"), position)}
        said = {name: row.get(name.removeprefix(_SERVER)) for name in _OF_SERVER}
        return self._replace(**{name: value for name, value in said.items() if type(value) is int})

    def since(self, then: Counts, *, same_server: bool) -> Counts:
        """What was added since `then`; nothing of the server's unless it is the `same_server`."""
        added = [max(now - before, 0) for now, before in zip(self, then, strict=True)]
        return Counts(*(added if same_server else added[: -len(_OF_SERVER)]))


_SERVER: Final = "server_"
_OF_SERVER: Final = tuple(name for name in Counts._fields if name.startswith(_SERVER))


class Snapshot(NamedTuple):
    """What is known at one moment."""

    sensor: int
    address: str
    connected: bool
    problem: str
    is_reachable: bool
    """Whether there is a server there, connected or not."""
    connection_s: float
    """How long there has been, or has not been, a connection."""
    info: SensorInfo | None
    lost: str | None
    silent_s: float
    """Since the last new sample, or since the connection was made."""
    rate_hz: float | None
    """Measured; None while that is not possible yet."""
    expected_hz: float
    age_us: tuple[float, float] | None
    """p50 and p99; None without samples or where the server's clock is another machine's."""
    counts: Counts
    new: Counts
    """Since the last regular report."""
    flags: Flags
    temperature: float | None
    server: Mapping[str, Any]
    """The latest `status` reply of this connection; empty if there is none yet."""
    answer_s: float
    """How long the server has owed an answer; 0 if it owes none."""
    settings: Mapping[str, object] = {}
    """The sensor's settings, as far as they are known."""
    compensation: CompensationState = CompensationState()

    @property
    def observation(self) -> Observation:
        """The same as every judge of a stream wants it."""
        mode, new = mapping(self.server_row.get("clock")).get("mode"), self.new
        return Observation(
            seconds=1.0,
            samples=new.samples,
            lost=max(new.lost, new.server_lost_samples),
            repeated=new.repeated,
            invalid=new.invalid,
            silent_s=self.silent_s,
            rate_hz=self.rate_hz,
            nominal_hz=self.expected_hz,
            age_p99_us=None if self.age_us is None else self.age_us[1],
            # The node checks those that it publishes, the server all.
            not_finite=max(new.not_finite, new.server_not_finite),
            warnings=self.flags.warnings,
            force_torque_saturated=self.flags.force_torque_saturated,
            acceleration_saturated=self.flags.acceleration_saturated,
            angular_rate_saturated=self.flags.angular_rate_saturated,
            temperature=self.temperature,
            locked=None if mode is None else mode == "locked",
            recoveries=new.server_recoveries,
            missed_deadlines=new.server_missed_deadlines,
            reconnects=new.connects if self.counts.connects > 1 else 0,
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
        self._then, self._same_server = Counts(), False
        """As of the last regular report, and whether the server's counts are in it."""

    def look(self, now_s: float) -> Snapshot:
        """How things are now."""
        link, reader = self._link, self._reader
        described = self._poll.collect(link)
        if described is not None:
            link.described(described)
        status, compensation, seen = self._poll.status, self._compensation(), reader.counts
        counts = Counts(
            link.connects, seen.new, seen.missing, seen.stale, seen.limited, seen.repeated, seen.invalid,
            reader.not_finite, reader.watch.saturated, compensation.withheld,
        ).with_server(status, link.sensor)  # fmt: skip
        if link.epoch != self._epoch:
            self._epoch, self._rate_hz = link.epoch, None
            self._rate_fresh, self._rate_s, self._rate_ns = counts.samples, now_s, reader.newest_ns
        if counts.samples != self._fresh:
            self._fresh, self._fresh_s = counts.samples, now_s
        self._flags = self._flags.merge(reader.watch.take_flags())
        sample = reader.watch.sample
        return Snapshot(
            sensor=link.sensor,
            address=link.address,
            connected=link.is_connected,
            problem=link.problem,
            is_reachable=link.is_reachable,
            connection_s=now_s - link.since_s,
            info=link.info,
            lost=link.lost,
            silent_s=max(now_s - max(self._fresh_s, link.since_s), 0.0),
            rate_hz=self._rate_hz,
            expected_hz=link.rate_hz,
            age_us=self._age_us,
            counts=counts,
            new=counts.since(self._then, same_server=self._same_server and bool(status)),
            flags=self._flags,
            temperature=None if sample is None else sample.temperature,
            server=status,
            answer_s=self._poll.owed_s(now_s),
            settings=link.settings,
            compensation=compensation,
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
        counts = reported.counts
        if not reported.server:  # what it had counted before is still known, unless it is another one then
            of_server = zip(_OF_SERVER, self._then[-len(_OF_SERVER) :], strict=True)
            counts = counts._replace(**dict(of_server))
        self._then = counts
        self._same_server = bool(reported.server) or (self._same_server and reported.connected)
        self._poll.ask(now_s)
