"""The whole screen as rows of text, from a state alone: the same state and size give the same rows."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Final

from rich.text import Text

from clients import numbers
from clients.monitor.model.state import AXES, State
from clients.monitor.view import words
from clients.monitor.view.glyphs import ALARM, BAD, LABEL, NOTICE, UNICODE, VALUE, Glyphs, to_ascii
from clients.monitor.view.panel import MOST_TALL, Row, alerts, all_alerts, field, panel

KEYS: Final = (
    ("t", "tare", "zero this sensor's reading, in the sensor, or undo that; asks first"),
    ("r", "record", "start or stop a recording in this folder (ethercat-record)"),
    ("p", "pause", "freeze the display; samples and peaks still count"),
    ("0", "reset", "reset peaks and past warnings"),
    ("n", "next", "the next sensor of the chain"),
    ("w", "warn", "all warnings of this sensor"),
    ("?", "help", "this page"),
    ("q", "quit", "also Ctrl-C; Ctrl-L redraws the screen"),
)
"""Key, its short name, what it does."""

_MESSAGE_ROWS_FROM: Final = 12
_PANEL_ROWS: Final = 18
_LEAST_WIDTH: Final = 24
_LEAST_HEIGHT: Final = 8


@dataclass(frozen=True, slots=True)
class Look:
    """The user's choices."""

    selected: int = 0
    """Which sensor, counted from 0 in the state's order."""
    paused: str = ""
    """Time of day of the pause; empty if not paused."""
    recording: str = ""
    """The running recording, in words."""
    question: str = ""
    """The pending question."""
    help: bool = False
    warnings: int = 0
    """The page of all warnings that is shown, from 1; 0: none. After the last comes the first."""
    glyphs: Glyphs = UNICODE


def render(state: State, look: Look, width: int, height: int) -> list[Text]:
    """Exactly `height` rows, none wider than `width`."""
    if width < _LEAST_WIDTH or height < _LEAST_HEIGHT:
        rows = [Text(f"too small: {_LEAST_WIDTH}x{_LEAST_HEIGHT} at least")]
    elif look.help:
        rows = _help(state)
    elif look.warnings and state.sensors:
        rows = _warnings(state, look, width, height)
    else:
        rows = _overview(state, look, width, height)
    rows = rows[:height] + [Text()] * (height - len(rows))
    return [_fitted(row, width, look.glyphs) for row in rows]


def _overview(state: State, look: Look, width: int, height: int) -> list[Text]:
    head = [Row(0, _title(state, look, width))]
    shared = [Row(3, _server(state)), Row(6, _clients(state, width))]
    if not state.server.connected and state.server.since_s is not None:
        shared[0] = Row(1, shared[0].text)
    foot = [*_message(state, look, width, height), _keys(look, width)]
    body = _sensors(state, look, width, height - len(head) - len(shared) - len(foot))
    rows = _dropped([*head, *body, *shared], height - len(foot))
    blank = [Text()] * (height - len(foot) - len(rows))
    return [*(row.text for row in rows), *blank, *foot]


