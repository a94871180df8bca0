"""One sensor's rows: identity, force and torque as bars, IMU, stream, clock, alerts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from rich.text import Text

from clients import numbers
from clients.monitor.model.sensor import TRACE_STEP_S
from clients.monitor.model.state import AXES, Alert, Range, SensorState
from clients.monitor.view import words
from clients.monitor.view.bars import bar, joined, scale_for, traces
from clients.monitor.view.glyphs import ALARM, BAD, BAR, LABEL, NOTICE, PEAK, VALUE, Glyphs

_LEAST_SCALE: Final = {"N": 5.0, "Nm": 0.2, "counts": 1000.0}
_LABEL_WIDTH: Final = 4
_VALUE_WIDTH: Final = 9
_PEAK_WIDTH: Final = 9
_FIELD_WIDTH: Final = 9
"""Width of the label before a row, such as `Stream`."""


MOST_TALL: Final = 8
"""More rows show no more of a trace."""


class Row(NamedTuple):
    """One row of the screen."""

    rank: int
    """Rows of the highest rank are dropped first."""
    text: Text


class _Columns(NamedTuple):
    """Widths of the parts of a force/torque row."""

    bar: int
    peaks: bool
    trace: int


def _columns(width: int) -> _Columns:
    trace_width = 80 if width >= 180 else 24 if width >= 110 else 16 if width >= 76 else 0
    peaks = width >= 56
    left = width - _LABEL_WIDTH - _VALUE_WIDTH - 1
    left -= 2 * _PEAK_WIDTH if peaks else 0
    left -= trace_width + 1 if trace_width else 0
    return _Columns(max(5, left - 1 + left % 2), peaks, trace_width)


def panel(
    sensor: SensorState, others: Sequence[SensorState], width: int, glyphs: Glyphs, tall: int = 1
) -> list[Row]:
    """The rows of `sensor`, without its alerts; of `others` only the state is shown.

    `tall`: rows of the trace of each axis.
    """
    force, torque = sensor.units
    return [
        Row(2, _identity(sensor, others, width)),
        *_bars(sensor, "Force", force, range(3), width, glyphs, tall),
        *_bars(sensor, "Torque", torque, range(3, 6), width, glyphs, tall),
        *_imu(sensor),
        Row(3, field("Stream", _stream(sensor))),
        Row(4, _losses(sensor)),
        Row(5, _clock(sensor)),
    ]


def field(name: str, text: str, *, bad: bool = False) -> Text:
    """A row of text with its label."""
    return Text.assemble((name.ljust(_FIELD_WIDTH), LABEL), (text, BAD if bad else ""))


def alerts(sensor: SensorState, width: int, most: int) -> list[Row]:
    """At most `most` rows of alerts, or one that says there are none."""
    if not sensor.alerts:
        none = "none" if sensor.sample is not None else "no sample yet"
        return [Row(1, field("Warnings", none))]
    rows: list[Row] = []
    for number, alert in enumerate(sensor.alerts):
        lines = _alert(alert, width)
        left = len(sensor.alerts) - number - 1
        if rows and len(rows) + len(lines) + bool(left) > most:
            rows.append(Row(3, field("", f"and {left + 1} more: press w")))
            break
        rows.extend(Row(1 if not number else 3, line) for line in lines)
    return rows


def all_alerts(sensor: SensorState, width: int) -> list[Text]:
    """The whole list."""
    return [line for alert in sensor.alerts for line in _alert(alert, width)] or [Text("none")]


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


def _identity(sensor: SensorState, others: Sequence[SensorState], width: int) -> Text:
    lost = sensor.al_state not in {"OP", ""}
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
    row = Text(who if len(who) <= room else words.who(sensor, firmware=False), BAD if lost else VALUE)
    row.truncate(room)
    row.append(state)
    if rest.cell_len:
        row.pad_right(width - rest.cell_len - row.cell_len)
    return row.append_text(rest)


def _bars(
    sensor: SensorState, title: str, unit: str, axes: range, width: int, glyphs: Glyphs, tall: int
) -> list[Row]:
    columns = _columns(width)
    peaks = sensor.peaks
    scale = scale_for([] if peaks is None else [peaks[axis] for axis in axes], _LEAST_SCALE[unit])
    rows = [Row(4, _header(title, unit, scale, columns))]
    values = (*sensor.sample.force, *sensor.sample.torque) if sensor.sample else None
    digits = words.DIGITS[unit]
    value_style = VALUE if sensor.old_s is None else LABEL
    for axis in axes:
        saturated = AXES[axis] in sensor.saturated
        label = f"{AXES[axis]}!" if saturated else AXES[axis]
        row = Text.assemble((label.ljust(_LABEL_WIDTH), ALARM if saturated else LABEL))
        if values is None:
            rows.append(Row(0, row.append("--".rjust(_VALUE_WIDTH))))
            continue
        row.append(numbers.quantity(values[axis], digits, _VALUE_WIDTH), value_style)
        row.append(" ")
        peak = None if peaks is None else peaks[axis]
        row.append_text(bar(values[axis], peak, scale, columns.bar, glyphs))
        if columns.peaks:
            row.append(_peak_text(peak, digits), PEAK)
        rows.append(Row(0, row))
        if columns.trace:
            first, *more = traces(sensor.traces[axis], scale, columns.trace, tall, glyphs)
            left = " " * (row.cell_len + 1)
            row.append(f" {first}", BAR)
            rows += [Row(8, Text.assemble(left, (line, BAR))) for line in more]
    return rows


def _peak_text(peak: Range | None, digits: int) -> str:
    if peak is None:
        return ""
    return "".join(numbers.quantity(value, digits, _PEAK_WIDTH - 1).rjust(_PEAK_WIDTH) for value in peak)


def _header(title: str, unit: str, scale: float, columns: _Columns) -> Text:
    middle = list(" " * columns.bar)
    ends = f"-{scale:g}", f"+{scale:g}"
    middle[: len(ends[0])] = ends[0]
    middle[columns.bar - len(ends[1]) :] = ends[1]
    middle[columns.bar // 2] = "0"
    head = f"{title} {unit}".ljust(_LABEL_WIDTH + _VALUE_WIDTH + 1)
    text = head + "".join(middle)[: columns.bar]
    if columns.peaks:
        text += "min".rjust(_PEAK_WIDTH) + "max".rjust(_PEAK_WIDTH)
    if columns.trace:
        text += f" last {columns.trace * TRACE_STEP_S:g} s".ljust(columns.trace + 1)
    return joined([text], [LABEL])


def _imu(sensor: SensorState) -> list[Row]:
    sample = sensor.sample
    if sample is None:
        return [Row(5, field("IMU", "--"))]
    temperature = Text.assemble(("   Temperature ", LABEL), (f"{sample.temperature:.1f} °C", VALUE))
    if sensor.imu_off:
        return [Row(4, field("IMU", "off").append_text(temperature))]
    rows = []
    for name, values, unit, digits, label in (
        ("Acceleration", sample.acceleration, "m/s²", 2, "a"),
        ("Angular rate", sample.angular_rate, "rad/s", 3, "ω"),
    ):
        marks = [axis for axis in "xyz" if f"{label}{axis}" in sensor.saturated]
        row = Text.assemble((name.ljust(13), LABEL))
        for value in values:
            row.append(numbers.quantity(value, digits, 8), VALUE)
        row.append(f" {unit}".ljust(7), LABEL)
        if marks:
            row.append(f"{''.join(marks)} saturated", ALARM)
        rows.append(row)
    rows[0].append_text(temperature)
    if sample.orientation is not None:
        rows[1].append("   Orient. ", LABEL)
        rows[1].append(" ".join(f"{v:+.2f}" for v in sample.orientation), VALUE)
    return [Row(5 + number, row) for number, row in enumerate(rows)]


def _stream(sensor: SensorState) -> str:
    return (
        f"{words.rate(sensor)}   age {words.age(sensor.stream.age_us, 'worst')}   "
        f"jitter {words.jitter(sensor)}"
    )


def _losses(sensor: SensorState) -> Text:
    row = field("Lost", "")
    for number, (text, bad) in enumerate(words.losses(sensor)):
        row.append("   " if number else "").append(text, PEAK if bad else "")
    return row


def _clock(sensor: SensorState) -> Text:
    row = Text.assemble(("Clock".ljust(_FIELD_WIDTH), LABEL))
    locked = sensor.clock is not None and sensor.clock.mode == "locked"
    row.append(words.clock(sensor), "" if locked else NOTICE if sensor.clock else "")
    if sensor.hand_out_us is not None:
        row.append(f"   age at hand-out {words.age(sensor.hand_out_us, 'p99')}")
    return row
