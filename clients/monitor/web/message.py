"""The state as a page shows it, as JSON: texts are those of the other views."""

from __future__ import annotations

import json
from typing import Any

from clients import numbers
from clients.monitor.model.state import AXES, Alert, SensorState, ServerState, State
from clients.monitor.view import words
from protocol.health.verdict import Level
from protocol.sensor.meaning import value_meaning
from protocol.text.json_text import finite


def state_text(state: State, position: int, number: int) -> str:
    """State `number` for a page that shows the sensor at `position`; unknown values are null."""
    server = state.server
    said = state.message
    message = {
        "state": number,
        "address": server.address,
        "link": words.link(server),
        "trouble": words.trouble(server),
        "server": _server(server),
        "clients": [words.client(client) for client in state.clients],
        "message": None if said is None else {"text": said.text, "bad": said.bad},
        "events": list(state.events),
        "sensors": [_brief(sensor, server) for sensor in state.sensors],
        "sensor": next((_sensor(sensor) for sensor in state.sensors if sensor.position == position), None),
    }
    return json.dumps(finite(message), allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def _server(server: ServerState) -> list[tuple[str, str]]:
    if not server.connected or server.uptime_s is None:
        return []
    return [
        ("Version", server.version or "?"),
        ("Up", numbers.duration(server.uptime_s)),
        ("Cycles", words.count(server.cycles)),
        ("Missed deadlines", words.count(server.missed_deadlines)),
        ("Lost frames", words.count(server.lost_frames)),
        ("Woke late by", words.age(server.wake_us, "p99")),
        ("Exchange", words.age(server.exchange_us, "p99")),
    ]


def _brief(sensor: SensorState, server: ServerState) -> dict[str, Any]:
    return {
        "position": sensor.position,
        "name": sensor.name,
        "ok": None if words.trouble(server) else sensor.verdict.level is not Level.TROUBLE,
    }


def _sensor(sensor: SensorState) -> dict[str, Any]:
    sample = sensor.sample
    return {
        "position": sensor.position,
        "identity": words.identity(sensor),
        "lost": sensor.al_state not in {"OP", ""},
        "old": None if sensor.old_s is None else numbers.duration(sensor.old_s),
        "has_sample": sample is not None,
        "nominal_hz": sensor.nominal_hz,
        "units": sensor.units,
        "digits": [words.DIGITS[unit] for unit in sensor.units],
        "imu_off": sensor.imu_off,
        "peaks": None if sensor.peaks is None else dict(zip(AXES, sensor.peaks, strict=True)),
        "saturated": sorted(sensor.saturated),
        "alerts": [_alert(alert) for alert in sensor.alerts],
        "stream": [
            ("Rate", words.rate(sensor)),
            ("Age", words.age(sensor.stream.age_us, "worst")),
            ("Age at hand-out", words.age(sensor.hand_out_us, "p99")),
            ("Jitter", words.jitter(sensor)),
            ("Clock", words.clock(sensor)),
            *_beside(sensor),
        ],
        "losses": words.losses(sensor),
        "settings": _settings(sensor),
    }


def _beside(sensor: SensorState) -> list[tuple[str, str]]:
    """What has no trace."""
    sample = sensor.sample
    if sample is None:
        return []
    found = [("Temperature", f"{sample.temperature:.1f} °C")]
    if sample.orientation is not None:
        found.append(("Orientation xyzw", " ".join(f"{part:+.2f}" for part in sample.orientation)))
    return found


def _alert(alert: Alert) -> dict[str, Any]:
    return {
        "severity": alert.level.key,
        "level": alert.level.words,
        "text": alert.text,
        "remedy": alert.remedy,
        "when": words.seen(alert.ago_s),
        "present": alert.ago_s is None,
    }


def _settings(sensor: SensorState) -> list[tuple[str, str, str]]:
    rate_hz, chop = sensor.nominal_hz, sensor.settings.get("chop")
    return [
        (name, str(value).lower(), value_meaning(name, value, round(rate_hz) if rate_hz else None, chop))
        for name, value in sensor.settings.items()
    ]
