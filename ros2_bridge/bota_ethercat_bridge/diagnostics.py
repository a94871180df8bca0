# SPDX-License-Identifier: Apache-2.0
"""/diagnostics and ~/published: a thread that checks subscribers and state ten times a second, and what it
reports.

It publishes every second, and at once when a level changes. What happened for a moment only is kept until a
regular report has carried it. The five statuses say what `bota_ethercat.health` finds and what to do; their
values are for those who look closer.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from typing import Final, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.health.judge import SATURATIONS, Observation, judge
from bota_ethercat.health.limits import About, Level, StreamLimits
from bota_ethercat.health.observer import SensorObserver, p99
from bota_ethercat.pdo import TEMPERATURE
from bota_ethercat.replies import Status
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import printable
from bota_ethercat_bridge.process import Worker
from bota_ethercat_bridge.publishing.messages import Stamps, create_publisher
from bota_ethercat_bridge.stream.reader import NO_FLAGS, Outputs, Reader

TICK_S: Final = 0.1
_REPORT_S: Final = 1.0
_SHORTEST_RATE_S: Final = 0.8  # a rate measured over less time than this says little
_SLOW_ANSWER_S: Final = 2.0  # a server that owes an answer for this time is stopped or overloaded
_LEVELS: Final = {
    Level.GOOD: DiagnosticStatus.OK,
    Level.LOOK: DiagnosticStatus.WARN,
    Level.TROUBLE: DiagnosticStatus.ERROR,
    Level.NOT_POSSIBLE: DiagnosticStatus.STALE,
}
Problems = list[tuple[Level, str]]  # how bad, and a sentence
Judged = tuple[Level, Callable[[], DiagnosticStatus]]  # how bad, and what makes the status of it
_PUBLISHED: Final = ("count", "stamp_ns", "rate_hz")  # what ~/published has of a topic
_NO_CONNECTION: Final = "there is no connection to the server, see link"
_NO_SAMPLES: Final = "there are no new samples, see stream"


class CompensationState(NamedTuple):
    """How the compensation is at one moment. What is wrong is a sentence each, empty if nothing is."""

    good: str = ""  # what to say when all is well
    values: Callable[[], Mapping[str, object]] = dict  # made only to be published
    stopped: str = ""  # why nothing is published, or would be with a subscriber, or single topics are silent
    doubtful: str = ""  # why what is published may be wrong
    withheld: int = 0  # samples since the node started that were not compensated
    why_withheld: str = ""  # the latest of them
    follows_imu: bool = False  # whether the tool's weight and inertia are from the sensor's IMU


class DiagnosticsPublisher:
    """Its `thread` runs until `stop`. `on_failure` is called with an unexpected error."""

    def __init__(
        self, node: Node, limits: StreamLimits, reader: Reader, compensation: Callable[[], CompensationState],
        outputs: Outputs, stamps: Stamps, on_failure: Callable[[str], object],
    ) -> None:  # fmt: skip
        self.limits = limits  # may be replaced at any time
        self._reader, self._link, self._clock = reader, reader.link, reader.link.clock
        self._compensation, self._outputs, self._stamps = compensation, outputs, stamps
        self._log = node.get_logger()
        self._prefix = node.get_fully_qualified_name().lstrip("/") + ": "
        self._count_publishers, self._shared = node.count_publishers, ""
        self._publisher = create_publisher(node, DiagnosticArray, "/diagnostics")
        self._counts_publisher = create_publisher(node, DiagnosticArray, "~/published")
        self._noted: list[tuple[str, int, int, float]] = []
        self._published_s = now_s = self._clock.monotonic()
        self._levels: list[Level] = []
        # The server's newest `status` of this connection, what it says of our sensor, and what it owes.
        self._server, self._said = Status(), SensorObserver()
        self._connects, self._asked_s, self._waiting = 0, 0.0, dict[str, Future[JsonObject]]()
        # Counts since the node started: now, as of the last regular report, and the growth since.
        self._counts = self._then = self._count(0)
        self._new = Counter[str]()
        self._flags = NO_FLAGS  # that were set since the last regular report
        # Of the last second, p50 and p99; None without samples, or by the clock of another machine.
        self._age_us: tuple[float, float] | None = None
        self._rate_hz: float | None = None  # measured; None while that is not possible yet
        # Where the rate is measured from: samples, time here, and the newest sample's.
        self._rate_from = 0, now_s, -1
        # When the number of samples changed, whether that is long ago, and the link's epoch.
        self._fresh_s, self._is_silent, self._epoch = now_s, False, -1
        self._unread = 0.0, False  # the worst `take_unread` since the last regular report, or sample
        self._stopping = threading.Event()
        self.thread = Worker("monitor", self._run, on_failure)

    def stop(self) -> bool:
        self._stopping.set()
        return self.thread.has_ended()

    def _run(self) -> None:
        while not self._clock.wait(self._stopping, TICK_S):
            self.tick()

    def tick(self) -> None:
        self._outputs.refresh()
        self._publish_counts()
        now_s = self._clock.monotonic()
        regular = now_s - self._published_s >= _REPORT_S
        if regular:
            self._measure(now_s)
            self._find_other_publishers()
        self._collect()
        compensation = self._compensation()
        self._observe(now_s, compensation.withheld)
        judged = self._judge(now_s, compensation)
        levels = [level for level, _ in judged]
        if regular or levels != self._levels:
            self._levels, self._published_s = levels, now_s
            message = DiagnosticArray(status=[make() for _, make in judged])
            self._stamp(message)
            self._publisher.publish(message)
        if regular:
            self._begin_interval(now_s)

    def _publish_counts(self) -> None:
        """Publish what the reader has noted since the last tick, and have it do so again."""
        noted, self._noted = self._noted, []
        if noted:
            message = DiagnosticArray(
                status=[
                    DiagnosticStatus(name=name, values=_key_values(zip(_PUBLISHED, values, strict=True)))
                    for name, *values in noted
                ]
            )
            self._stamp(message)
            self._counts_publisher.publish(message)
        if self._counts_publisher.get_subscription_count():
            self._reader.between_samples = self._note_published

    def _note_published(self) -> None:
        """Note how many messages of each topic have a stamp up to this one; for the reader's thread."""
        until_ns, rate_hz = self._reader.stamp_ns, self._link.info.rate_hz
        self._noted = [
            (topic.name, topic.published, until_ns - self._stamps.of(topic.kind), rate_hz)
            for output in self._outputs.all
            for topic in output.topics
            if topic.published
        ]

    def _find_other_publishers(self) -> None:
        """Log, and keep for the diagnostics, that somebody else publishes one of this node's topics."""
        names = (topic.name for output in self._outputs.all for topic in output.topics)
        shared, before = [name for name in names if self._count_publishers(name) > 1], self._shared
        self._shared = ""
        if shared:
            others = f" and {len(shared) - 1} more" if len(shared) > 1 else ""
            self._shared = (
                f"another node, or one that was just killed, publishes {shared[0]}{others} too: give one of "
                "them a namespace (--ros-args -r __ns:=/NAME)"
            )
        if self._shared and not before:
            self._log.warning(self._shared)

    def _stamp(self, message: DiagnosticArray) -> None:
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(self._clock.time_ns(), 1_000_000_000)

    def _measure(self, now_s: float) -> None:
        ages, link = self._reader.pop_ages(), self._link
        self._age_us = None
        if ages and link.is_connected and link.client.session.same_machine:
            self._age_us = ages[len(ages) // 2] / 1e3, (p99(ages) or 0) / 1e3
        if link.in_force.epoch != self._epoch:
            return
        (fresh, from_s, from_ns), elapsed_s = self._rate_from, now_s - self._rate_from[1]
        self._begin_rate(now_s)
        # By the stamps, as a delay here is none of the sensor's; by the clock if it has become silent.
        span_s = (self._rate_from[2] - from_ns) * 1e-9 if from_ns >= 0 else 0.0
        span_s = span_s if span_s >= _SHORTEST_RATE_S else elapsed_s
        samples = self._rate_from[0] - fresh
        self._rate_hz = samples / span_s if now_s - from_s >= _SHORTEST_RATE_S else None

    def _begin_rate(self, now_s: float) -> None:
        self._rate_from = self._reader.counts.new, now_s, self._reader.accounting.new_ns

    def _collect(self) -> None:
        """Take what the server has answered, without waiting; the link gets the description."""
        link, said = self._link, self._said
        if not link.is_connected or link.connects != self._connects:
            self._server, self._waiting = Status(), {}
            said.disconnected()
        if link.connects != self._connects:
            self._connects = link.connects
            said.connected(self._clock.monotonic_ns())
        for action in [action for action, reply in self._waiting.items() if reply.done()]:
            reply = self._waiting.pop(action)
            is_granted = reply.exception() is None and reply.result().get("ok") is True
            if is_granted and action == "status":  # a description is in the link already
                self._server = Status.parse(reply.result())
                said.add_status(self._server, link.sensor, self._clock.monotonic_ns())
        said.in_force = link.in_force

    def _count(self, withheld: int) -> Counter[str]:
        seen, reader = self._reader.counts, self._reader
        return Counter(
            connects=self._link.connects, samples=seen.new, lost=seen.missing, stale=seen.stale,
            limited=seen.limited, repeated=seen.repeated, invalid=seen.invalid,
            not_finite=reader.not_finite, saturated=reader.saturated, withheld=withheld,
        )  # fmt: skip

    def _observe(self, now_s: float, withheld: int) -> None:
        link, then, before = self._link, self._then, self._counts["samples"]
        counts = self._counts = self._count(withheld)
        self._new = Counter({name: max(counts[name] - then[name], 0) for name in counts})
        self._flags = self._reader.pop_flags(self._flags)
        if link.in_force.epoch != self._epoch:
            self._epoch, self._rate_hz = link.in_force.epoch, None
            self._begin_rate(now_s)
        self._unread = max(self._unread, link.client.take_unread())
        if counts["samples"] != before:
            self._fresh_s = now_s

    def _begin_interval(self, now_s: float) -> None:
        """A regular report was made: what is new counts from there on. Asks the server again."""
        self._flags, link = NO_FLAGS, self._link
        self._unread = self._unread if self._is_silent else (0.0, False)
        self._then = self._counts
        self._said.restart()
        if link.is_connected and not self._waiting:  # unless an answer is still owed
            self._asked_s = now_s
            try:
                self._waiting = {action: link.client.request(action) for action in ("status", "describe")}
            except ConnectionFailedError:
                self._waiting = {}  # the reader will notice

    # -- the statuses

    def _judge(self, now_s: float, compensation: CompensationState) -> list[Judged]:
        """The five statuses, in the order in which one would look for a cause."""
        link, new, said, now_ns = self._link, self._new, self._said, self._clock.monotonic_ns()
        silent_s = max(now_s - max(self._fresh_s, link.since_s), 0.0)
        # How long the server has owed an answer that this node would have seen.
        answer_s = max(now_s - self._asked_s - self._unread[0], 0.0) if self._waiting else 0.0
        values = self._reader.values
        said.note_unread(self._unread, now_ns)
        seen = Observation(
            seconds=1.0,
            samples=new["samples"],
            lost=max(new["lost"], said.grown("lost_samples")),
            skipped=new["stale"],
            repeated=new["repeated"],
            invalid=new["invalid"],
            silent_s=silent_s,
            rate_hz=self._rate_hz,
            nominal_hz=link.info.rate_hz,
            age_p99_us=None if self._age_us is None else self._age_us[1],
            not_finite=new["not_finite"],  # of those that it publishes; the server checks all
            **{name: bits for name, bits in self._flags._asdict().items() if name != "status"},
            temperature=None if values is None else values[TEMPERATURE][0],
            server_silent=answer_s > _SLOW_ANSWER_S / 2,
        )
        findings = judge(said.complete(seen, now_ns, limits=self.limits), self.limits).findings

        def about(subject: About) -> Problems:
            return [(finding.level, finding.sentence) for finding in findings if finding.about is subject]

        was_silent, self._is_silent = self._is_silent, silent_s > self.limits.stale_after
        if self._is_silent and not was_silent and link.is_connected and link.lost is None:
            self._log.warning(findings[0].sentence)
        has_samples = link.is_connected and link.lost is None and not self._is_silent
        return [
            self._judge_link(about(About.LINK), now_s, answer_s),
            self._judge_stream(about(About.STREAM)),
            self._judge_sensor(about(About.SENSOR), seen.temperature),
            self._judge_clock(about(About.CLOCK), has_samples=has_samples),
            self._judge_compensation(compensation, has_samples=has_samples),
        ]

    def _status(
        self, name: str, problems: Problems, good: str, values: Callable[[], Mapping[str, object]]
    ) -> Judged:
        """The worst level, and all sentences, the worst first; `good` if there is none."""
        problems, info = sorted(problems, key=lambda problem: -problem[0]), self._link.info
        level = problems[0][0] if problems else Level.GOOD
        return level, lambda: DiagnosticStatus(
            name=self._prefix + name,
            level=_LEVELS[level],
            message="; ".join(sentence for _, sentence in problems) or good,
            hardware_id=f"{info.name} {text_of(info.serial)}".strip(),
            values=_key_values(values().items()),
        )

    def _judge_link(self, problems: Problems, now_s: float, answer_s: float) -> Judged:
        link = self._link
        if not link.is_connected:
            problems = [(Level.TROUBLE, f"{link.absence} (the node keeps trying)")]
        elif answer_s > _SLOW_ANSWER_S:
            text = f"the server at {link.address} has not answered for {answer_s:.0f} s"
            problems = [(Level.LOOK, f"{text}: it is stopped or overloaded")]
        values = {
            "address": link.address,
            "connected": link.is_connected,
            "connected_s" if link.is_connected else "disconnected_s": round(now_s - link.since_s, 1),
            "reconnects": max(self._counts["connects"] - 1, 0),
            "server_uptime_s": self._server.uptime_s,
            "last_problem": link.problem,
        }
        return self._status("link", problems, f"connected to {link.address}", lambda: values)

    def _judge_stream(self, problems: Problems) -> Judged:
        link, counts, server = self._link, self._counts, self._server
        if not link.is_connected:
            problems = [(Level.NOT_POSSIBLE, f"no samples: {_NO_CONNECTION}")]
        elif self._shared:
            problems = [*problems, (Level.LOOK, self._shared)]
        recent, row, age = server.last_10s, self._said.status, server.recent_age_us(link.sensor)
        ages_us = [None, None] if self._age_us is None else map(round, self._age_us)
        values = {
            "rate_hz": None if self._rate_hz is None else round(self._rate_hz, 1),
            "expected_hz": link.info.rate_hz or "",
            **dict(zip(("age_p50_us", "age_p99_us"), ages_us, strict=True)),
            "samples": counts["samples"],
            "lost": counts["lost"],
            "skipped": counts["stale"],
            **{name: counts[name] for name in ("limited", "repeated", "invalid", "not_finite")},
            **{f"server_{name}": getattr(row, name) for name in ("not_finite", "recoveries")},
            "server_lost": row.lost_samples,
            **{f"server_{name}": getattr(server, name) for name in ("missed_deadlines", "lost_frames")},
            "server_late_p50_us": recent.wake_us.p50,
            "server_late_p99_us": recent.wake_us.p99,
            "server_exchange_p99_us": recent.exchange_us.p99,
            "server_age_p50_us": age.p50,
            "server_age_p99_us": age.p99,
        }
        good = "samples arrive" if self._rate_hz is None else f"{self._rate_hz:.0f} samples a second"
        return self._status("stream", problems, good, lambda: values)

    def _judge_sensor(self, problems: Problems, temperature: float | None) -> Judged:
        link, info, flags, status = self._link, self._link.info, self._flags, self._said.status
        if not link.is_connected:
            problems = [(Level.NOT_POSSIBLE, f"unknown: {_NO_CONNECTION}")]
        elif link.lost is not None:  # the server's words, with what to do if they do not say it
            lost = link.lost if "check " in link.lost else f"{link.lost}; check its cable and power"
            problems = [(Level.TROUBLE, lost)]
        elif self._is_silent:
            problems = [(Level.NOT_POSSIBLE, f"unknown: {_NO_SAMPLES}")]
        last = status.emergency
        values = {
            **{name: getattr(info, name) for name in ("name", "serial", "hardware", "firmware")},
            "al_state": info.state if link.is_connected else "",
            "temperature_c": None if temperature is None else round(temperature, 2),
            "status_byte": f"{flags.status:#04x}",
            "warnings_register": f"{flags.warnings:#010x}",
            **{row.field: f"{getattr(flags, row.field):#x}" for row in SATURATIONS},
            "saturated_samples": self._counts["saturated"],
            "emergencies": status.emergencies,
            "last_emergency": None if last.code is None else f"emergency 0x{last.code:04X} ({last.text})",
            "last_emergency_ago_s": last.ago_s,
        }
        return self._status("sensor", problems, "as it should be", lambda: values)

    def _judge_clock(self, problems: Problems, *, has_samples: bool) -> Judged:
        clock, delays = self._said.status.clock, self._link.info.delay_ns
        if not has_samples:
            problems = [(Level.NOT_POSSIBLE, f"unknown: {_NO_SAMPLES}")]
        elif not clock.mode:
            problems = [(Level.NOT_POSSIBLE, "the server has not said yet")]
        elif self._stamps.problem:
            problems = [*problems, (Level.LOOK, self._stamps.problem)]
        values = clock._asdict() | {"stamp": self._stamps.kind}
        for name, delay_ns in zip(delays._fields[:2], delays, strict=False):
            values[f"delay_{name}_ms"] = None if delay_ns is None else delay_ns / 1e6
        return self._status("clock", problems, "locked to the sensor's clock", lambda: values)

    def _judge_compensation(self, c: CompensationState, *, has_samples: bool) -> Judged:
        problems, flags = Problems(), self._flags
        if not has_samples:
            problems.append((Level.NOT_POSSIBLE, _NO_SAMPLES))
        elif c.stopped:
            problems.append((Level.TROUBLE, c.stopped))
        elif c.follows_imu and (flags.acceleration_saturated or flags.angular_rate_saturated):
            text = "the IMU's range was exceeded, so wrench_compensated was wrong meanwhile: set "
            text += "settings.acceleration_range_g and settings.angular_rate_range_dps higher"
            problems.append((Level.LOOK, text))
        elif count := self._new["withheld"]:
            problems.append((Level.LOOK, f"{count} samples were not compensated: {c.why_withheld}"))
        if c.doubtful:
            problems.append((Level.LOOK if has_samples else Level.NOT_POSSIBLE, c.doubtful))
        return self._status("compensation", problems, c.good, c.values)


def _key_values(values: Iterable[tuple[str, object]]) -> list[KeyValue]:
    return [KeyValue(key=key, value=text_of(value)) for key, value in values]


def text_of(value: object) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else printable(value)
