"""Bytes that no client should send: hostile JSON texts, and mutations of messages that were valid."""

from __future__ import annotations

import random
import struct
from collections.abc import Sequence
from typing import Any, Final

from bota_ethercat.framing import encode_data, encode_json
from ethercat_server.serving.bare_json import encode_bare_json

MESSAGES: Final[Sequence[dict[str, Any]]] = (
    {"action": "describe", "id": 1},
    {"action": "status", "id": {"deep": [1, [2, [3, None]]]}},
    {"action": "subscribe", "sensors": [0], "every": 3, "fresh_only": False},
    {"action": "unsubscribe", "id": 'a "quoted" \\ } { text'},
    {"action": "configure", "sensor": 0, "settings": {"fir": True, "sinc_length": 128}, "save": False},
    {"action": "tare", "sensor": 0, "samples": 100, "target": [0.0, 0, 0, 0, 0, -1e-3]},
    {"action": "sdo_write", "sensor": 0, "index": 0x8010, "subindex": 1, "hex": "00"},
    {"action": "é\ud800\u2028", "": None, "id": ""},
    {},
)
DATA: Final = encode_data(7, 1_700_000_000_000_000_000, 123_456_789, 0, 4, 3, bytes(range(61)))
DATA_WITH_ORIENTATION: Final = encode_data(2**64 - 1, 0, 2**64 - 1, 255, 255, 65535, b"\xff" * 77)

HOSTILE_TEXTS: Final[Sequence[bytes]] = (
    b"", b" ", b"null", b"[]", b"0", b'"x"', b"{", b"}", b"{}{}", b"nonsense", b"\xef\xbb\xbf{}", b"{}\0",
    b"[" * 8000, b'{"a":' * 2000 + b"1" + b"}" * 2000, b'{"a":' * 33 + b"1" + b"}" * 33,
    b'{"id":' + b"[" * 3000 + b"]" * 3000 + b"}",
    b'{"action":"describe","id":' + b"9" * 4300 + b"}", b'{"action":"describe","id":' + b"9" * 4301 + b"}",
    b'{"action":"describe","id":-' + b"9" * 15000 + b"}", b'{"action":"describe","id":1e999999}',
    b'{"action":"describe","id":1e308}', b'{"action":"describe","id":NaN}', b'{"id":-Infinity}',
    b'{"action":"subscribe","every":1e0}', b'{"action":"subscribe","every":true}',
    b'{"action":"subscribe","every":' + b"9" * 400 + b"}", b'{"action":"subscribe","sensors":[-1]}',
    b'{"action":"subscribe","sensors":[' + b"0," * 7000 + b"0]}",
    b'{"action":"tare","sensor":0,"target":[' + b"9" * 400 + b",0,0,0,0,0]}",
    b'{"action":"describe","id":"\\ud800"}', b'{"action":"\\udfff\\ud800"}',
    b'{"\\ud800":1,"action":"status"}',
    b'{"action":"describe","action":"status","id":1,"id":2}', b'{"action":["describe"]}', b'{"action":null}',
    b'{"action":{"action":"describe"}}', b'{"action":"describe","id":"\xff"}', b"\xed\xa0\x80", b"\xc0\xae",
    b'{"action":"describe","id":"' + "é".encode() * 8000 + b'"}',
    b'{"action":"describe","id":[' + b",".join([b"1e15"] * 3200) + b"]}",
    b'{"action":"describe","id":"\\u0000\\n\\u001b[2J"}', b'{"action":"describe","id":"\n"}',
    b'{"action":"describe","uid":0,"user":"root"}', b'{"action":"' + b"x" * 16000 + b'"}',
    b'{"action":"__init__"}', b'{"action":"_shutdown"}', b'{"action":"describe","id":"\\',
)  # fmt: skip
"""Texts where a request should stand. Most are no request, some are one that is hard to answer."""


def framed(text: bytes) -> bytes:
    """`text` as a JSON message of a framed connection."""
    return struct.pack(">IB", 1 + len(text), 2) + text


FRAMED: Final = (*(encode_json(m) for m in MESSAGES), DATA, DATA_WITH_ORIENTATION)
"""Whole valid messages of a framed connection."""
BARE: Final = tuple(encode_bare_json(m) for m in MESSAGES)
"""Whole valid lines of a bare JSON connection."""


def _flip(rng: random.Random, wire: bytearray, _others: Sequence[bytes]) -> None:
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        wire[rng.randrange(len(wire))] ^= 1 << rng.randrange(8)


def _cut(rng: random.Random, wire: bytearray, _others: Sequence[bytes]) -> None:
    del wire[rng.randrange(len(wire)) :]


def _cut_out(rng: random.Random, wire: bytearray, _others: Sequence[bytes]) -> None:
    at = rng.randrange(len(wire))
    del wire[at : at + rng.randint(1, 8)]


def _double(rng: random.Random, wire: bytearray, _others: Sequence[bytes]) -> None:
    at = rng.randrange(len(wire))
    wire[at:at] = wire[at : at + rng.randint(1, 40)]


def _change_length(rng: random.Random, wire: bytearray, _others: Sequence[bytes]) -> None:
    lengths = (0, 1, 2, 90, 106, 16385, 16386, 65537, 65538, 2**31, 2**32 - 1, rng.randrange(2**17))
    wire[:4] = struct.pack(">I", rng.choice(lengths))


def _splice(rng: random.Random, wire: bytearray, others: Sequence[bytes]) -> None:
    other = rng.choice(others)
    wire[rng.randrange(len(wire)) :] = other[rng.randrange(len(other)) :]


def _insert(rng: random.Random, wire: bytearray, _others: Sequence[bytes]) -> None:
    at = rng.randrange(len(wire) + 1)
    wire[at:at] = rng.choice((rng.randbytes(rng.randint(1, 9)), b"\n", b"{", b"}", b'"', b"\\", b"\\\n"))


_MUTATIONS: Final = (_flip, _cut, _cut_out, _double, _change_length, _splice, _insert)


def mutate(rng: random.Random, wire: bytes, others: Sequence[bytes]) -> bytes:
    """`wire` with something wrong in it; `others` are messages to splice it with. May still be valid."""
    changed = bytearray(wire)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if changed:
            rng.choice(_MUTATIONS)(rng, changed, others)
    return bytes(changed)


def in_chunks(rng: random.Random, stream: bytes) -> list[bytes]:
    """`stream` as it may arrive: in pieces of any size."""
    chunks, at, longest = [], 0, rng.choice((1, 7, 100, 5000, 16384))
    while at < len(stream):
        size = rng.randint(1, longest)
        chunks.append(stream[at : at + size])
        at += size
    return chunks
