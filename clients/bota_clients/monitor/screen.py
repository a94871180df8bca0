"""The screen as rows of text, from a state alone; and the same rows as a table for --once.

Nothing depends on color alone: bars, peak marks and warnings differ in their characters too. The three colors
can be told apart with common color blindness, on light and dark backgrounds.
"""

from __future__ import annotations

import math
import statistics
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Final, NamedTuple

from rich.text import Text

from bota_clients import numbers
from bota_clients.monitor import words
from bota_clients.monitor.model import AXES, TRACE_STEP_S, Alert, Range, SensorState, State

KEYS: Final = (
    ("t", "tare", "zero this sensor's reading, in the sensor, or undo that; asks first"),
    ("r", "record", "start or stop a recording in this folder (ethercat-record)"),
    ("p", "pause", "freeze the display; samples and peaks still count"),
    ("0", "reset", "reset peaks and past warnings"),
    ("n", "next", "the next sensor of the chain"),
    ("w", "warn", "all warnings of this sensor"),
    ("?", "help", "this page"),
    ("q", "quit", "also Ctrl-C; Ctrl-L redraws the screen"),
)  # key, its short name, what it does
_HELP: Final = """
Bars are centered on zero; their scale grows with the marked peaks, for which
every sample counts. A trace has its own scale; a column of it is 0.25 s.
age     of a sample on arrival; only on the server's own machine
jitter  of the intervals between the samples' stamps
lost    on the bus since the server started; on the way here since connecting
Clock   locked: the server follows the sensor's own clock, else oversampling
Fx!     this axis is saturated; warnings stay listed until the reset

Press any key to return."""

LABEL: Final = "dim"
VALUE: Final = "bold"
BAR: Final = "#2a94d6"
PEAK: Final = "bold #d98200"
BAD: Final = "bold #d55e00"
ALARM: Final = "bold reverse #d55e00"
NOTICE: Final = "bold reverse"

_LEAST: Final = (24, 8)  # width and height
_MESSAGE_ROWS_FROM: Final = 12
_PANEL_ROWS: Final = 18
_TABLE_WIDTH: Final = 80
_LEAST_SCALE: Final = {"N": 5.0, "Nm": 0.2, "counts": 1000.0}
_VALUE_WIDTH: Final = 9
_AXIS_WIDTH: Final = 4 + _VALUE_WIDTH + 1  # label, value, space
_LEVELS: Final = "▁▂▃▄▅▆▇"  # of a trace
_LEAST_TRACE: Final = 0.05  # of the bar's scale, so that noise does not look like a signal


@dataclass(frozen=True, slots=True)
class Look:
    """The user's choices."""

    selected: int = 0  # which sensor, counted from 0 in the state's order
    paused: str = ""  # time of day of the pause; empty if not paused
    recording: str = ""  # the running recording, in words
    question: str = ""  # the pending question
    help: bool = False
    warnings: int = 0  # the page of all warnings, from 1; 0: none. After the last comes the first
    ascii: bool = False


class Row(NamedTuple):
    """One row of the screen. Rows of the highest rank are dropped first."""

    rank: int
    text: Text


def render(state: State, look: Look, width: int, height: int) -> list[Text]:
    """Exactly `height` rows, none wider than `width`."""
    if width < _LEAST[0] or height < _LEAST[1]:
        rows = [Text(f"too small: {_LEAST[0]}x{_LEAST[1]} at least")]
    elif look.help:
        rows = [Text.assemble(("ethercat-monitor ", VALUE), state.server.address), Text()]
        rows += [
            Text.assemble((f"  {key}  ", VALUE), (name.ljust(8), LABEL), what) for key, name, what in KEYS
        ]
        rows += map(Text, _HELP.splitlines())
    elif look.warnings and state.sensors:
        rows = _warnings(state.sensors[look.selected % len(state.sensors)], look.warnings, width, height)
    else:
        rows = _overview(state, look, width, height)
    rows = rows[:height] + [Text()] * (height - len(rows))
    return [_fitted(row, width, look.ascii) for row in rows]


