"""What the diagnostics say: a snapshot of what is known, judged against the thresholds. No ROS, no threads.

Five statuses. A message says what is wrong and what to do; the values are for those who look closer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Final, NamedTuple

from bridge.diagnostics.snapshot import Snapshot, mapping, row_of
from bridge.parameters.table import Thresholds
from protocol.sensor.warnings_register import Severity, explain
from protocol.text.untrusted import number, whole
from protocol.text.visible import printable

Values = dict[str, object]


class Level(IntEnum):
    """As `diagnostic_msgs/DiagnosticStatus` numbers them."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Status(NamedTuple):
    """One status: its short name, how bad, one sentence, and the values."""

    name: str
    level: Level
    message: str
    values: Values


_SLOW_ANSWER_S: Final = 2.0
_EMERGENCY_S: Final = 60.0
"""How long an emergency of the sensor is a warning."""
_ERROR_CLASS: Final = 0xFF00
"""Bits of its code; none of them in one that says that an error is over."""
_SATURATIONS: Final = ("force_torque_saturated", "acceleration_saturated", "angular_rate_saturated")
_LEVELS: Final = {
    Severity.WARNING: Level.WARN, Severity.ERROR: Level.ERROR, Severity.FATAL: Level.ERROR,
}  # fmt: skip


class _Verdict:
    """Collects problems: the worst level, and the sentences of all, the worst first."""

    def __init__(self) -> None:
        self.level = Level.OK
        self.sentences: list[str] = []

    def add(self, level: Level, sentence: str) -> None:
        self.sentences.insert(0 if level > self.level else len(self.sentences), sentence)
        self.level = max(self.level, level)

    def status(self, name: str, good: str, values: Values) -> Status:
        return Status(name, self.level, "; ".join(self.sentences) or good, values)


def judge(snapshot: Snapshot, thresholds: Thresholds) -> list[Status]:
    """The five statuses, in the order in which one would look for a cause."""
    judges: tuple[Callable[[Snapshot, Thresholds], Status], ...] = (
        _link, _stream, _sensor, _clock, _compensation,
    )  # fmt: skip
    return [one(snapshot, thresholds) for one in judges]


def _link(s: Snapshot, _: Thresholds) -> Status:
    verdict = _Verdict()
    if not s.connected:
        verdict.add(
            Level.ERROR,
            f"no server at {s.address}: {s.problem}; start ethercat-server there, or set server_host and "
            "server_port to where it is (the node keeps trying)"
            if not s.is_reachable
            else f"not connected to {s.address}: {s.problem} (the node keeps trying)",
        )
    elif s.answer_s > _SLOW_ANSWER_S:
        verdict.add(
            Level.WARN,
            f"the server at {s.address} has not answered for {s.answer_s:.0f} s: it is stopped or overloaded",
        )
    elif s.new_connects and s.connects > 1:
        verdict.add(Level.WARN, f"connected to {s.address} again")
    values: Values = {
        "address": s.address,
        "connected": s.connected,
        "connected_s" if s.connected else "disconnected_s": round(s.connection_s, 1),
        "reconnects": max(s.connects - 1, 0),
        "server_uptime_s": s.server.get("uptime_s", ""),
        "last_problem": s.problem,
    }
    return verdict.status("link", f"connected to {s.address}", values)


