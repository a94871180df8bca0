"""What the diagnostics say: what is known, as `bota_ethercat.health` judges it. No ROS, no threads.

Five statuses. A message says what is wrong and what to do; the values are for those who look closer.
"""

from __future__ import annotations

from typing import NamedTuple

from bota_ethercat.health.judge import SATURATIONS
from bota_ethercat.health.judge import judge as judge_stream
from bota_ethercat.health.verdict import About, Level, Limits
from bota_ethercat.text.untrusted import number, printable, whole
from bridge.diagnostics.observer import SLOW_ANSWER_S, Snapshot, mapping, row_of

Values = dict[str, object]


class Status(NamedTuple):
    """One status: its short name, how bad (NOT_POSSIBLE: STALE in ROS), one sentence, and the values."""

    name: str
    level: Level
    message: str
    values: Values


Problems = list[tuple[Level, str]]
"""How bad, and a sentence."""


def _status(name: str, problems: Problems, good: str, values: Values) -> Status:
    """The worst level, and all sentences, the worst first; `good` if there is none."""
    problems = sorted(problems, key=lambda problem: problem[0], reverse=True)
    sentences = "; ".join(sentence for _, sentence in problems)
    return Status(name, problems[0][0] if problems else Level.GOOD, sentences or good, values)


def judge(snapshot: Snapshot, limits: Limits) -> list[Status]:
    """The five statuses, in the order in which one would look for a cause."""
    findings = judge_stream(snapshot.observation, limits).findings

    def about(subject: About) -> Problems:
        return [(finding.level, finding.sentence) for finding in findings if finding.about is subject]

    is_silent = snapshot.silent_s > limits.stale_after
    return [
        _link(snapshot, about(About.LINK)),
        _stream(snapshot, about(About.STREAM), limits),
        _sensor(snapshot, about(About.SENSOR), is_silent=is_silent),
        _clock(snapshot, about(About.CLOCK), is_silent=is_silent),
        _compensation(snapshot, is_silent=is_silent),
    ]


def _link(s: Snapshot, problems: Problems) -> Status:
    if not s.connected and s.is_reachable:
        text = f"not connected to {s.address}: {s.problem} (the node keeps trying)"
        problems = [(Level.TROUBLE, text)]
    elif not s.connected:
        text = f"no server at {s.address}: {s.problem}; start ethercat-server there, or set server_host and "
        problems = [(Level.TROUBLE, text + "server_port to where it is (the node keeps trying)")]
    elif s.answer_s > SLOW_ANSWER_S:
        text = f"the server at {s.address} has not answered for {s.answer_s:.0f} s"
        problems = [(Level.LOOK, f"{text}: it is stopped or overloaded")]
    values: Values = {
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
    values: Values = {
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
    return _status("stream", problems, _rate_text(s), values)


def _lost_text(lost: str) -> str:
    """The server's words, with what to do if they do not say it."""
    return lost if "check " in lost else f"{lost}; check its cable and power"


def _sensor(s: Snapshot, problems: Problems, *, is_silent: bool) -> Status:
    if not s.connected:
        problems = [(Level.NOT_POSSIBLE, "unknown: there is no connection to the server, see link")]
    elif s.lost is not None:
        problems = [(Level.TROUBLE, _lost_text(s.lost))]
    elif is_silent:
        problems = [(Level.NOT_POSSIBLE, "unknown: there are no new samples, see stream")]
    last = mapping(s.server_row.get("emergency"))
    code, ago_s = whole(last.get("code")), number(last.get("ago_s"))
    emergency = "" if code is None else f"emergency 0x{code:04X} ({printable(last.get('text'), 80)})"
    info = s.info
    values: Values = {
        "name": info.name if info else "",
        "serial": info.serial if info else "",
        "hardware": info.hardware if info else "",
        "firmware": info.firmware if info else "",
        "al_state": info.state if info and s.connected else "",
        "temperature_c": "" if s.temperature is None else round(s.temperature, 2),
        "status_byte": f"{s.flags.status:#04x}",
        "warnings_register": f"{s.flags.warnings:#010x}",
        **{row.field: f"{getattr(s.flags, row.field):#x}" for row in SATURATIONS},
        "saturated_samples": s.counts.saturated,
        "emergencies": s.server_row.get("emergencies", ""),
        "last_emergency": emergency,
        "last_emergency_ago_s": "" if ago_s is None else ago_s,
    }
    return _status("sensor", problems, "as it should be", values)


def _clock(s: Snapshot, problems: Problems, *, is_silent: bool) -> Status:
    clock = mapping(s.server_row.get("clock"))
    if not s.connected or s.lost is not None or is_silent:
        problems = [(Level.NOT_POSSIBLE, "unknown: there are no new samples, see stream")]
    elif clock.get("mode") is None:
        problems = [(Level.NOT_POSSIBLE, "the server has not said yet")]
    values: Values = {
        name: clock.get(name, "") for name in ("mode", "stamps", "period_us", "offset_ppm", "uncertainty_us")
    }
    return _status("clock", problems, "locked to the sensor's clock", values)


def _compensation(s: Snapshot, *, is_silent: bool) -> Status:
    problems, c = Problems(), s.compensation
    if not s.connected or s.lost is not None or is_silent:
        problems.append((Level.NOT_POSSIBLE, "there are no new samples, see stream"))
    elif c.why_stopped is not None:
        state = "has stopped" if c.has_subscribers else "could not be published if somebody subscribed"
        problems.append((Level.TROUBLE, f"wrench_compensated {state}: {c.why_stopped}"))
    elif c.why_partly:
        problems.append((Level.TROUBLE, c.why_partly))
    elif (
        c.source == "imu"
        and c.payload.mass
        and (s.flags.acceleration_saturated or s.flags.angular_rate_saturated)
    ):
        problems.append(
            (
                Level.LOOK,
                "the IMU's range was exceeded, so wrench_compensated was wrong meanwhile: set "
                "settings.acceleration_range_g and settings.angular_rate_range_dps higher",
            )
        )
    elif s.new.uncompensated:
        problems.append((Level.LOOK, f"{s.new.uncompensated} samples were not compensated{_why_withheld(s)}"))
    if c.problem:
        is_stale = any(level is Level.NOT_POSSIBLE for level, _ in problems)
        problems.append((Level.NOT_POSSIBLE if is_stale else Level.LOOK, c.problem))
    return _status("compensation", problems, c.good, c.values)


def _why_withheld(s: Snapshot) -> str:
    """What may have been the reason."""
    c, reasons = s.compensation, []
    if c.stops_on_saturation and s.new.saturated:
        reasons.append("because force or torque was saturated (on_saturation)")
    if c.payload.mass:
        reasons.append(f"for lack of a current orientation ({c.source})")
    return f", {', or '.join(reasons)}" if reasons else " while the sensor was looked up"


def _rate_text(s: Snapshot) -> str:
    return "samples arrive" if s.rate_hz is None else f"{s.rate_hz:.0f} samples a second"


def text_of(value: object) -> str:
    """A value as a KeyValue carries it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return printable(value)
