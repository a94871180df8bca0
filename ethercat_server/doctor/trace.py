"""A trace of a server's last minute, written and shown.

It is replayed through the server's own sampling clocks: what was late or lost, when, and why.
"""

from __future__ import annotations

import base64
import binascii
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from bota_ethercat.client import Client
from bota_ethercat.errors import ConnectionFailedError, ProtocolError
from bota_ethercat.program.command import command
from bota_ethercat.program.server_choice import default_server
from bota_ethercat.text.untrusted import printable
from ethercat_server.errors import ServerError
from ethercat_server.sampling.replay import Decision, Trace, TraceError
from ethercat_server.sampling.trace import RecordKind

SUFFIX: Final = ".trace"
_LATE: Final = 1.5  # periods between two exchanges beyond which samples pass
_MOST_SHOWN: Final = 20
_CELL_S: Final = 0.1  # of the picture
_CELLS: Final = 100  # in a line
# Causes as they stand in the picture, the worst last.
_MARKS: Final = {
    "": ".",
    "uncertain": "?",
    "sensor": "s",
    "card or slave": "c",
    "machine": "m",
    "not in the exchange": "i",
}


class Loss(NamedTuple):
    """What was wrong with a sample, or before it."""

    at_ns: int
    sensor: int
    cause: str  # of `_MARKS`
    text: str


def save(path: Path) -> str:
    """Get the trace of the server; what was done. ServerError if it gives none."""
    data, size, address = b"", 1, default_server()
    try:
        with Client(address.port, address.host, stream=False, reconnect=False).connect() as client:
            while len(data) < size:
                reply = client.ask("trace", offset=len(data))
                part, size = base64.b64decode(reply["data"], validate=True), int(reply["size"])
                if not part:
                    raise ServerError(f"the server at {address} ended its trace early: ask again")
                data += part
        Trace(data)
        path.write_bytes(data)
    except (ConnectionFailedError, ProtocolError, TraceError) as error:
        raise ServerError(f"no trace of the server at {address}: {error}") from None
    except (KeyError, TypeError, ValueError, binascii.Error):
        raise ServerError(f"the program at {address} is not a compatible ethercat-server") from None
    except OSError as error:
        raise ServerError(f"{path} cannot be written: {error.strerror}") from None
    show = command(f"ethercat-doctor {path}")
    return f"{path}: {len(data) // 1024} KiB; '{show}' shows it"


def show(path: Path) -> Iterator[str]:
    """The lines that show a trace file; ServerError if it is none."""
    try:
        trace = Trace(path.read_bytes())
        decisions = list(trace.replay())
    except OSError as error:
        raise ServerError(f"{path} cannot be read: {error.strerror}") from None
    except TraceError as error:
        raise ServerError(f"{path} cannot be replayed: {error}") from None
    sensors = trace.about.get("sensors")
    rows: Sequence[Any] = sensors if isinstance(sensors, list) else ()
    yield f"written by {printable(trace.about.get('program'), 40)}, {len(trace.records)} records"
    losses = []
    for number in sorted({decision.record.sensor for decision in decisions}):
        own = [decision for decision in decisions if decision.record.sensor == number]
        found = list(find_losses(number, own))
        losses += found
        row = rows[number] if number < len(rows) and isinstance(rows[number], dict) else {}
        yield f"\nsensor {number} ({printable(row.get('model'), 40)})"
        yield from _table(own)
        yield from _picture(own, found)
    losses.sort()
    for loss in losses[:_MOST_SHOWN]:
        at_s = (loss.at_ns - decisions[0].record.sent_ns) * 1e-9
        yield f"{at_s:9.4f} s  sensor {loss.sensor}: {loss.text}"
    if len(losses) > _MOST_SHOWN:
        yield f"({len(losses) - _MOST_SHOWN} more)"