def _stream(s: Snapshot, t: Thresholds) -> Status:
    verdict = _Verdict()
    if not s.connected:
        verdict.add(Level.STALE, "no samples: there is no connection to the server, see link")
    elif s.silent_s > t.stale_after:
        verdict.add(Level.ERROR, f"no new sample for {s.silent_s:.1f} s: {_why_silent(s)}")
    else:
        _judge_samples(verdict, s, t)
    if s.connected:
        _judge_losses(verdict, s, t)
    mine, recent = s.server_row, mapping(s.server.get("last_10s"))
    age = row_of(recent.get("age_us"), s.sensor)
    wake, exchange = mapping(recent.get("wake_us")), mapping(recent.get("exchange_us"))
    values: Values = {
        "rate_hz": "" if s.rate_hz is None else round(s.rate_hz, 1),
        "expected_hz": s.expected_hz or "",
        "age_p50_us": "" if s.age_us is None else round(s.age_us[0]),
        "age_p99_us": "" if s.age_us is None else round(s.age_us[1]),
        "samples": s.counts.new,
        "lost": s.counts.missing,
        "skipped": s.counts.stale,
        "limited": s.counts.limited,
        "repeated": s.counts.repeated,
        "invalid": s.counts.invalid,
        "not_finite": s.not_finite,
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
    return verdict.status("stream", _rate_text(s), values)


def _judge_samples(verdict: _Verdict, s: Snapshot, t: Thresholds) -> None:
    rate, expected = s.rate_hz, s.expected_hz
    # One sample more or less within the second that is counted is no deviation.
    if rate is not None and expected and abs(rate - expected) > max(t.rate_tolerance * expected, 2.0):
        verdict.add(Level.WARN, f"{rate:.0f} samples a second instead of {expected:g}")
    if s.age_us is not None and s.age_us[1] >= t.age_warn * 1e6:
        level = Level.ERROR if s.age_us[1] >= t.age_error * 1e6 else Level.WARN
        verdict.add(
            level, f"samples are {s.age_us[1] / 1000:.1f} ms old (p99): this machine or the node is busy"
        )


def _judge_losses(verdict: _Verdict, s: Snapshot, t: Thresholds) -> None:
    missing = max(s.new.missing, s.new_server.lost_samples)
    if missing >= t.lost_warn:
        verdict.add(Level.WARN, f"{missing} samples lost at the server or on the way")
    if s.new.stale >= t.lost_warn:
        verdict.add(Level.WARN, f"{s.new.stale} old samples skipped: the node or the server was stopped")
    # The node checks those that it publishes, the server all.
    if not_finite := max(s.new_not_finite, s.new_server.not_finite):
        verdict.add(
            Level.ERROR,
            f"{not_finite} samples had values that are not finite: power-cycle the sensor; if that does not "
            "help, ask Bota",
        )


def _lost_text(lost: str) -> str:
    """The server's words, with what to do if they do not say it."""
    return lost if "check " in lost else f"{lost}; check its cable and power"


def _why_silent(s: Snapshot) -> str:
    if s.lost is not None:
        return _lost_text(s.lost)
    if s.answer_s > 1.0:
        return "the server does not answer: it is stopped or overloaded"
    if s.info is not None and s.info.state not in {"OP", "?"}:
        return f"the server has the sensor in state {s.info.state}, not OP: see its log"
    if s.new.repeated:
        return "the sensor repeats the same sample again and again: power-cycle it"
    if s.new.invalid:
        return "the sensor does not answer the bus: check its cable and power"
    return "the server sends none: see its log"


def _sensor(s: Snapshot, t: Thresholds) -> Status:
    verdict = _Verdict()
    if not s.connected:
        verdict.add(Level.STALE, "unknown: there is no connection to the server, see link")
    elif s.lost is not None:
        verdict.add(Level.ERROR, _lost_text(s.lost))
    elif s.silent_s > t.stale_after:
        verdict.add(Level.STALE, "unknown: there are no new samples, see stream")
    else:
        for row in explain(s.flags.warnings):
            verdict.add(_LEVELS[row.severity], f"{row.meaning}: {row.remedy}")
        for name in _SATURATIONS:
            if bits := getattr(s.flags, name):
                many = f" ({s.new_saturated} samples)" if name == _SATURATIONS[0] else ""
                verdict.add(Level.WARN, f"{name.replace('_', ' ')}: axes {bits:#x}{many}")
        _judge_settings(verdict, s.settings)
        if s.temperature is not None and s.temperature >= t.temperature_warn:
            level = Level.ERROR if s.temperature >= t.temperature_error else Level.WARN
            verdict.add(level, f"{s.temperature:.1f} °C: let the sensor cool down")
    last = mapping(s.server_row.get("emergency"))
    code, ago_s = whole(last.get("code")), number(last.get("ago_s"))
    emergency = "" if code is None else f"emergency 0x{code:04X} ({printable(last.get('text'), 80)})"
    if code is not None and code & _ERROR_CLASS and ago_s is not None and 0 <= ago_s < _EMERGENCY_S:
        verdict.add(Level.WARN, f"{emergency} {ago_s:.0f} s ago: if it comes again, ask Bota")
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
        **{name: f"{getattr(s.flags, name):#x}" for name in _SATURATIONS},
        "saturated_samples": s.saturated,
        "emergencies": s.server_row.get("emergencies", ""),
        "last_emergency": emergency,
        "last_emergency_ago_s": "" if ago_s is None else ago_s,
    }
    return verdict.status("sensor", "as it should be", values)


def _judge_settings(verdict: _Verdict, settings: Mapping[str, object]) -> None:
    if settings.get("calibration_matrix") is False:
        verdict.add(
            Level.ERROR,
            "settings.calibration_matrix is off: force and torque are counts and not N and Nm, switch it on",
        )
    if settings.get("coordinate_system") is True:
        verdict.add(
            Level.WARN,
            "settings.coordinate_system is on: force and torque are in a frame configured in the sensor, "
            "not in frame_id as in the URDF; switch it off, or correct the URDF",
        )


def _clock(s: Snapshot, t: Thresholds) -> Status:
    clock = mapping(s.server_row.get("clock"))
    verdict, mode = _Verdict(), clock.get("mode")
    if not s.connected or s.lost is not None or s.silent_s > t.stale_after:
        verdict.add(Level.STALE, "unknown: there are no new samples, see stream")
    elif mode is None:
        verdict.add(Level.STALE, "the server has not said yet")
    elif mode != "locked":
        verdict.add(
            Level.WARN,
            "oversampling: the server does not follow the sensor's clock (yet): stamps are less exact",
        )
    values: Values = {
        name: clock.get(name, "") for name in ("mode", "period_us", "offset_ppm", "uncertainty_us")
    }
    return verdict.status("clock", "locked to the sensor's clock", values)


def _compensation(s: Snapshot, t: Thresholds) -> Status:
    verdict, c = _Verdict(), s.compensation
    if not s.connected or s.lost is not None or s.silent_s > t.stale_after:
        verdict.add(Level.STALE, "there are no new samples, see stream")
    elif c.why_stopped is not None:
        state = "has stopped" if c.has_subscribers else "could not be published if somebody subscribed"
        verdict.add(Level.ERROR, f"wrench_compensated {state}: {c.why_stopped}")
    elif c.why_partly:
        verdict.add(Level.ERROR, c.why_partly)
    elif s.new_withheld:
        verdict.add(Level.WARN, f"{s.new_withheld} samples were not compensated{_why_withheld(s)}")
    if c.problem:
        verdict.add(Level.WARN, c.problem)
    return verdict.status("compensation", c.good, c.values)


def _why_withheld(s: Snapshot) -> str:
    """What may have been the reason."""
    c, reasons = s.compensation, []
    if c.stops_on_saturation and s.new_saturated:
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
