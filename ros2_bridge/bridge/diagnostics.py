"""/diagnostics: a thread that looks ten times a second who listens and how things are, and what it says.

A thread of its own, so that neither a service that waits for the server nor the stream holds it up. It
publishes every second, and at once when a level changes. What happened for a moment only is kept until a
regular report, a second after the one before, has carried it. Five statuses: a message says what is wrong, as
`bota_ethercat.health` judges it, and what to do; the values are for those who look closer.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.health.judge import SATURATIONS, Observation, emergency
from bota_ethercat.health.judge import judge as judge_stream
from bota_ethercat.health.observer import p99
from bota_ethercat.health.verdict import About, Level, Limits
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import number, printable, whole
from bridge.process import Worker
from bridge.publishing.messages import Stamps, create_publisher
from bridge.stream.link import Link
from bridge.stream.reader import Flags, Outputs, Reader

TICK_S: Final = 0.1
_REPORT_S: Final = 1.0
_SHORTEST_RATE_S: Final = 0.8  # a rate measured over less time than this says little
_SLOW_ANSWER_S: Final = 2.0  # a server that owes an answer for this time is stopped or overloaded
_OF_SERVER: Final = ("lost_samples", "not_finite", "recoveries", "missed_deadlines")
_LEVELS: Final = {
    Level.GOOD: DiagnosticStatus.OK,
    Level.LOOK: DiagnosticStatus.WARN,
    Level.TROUBLE: DiagnosticStatus.ERROR,
    Level.NOT_POSSIBLE: DiagnosticStatus.STALE,
}
Problems = list[tuple[Level, str]]  # how bad, and a sentence


class CompensationState(NamedTuple):
    """How the compensation is at one moment. What is wrong is a sentence each, empty if nothing is."""

    good: str = ""  # what to say when all is well
    values: Mapping[str, object] = {}
    stopped: str = ""  # why nothing is published, or would be with a subscriber, or single topics are silent
    doubtful: str = ""  # why what is published may be wrong
    follows_imu: bool = False  # whether the tool's weight and inertia are from the sensor's IMU
    withheld: int = 0  # samples since the node started that were not compensated
    why_withheld: str = ""  # the latest of them


class Snapshot(NamedTuple):
    """What is known at one moment."""

    link: Link
    connection_s: float  # how long there has been, or has not been, a connection
    silent_s: float  # since the last new sample, or since the connection was made
    rate_hz: float | None  # measured; None while that is not possible yet
    # p50 and p99; None without samples or where the server's clock is another machine's.
    age_us: tuple[float, float] | None
    counts: Counter[str]  # since the node and, of the server's ("server_..."), the server started
    new: Counter[str]  # since the last regular report
    flags: Flags
    temperature: float | None
    server: Mapping[str, Any]  # the latest `status` reply of this connection; empty if there is none yet
    answer_s: float  # how long the server has owed an answer; 0 if it owes none
    compensation: CompensationState = CompensationState()
    stamp: str = "sample"
    stamp_problem: str = ""  # why stamps are not what they should be, a sentence

    @property
    def observation(self) -> Observation:
        """The same as every judge of a stream wants it."""
        link, new, info = self.link, self.new, self.link.info
        mode = mapping(self.server_row.get("clock")).get("mode")
        return Observation(
            seconds=1.0,
            samples=new["samples"],
            lost=max(new["lost"], new["server_lost_samples"]),
            repeated=new["repeated"],
            invalid=new["invalid"],
            silent_s=self.silent_s,
            rate_hz=self.rate_hz,
            nominal_hz=link.rate_hz,
            age_p99_us=None if self.age_us is None else self.age_us[1],
            # The node checks those that it publishes, the server all.
            not_finite=max(new["not_finite"], new["server_not_finite"]),
            **{name: bits for name, bits in self.flags._asdict().items() if name != "status"},
            temperature=self.temperature,
            locked=None if mode is None else mode == "locked",
            recoveries=new["server_recoveries"],
            missed_deadlines=new["server_missed_deadlines"],
            reconnects=new["connects"] if self.counts["connects"] > 1 else 0,
            is_lost=link.lost is not None,
            state="?" if info is None else info.state,
            server_silent=self.answer_s > _SLOW_ANSWER_S / 2,
            emergency=emergency(self.server_row.get("emergency")),
            settings=link.settings,
        )

    @property
    def server_row(self) -> Mapping[str, Any]:
        """Our sensor's row of `server`; empty if it has none."""
        return row_of(self.server.get("sensors"), self.link.sensor)


