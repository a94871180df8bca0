"""What the diagnostics say: what is known at one moment, as `bota_ethercat.health` judges it. No ROS.

Five statuses. A message says what is wrong and what to do; the values are for those who look closer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from bota_ethercat.health.judge import SATURATIONS, Observation, emergency
from bota_ethercat.health.judge import judge as judge_stream
from bota_ethercat.health.verdict import About, Level, Limits
from bota_ethercat.text.untrusted import number, printable, whole
from bridge.stream.link import SensorInfo
from bridge.stream.reader import Flags

_SLOW_ANSWER_S: Final = 2.0  # a server that owes an answer for this time is stopped or overloaded
_SERVER: Final = "server_"


class Status(NamedTuple):
    """One status: its short name, how bad (NOT_POSSIBLE: STALE in ROS), one sentence, and the values."""

    name: str
    level: Level
    message: str
    values: Mapping[str, object]


Problems = list[tuple[Level, str]]  # how bad, and a sentence


class CompensationState(NamedTuple):
    """How the compensation is at one moment."""

    good: str = ""  # what to say when all is well
    values: Mapping[str, object] = {}
    has_subscribers: bool = False
    has_tool: bool = False
    source: str = "none"
    withheld: int = 0  # samples since the node started that could not be compensated
    # Why the latest sample was not compensated, or would not be with a subscriber; None: it was.
    why_stopped: str | None = None
    why_partly: str = ""  # why single topics have stopped, a sentence; empty if none has
    stops_on_saturation: bool = False
    problem: str = ""  # what is not as it should be, a sentence


class Counts(NamedTuple):
    """What was counted since the node and, of the server's, the server started, or in some time."""

    connects: int = 0
    samples: int = 0
    lost: int = 0  # and withheld
    stale: int = 0
    limited: int = 0
    repeated: int = 0
    invalid: int = 0
    not_finite: int = 0
    saturated: int = 0  # samples whose force or torque was saturated
    uncompensated: int = 0  # samples that could not be compensated
    server_lost_samples: int = 0
    server_not_finite: int = 0
    server_recoveries: int = 0
    server_missed_deadlines: int = 0

    def with_server(self, status: Mapping[str, Any], position: int) -> Counts:
        """With those of a `status` reply, of our sensor or of all; 0 for what it does not say."""
        row = {**status, **row_of(status.get("sensors"), position)}
        said = {name: row.get(name.removeprefix(_SERVER)) for name in OF_SERVER}
        return self._replace(**{name: value for name, value in said.items() if type(value) is int})

    def since(self, then: Counts, *, same_server: bool) -> Counts:
        """What was added since `then`; nothing of the server's unless it is the `same_server`."""
        added = [max(now - before, 0) for now, before in zip(self, then, strict=True)]
        return Counts(*(added if same_server else added[: -len(OF_SERVER)]))


OF_SERVER: Final = tuple(name for name in Counts._fields if name.startswith(_SERVER))


class Snapshot(NamedTuple):
    """What is known at one moment."""

    sensor: int
    address: str
    connected: bool
    problem: str
    is_reachable: bool  # whether there is a server there, connected or not
    connection_s: float  # how long there has been, or has not been, a connection
    info: SensorInfo | None
    lost: str | None
    silent_s: float  # since the last new sample, or since the connection was made
    rate_hz: float | None  # measured; None while that is not possible yet
    expected_hz: float
    # p50 and p99; None without samples or where the server's clock is another machine's.
    age_us: tuple[float, float] | None
    counts: Counts
    new: Counts  # since the last regular report
    flags: Flags
    temperature: float | None
    server: Mapping[str, Any]  # the latest `status` reply of this connection; empty if there is none yet
    answer_s: float  # how long the server has owed an answer; 0 if it owes none
    settings: Mapping[str, object] = {}  # the sensor's settings, as far as they are known
    compensation: CompensationState = CompensationState()

    @property
    def observation(self) -> Observation:
        """The same as every judge of a stream wants it."""
        mode, new, flags = mapping(self.server_row.get("clock")).get("mode"), self.new, self.flags
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
            **{name: bits for name, bits in flags._asdict().items() if name != "status"},
            temperature=self.temperature,
            locked=None if mode is None else mode == "locked",
            recoveries=new.server_recoveries,
            missed_deadlines=new.server_missed_deadlines,
            reconnects=new.connects if self.counts.connects > 1 else 0,
            is_lost=self.lost is not None,
            state="?" if self.info is None else self.info.state,
            server_silent=self.answer_s > _SLOW_ANSWER_S / 2,
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


def judge(snapshot: Snapshot, limits: Limits) -> list[Status]:
    """The five statuses, in the order in which one would look for a cause."""
    findings = judge_stream(snapshot.observation, limits).findings

    def about(subject: About) -> Problems:
        return [(finding.level, finding.sentence) for finding in findings if finding.about is subject]

    is_silent = snapshot.silent_s > limits.stale_after
    has_samples = snapshot.connected and snapshot.lost is None and not is_silent
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
    if not s.connected and s.is_reachable:
        text = f"not connected to {s.address}: {s.problem} (the node keeps trying)"
        problems = [(Level.TROUBLE, text)]
    elif not s.connected:
        text = f"no server at {s.address}: {s.problem}; start ethercat-server there, or set server_host and "
        problems = [(Level.TROUBLE, text + "server_port to where it is (the node keeps trying)")]
    elif s.answer_s > _SLOW_ANSWER_S:
        text = f"the server at {s.address} has not answered for {s.answer_s:.0f} s"
        problems = [(Level.LOOK, f"{text}: it is stopped or overloaded")]
    values = {
        "address": s.address,
        "connected": s.connected,
        "connected_s" if s.connected else "disconnected_s": round(s.connection_s, 1),
        "reconnects": max(s.counts.connects - 1, 0),
        "server_uptime_s": s.server.get("uptime_s", ""),
        "last_problem": s.problem,
    }
    return _status("link", problems, f"connected to {s.address}", values)


