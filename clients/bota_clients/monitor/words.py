"""States in words and as JSON, the same for the terminal and the browser."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from bota_clients.monitor.model import Alert, Percentiles, SensorView, ServerClient, ServerState, State
from bota_clients.numbers import duration, milliseconds
from bota_ethercat.health.limits import Level
from bota_ethercat.text.json_text import finite

if TYPE_CHECKING:
    from bota_clients.monitor.compensated import Compensated
    from bota_ft_compensation.contact import Contact

DIGITS = {"N": 2, "Nm": 3, "counts": 0, "m/s²": 2, "rad/s": 3}  # decimals by unit


def link(server: ServerState) -> str:
    """State of the connection, in a few words."""
    if server.since_s is None:
        return "connecting"
    if not server.connected:
        return f"SERVER GONE {duration(server.since_s)}"
    return (
        f"SERVER SILENT {duration(server.heard_s or 0)}"
        if server.silent
        else f"connected {duration(server.since_s)}"
    )


def trouble(server: ServerState) -> str | None:
    """What is wrong with the server, one clause; None if nothing is."""
    if server.since_s is None:
        return None
    if not server.connected:
        return f"gone: {server.reason}; reconnecting"
    silent = f"nothing came for {duration(server.heard_s or 0)}: it may be stopped, or its machine too busy"
    return silent if server.silent else None


def verdict(state: State) -> tuple[Level, str]:
    """How bad all that is there is, and what was found."""
    if not state.server.connected or trouble(state.server):
        wrong = trouble(state.server)
        return Level.TROUBLE, f"there is no server: {wrong}" if wrong else "there is no server"
    if not state.sensors:
        return Level.TROUBLE, "the server has no sensor"
    found = [
        (finding.level, f"sensor {sensor.position}: {finding.sentence}")
        for sensor in state.sensors
        for finding in sensor.verdict.findings
    ]
    if not found:
        return Level.GOOD, state.sensors[0].verdict.sentence
    found.sort(key=lambda one: -one[0])
    return found[0][0], "; ".join(sentence for _, sentence in found)


def server_facts(server: ServerState) -> list[tuple[str, str]]:
    """Name and value of what is known of the server."""
    if not server.connected or server.uptime_s is None:
        return []
    return [
        ("Up", duration(server.uptime_s)),
        ("Missed deadlines", count(server.status.missed_deadlines)),
        ("Lost frames", count(server.status.lost_frames)),
        ("Exchange", times(server.exchange_us)),
        ("Woke late by", times(server.wake_us)),
        ("Cycles", count(server.status.cycles)),
        ("Version", server.version or "?"),
    ]


def identity(sensor: SensorView) -> str:
    """Position, AL state, name, serial number and firmware."""
    info = sensor.info
    serial = "" if info.serial is None else f"serial {info.serial}"
    firmware = f"firmware {info.firmware}" if info.firmware else ""
    parts = (f"Sensor {sensor.position}", sensor.al_state, info.name, serial, firmware)
    return "  ".join(part for part in parts if part)


def delays(sensor: SensorView) -> str:
    """By how much the sensor's filters delay its values."""
    force_torque, *imu = ("not known" if ms is None else f"{ms:g} ms" for ms in sensor.delay_ms.values())
    of_imu = "" if sensor.imu_off else f"   acceleration {imu[0]}   angular rate {imu[1]}"
    return f"force, torque {force_torque}{of_imu}"


def rate(sensor: SensorView) -> str:
    found = "no samples" if sensor.rate_hz is None else f"{sensor.rate_hz:.1f}"
    return f"{found} of {sensor.info.rate_hz:g} Hz" if sensor.info.rate_hz else f"{found} Hz"


def jitter(sensor: SensorView) -> str:
    if sensor.jitter_us is None or sensor.jitter_worst_us is None:
        return "not known"
    return f"{sensor.jitter_us:.0f} µs, worst {sensor.jitter_worst_us:.0f}"


def losses(sensor: SensorView) -> list[tuple[str, bool]]:
    """Each kind of loss in words, and whether there was any."""
    lost = sensor.status.lost_samples
    return [
        (f"{sensor.missed} on the way here", bool(sensor.missed)),
        (f"repeated {sensor.repeated}", bool(sensor.repeated)),
        (f"invalid {sensor.invalid}", bool(sensor.invalid)),
        (f"{count(lost)} on the bus since start", False),  # what is lost now is in the verdict
    ]