class Monitor:
    """Its `thread` runs until `stop`. `on_failure` hears of an error that should not be."""

    def __init__(
        self,
        node: Node,
        limits: Limits,
        reader: Reader,
        compensation: Callable[[], CompensationState],
        outputs: Outputs,
        stamps: Stamps,
        on_failure: Callable[[str], object],
    ) -> None:
        self.limits = limits  # may be replaced at any time
        self._reader, self._link, self._clock = reader, reader.link, reader.link.clock
        self._compensation, self._outputs, self._stamps = compensation, outputs, stamps
        self._prefix = node.get_fully_qualified_name().lstrip("/") + ": "
        self._publisher = create_publisher(node, DiagnosticArray, "/diagnostics")
        self._levels: list[Level] = []
        self._status: Mapping[str, Any] = {}  # the server's newest, of this connection
        self._connects, self._asked_s, self._waiting = 0, 0.0, dict[str, Future[JsonObject]]()
        self._flags = Flags()
        self._age_us: tuple[float, float] | None = None
        self._rate_hz: float | None = None
        self._published_s = now_s = self._clock.monotonic()
        # The last number of fresh samples, when it changed, and the link's epoch.
        self._fresh, self._fresh_s, self._epoch = 0, now_s, -1
        # Where the rate is measured from: samples, time here, and the newest one's stamp.
        self._rate_fresh, self._rate_s, self._rate_ns = 0, now_s, -1
        self._then = self._count()  # as of the last regular report
        self._stopping = threading.Event()
        self.thread = Worker("monitor", self._run, on_failure)

    def stop(self) -> bool:
        """Stop and wait for the thread; False if it does not end in time."""
        self._stopping.set()
        return self.thread.has_ended()

    def _run(self) -> None:
        while not self._clock.wait(self._stopping, TICK_S):
            self.tick()

    def tick(self) -> None:
        """Look once, and publish if it is time or a level has changed."""
        self._outputs.refresh()
        now_s = self._clock.monotonic()
        regular = now_s - self._published_s >= _REPORT_S
        if regular:
            self._measure(now_s)
        snapshot = self._look(now_s)
        statuses = judge(snapshot, self.limits)
        levels = [status.level for status in statuses]
        if regular or levels != self._levels:
            self._levels, self._published_s = levels, now_s
            self._publish(statuses)
        if regular:
            self._begin_interval(snapshot, now_s)

    def _measure(self, now_s: float) -> None:
        """Work out rate and ages of the interval that ends."""
        ages, link = self._reader.watch.take_ages(), self._link
        self._age_us = None
        if ages and link.is_connected and link.client.session.same_machine:
            self._age_us = ages[len(ages) // 2] / 1e3, (p99(ages) or 0) / 1e3
        if link.epoch != self._epoch:
            return
        fresh, elapsed_s = self._reader.counts.new, now_s - self._rate_s
        newest_ns = self._reader.accounting.new_ns
        # By the stamps, as a delay here is none of the sensor's; by the clock if it has become silent.
        span_s = (newest_ns - self._rate_ns) * 1e-9 if self._rate_ns >= 0 else 0.0
        span_s = span_s if span_s >= _SHORTEST_RATE_S else elapsed_s
        self._rate_hz = (fresh - self._rate_fresh) / span_s if elapsed_s >= _SHORTEST_RATE_S else None
        self._rate_fresh, self._rate_s, self._rate_ns = fresh, now_s, newest_ns

    def _count(self, withheld: int = 0) -> Counter[str]:
        """All counts: of the node, and those that the server has told."""
        seen, status = self._reader.counts, self._status
        row = {**status, **row_of(status.get("sensors"), self._link.sensor)}
        told = {f"server_{name}": row.get(name) for name in _OF_SERVER} if status else {}
        return Counter(
            connects=self._link.connects, samples=seen.new, lost=seen.missing, stale=seen.stale,
            limited=seen.limited, repeated=seen.repeated, invalid=seen.invalid,
            not_finite=self._reader.not_finite, saturated=self._reader.watch.saturated,
            uncompensated=withheld,
            **{name: count if type(count) is int else 0 for name, count in told.items()},
        )  # fmt: skip

    def _look(self, now_s: float) -> Snapshot:
        """How things are now."""
        link, reader, compensation = self._link, self._reader, self._compensation()
        self._collect()
        counts = self._count(compensation.withheld)
        if link.epoch != self._epoch:
            self._epoch, self._rate_hz = link.epoch, None
            self._rate_fresh, self._rate_s = counts["samples"], now_s
            self._rate_ns = reader.accounting.new_ns
        if counts["samples"] != self._fresh:
            self._fresh, self._fresh_s = counts["samples"], now_s
        self._flags = self._flags.merge(reader.watch.take_flags())
        sample, then = reader.watch.sample, self._then
        return Snapshot(
            link,
            connection_s=now_s - link.since_s,
            silent_s=max(now_s - max(self._fresh_s, link.since_s), 0.0),
            rate_hz=self._rate_hz,
            age_us=self._age_us,
            counts=counts,
            new=Counter({name: max(counts[name] - then[name], 0) for name in counts if name in then}),
            flags=self._flags,
            temperature=None if sample is None else sample.temperature,
            server=self._status,
            answer_s=now_s - self._asked_s if self._waiting else 0.0,
            compensation=compensation,
            stamp=self._stamps.kind,
            stamp_problem=self._stamps.problem,
        )

    def _begin_interval(self, reported: Snapshot, now_s: float) -> None:
        """`reported` was a regular report: what is new counts from there on. Asks the server again."""
        self._flags, link = Flags(), self._link
        # What a server has counted is compared with what the same one had counted before.
        before = self._then if link.is_connected else Counter[str]()
        self._then = Counter({**before, **reported.counts})
        if link.is_connected and not self._waiting:  # unless an answer is still owed
            self._asked_s = now_s
            try:
                for action in ("status", "describe"):
                    self._waiting[action] = link.client.request(action)
            except ConnectionFailedError:
                self._waiting = {}  # the reader will notice

    def _collect(self) -> None:
        """Take what the server has answered, without waiting; the link gets the description."""
        link = self._link
        if not link.is_connected or link.connects != self._connects:
            self._connects, self._status, self._waiting = link.connects, {}, {}
        for action in [action for action, reply in self._waiting.items() if reply.done()]:
            reply = self._waiting.pop(action)
            if reply.exception() is None and (content := reply.result()).get("ok") is True:
                if action == "status":
                    self._status = content
                else:
                    link.described(content)

    def _publish(self, statuses: Sequence[Status]) -> None:
        info, message = self._link.info, DiagnosticArray()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self._clock.time_ns(), 1_000_000_000)
        message.status = [
            DiagnosticStatus(
                name=self._prefix + status.name,
                level=_LEVELS[status.level],
                message=status.message,
                hardware_id=f"{info.name} {info.serial}" if info else "",
                values=[KeyValue(key=key, value=text_of(value)) for key, value in status.values.items()],
            )
            for status in statuses
        ]
        self._publisher.publish(message)


