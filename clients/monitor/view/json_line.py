"""The state as one JSON object, for programs. docs/monitor.md says what each key is."""

from __future__ import annotations

import json
from typing import Any

from clients.monitor.model.state import Range, SensorState, Spread, State
from protocol.text.json_text import finite


def json_line(state: State, unix_s: float) -> str:
    """One line. Numbers that JSON has not, and what is not known, are null."""
    return json.dumps(finite(as_json(state, unix_s)), allow_nan=False, ensure_ascii=True)


def as_json(state: State, unix_s: float) -> dict[str, Any]:
    """The same, not yet text."""
    server = state.server
    return {
        "time": unix_s,
        "address": server.address,
        "connected": server.connected,
        "since_s": server.since_s,
        "heard_s": server.heard_s,
        "reason": server.reason or None,
        "replay": server.replay or None,
        "server": {
            "version": server.version,
            "uptime_s": server.uptime_s,
            "cycles": server.cycles,
            "missed_deadlines": server.missed_deadlines,
            "lost_frames": server.lost_frames,
            "wake_us": _spread(server.wake_us, "p99"),
            "exchange_us": _spread(server.exchange_us, "p99"),
        }
        if server.connected
        else None,
        "sensors": [_sensor(sensor) for sensor in state.sensors],
        "clients": [
            {
                "peer": client.peer,
                "this": client.is_this,
                "rate_hz": client.rate_hz,
                "sent": client.sent,
                "withheld": client.withheld,
            }
            for client in state.clients
        ],
    }


def _sensor(sensor: SensorState) -> dict[str, Any]:
    sample, stream = sensor.sample, sensor.stream
    peaks = sensor.peaks
    return {
        "sensor": sensor.position,
        "name": sensor.name,
        "serial": sensor.serial,
        "firmware": sensor.firmware,
        "state": sensor.al_state,
        "nominal_hz": sensor.nominal_hz,
        "units": list(sensor.units),
        "force": sample and list(sample.force),
        "torque": sample and list(sample.torque),
        "force_min_max": peaks and _ranges(peaks[:3]),
        "torque_min_max": peaks and _ranges(peaks[3:]),
        "acceleration": None if sample is None or sensor.imu_off else list(sample.acceleration),
        "angular_rate": None if sample is None or sensor.imu_off else list(sample.angular_rate),
        "temperature": sample and sample.temperature,
        "orientation": sample and sample.orientation and list(sample.orientation),
        "saturated": sorted(sensor.saturated),
        "verdict": sensor.verdict.level.key,
        "alerts": [{"severity": a.level.key, "text": a.text, "remedy": a.remedy} for a in sensor.alerts],
        "samples": stream.samples,
        "rate_hz": stream.rate_hz,
        "age_us": _spread(stream.age_us, "worst"),
        "jitter_us": stream.jitter_us,
        "jitter_worst_us": stream.jitter_worst_us,
        "missed": stream.missed,
        "gaps": stream.gaps,
        "repeated": stream.repeated,
        "invalid": stream.invalid,
        "silent_s": stream.silent_s,
        "lost_on_bus": sensor.bus_lost,
        "recoveries": sensor.recoveries,
        "clock": sensor.clock and sensor.clock._asdict(),
        "hand_out_us": _spread(sensor.hand_out_us, "p99"),
    }


def _ranges(ranges: tuple[Range, ...]) -> list[list[float]]:
    return [[r.low, r.high] for r in ranges]


def _spread(spread: Spread | None, worst: str) -> dict[str, float] | None:
    return None if spread is None else {"p50": spread.p50, worst: spread.worst}