def table(state: State) -> list[str]:
    """The whole state in plain text; the last line is the verdict."""
    server = state.server
    wrong = words.trouble(server)
    lines = [f"Server {server.address}  {words.link(server)}"]
    if server.replay:
        lines.append(f"  REPLAY of {server.replay}")
    facts = [f"{name.lower()} {value}" for name, value in words.server_facts(server)]
    lines += [f"  {wrong}"] if wrong else [f"  {'; '.join(row)}" for row in (facts[:4], facts[4:]) if row]
    lines += [f"  client {words.client(client)}" for client in state.clients]
    for sensor in state.sensors:
        rows = [*_panel(sensor, (), _TABLE_WIDTH, trace=False), *_alerts(sensor, 1 << 16, 1 << 16)]
        lines += ["", *(row.text.plain.rstrip() for row in rows)]
    level, what = words.verdict(state)
    return [*lines, "", f"{level.words.capitalize()}: {what}."]


def line(sensor: SensorState, now: str) -> str:
    """One sensor in one line, at this time of day."""
    parts = [now, f"sensor {sensor.position}"]
    sample = sensor.sample
    if sample is None:
        parts.append("no sample yet")
    else:
        for name, unit, values in zip("FM", sensor.units, (sample.force, sample.torque), strict=True):
            shown = " ".join(numbers.quantity(value, words.DIGITS[unit]) for value in values)
            parts.append(f"{name} {shown} {unit}")
        parts.append(f"{sample.temperature:.1f} °C")
    parts += [words.rate(sensor), f"age {words.times(sensor.age_us)}"]
    parts.append(f"lost {words.count(sensor.lost_on_bus)}+{sensor.missed} repeated {sensor.repeated}")
    parts += [f"{alert.level.words}: {alert.text}" for alert in sensor.alerts if alert.ago_s is None]
    return "  ".join(parts)


def _overview(state: State, look: Look, width: int, height: int) -> list[Text]:
    gone = not state.server.connected and state.server.since_s is not None
    shared = [Row(1 if gone else 3, _server(state)), Row(6, _clients(state, width))]
    foot = [*_message(state, look, width, height), _keys(look, width)]
    body = _sensors(state, look, width, height - 1 - len(shared) - len(foot))
    rows = [Row(0, _title(state, look, width)), *body, *shared]
    while len(rows) > height - len(foot):
        worst = max(row.rank for row in rows)
        del rows[max(n for n, row in enumerate(rows) if row.rank == worst)]
    blank = [Text()] * (height - len(foot) - len(rows))
    return [*(row.text for row in rows), *blank, *foot]


