"""States in words, the same in every view."""

from __future__ import annotations

from clients.monitor.model.state import Client, SensorState, ServerState, Spread
from clients.numbers import duration, milliseconds

DIGITS = {"N": 2, "Nm": 3, "counts": 0}
"""Decimals by unit."""


def age(spread: Spread | None, worst: str) -> str:
    """Median and worst of a distribution of ages."""
    if spread is None:
        return "not known"
    return f"{milliseconds(spread.p50)} ms, {worst} {milliseconds(spread.worst)}"


def count(value: int | None) -> str:
    """A count that may not be known."""
    return "?" if value is None else str(value)


def link(server: ServerState) -> str:
    """State of the connection, in a few words."""
    if server.since_s is None:
        return "connecting"
    if not server.connected:
        return f"SERVER GONE {duration(server.since_s)}"
    if server.silent and server.heard_s is not None:
        return f"SERVER SILENT {duration(server.heard_s)}"
    return f"connected {duration(server.since_s)}"


def trouble(server: ServerState) -> str | None:
    """What is wrong with the server, one clause; None if nothing is."""
    if server.since_s is None:
        return None
    if not server.connected:
        return f"gone at {server.since_clock}: {server.reason}; reconnecting"
    if server.silent and server.heard_s is not None:
        return f"nothing came for {duration(server.heard_s)}: it may be stopped, or its machine too busy"
    return None


def identity(sensor: SensorState) -> str:
    """Position, name, serial number, firmware and AL state."""
    return "  ".join(part for part in (who(sensor), sensor.al_state) if part)


def who(sensor: SensorState, *, firmware: bool = True) -> str:
    """Position, name, serial number and firmware."""
    parts = [f"Sensor {sensor.position}", sensor.name]
    if sensor.serial is not None:
        parts.append(f"serial {sensor.serial}")
    if sensor.firmware and firmware:
        parts.append(f"firmware {sensor.firmware}")
    return "  ".join(part for part in parts if part)


def rate(sensor: SensorState) -> str:
    """Measured and nominal rate."""
    found = "no samples" if sensor.stream.rate_hz is None else f"{sensor.stream.rate_hz:.1f}"
    return f"{found} of {sensor.nominal_hz:g} Hz" if sensor.nominal_hz else f"{found} Hz"


def jitter(sensor: SensorState) -> str:
    """Standard deviation and worst interval."""
    stream = sensor.stream
    if stream.jitter_us is None or stream.jitter_worst_us is None:
        return "not known"
    return f"{stream.jitter_us:.0f} µs, worst {stream.jitter_worst_us:.0f}"


def losses(sensor: SensorState) -> list[tuple[str, bool]]:
    """Each kind of loss in words, and whether there was any."""
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
    """When something was last seen."""
    return "now" if ago_s is None else f"{duration(ago_s)} ago"
