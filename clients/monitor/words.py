"""Numbers and states in words, the same in every view."""

from __future__ import annotations

import math

from clients.monitor.state import Client, SensorState, ServerState, Spread

DIGITS = {"N": 2, "Nm": 3, "counts": 0}
"""After the point, by unit."""


def quantity(value: float, digits: int, width: int = 0) -> str:
    """A number with its sign; what does not fit its width loses digits, never its size."""
    if not math.isfinite(value):
        return "nan".rjust(width)
    if value == 0:
        value = 0.0  # -0.0 has a sign
    text = f"{value:+.{digits}f}"
    if width and len(text) > width:
        text = f"{value:+.{max(0, width - 7)}e}"
    return text.rjust(width)


def duration(seconds: float) -> str:
    """So long: `4 s`, `3m05s`, `1h02m`, `2d03h`."""
    whole = max(0, int(seconds))
    if whole < 60:
        return f"{whole} s"
    minutes, second = divmod(whole, 60)
    hours, minute = divmod(minutes, 60)
    days, hour = divmod(hours, 24)
    if days:
        return f"{days}d{hour:02d}h"
    return f"{hour}h{minute:02d}m" if hours else f"{minute}m{second:02d}s"


def milliseconds(value_us: float) -> str:
    """Of a time in µs."""
    return f"{value_us / 1e3:.2f}" if value_us < 99_950 else f"{value_us / 1e3:.0f}"


def age(spread: Spread | None, worst: str) -> str:
    """A distribution of ages."""
    if spread is None:
        return "not known"
    return f"{milliseconds(spread.p50)} ms, {worst} {milliseconds(spread.worst)}"


def count(value: int | None) -> str:
    """A count that may not be known."""
    return "?" if value is None else str(value)


def link(server: ServerState) -> str:
    """How the server is, in a few words."""
    if server.since_s is None:
        return "connecting"
    if not server.connected:
        return f"SERVER GONE {duration(server.since_s)}"
    if server.silent and server.heard_s is not None:
        return f"SERVER SILENT {duration(server.heard_s)}"
    return f"connected {duration(server.since_s)}"


def trouble(server: ServerState) -> str | None:
    """What is wrong with the server, one sentence; None if nothing is."""
    if server.since_s is None:
        return None
    if not server.connected:
        return f"gone at {server.since_clock}: {server.reason}; trying again"
    if server.silent and server.heard_s is not None:
        return f"nothing came for {duration(server.heard_s)}: it may be stopped, or its machine too busy"
    return None


def identity(sensor: SensorState) -> str:
    """Who it is."""
    parts = [f"Sensor {sensor.place}", sensor.name]
    if sensor.serial is not None:
        parts.append(f"serial {sensor.serial}")
    if sensor.firmware:
        parts.append(f"firmware {sensor.firmware}")
    return "  ".join(part for part in (*parts, sensor.al_state) if part)


def rate(sensor: SensorState) -> str:
    """Samples a second, and how many there should be."""
    found = "no samples" if sensor.stream.rate_hz is None else f"{sensor.stream.rate_hz:.1f}"
    return f"{found} of {sensor.nominal_hz:g} Hz" if sensor.nominal_hz else f"{found} Hz"


def jitter(sensor: SensorState) -> str:
    """Of the stamps."""
    stream = sensor.stream
    if stream.jitter_us is None or stream.jitter_worst_us is None:
        return "not known"
    return f"{stream.jitter_us:.0f} µs, worst {stream.jitter_worst_us:.0f}"


def losses(sensor: SensorState) -> list[tuple[str, bool]]:
    """What did not come, or came in vain: in words, and whether it did."""
    stream = sensor.stream
    return [
        (f"{count(sensor.bus_lost)} on the bus", bool(sensor.bus_lost)),
        (f"{stream.missed} on the way here", bool(stream.missed)),
        (f"repeated {stream.repeated}", bool(stream.repeated)),
        (f"invalid {stream.invalid}", bool(stream.invalid)),
    ]


def clock(sensor: SensorState) -> str:
    """How the server follows the sensor's clock."""
    known = sensor.clock
    if known is None:
        return "not known"
    text = known.mode
    if known.mode == "locked":
        if known.offset_ppm is not None:
            text += f", {known.offset_ppm:+.1f} ppm"
        if known.uncertainty_us is not None:
            text += f", ±{known.uncertainty_us:.0f} µs"
    return text


def client(one: Client) -> str:
    """One client of the server."""
    text = "this one" if one.is_this else one.peer
    if one.rate_hz is not None:
        text += f" {one.rate_hz:.0f}/s"
    return f"{text}, {one.withheld} withheld" if one.withheld else text


def seen(ago_s: float | None) -> str:
    """When something last was."""
    return "now" if ago_s is None else f"{duration(ago_s)} ago"