def _sensors(state: State, look: Look, width: int, height: int) -> list[Row]:
    """As many sensors as fit, starting with the selected one; of the others the state."""
    if not state.sensors:
        text = "no sensor known yet" if not state.server.connected else "the server has no sensors"
        return [Row(0, Text(text, LABEL))]
    first = look.selected % len(state.sensors)
    ordered = [*state.sensors[first:], *state.sensors[:first]]
    count = max(1, min(len(ordered), height // _PANEL_ROWS))
    rows: list[Row] = []
    for number, sensor in enumerate(ordered[:count]):
        others = () if number else sorted(ordered[count:], key=lambda other: other.position)
        rows += [Row(7, Text())] if number else []
        own = _panel(sensor, others, width)
        room = height // count - bool(number)
        rows += [*own, *_alerts(sensor, width, max(2, room - len(own)))]
    return rows


def _title(state: State, look: Look, width: int) -> Text:
    server = state.server
    left = Text.assemble(("ethercat-monitor ", VALUE), server.address)
    right = Text()
    for name, what in (("REPLAY ", server.replay), ("", look.recording), ("PAUSED ", look.paused)):
        right.append(f" {name}{what} " if what else "", NOTICE)
    right.append(f" {words.link(server)} ", ALARM if words.trouble(server) else "")
    left.truncate(max(0, width - right.cell_len))
    left.pad_right(max(0, width - right.cell_len - left.cell_len))
    return left.append_text(right)


def _server(state: State) -> Text:
    server = state.server
    if wrong := words.trouble(server):
        return _field("Server", wrong, BAD)
    if server.uptime_s is None:
        return _field("Server", "waiting for its status")
    facts = [f"{name.lower()} {value}" for name, value in words.server_facts(server)]
    return _field("Server", "  ".join(facts[:4]))


def _clients(state: State, width: int) -> Text:
    text = str(len(state.clients)) if state.server.connected else "not known"
    for number, client in enumerate(state.clients):
        left = len(state.clients) - number
        more = f"{':' if not number else ' ·'} {words.client(client)}"
        if len(text) + len(more) + 16 > width - (10 if left > 1 else 0):
            text += f" and {left} more"
            break
        text += more
    return _field("Clients", text)


def _message(state: State, look: Look, width: int, height: int) -> list[Text]:
    """The latest message, on up to three rows."""
    text, style = state.events[-1] if state.events else "", LABEL
    if look.question:
        text, style = look.question, NOTICE
    elif state.message is not None:
        text, style = state.message.text, BAD if state.message.bad else ""
    most = 3 if height >= _MESSAGE_ROWS_FROM else 1
    lines = textwrap.wrap(text, width, break_on_hyphens=False)[:most]
    return [Text(line, style) for line in lines or [""]]


def _keys(look: Look, width: int) -> Text:
    other = {"r": "stop"} if look.recording else {}
    other |= {"p": "resume"} if look.paused else {}
    row = Text()
    for key, name, _ in KEYS:
        row.append(key, VALUE)
        row.append((f" {other.get(key, name)} " if width >= 60 else " ") + " " * (width >= 68), LABEL)
    return row


def _warnings(sensor: SensorState, page: int, width: int, height: int) -> list[Text]:
    """All warnings of the sensor, a page of them."""
    lines = [line for alert in sensor.alerts for line in _alert(alert, width)] or [Text("none")]
    room = height - 4
    pages = math.ceil(len(lines) / room)
    number = (page - 1) % pages
    shown = lines[number * room :][:room]
    title = Text(f"Warnings of sensor {sensor.position}: page {number + 1} of {pages}", VALUE)
    blank = [Text()] * (room - len(shown) + 1)
    return [title, Text(), *shown, *blank, Text("w: next page, any other key: return", LABEL)]


def _panel(
    sensor: SensorState, others: Iterable[SensorState], width: int, *, trace: bool = True
) -> list[Row]:
    """The rows of `sensor`, without its alerts."""
    stream = f"{words.rate(sensor)}   age {words.times(sensor.age_us)}   jitter {words.jitter(sensor)}"
    lost = _field("Lost", "")
    for number, (text, bad) in enumerate(words.losses(sensor)):
        lost.append("   " if number else "").append(text, PEAK if bad else "")
    unlocked = sensor.clock is not None and sensor.clock.mode != "locked"
    clock = _field("Clock", words.clock(sensor), NOTICE if unlocked else "")
    if sensor.hand_out_us is not None:
        clock.append(f"   age at hand-out {words.times(sensor.hand_out_us)}")
    return [
        Row(2, _identity(sensor, others, width)),
        *_axes(sensor, 0, width, trace=trace),
        *_axes(sensor, 1, width, trace=trace),
        *_imu(sensor),
        Row(3, _field("Stream", stream)),
        Row(4, lost),
        Row(5, clock),
    ]


def _field(name: str, text: str, style: str = "") -> Text:
    return Text.assemble((name.ljust(9), LABEL), (text, style))


def _alerts(sensor: SensorState, width: int, most: int) -> list[Row]:
    """At most `most` rows of alerts, or one that says there are none."""
    if not sensor.alerts:
        return [Row(1, _field("Warnings", "none" if sensor.sample is not None else "no sample yet"))]
    rows: list[Row] = []
    for number, alert in enumerate(sensor.alerts):
        lines = _alert(alert, width)
        left = len(sensor.alerts) - number - 1
        if rows and len(rows) + len(lines) + bool(left) > most:
            return [*rows, Row(3, _field("", f"and {left + 1} more: press w"))]
        rows += [Row(3 if number else 1, line) for line in lines]
    return rows


def _alert(alert: Alert, width: int) -> list[Text]:
    present = alert.ago_s is None
    head = Text.assemble(
        (f" {alert.level.words} " if present else alert.level.words, ALARM if present else BAD),
        (f" {words.seen(alert.ago_s)}: ", "" if present else LABEL),
        (alert.text, VALUE if present else ""),
    )
    if head.cell_len + len(alert.remedy) + 4 <= width:
        return [head.append(f" -> {alert.remedy}")]
    return [head, Text(f"  -> {alert.remedy}")]


def _identity(sensor: SensorState, others: Iterable[SensorState], width: int) -> Text:
    rest = Text()
    if sensor.old_s is not None:
        rest.append(f" values {numbers.duration(sensor.old_s)} old ", ALARM)
    for other in others:
        level = other.verdict.level
        rest.append(f" {other.position}", LABEL)
        rest.append(f" {level.words} " if level else f" {level.words}", ALARM if level else "")
    # The state and what is on the right are to be read at every width.
    state = f"  {sensor.al_state}" if sensor.al_state else ""
    room = max(0, width - len(state) - rest.cell_len - bool(rest))
    who = words.who(sensor)
    who = who if len(who) <= room else words.who(sensor, firmware=False)
    row = Text(who, VALUE if sensor.al_state in {"OP", ""} else BAD)
    row.truncate(room)
    row.append(state)
    if rest.cell_len:
        row.pad_right(width - rest.cell_len - row.cell_len)
    return row.append_text(rest)


def _axes(sensor: SensorState, which: int, width: int, *, trace: bool) -> list[Row]:
    """Force, or torque if `which` is 1: a heading and a row an axis."""
    unit, axes = sensor.units[which], range(3 * which, 3 * which + 3)
    shown = (80 if width >= 180 else 24 if width >= 110 else 16 if width >= 76 else 0) if trace else 0
    with_peaks = width >= 56
    left = width - _AXIS_WIDTH - 2 * _VALUE_WIDTH * with_peaks - (shown + 1 if shown else 0)
    across = max(5, left - 1 + left % 2)
    peaks = sensor.peaks or (None,) * len(AXES)
    scale = scale_for((peak for axis in axes if (peak := peaks[axis])), _LEAST_SCALE[unit])
    ends = f"-{scale:g}", f"+{scale:g}"
    middle = ends[0].ljust(across // 2) + "0" + ends[1].rjust(across // 2)
    head = f"{('Force', 'Torque')[which]} {unit}".ljust(_AXIS_WIDTH) + middle[:across]
    head += "min".rjust(_VALUE_WIDTH) + "max".rjust(_VALUE_WIDTH) if with_peaks else ""
    head += f" last {shown * TRACE_STEP_S:g} s" if shown else ""
    rows = [Row(4, Text(head, LABEL))]
    sample = sensor.sample
    for axis in axes:
        saturated = AXES[axis] in sensor.saturated
        label = f"{AXES[axis]}{'!' if saturated else ''}".ljust(4)
        row = Text.assemble((label, ALARM if saturated else LABEL))
        rows.append(Row(0, row))
        if sample is None:
            row.append("--".rjust(_VALUE_WIDTH))
            continue
        value, peak, digits = (*sample.force, *sample.torque)[axis], peaks[axis], words.DIGITS[unit]
        row.append(numbers.quantity(value, digits, _VALUE_WIDTH), VALUE if sensor.old_s is None else LABEL)
        row.append(" ").append_text(bar(value, peak, scale, across))
        if with_peaks:
            for extreme in peak or ():
                row.append(numbers.quantity(extreme, digits, _VALUE_WIDTH - 1).rjust(_VALUE_WIDTH), PEAK)
        if shown:
            row.append(f" {trace_of(sensor.traces[axis], scale, shown)}", BAR)
    return rows


def _imu(sensor: SensorState) -> list[Row]:
    sample = sensor.sample
    if sample is None:
        return [Row(5, _field("IMU", "--"))]
    temperature = Text.assemble(("   Temperature ", LABEL), (f"{sample.temperature:.1f} °C", VALUE))
    if sensor.imu_off:
        return [Row(4, _field("IMU", "off").append_text(temperature))]
    rows = []
    for name, values, unit, label in (
        ("Acceleration", sample.acceleration, "m/s²", "a"),
        ("Angular rate", sample.angular_rate, "rad/s", "ω"),
    ):
        row = Text.assemble((name.ljust(13), LABEL))
        row.append("".join(numbers.quantity(value, words.DIGITS[unit], 8) for value in values), VALUE)
        row.append(f" {unit}".ljust(7), LABEL)
        if marks := [axis for axis in "xyz" if f"{label}{axis}" in sensor.saturated]:
            row.append(f"{''.join(marks)} saturated", ALARM)
        rows.append(row)
    rows[0].append_text(temperature)
    if sample.orientation is not None:
        rows[1].append("   Orient. ", LABEL)
        rows[1].append(" ".join(f"{v:+.2f}" for v in sample.orientation), VALUE)
    return [Row(5 + number, row) for number, row in enumerate(rows)]


def scale_for(ranges: Iterable[Range], least: float) -> float:
    """The full scale that shows all of `ranges`: 1, 2, 3 or 5 times a power of ten, at least `least`."""
    reach = max((abs(value) for r in ranges for value in r if math.isfinite(value)), default=0.0)
    if reach <= least:
        return least
    power = 10.0 ** math.floor(math.log10(reach))
    return next((step * power for step in (1.0, 2.0, 3.0, 5.0) if step * power >= reach), 10.0 * power)


def bar(value: float, peak: Range | None, scale: float, width: int) -> Text:
    """A bar of `width` cells, with zero in the middle and `scale` at either end; marks at the peaks."""
    zero = width // 2
    cells = [("─", LABEL)] * width
    cells[zero] = "┼", LABEL
    halves = round(min(1.0, abs(value) / scale) * 2 * zero) if math.isfinite(value) else 0
    step, half = (1, "▌") if value >= 0 else (-1, "▐")
    for n in range(1, (halves + 1) // 2 + 1):
        cells[zero + step * n] = "█" if 2 * n <= halves else half, BAR
    for extreme, mark in zip(peak or (), "├┤", strict=False):
        if math.isfinite(extreme):
            cells[zero + round(max(-1.0, min(1.0, extreme / scale)) * zero)] = mark, PEAK
    text = Text()
    for style, run in groupby(cells, itemgetter(1)):
        text.append("".join(cell for cell, _ in run), style)
    return text


def trace_of(past: Sequence[Range | None], scale: float, width: int) -> str:
    """The last `width` steps in a row of characters: of each step the value furthest from the median."""
    shown = past[-width:]
    known = [r for r in shown if r is not None]
    if not known:
        return " " * width
    low, high = min(r.low for r in known), max(r.high for r in known)
    usual = statistics.median((r.low + r.high) / 2 for r in known)
    half = max((high - low) / 2, _LEAST_TRACE * scale / 2)

    def level(step: Range) -> str:
        value = step.high if step.high - usual >= usual - step.low else step.low
        at = (value - (low + high) / 2 + half) / (2 * half)
        return _LEVELS[round(at * (len(_LEVELS) - 1))]

    return "".join(level(step) if step else " " for step in shown).rjust(width)


def _fitted(row: Text, width: int, ascii_only: bool) -> Text:
    fitted = row.copy()
    if ascii_only:
        fitted = Text()
        for piece in row.divide(sorted({edge for s in row.spans for edge in (s.start, s.end)})):
            fitted.append(words.to_ascii(piece.plain), piece.spans[0].style if piece.spans else piece.style)
    fitted.no_wrap = True
    fitted.truncate(width, overflow="crop" if width < 40 else "ellipsis")
    return fitted