def text_of(value: object) -> str:
    """A value as a KeyValue carries it."""
    return str(value).lower() if isinstance(value, bool) else printable(value)


def mapping(value: object) -> Mapping[str, Any]:
    """`value` if it is a JSON object, else an empty one: the server's word is not trusted to have a form."""
    return value if isinstance(value, dict) else {}


def row_of(rows: object, position: int) -> Mapping[str, Any]:
    """The object at `position` of a JSON list; empty if there is none."""
    return mapping(rows[position] if isinstance(rows, list) and position < len(rows) else None)


# The statuses.


class Status(NamedTuple):
    """One status: its short name, how bad (NOT_POSSIBLE: STALE in ROS), one sentence, and the values."""

    name: str
    level: Level
    message: str
    values: Mapping[str, object]


def judge(snapshot: Snapshot, limits: Limits) -> list[Status]:
    """The five statuses, in the order in which one would look for a cause."""
    findings = judge_stream(snapshot.observation, limits).findings

    def about(subject: About) -> Problems:
        return [(finding.level, finding.sentence) for finding in findings if finding.about is subject]

    is_silent = snapshot.silent_s > limits.stale_after
    has_samples = snapshot.link.is_connected and snapshot.link.lost is None and not is_silent
    return [
        _link(snapshot, about(About.LINK)),
        _stream(snapshot, about(About.STREAM), limits),
        _sensor(snapshot, about(About.SENSOR), is_silent=is_silent),
        _clock(snapshot, about(About.CLOCK), has_samples=has_samples),
        _compensation(snapshot, has_samples=has_samples),
    ]


