"""The frames of an exchange: which process data, and whose latched times, each of them carries, and where."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from ethercat_server.errors import SetUpError
from ethercat_server.ethercat.exchange.distributed_clock import LATCHED_SIZE, latched_datagrams
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import (
    COUNTER_SIZE,
    DATAGRAM_HEADER,
    FIRST_DATA,
    SHORTEST_FRAME,
    Command,
    build,
)

# Each frame carries its number in a last datagram (NOP), which comes back as it was sent: by the index
# alone one that comes back very late would be taken for a later one.
TAG_SIZE: Final = 4
_AROUND_DATA: Final = DATAGRAM_HEADER + COUNTER_SIZE
# Bytes of datagrams that fit one frame.
_LONGEST: Final = 1498
# What is sent where the inputs will be; no sensor says it, for its numbers would be NaN throughout.
_NEVER: Final = b"\xff"


class Area(NamedTuple):
    """Process data of one slave in the logical address space."""

    start: int
    end: int
    kind: int


class Inputs(NamedTuple):
    """Where the inputs of a sensor are in the frame that carries them."""

    number: int
    """Of the sensor."""
    start: int
    end: int
    untouched: bytes
    """What is there after an exchange in which the sensor did not take part."""
    latched: int
    """Where the times are that its controller latched (`LATCHED`); 0 if the frame does not read them."""


class Frame(NamedTuple):
    """One of an exchange, as it is sent but for its index and number."""

    content: bytearray
    inputs: list[Inputs]
    end: int
    """Of the process data (at least the inputs): there is the working counter."""
    written: int
    """End of the outputs if they have a datagram of their own, else 0."""
    tag: int
    counters: list[int]
    """What each sensor adds to the working counter: 2 for its outputs, 1 for its inputs."""


def make_frames(areas: Sequence[Sequence[Area]], stations: Sequence[int | None], *, lrw: bool) -> list[Frame]:
    """The frames that exchange the `areas` of each sensor, by number.

    Without `lrw` each reads (LRD) and writes (LWR) with datagrams of their own. `stations` are the addresses
    of the sensors whose latched times are read, None for others. SetUpError if the inputs of a sensor are not
    in one frame.
    """
    spans = _spans(areas, stations, lrw=lrw)
    carried: list[list[int]] = [[] for _ in spans]
    for number, each in enumerate(areas):
        first, last = _inputs(each)
        which = next((n for n, (start, end) in enumerate(spans) if start <= first and last <= end), None)
        if which is None:
            raise SetUpError(f"the process data of sensor {number} lies among that of others: start again")
        carried[which].append(number)
    return [
        _frame(span, numbers, areas, stations, lrw=lrw) for span, numbers in zip(spans, carried, strict=True)
    ]


def fit_a_frame(areas: Sequence[Area], *, lrw: bool) -> bool:
    """Whether one frame can carry all the process data of a sensor."""
    return _size(max(area.end for area in areas) - min(area.start for area in areas), 1, lrw=lrw) <= _LONGEST


def _size(length: int, latching: int, *, lrw: bool) -> int:
    """Bytes of the datagrams that exchange so much process data, and the latched times of so many."""
    exchanged = (1 if lrw else 2) * (_AROUND_DATA + length)
    return exchanged + latching * LATCHED_SIZE + _AROUND_DATA + TAG_SIZE


def _spans(
    areas: Sequence[Sequence[Area]], stations: Sequence[int | None], *, lrw: bool
) -> list[tuple[int, int]]:
    """Logical addresses of each frame: as many areas as fit one."""
    spans: list[tuple[int, int]] = []
    latching = 0
    for area, number in sorted((area, number) for number, each in enumerate(areas) for area in each):
        adds = area.kind == reg.FMMU_READ and stations[number] is not None
        if not spans or _size(area.end - spans[-1][0], latching + adds, lrw=lrw) > _LONGEST:
            spans.append((area.start, area.end))
            latching = 0
        spans[-1] = spans[-1][0], max(spans[-1][1], area.end)
        latching += adds
    return spans


def _inputs(areas: Sequence[Area]) -> tuple[int, int]:
    """Where the inputs of a sensor begin and end."""
    inputs = [area for area in areas if area.kind == reg.FMMU_READ]
    return min(area.start for area in inputs), max(area.end for area in inputs)


def _frame(
    span: tuple[int, int],
    numbers: Sequence[int],
    areas: Sequence[Sequence[Area]],
    stations: Sequence[int | None],
    *,
    lrw: bool,
) -> Frame:
    """The frame for the logical addresses of `span`, with the inputs of the sensors with these `numbers`."""
    start, length = span[0], span[1] - span[0]
    end = FIRST_DATA + length
    written = 0 if lrw else end + _AROUND_DATA + length
    commands = (Command.LRW,) if lrw else (Command.LRD, Command.LWR)
    datagrams: list[tuple[int, int, int, bytes]] = [
        (command, start & 0xFFFF, start >> 16, bytes(length)) for command in commands
    ]
    content = bytearray(length)
    inputs: list[Inputs] = []
    at = (written or end) + COUNTER_SIZE + DATAGRAM_HEADER
    for number in numbers:
        for area in areas[number]:
            if area.kind == reg.FMMU_READ:
                content[area.start - start : area.end - start] = _NEVER * (area.end - area.start)
        first, last = (each - start for each in _inputs(areas[number]))
        station, latched = stations[number], 0
        if station is not None:
            latched, at = at, at + LATCHED_SIZE
            datagrams += latched_datagrams(station)
        inputs.append(
            Inputs(number, first + FIRST_DATA, last + FIRST_DATA, bytes(content[first:last]), latched)
        )
    made = build(*datagrams, (Command.NOP, 0, 0, bytes(TAG_SIZE))).ljust(SHORTEST_FRAME, b"\0")
    made[FIRST_DATA:end] = content
    counters = [_working_counter(each, span) for each in areas]
    return Frame(made, inputs, end, written, at, counters)


def _working_counter(areas: Sequence[Area], span: tuple[int, int]) -> int:
    kinds = {area.kind for area in areas if span[0] <= area.start < span[1]}
    return 2 * (reg.FMMU_WRITE in kinds) + (reg.FMMU_READ in kinds)