def clock(sensor: SensorView) -> str:
    """How the server follows the sensor's clock."""
    known = sensor.status.clock
    text = known.mode
    if text == "locked":
        text += "" if known.offset_ppm is None else f", {known.offset_ppm:+.1f} ppm"
        text += "" if known.uncertainty_us is None else f", ±{known.uncertainty_us:.0f} µs"
    return text or "not known"


def client(one: ServerClient) -> str:
    text = "this one" if one.this else one.peer
    if one.rate_hz is not None:
        text += f" {one.rate_hz:.0f}/s"
    return f"{text}, {one.withheld} withheld" if one.withheld else text


def contact(one: Contact) -> str:
    """Whether something touches the tool, and where."""
    if one.region is None:
        return "none" if one.why.name == "NO_CONTACT" else f"yes, but not known where: {one.why.value}"
    x, y, z = (1e3 * each for each in one.point)
    how = "press" if one.is_press else "pull"
    return f"{how} at x {x:.0f}, y {y:.0f}, z {z:.0f} mm, 95 % region up to {1e3 * one.region.largest:.0f} mm"


def times(spread: Percentiles | None) -> str:
    """Median and p99 or worst of a distribution."""
    if spread is None:
        return "not known"
    return f"{milliseconds(spread.p50)} ms, {spread.which} {milliseconds(spread.high)}"


def count(value: int | None) -> str:
    return "?" if value is None else str(value)


def seen(ago_s: float | None) -> str:
    return "now" if ago_s is None else f"{duration(ago_s)} ago"


def alert(one: Alert) -> dict[str, str]:
    return {"severity": one.level.key, "text": one.text, "remedy": one.remedy}


def json_line(state: State, unix_s: float) -> str:
    """The state in one line, for programs: docs/schemas/monitor.json."""
    return json.dumps(finite(json_object(state, unix_s)), allow_nan=False)


def json_object(state: State, unix_s: float) -> dict[str, Any]:
    """The state for programs; what is not known is null."""
    server = state.server
    return {
        "time": unix_s,
        **_plain(server, "address connected since_s heard_s"),
        "reason": server.reason or None,
        "replay": server.replay or None,
        "server": {
            **_plain(server, "version uptime_s"),
            **_plain(server.status, "cycles missed_deadlines lost_frames"),
            "wake_us": _percentiles(server.wake_us),
            "exchange_us": _percentiles(server.exchange_us),
        }
        if server.connected
        else None,
        "sensors": [_sensor(sensor) for sensor in state.sensors],
        "clients": [client._asdict() for client in state.clients],
    }


def _sensor(sensor: SensorView) -> dict[str, Any]:
    sample, peaks, info, status = sensor.sample, sensor.peaks, sensor.info, sensor.status
    imu = None if sensor.imu_off else sample
    return {
        "sensor": sensor.position,
        "state": sensor.al_state,
        **_plain(info, "name serial firmware"),
        "nominal_hz": info.rate_hz or None,
        **_plain(sensor, "delay_ms units"),
        "force": sample and sample.force,
        "torque": sample and sample.torque,
        "force_min_max": peaks and peaks[:3],
        "torque_min_max": peaks and peaks[3:],
        "acceleration": imu and imu.acceleration,
        "angular_rate": imu and imu.angular_rate,
        "temperature": sample and sample.temperature,
        "orientation": sample and sample.orientation,
        "compensated": sensor.compensated and _compensated(sensor.compensated),
        "saturated": sorted(sensor.saturated),
        "verdict": sensor.verdict.level.key,
        "alerts": [alert(one) for one in sensor.alerts],
        **_plain(sensor, "samples rate_hz jitter_us jitter_worst_us missed gaps repeated invalid silent_s"),
        "lost_on_bus": status.lost_samples,
        "recoveries": status.recoveries,
        "age_us": _percentiles(sensor.age_us),
        "clock": _plain(status.clock, "mode offset_ppm uncertainty_us") if status.clock.mode else None,
        "hand_out_us": _percentiles(sensor.hand_out_us),
    }


def _compensated(found: Compensated) -> dict[str, Any]:
    contact = found.contact
    return {
        **_plain(found, "force torque force_bound torque_bound"),
        "contact": contact and {
            "detected": contact.why.name != "NO_CONTACT",
            "point": contact.region and contact.point,
            "press": None if contact.region is None else contact.is_press,
            "region_m": contact.region and contact.region.largest,
        },
    }  # fmt: skip


def _plain(thing: object, names: str) -> dict[str, Any]:
    return {name: getattr(thing, name) for name in names.split()}


def _percentiles(spread: Percentiles | None) -> dict[str, float] | None:
    return None if spread is None else {"p50": spread.p50, spread.which: spread.high}