def _status(name: str, problems: Problems, good: str, values: Mapping[str, object]) -> Status:
    """The worst level, and all sentences, the worst first; `good` if there is none."""
    problems = sorted(problems, key=lambda problem: problem[0], reverse=True)
    sentences = "; ".join(sentence for _, sentence in problems)
    return Status(name, problems[0][0] if problems else Level.GOOD, sentences or good, values)


def _link(s: Snapshot, problems: Problems) -> Status:
    link = s.link
    if not link.is_connected:
        text = f"not connected to {link.address}: {link.problem}"
        if not link.is_reachable:
            text = f"no server at {link.address}: {link.problem}; start ethercat-server there, or set "
            text += "server_host and server_port to where it is"
        problems = [(Level.TROUBLE, f"{text} (the node keeps trying)")]
    elif s.answer_s > _SLOW_ANSWER_S:
        text = f"the server at {link.address} has not answered for {s.answer_s:.0f} s"
        problems = [(Level.LOOK, f"{text}: it is stopped or overloaded")]
    values = {
        "address": link.address,
        "connected": link.is_connected,
        "connected_s" if link.is_connected else "disconnected_s": round(s.connection_s, 1),
        "reconnects": max(s.counts["connects"] - 1, 0),
        "server_uptime_s": s.server.get("uptime_s", ""),
        "last_problem": link.problem,
    }
    return _status("link", problems, f"connected to {link.address}", values)


def _stream(s: Snapshot, problems: Problems, limits: Limits) -> Status:
    if not s.link.is_connected:
        problems = [(Level.NOT_POSSIBLE, "no samples: there is no connection to the server, see link")]
    elif s.new["stale"] >= limits.lost_warn:
        skipped = f"{s.new['stale']} old samples skipped: the node or the server was stopped"
        problems = [*problems, (Level.LOOK, skipped)]
    mine, recent = s.server_row, mapping(s.server.get("last_10s"))
    age = row_of(recent.get("age_us"), s.link.sensor)
    wake, exchange = mapping(recent.get("wake_us")), mapping(recent.get("exchange_us"))
    values = {
        "rate_hz": "" if s.rate_hz is None else round(s.rate_hz, 1),
        "expected_hz": s.link.rate_hz or "",
        "age_p50_us": "" if s.age_us is None else round(s.age_us[0]),
        "age_p99_us": "" if s.age_us is None else round(s.age_us[1]),
        "samples": s.counts["samples"],
        "lost": s.counts["lost"],
        "skipped": s.counts["stale"],
        **{name: s.counts[name] for name in ("limited", "repeated", "invalid", "not_finite")},
        "server_not_finite": mine.get("not_finite", ""),
        "server_lost": mine.get("lost_samples", ""),
        "server_recoveries": mine.get("recoveries", ""),
        "server_missed_deadlines": s.server.get("missed_deadlines", ""),
        "server_lost_frames": s.server.get("lost_frames", ""),
        "server_late_p50_us": wake.get("p50", ""),
        "server_late_p99_us": wake.get("p99", ""),
        "server_exchange_p99_us": exchange.get("p99", ""),
        "server_age_p50_us": age.get("p50", ""),
        "server_age_p99_us": age.get("p99", ""),
    }
    good = "samples arrive" if s.rate_hz is None else f"{s.rate_hz:.0f} samples a second"
    return _status("stream", problems, good, values)