def _stream(s: Snapshot, problems: Problems, limits: Limits) -> Status:
    if not s.connected:
        problems = [(Level.NOT_POSSIBLE, "no samples: there is no connection to the server, see link")]
    elif s.new.stale >= limits.lost_warn:
        skipped = f"{s.new.stale} old samples skipped: the node or the server was stopped"
        problems = [*problems, (Level.LOOK, skipped)]
    mine, recent = s.server_row, mapping(s.server.get("last_10s"))
    age = row_of(recent.get("age_us"), s.sensor)
    wake, exchange = mapping(recent.get("wake_us")), mapping(recent.get("exchange_us"))
    values = {
        "rate_hz": "" if s.rate_hz is None else round(s.rate_hz, 1),
        "expected_hz": s.expected_hz or "",
        "age_p50_us": "" if s.age_us is None else round(s.age_us[0]),
        "age_p99_us": "" if s.age_us is None else round(s.age_us[1]),
        "samples": s.counts.samples,
        "lost": s.counts.lost,
        "skipped": s.counts.stale,
        "limited": s.counts.limited,
        "repeated": s.counts.repeated,
        "invalid": s.counts.invalid,
        "not_finite": s.counts.not_finite,
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
    if not s.connected:
        problems = [(Level.NOT_POSSIBLE, "unknown: there is no connection to the server, see link")]
    elif s.lost is not None:  # the server's words, with what to do if they do not say it
        lost = s.lost if "check " in s.lost else f"{s.lost}; check its cable and power"
        problems = [(Level.TROUBLE, lost)]
    elif is_silent:
        problems = [(Level.NOT_POSSIBLE, "unknown: there are no new samples, see stream")]
    last, info = mapping(s.server_row.get("emergency")), s.info
    code, ago_s = whole(last.get("code")), number(last.get("ago_s"))
    text = "" if code is None else f"emergency 0x{code:04X} ({printable(last.get('text'), 80)})"
    values = {
        **{name: getattr(info, name) if info else "" for name in ("name", "serial", "hardware", "firmware")},
        "al_state": info.state if info and s.connected else "",
        "temperature_c": "" if s.temperature is None else round(s.temperature, 2),
        "status_byte": f"{s.flags.status:#04x}",
        "warnings_register": f"{s.flags.warnings:#010x}",
        **{row.field: f"{getattr(s.flags, row.field):#x}" for row in SATURATIONS},
        "saturated_samples": s.counts.saturated,
        "emergencies": s.server_row.get("emergencies", ""),
        "last_emergency": text,
        "last_emergency_ago_s": "" if ago_s is None else ago_s,
    }
    return _status("sensor", problems, "as it should be", values)


def _clock(s: Snapshot, problems: Problems, *, has_samples: bool) -> Status:
    clock = mapping(s.server_row.get("clock"))
    if not has_samples:
        problems = [(Level.NOT_POSSIBLE, "unknown: there are no new samples, see stream")]
    elif clock.get("mode") is None:
        problems = [(Level.NOT_POSSIBLE, "the server has not said yet")]
    names = "mode", "stamps", "period_us", "offset_ppm", "uncertainty_us"
    values = {name: clock.get(name, "") for name in names}
    return _status("clock", problems, "locked to the sensor's clock", values)


def _compensation(s: Snapshot, *, has_samples: bool) -> Status:
    problems, reasons, c = Problems(), list[str](), s.compensation
    is_exceeded = s.flags.acceleration_saturated or s.flags.angular_rate_saturated
    if not has_samples:
        problems.append((Level.NOT_POSSIBLE, "there are no new samples, see stream"))
    elif c.why_stopped is not None:
        state = "has stopped" if c.has_subscribers else "could not be published if somebody subscribed"
        problems.append((Level.TROUBLE, f"wrench_compensated {state}: {c.why_stopped}"))
    elif c.why_partly:
        problems.append((Level.TROUBLE, c.why_partly))
    elif c.source == "imu" and c.has_tool and is_exceeded:
        text = "the IMU's range was exceeded, so wrench_compensated was wrong meanwhile: set "
        text += "settings.acceleration_range_g and settings.angular_rate_range_dps higher"
        problems.append((Level.LOOK, text))
    elif s.new.uncompensated:
        if c.stops_on_saturation and s.new.saturated:
            reasons.append("because force or torque was saturated (on_saturation)")
        if c.has_tool:
            reasons.append(f"for lack of a current orientation ({c.source})")
        why = f", {', or '.join(reasons)}" if reasons else " while the sensor was looked up"
        problems.append((Level.LOOK, f"{s.new.uncompensated} samples were not compensated{why}"))
    if c.problem:
        is_stale = any(level is Level.NOT_POSSIBLE for level, _ in problems)
        problems.append((Level.NOT_POSSIBLE if is_stale else Level.LOOK, c.problem))
    return _status("compensation", problems, c.good, c.values)