def _sensors(state: State, look: Look, width: int, height: int) -> list[Row]:
    """As many sensors as fit, starting with the selected one."""
    if not state.sensors:
        text = "no sensor known yet" if not state.server.connected else "the server has no sensors"
        return [Row(0, Text(text, LABEL))]
    first = look.selected % len(state.sensors)
    ordered = [*state.sensors[first:], *state.sensors[:first]]
    count = max(1, min(len(ordered), height // _PANEL_ROWS))
    shown, others = ordered[:count], ordered[count:]
    rows: list[Row] = []
    for number, sensor in enumerate(shown):
        if number:
            rows.append(Row(7, Text()))
        told = sorted(others, key=lambda s: s.position) if not number else ()
        own = panel(sensor, told, width, look.glyphs)
        room = height // count - bool(number)
        wrong = alerts(sensor, width, max(2, room - len(own)))
        tall = min(MOST_TALL, 1 + (room - len(own) - len(wrong)) // len(AXES))
        if tall > 1:
            own = panel(sensor, told, width, look.glyphs, tall)
        rows += [*own, *wrong]
    return rows


def _dropped(rows: list[Row], height: int) -> list[Row]:
    """Drop rows of the highest rank, last first, until the rest fits."""
    rows = list(rows)
    while len(rows) > height:
        worst = max(row.rank for row in rows)
        del rows[max(n for n, row in enumerate(rows) if row.rank == worst)]
    return rows


def _title(state: State, look: Look, width: int) -> Text:
    server = state.server
    left = Text.assemble(("ethercat-monitor ", VALUE), server.address)
    right = Text()
    if server.replay:
        right.append(f" REPLAY {server.replay} ", NOTICE)
    if look.recording:
        right.append(f" {look.recording} ", NOTICE)
    if look.paused:
        right.append(f" PAUSED {look.paused} ", NOTICE)
    bad = words.trouble(server) is not None
    right.append(f" {words.link(server)} ", ALARM if bad else "")
    left.truncate(max(0, width - right.cell_len))
    left.pad_right(max(0, width - right.cell_len - left.cell_len))
    return left.append_text(right)


def _server(state: State) -> Text:
    server = state.server
    trouble = words.trouble(server)
    if trouble is not None:
        return field("Server", trouble, bad=True)
    if server.uptime_s is None:
        return field("Server", "waiting for its status")
    text = (
        f"up {numbers.duration(server.uptime_s)}  missed deadlines {words.count(server.missed_deadlines)}  "
        f"lost frames {words.count(server.lost_frames)}"
    )
    if server.exchange_us is not None:
        text += f"  exchange {numbers.milliseconds(server.exchange_us.worst)} ms p99"
    return field("Server", text)


def _clients(state: State, width: int) -> Text:
    text = str(len(state.clients)) if state.server.connected else "not known"
    for number, client in enumerate(state.clients):
        left = len(state.clients) - number
        more = f"{':' if not number else ' ·'} {words.client(client)}"
        if len(text) + len(more) + 16 > width - (10 if left > 1 else 0):
            text += f" and {left} more"
            break
        text += more
    return field("Clients", text)


def _message(state: State, look: Look, width: int, height: int) -> list[Text]:
    """The latest message, on up to three rows."""
    text, style = state.events[-1] if state.events else "", LABEL
    if look.question:
        text, style = look.question, NOTICE
    elif state.message is not None:
        text, style = state.message.text, BAD if state.message.bad else ""
    most = 3 if height >= _MESSAGE_ROWS_FROM else 1
    return [Text(line, style) for line in textwrap.wrap(text, width, break_on_hyphens=False)[:most]] or [
        Text()
    ]


def _keys(look: Look, width: int) -> Text:
    names = {**{key: name for key, name, _ in KEYS}}
    if look.recording:
        names["r"] = "stop"
    if look.paused:
        names["p"] = "resume"
    row = Text()
    gap = "  " if width >= 68 else " "
    for key, name in names.items():
        row.append(key, VALUE)
        row.append(f" {name}{gap}" if width >= 60 else f"{gap}", LABEL)
    return row


def _help(state: State) -> list[Text]:
    rows = [Text.assemble(("ethercat-monitor ", VALUE), state.server.address), Text()]
    rows += [Text.assemble((f"  {key}  ", VALUE), (name.ljust(8), LABEL), what) for key, name, what in KEYS]
    rows.append(Text())
    rows += [
        Text(line)
        for line in (
            "Bars are centered on zero; their scale grows with the marked peaks, for which",
            "every sample counts. A trace has its own scale; a column of it is 0.25 s.",
            "age     of a sample on arrival; only on the server's own machine",
            "jitter  of the intervals between the samples' stamps",
            "lost    on the bus since the server started; on the way here since connecting",
            "Clock   locked: the server follows the sensor's own clock, else oversampling",
            "Fx!     this axis is saturated; warnings stay listed until the reset",
            "",
            "Press any key to return.",
        )
    ]
    return rows


def _warnings(state: State, look: Look, width: int, height: int) -> list[Text]:
    """All warnings of the selected sensor, a page of them."""
    sensor = state.sensors[look.selected % len(state.sensors)]
    lines = all_alerts(sensor, width)
    room = height - 4
    pages = [lines[start : start + room] for start in range(0, len(lines), room)]
    number = (look.warnings - 1) % len(pages)
    shown = pages[number] + [Text()] * (room - len(pages[number]))
    title = Text(f"Warnings of sensor {sensor.position}: page {number + 1} of {len(pages)}", VALUE)
    return [title, Text(), *shown, Text(), Text("w: next page, any other key: return", LABEL)]


def _fitted(row: Text, width: int, glyphs: Glyphs) -> Text:
    if not glyphs.full.isascii():
        fitted = row.copy()
    else:
        fitted = Text(no_wrap=True)
        for piece in row.divide(sorted({edge for s in row.spans for edge in (s.start, s.end)})):
            fitted.append(to_ascii(piece.plain), piece.spans[0].style if piece.spans else piece.style)
    fitted.no_wrap = True
    fitted.truncate(width, overflow="crop" if width < 40 else "ellipsis")
    return fitted