def find_losses(number: int, decisions: Sequence[Decision]) -> Iterator[Loss]:
    """What was lost, re-associated or invalid of a sensor, and why."""
    fresh_ns = [decision.record.sent_ns for decision in decisions if decision.record.kind is RecordKind.FRESH]
    gaps = sorted(after - before for before, after in pairwise(fresh_ns))
    period_ns = gaps[len(gaps) // 2] if gaps else 0
    took = sorted(decision.record.duration_ns for decision in decisions)
    long_ns = took[len(took) // 2] + period_ns / 2
    before_ns, invalid = 0, 0
    # Why the count at the sample before was uncertain; that of the first is, with nothing before it.
    doubt: tuple[str, str] | None = ("uncertain", "what came before is not in the trace")
    for decision in decisions:
        record = decision.record
        sent_ns, back_ns = record.sent_ns, record.sent_ns + record.duration_ns
        asleep_ns = sent_ns - before_ns if before_ns else 0
        before_ns = back_ns
        if record.kind is RecordKind.INVALID:
            invalid += 1
            if invalid == 1:
                text = f"it took no part in an exchange (working counter {record.wkc})"
                yield Loss(sent_ns, number, "not in the exchange", text)
        if record.kind is not RecordKind.FRESH:
            continue
        lost = decision.steps - 1
        if invalid:
            why = "not in the exchange", "while it took no part"
        elif asleep_ns > _LATE * period_ns:
            why = "machine", f"this computer sent nothing for {asleep_ns / 1e6:.2f} ms"
        elif record.duration_ns > long_ns:
            why = "card or slave", f"an exchange took {record.duration_ns / 1e6:.2f} ms"
        elif doubt is not None:  # what was in doubt there is counted here
            why = doubt
        else:
            why = "sensor", "it was polled and gave none"
        if decision.steps == 0:
            yield Loss(sent_ns, number, "uncertain", "a sample that was counted as lost came late")
        elif lost:
            yield Loss(sent_ns, number, why[0], f"{lost} lost: {why[1]}")
        elif decision.uncertain and doubt is None:
            yield Loss(sent_ns, number, "uncertain", f"maybe one lost: {why[1]}")
        invalid, doubt = 0, why if decision.uncertain else None


def _table(decisions: Sequence[Decision]) -> Iterator[str]:
    kinds = Counter(decision.record.kind for decision in decisions)
    new = [decision for decision in decisions if decision.record.kind is RecordKind.FRESH]
    seconds = (decisions[-1].record.sent_ns - decisions[0].record.sent_ns) * 1e-9
    yield (
        f"  {seconds:.1f} s: {len(new)} samples, {sum(max(0, decision.steps - 1) for decision in new)} lost, "
        f"{kinds[RecordKind.READ]} polls without a new sample, {kinds[RecordKind.INVALID]} invalid exchanges"
    )
    if new:
        ages = [
            decision.record.sent_ns + decision.record.duration_ns - decision.instant_ns for decision in new
        ]
        yield f"  age when it was here {_points(ages)} µs"
        events = 100 * sum(decision.by_events for decision in new) // len(new)
        locked = 100 * sum(decision.locked for decision in new) // len(new)
        yield f"  followed {locked} % of the time, dated by the slave controller {events} %"
    yield f"  exchanges {_points([float(decision.record.duration_ns) for decision in decisions])} µs"


def _points(values_ns: Sequence[float]) -> str:
    ordered = sorted(values_ns)
    points = {"p50": 0.5, "p99": 0.99, "max": 1.0}
    return ", ".join(
        f"{name} {ordered[min(int(at * len(ordered)), len(ordered) - 1)] / 1e3:.0f}"
        for name, at in points.items()
    )


def _picture(decisions: Sequence[Decision], losses: Sequence[Loss]) -> Iterator[str]:
    """A mark for each tenth of a second: the worst that happened in it."""
    begin_ns, order = decisions[0].record.sent_ns, [*_MARKS]
    cells = {int((each.record.sent_ns - begin_ns) * 1e-9 / _CELL_S): 0 for each in decisions}
    most = max(cells)
    for loss in losses:
        at = int((loss.at_ns - begin_ns) * 1e-9 / _CELL_S)
        cells[at] = max(cells[at], order.index(loss.cause))
    for begin in sorted({at // _CELLS * _CELLS for at in cells}):  # none for a pause
        marks = (_MARKS[order[cells.get(at, 0)]] for at in range(begin, min(begin + _CELLS, most + 1)))
        yield f"  {begin * _CELL_S:5.0f} s {''.join(marks)}"
    if any(cells.values()):
        yield "  " + ", ".join(f"{mark} {cause}" for cause, mark in _MARKS.items() if cause)
