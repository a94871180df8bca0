"""The state as plain text: a table for --once, a line for where there is no terminal."""

from __future__ import annotations

from collections.abc import Sequence

from clients import numbers
from clients.monitor.model.state import Alert, SensorState, State
from clients.monitor.view import words
from protocol.health.verdict import Level

_WIDTH = 20


def table(state: State) -> list[str]:
    """The whole state; the last line is the verdict."""
    server = state.server
    trouble = words.trouble(server)
    lines = [f"Server {server.address}  {words.link(server)}"]
    if server.replay:
        lines.append(f"  REPLAY of {server.replay}")
    if trouble is not None:
        lines.append(f"  {trouble}")
    elif server.uptime_s is not None:
        lines += [
            f"  up {numbers.duration(server.uptime_s)}, version {server.version or '?'}, cycles "
            f"{words.count(server.cycles)}, missed deadlines {words.count(server.missed_deadlines)}, "
            f"lost frames {words.count(server.lost_frames)}",
            f"  woke late by {words.age(server.wake_us, 'p99')}; "
            f"exchange {words.age(server.exchange_us, 'p99')}",
        ]
    lines += [f"  client {words.client(client)}" for client in state.clients]
    for sensor in state.sensors:
        lines += ["", *_sensor(sensor)]
    level, what = verdict(state)
    return [*lines, "", f"{level.words.capitalize()}: {what}."]


def verdict(state: State) -> tuple[Level, str]:
    """How bad all that is there is, and what was found."""
    wrong = words.trouble(state.server)
    if wrong is not None or not state.server.connected:
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


def line(sensor: SensorState, clock_text: str) -> str:
    """One sensor in one line."""
    parts = [clock_text, f"sensor {sensor.position}"]
    sample = sensor.sample
    if sample is None:
        parts.append("no sample yet")
    else:
        for name, unit, values in zip("FM", sensor.units, (sample.force, sample.torque), strict=True):
            parts.append(f"{name} {_numbers(values, words.DIGITS[unit], 0, ' ')} {unit}")
        parts.append(f"{sample.temperature:.1f} °C")
    parts += [words.rate(sensor), f"age {words.age(sensor.stream.age_us, 'worst')}"]
    stream = sensor.stream
    parts.append(f"lost {words.count(sensor.bus_lost)}+{stream.missed} repeated {stream.repeated}")
    alerts = [f"{alert.level.words}: {_alert(alert)}" for alert in sensor.alerts if alert.ago_s is None]
    return "  ".join([*parts, *alerts])


def _sensor(sensor: SensorState) -> list[str]:
    force, torque = sensor.units
    rows = [words.identity(sensor)]
    sample = sensor.sample
    if sample is not None:
        rows.append(" " * _WIDTH + "".join(axis.rjust(10) for axis in "xyz"))
        peaks = sensor.peaks or ()
        for name, unit, values, part in (
            ("force", force, sample.force, peaks[:3]),
            ("torque", torque, sample.torque, peaks[3:]),
        ):
            digits = words.DIGITS[unit]
            rows.append(f"  {name}, {unit}".ljust(_WIDTH) + _numbers(values, digits))
            if part:
                rows.append("    min".ljust(_WIDTH) + _numbers([r.low for r in part], digits))
                rows.append("    max".ljust(_WIDTH) + _numbers([r.high for r in part], digits))
        if sensor.imu_off:
            rows.append("  IMU off")
        else:
            rows.append("  acceleration, m/s²".ljust(_WIDTH) + _numbers(sample.acceleration, 2))
            rows.append("  rate, rad/s".ljust(_WIDTH) + _numbers(sample.angular_rate, 3))
        if sample.orientation is not None:
            rows.append("  orientation xyzw".ljust(_WIDTH) + _numbers(sample.orientation, 3))
        rows.append("  temperature, °C".ljust(_WIDTH) + f"{sample.temperature:.1f}".rjust(10))
    stream = sensor.stream
    rows += [
        f"  stream    {words.rate(sensor)}, age {words.age(stream.age_us, 'worst')}, "
        f"jitter {words.jitter(sensor)}",
        f"  lost      {', '.join(text for text, _ in words.losses(sensor))}, gaps {stream.gaps}",
        f"  clock     {words.clock(sensor)}, age at hand-out {words.age(sensor.hand_out_us, 'p99')}",
    ]
    for alert in sensor.alerts:
        rows.append(f"  {alert.level.words.ljust(12)}  {_alert(alert)} -> {alert.remedy}")
    if not sensor.alerts:
        rows.append("  warnings  none")
    return rows


def _alert(alert: Alert) -> str:
    return alert.text if alert.ago_s is None else f"{alert.text} ({words.seen(alert.ago_s)})"


def _numbers(values: Sequence[float], digits: int, width: int = 10, separator: str = "") -> str:
    return separator.join(numbers.quantity(value, digits, width) for value in values)
