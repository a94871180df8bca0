"""The golden vectors in tests/protocol/golden: their bytes, and what must come of them."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Sample
from bota_ethercat.text.json_text import JsonObject

_FOLDER: Final = Path(__file__).parent / "protocol" / "golden"

Outcome = DataMessage | JsonObject | str
"""A message, `refused` (this message only) or `broken` (nothing after it can be trusted)."""


class Vector(NamedTuple):
    """A message, whole or broken."""

    name: str
    wire: bytes
    outcome: Outcome
    sample: Sample | None = None
    """What its process data decodes to from firmware that sends g and degrees per second."""
    sample_si: Sample | None = None
    """The same from firmware that sends SI units."""


def _read(name: str) -> Any:
    return json.loads((_FOLDER / name).read_text(encoding="utf-8"))


def _wire(entry: JsonObject) -> bytes:
    if "text" in entry:
        text: bytes = entry["text"].encode()
        return struct.pack(">IB", 1 + len(text), 2) + text
    return b"".join(bytes.fromhex(digits) for _, digits in entry["parts"])


def _floats(values: Sequence[float | str] | None) -> Any:
    return None if values is None else tuple(float(value) for value in values)


def _sample(fields: JsonObject) -> Sample:
    vectors = ("force", "torque", "acceleration", "angular_rate", "orientation")
    return Sample(**{**fields, **{name: _floats(fields[name]) for name in vectors}})


def _data(entry: JsonObject) -> Vector:
    wire = _wire(entry)
    size = 77 if len(wire) == 110 else 61
    message = DataMessage(**entry["message"], process_data=wire[-size:])
    return Vector(
        entry["name"],
        wire,
        message,
        _sample(entry["sample"]),
        _sample({**entry["sample"], **entry.get("sample_si", {})}),
    )


DATA: Final = [_data(entry) for entry in _read("data.json")]
JSON: Final = [Vector(entry["name"], _wire(entry), entry["object"]) for entry in _read("json.json")]
BROKEN: Final = [Vector(entry["name"], _wire(entry), entry["outcome"]) for entry in _read("broken.json")]
BY_NAME: Final = {vector.name: vector for vector in (*DATA, *JSON, *BROKEN)}
STREAMS: Final = {
    entry["name"]: [BY_NAME[name] for name in entry["vectors"]] for entry in _read("streams.json")
}


class AccountedStream(NamedTuple):
    """Frames of one sensor, and what `bota_ethercat.accounting` makes of them."""

    name: str
    every: int
    fresh_only: bool
    rate_hz: float
    steps: list[tuple[int, int, int, str] | None]
    """`sequence`, `monotonic_ns`, `flags` and kind of each frame; None where a new subscription begins."""
    counts: dict[str, int]
    """At the end; 0 where none is given."""


def _accounted(entry: JsonObject) -> AccountedStream:
    steps = [None if step == "begin" else tuple(step) for step in entry["frames"]]
    options = entry.get("every", 1), entry.get("fresh_only", True), entry.get("rate_hz", 0)
    return AccountedStream(entry["name"], *options, steps, entry["counts"])


ACCOUNTED: Final = [_accounted(entry) for entry in _read("accounting.json")]


def expected(vectors: Sequence[Vector]) -> list[Outcome]:
    """What comes of these vectors, sent one behind the other."""
    found: list[Outcome] = []
    for vector in vectors:
        found.append(vector.outcome)
        if vector.outcome == "broken":
            break
    return found


def same_number(one: float, other: float) -> bool:
    """Equal to the bit, but for what kind of NaN it is."""
    if math.isnan(one) or math.isnan(other):
        return math.isnan(one) and math.isnan(other)
    return one == other and math.copysign(1, one) == math.copysign(1, other)


def numbers(sample: Sample) -> list[float]:
    """Every measured value of a sample."""
    return [*sample.array, sample.temperature, *(sample.orientation or ())]


def same_sample(one: Sample, other: Sample) -> bool:
    """Whether two samples are the same to the bit."""
    mine, others = numbers(one), numbers(other)
    return (
        len(mine) == len(others)
        and all(map(same_number, mine, others))
        and one[6:] == other[6:]
        and (one.orientation is None) == (other.orientation is None)
    )
