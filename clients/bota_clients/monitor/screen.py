"""The terminal's view as rows of text, from a state alone; and the same rows in plain text for --once.

Nothing depends on color alone: bars, peak marks and warnings differ in their characters too. The three colors
can be told apart with common color blindness, on light and dark backgrounds.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Final, NamedTuple

from rich.text import Text

from bota_clients import numbers
from bota_clients.monitor import words
from bota_clients.monitor.model import Alert, Range, SensorView, State
from bota_ethercat.pdo import AXES

KEYS: Final = (
    ("t", "tare", "zero the reading, in the sensor, or undo that; asks first"),
    ("r", "record", "start or stop a recording in this folder, as of ethercat-record"),
    ("p", "pause", "freeze the display; samples and peaks still count"),
    ("0", "reset", "reset peaks and past warnings"),
    ("n", "next", "the next sensor of the chain"),
    ("?", "help", "this page"),
    ("q", "quit", "also Ctrl-C; Ctrl-L redraws the screen"),
)  # key, its short name, what it does
_HELP: Final = """
Arrows, Page Up and Page Down scroll. Bars are centered on zero; their scale
grows with the marked peaks, for which every sample counts.

Press any key to return."""

LABEL: Final = "dim"
VALUE: Final = "bold"
BAR: Final = "#2a94d6"
PEAK: Final = "bold #d98200"
BAD: Final = "bold #d55e00"
ALARM: Final = "bold reverse #d55e00"
NOTICE: Final = "bold reverse"

_MESSAGE_ROWS: Final = 3
_TABLE_WIDTH: Final = 80
_LEAST_SCALE: Final = {"N": 5.0, "Nm": 0.2, "counts": 1000.0}
_VALUE_WIDTH: Final = 9
_AXIS_WIDTH: Final = 4 + _VALUE_WIDTH + 1  # label, value, space
_WITH_PEAKS: Final = 56  # width from which the peaks are shown as numbers too


@dataclass(frozen=True, slots=True)
class ViewOptions:
    selected: int = 0  # which sensor comes first, counted from 0 in the state's order
    paused: str = ""  # time of day of the pause; empty if not paused
    recording: str = ""  # the running recording, in words
    question: str = ""  # the pending question
    help: bool = False  # in place of the overview


class Screen(NamedTuple):
    """Rows that are no wider than the screen; the body scrolls if it is higher than the room for it."""

    head: list[Text]
    body: list[Text]
    foot: list[Text]


def render(state: State, look: ViewOptions, width: int) -> Screen:
    body = _help() if look.help else _overview(state, look, width)
    screen = Screen([_title(state, look, width)], body, [*_message(state, look, width), _keys(look, width)])
    for row in (row for part in screen for row in part):
        row.no_wrap = True
        row.truncate(width, overflow="ellipsis")
    return screen


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
        lines += ["", *(row.plain.rstrip() for row in _panel(sensor, _TABLE_WIDTH, bars=False))]
    level, what = words.verdict(state)
    return [*lines, "", f"{level.words.capitalize()}: {what}."]


def _help() -> list[Text]:
    rows = [Text.assemble((f"  {key}  ", VALUE), (name.ljust(10), LABEL), what) for key, name, what in KEYS]
    return [*rows, *map(Text, _HELP.splitlines())]


def _overview(state: State, look: ViewOptions, width: int) -> list[Text]:
    """Server, sensors from the selected one on, clients."""
    rows = _server(state, width)
    if not state.sensors:
        unknown = "no sensor known yet" if not state.server.connected else "the server has no sensors"
        rows.append(Text(unknown, LABEL))
    first = look.selected % max(1, len(state.sensors))
    for number, sensor in enumerate([*state.sensors[first:], *state.sensors[:first]]):
        rows += [*([Text()] if number else []), *_panel(sensor, width)]
    return [*rows, _clients(state)]


def _title(state: State, look: ViewOptions, width: int) -> Text:
    """Address, what is special, sensors that have findings, connection."""
    server = state.server
    left = Text(server.address, VALUE)
    right = Text()
    for name, what in (("REPLAY ", server.replay), ("", look.recording), ("PAUSED ", look.paused)):
        right.append(f" {name}{what} " if what else "", NOTICE)
    for sensor in state.sensors if len(state.sensors) > 1 else ():
        if level := sensor.verdict.level:
            right.append(f" {sensor.position}", LABEL).append(f" {level.words} ", ALARM)
    right.append(f" {words.link(server)} ", ALARM if words.trouble(server) else "")
    left.truncate(max(0, width - right.cell_len))
    left.pad_right(max(0, width - right.cell_len - left.cell_len))
    return left.append_text(right)


def _server(state: State, width: int) -> list[Text]:
    server = state.server
    if wrong := words.trouble(server):  # the end says what to do
        lines = textwrap.wrap(wrong, max(20, width - 9), break_on_hyphens=False)
        return [_field("" if number else "Server", line, BAD) for number, line in enumerate(lines)]
    if server.uptime_s is None:
        return [_field("Server", "waiting for its status")]
    return [_field("Server", "  ".join(f"{n.lower()} {v}" for n, v in words.server_facts(server)[:4]))]


def _clients(state: State) -> Text:
    known = f"{len(state.clients)}: {' · '.join(map(words.client, state.clients))}"
    return _field("Clients", known if state.server.connected else "not known")


def _message(state: State, look: ViewOptions, width: int) -> list[Text]:
    text, style = state.events[-1] if state.events else "", LABEL
    if look.question:
        text, style = look.question, NOTICE
    elif state.message is not None:
        text, style = state.message.text, BAD if state.message.bad else ""
    lines = textwrap.wrap(text, max(1, width), break_on_hyphens=False)[:_MESSAGE_ROWS]
    return [Text(line, style) for line in lines or [""]]


def _keys(look: ViewOptions, width: int) -> Text:
    other = {"r": "stop"} if look.recording else {}
    other |= {"p": "resume"} if look.paused else {}
    row = Text()
    for key, name, _ in KEYS:
        row.append(key, VALUE).append(f" {other.get(key, name)}  " if width >= 60 else " ", LABEL)
    return row


def _panel(sensor: SensorView, width: int, *, bars: bool = True) -> list[Text]:
    stream = f"{words.rate(sensor)}   age {words.times(sensor.age_us)}   jitter {words.jitter(sensor)}"
    lost = _field("Lost", "")
    for number, (text, bad) in enumerate(words.losses(sensor)):
        lost.append("   " if number else "").append(text, PEAK if bad else "")
    unlocked = sensor.status.clock.mode not in {"locked", ""}
    clock = _field("Clock", words.clock(sensor), NOTICE if unlocked else "")
    if sensor.hand_out_us is not None:
        clock.append(f"   age at hand-out {words.times(sensor.hand_out_us)}")
    identity = Text(words.identity(sensor), VALUE if sensor.al_state in {"OP", ""} else BAD)
    if sensor.old_s is not None:
        identity = Text.assemble((f"values {numbers.duration(sensor.old_s)} old ", ALARM), " ", identity)
    return [
        identity,
        *_axes(sensor, 0, width, bars=bars),
        *_axes(sensor, 1, width, bars=bars),
        *_compensated(sensor),
        *_alerts(sensor, width),
        *_imu(sensor),
        _field("Stream", stream),
        _field("Delay", words.delays(sensor)),
        *([_field("Zero", sensor.zero)] if sensor.zero else []),
        lost,
        clock,
    ]


def _field(name: str, text: str, style: str = "") -> Text:
    return Text.assemble((name.ljust(9), LABEL), (text, style))


def _alerts(sensor: SensorView, width: int) -> list[Text]:
    none = _field("Warnings", "none" if sensor.sample is not None else "no sample yet")
    return [row for alert in sensor.alerts for row in _alert(alert, width)] or [none]


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


def _axes(sensor: SensorView, which: int, width: int, *, bars: bool) -> list[Text]:
    """Force, or torque if `which` is 1: a heading and a row an axis."""
    unit, axes = sensor.units[which], range(3 * which, 3 * which + 3)
    peaks = sensor.peaks or (None,) * len(AXES)
    with_peaks = width >= _WITH_PEAKS
    left = width - _AXIS_WIDTH - 2 * _VALUE_WIDTH * with_peaks
    across = max(5, left - 1 + left % 2) if bars else 0
    scale = scale_for((peak for axis in axes if (peak := peaks[axis])), _LEAST_SCALE[unit])
    ends = f"-{scale:g}", f"+{scale:g}"
    middle = f"{ends[0].ljust(across // 2)}0{ends[1].rjust(across // 2)}"
    head = f"{('Force', 'Torque')[which]} {unit}".ljust(_AXIS_WIDTH) + middle[:across]
    head += f"{'min':>{_VALUE_WIDTH}}{'max':>{_VALUE_WIDTH}}" if with_peaks else ""
    rows = [Text(head, LABEL)]
    sample = sensor.sample
    for axis in axes:
        saturated, peak = AXES[axis] in sensor.saturated, peaks[axis]
        row = Text.assemble((f"{AXES[axis]}{'!' * saturated}".ljust(4), ALARM if saturated else LABEL))
        rows.append(row)
        if sample is None:
            row.append("--".rjust(_VALUE_WIDTH))
            continue
        value, digits = (*sample.force, *sample.torque)[axis], words.DIGITS[unit]
        row.append(numbers.quantity(value, digits, _VALUE_WIDTH), VALUE if sensor.old_s is None else LABEL)
        row.append(" ").append_text(bar(value, peak, scale, across) if bars else Text())
        for extreme in (peak or ()) if with_peaks else ():
            row.append(numbers.quantity(extreme, digits, _VALUE_WIDTH - 1).rjust(_VALUE_WIDTH), PEAK)
    return rows


def _compensated(sensor: SensorView) -> list[Text]:
    row, found = Text.assemble(("Compensated".ljust(13), LABEL)), sensor.compensated
    if found is None:
        return [row.append(sensor.not_compensated, BAD)] if sensor.not_compensated else []
    for values, unit, bound in (
        (found.force, "N", found.force_bound),
        (found.torque, "Nm", found.torque_bound),
    ):
        digits = words.DIGITS[unit]
        row.append("".join(numbers.quantity(value, digits, 8) for value in values), VALUE)
        row.append(f" {unit} ±{bound:.{digits}f}", LABEL)
    return [row, *([_field("Contact", words.contact(found.contact))] if found.contact else [])]


def _imu(sensor: SensorView) -> list[Text]:
    sample = sensor.sample
    if sample is None:
        return [_field("IMU", "--")]
    temperature = Text.assemble(("   Temperature ", LABEL), (f"{sample.temperature:.1f} °C", VALUE))
    if sensor.imu_off:
        return [_field("IMU", "off").append_text(temperature)]
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
    return rows


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
