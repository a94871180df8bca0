"""The golden vectors in tests/protocol/golden: their bytes, and what must come of them."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from bota_ethercat.address import boot_id
from bota_ethercat.errors import BadMessageError, RemoteProtocolError
from bota_ethercat.framing import (
    MAX_JSON_LENGTH,
    DataFlag,
    DataMessage,
    FrameDecoder,
    MessageType,
    encode_data,
    encode_json,
)
from bota_ethercat.pdo import Sample, encode
from bota_ethercat.text.json_text import JsonObject

_FOLDER: Final = Path(__file__).parent / "protocol" / "golden"

Outcome = DataMessage | JsonObject | str
"""A message, `refused` (this message only) or `broken` (nothing after it can be trusted)."""


class Vector(NamedTuple):
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
    found = {name: _floats(fields[name]) for name in vectors}
    return Sample(**{**fields, **found, "temperature": float(fields["temperature"])})


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
    frames: list[Any]  # `sequence`, `monotonic_ns`, `flags`, kind; or `begin`: a new subscription
    counts: dict[str, int]  # at the end; 0 where none is given
    every: int = 1
    fresh_only: bool = True
    rate_hz: float = 0.0


ACCOUNTED: Final = [AccountedStream(**entry) for entry in _read("accounting.json")]


BEGIN_NS: Final = 10**15  # both clocks of readings.json at 0 ms
CHANNELS: Final = ("force_torque", "acceleration", "angular_rate")
_DELAYS: Final = {"force_torque": 1.88, "acceleration": 1.94, "angular_rate": 2.9}
_DESCRIPTION: Final = {"protocol": 1, "sensors": [{"sensor": 0, "rate_hz": 800, "delay_ms": _DELAYS}]}


class Player(Protocol):
    """A client, the server that it talks to, and a clock: what plays a stream of readings.json."""

    def now(self, now_ns: int) -> None: ...
    def connect(self, description: JsonObject) -> None: ...
    def send(self, message: bytes) -> None: ...
    def end(self) -> None: ...
    def read(self, sensor: int) -> dict[str, object]:
        """What `latest` gives, by the names of readings.json, in ns."""


class ReadStream(NamedTuple):
    name: str
    steps: list[list[Any]]
    max_age_ms: int = 10
    every: int = 1
    sensors: Sequence[int] = (0,)
    connect: Mapping[str, Any] = {}

    def play(self, player: Player) -> None:
        """Every reading is what the stream says."""
        for ms, kind, *rest in [[0, "connect", self.connect], *self.steps]:
            now_ns = BEGIN_NS + round(ms * 1e6)
            player.now(now_ns)
            if kind == "connect":
                clock = json.loads(json.dumps(rest[0]).replace("OURS", str(boot_id())))
                player.connect({**_DESCRIPTION, **clock})
            elif kind == "frame":
                player.send(_frame(now_ns, *rest))
            elif kind == "message":
                player.send(encode_json(rest[0]))
            elif kind == "end":
                player.end()
            else:
                wanted, told = _in_ns(rest[0]), player.read(*(rest[1:] or [self.sensors[0]]))
                assert {name: told[name] for name in wanted} == wanted, (self.name, ms)


def _frame(now_ns: int, sequence: int, flags: str = "", values: Mapping[str, Any] = {}) -> bytes:
    values = {"age_ms": 0, "sensor": 0, "size": 61, "force.x": sequence, **values}
    age_ms, sensor, size = (values.pop(name) for name in ("age_ms", "sensor", "size"))
    at_ns = now_ns - round(age_ms * 1e6)
    bits = sum(DataFlag[flag] for flag in flags.split())
    data = encode(size, {name: float(value) for name, value in values.items()})
    return encode_data(sequence, at_ns, at_ns, sensor, bits, 3, data)


def _in_ns(reading: JsonObject) -> dict[str, object]:
    found = dict(reading)
    if "age_ms" in found:
        age_ms = found.pop("age_ms")
        found["age_ns"] = None if age_ms is None else round(age_ms * 1e6)
    if "measured_ms" in found:
        times = found.pop("measured_ms")
        found["measured_ns"] = [None if ms is None else BEGIN_NS + round(ms * 1e6) for ms in times]
    return found


READ: Final = [ReadStream(**entry) for entry in _read("readings.json")]


def odd_messages() -> Iterator[JsonObject]:
    """Events and replies with odd values where others are expected."""
    for odd in (None, True, -1, 256, 1.5, 10**30, "0", "", [], {}, [0], {"sensor": 0}, "\\ud800\\u0000"):
        for name in ("sensor_lost", "sensor_back", "reconfigured", "emergency", "unknown", odd):
            yield {"event": name, "sensor": odd, "message": odd}
        yield {"event": "sensor_lost", "sensor": 1, "message": odd}
        yield {"reply": odd, "ok": odd, "error": odd}
        yield {"reply": odd, "ok": False, "error": {"message": odd}}
        yield {"event": "reconfigured", "sensor": 0, "settings": odd, "rate_hz": odd, "delay_ms": odd}


def expected(vectors: Sequence[Vector]) -> list[Outcome]:
    found: list[Outcome] = []
    for vector in vectors:
        found.append(vector.outcome)
        if vector.outcome == "broken":
            break
    return found


def outcomes(chunks: Sequence[bytes], max_json_length: int = MAX_JSON_LENGTH) -> list[Outcome]:
    """What the Python decoder makes of these bytes, without TERMINAL messages, which C++ does not know."""
    accepts = MessageType.DATA, MessageType.JSON
    decoder, found = FrameDecoder(max_json_length=max_json_length, accepts=accepts), list[Outcome]()
    for chunk in chunks:
        decoder.feed(chunk)
        while True:
            try:
                message = decoder.next_message()
            except BadMessageError:
                found.append("refused")
                continue
            except RemoteProtocolError:
                return [*found, "broken"]
            if message is None:
                break
            found.append(message)
    return found


def same_sample(one: Sample, other: Sample) -> bool:
    return repr(one) == repr(other)