def _sensor(s: Snapshot, problems: Problems, *, is_silent: bool) -> Status:
    link, info = s.link, s.link.info
    if not link.is_connected:
        problems = [(Level.NOT_POSSIBLE, "unknown: there is no connection to the server, see link")]
    elif link.lost is not None:  # the server's words, with what to do if they do not say it
        lost = link.lost if "check " in link.lost else f"{link.lost}; check its cable and power"
        problems = [(Level.TROUBLE, lost)]
    elif is_silent:
        problems = [(Level.NOT_POSSIBLE, "unknown: there are no new samples, see stream")]
    last = mapping(s.server_row.get("emergency"))
    code, ago_s = whole(last.get("code")), number(last.get("ago_s"))
    text = "" if code is None else f"emergency 0x{code:04X} ({printable(last.get('text'), 80)})"
    values = {
        **{name: getattr(info, name) if info else "" for name in ("name", "serial", "hardware", "firmware")},
        "al_state": info.state if info and link.is_connected else "",
        "temperature_c": "" if s.temperature is None else round(s.temperature, 2),
        "status_byte": f"{s.flags.status:#04x}",
        "warnings_register": f"{s.flags.warnings:#010x}",
        **{row.field: f"{getattr(s.flags, row.field):#x}" for row in SATURATIONS},
        "saturated_samples": s.counts["saturated"],
        "emergencies": s.server_row.get("emergencies", ""),
        "last_emergency": text,
        "last_emergency_ago_s": "" if ago_s is None else ago_s,
    }
    return _status("sensor", problems, "as it should be", values)


def _clock(s: Snapshot, problems: Problems, *, has_samples: bool) -> Status:
    clock, delay_ms = mapping(s.server_row.get("clock")), s.link.delay_ms
    if not has_samples:
        problems = [(Level.NOT_POSSIBLE, "unknown: there are no new samples, see stream")]
    elif clock.get("mode") is None:
        problems = [(Level.NOT_POSSIBLE, "the server has not said yet")]
    elif s.stamp_problem:
        problems = [*problems, (Level.LOOK, s.stamp_problem)]
    names = "mode", "stamps", "period_us", "offset_ppm", "uncertainty_us"
    values = {name: clock.get(name, "") for name in names} | {
        "stamp": s.stamp,
        "delay_force_torque_ms": delay_ms.get("force_torque", ""),
        "delay_acceleration_ms": delay_ms.get("acceleration", ""),
    }
    return _status("clock", problems, "locked to the sensor's clock", values)


def _compensation(s: Snapshot, *, has_samples: bool) -> Status:
    problems, c = Problems(), s.compensation
    if not has_samples:
        problems.append((Level.NOT_POSSIBLE, "there are no new samples, see stream"))
    elif c.stopped:
        problems.append((Level.TROUBLE, c.stopped))
    elif c.follows_imu and (s.flags.acceleration_saturated or s.flags.angular_rate_saturated):
        text = "the IMU's range was exceeded, so wrench_compensated was wrong meanwhile: set "
        text += "settings.acceleration_range_g and settings.angular_rate_range_dps higher"
        problems.append((Level.LOOK, text))
    elif count := s.new["uncompensated"]:
        problems.append((Level.LOOK, f"{count} samples were not compensated: {c.why_withheld}"))
    if c.doubtful:
        problems.append((Level.LOOK if has_samples else Level.NOT_POSSIBLE, c.doubtful))
    return _status("compensation", problems, c.good, c.values)
