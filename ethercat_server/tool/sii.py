"""The SII, a slave's EEPROM, taken apart: identity, mailboxes, sync managers. From ETG.1000.6, ETG.2010."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Final

from ethercat_server.virtual_sensor.sii import checksum
from protocol.control import MAX_SII_WORDS
from protocol.text import visible

_HEADER_WORDS: Final = 0x40
"""The categories begin here."""
_RAW_WORDS: Final = 0x80
_MOST_WORDS: Final = 0x2000
_END: Final = 0xFFFF
_STRINGS, _GENERAL, _FMMUS, _SYNC_MANAGERS = 10, 30, 40, 41
_CATEGORY_NAMES: Final = {
    10: "strings", 30: "general", 40: "FMMUs", 41: "sync managers", 50: "TxPDOs", 51: "RxPDOs", 60: "clocks",
}  # fmt: skip
_PROTOCOLS: Final = ((0x01, "AoE"), (0x02, "EoE"), (0x04, "CoE"), (0x08, "FoE"), (0x10, "SoE"), (0x20, "VoE"))
_SM_KINDS: Final = ("unused", "mailbox out", "mailbox in", "outputs", "inputs")


def read_image(read: Callable[[int, int], bytes]) -> bytes:
    """The SII up to the end of its categories; `read` gives so many words from a word on, two bytes each."""
    image = bytearray()

    def have(words: int) -> None:
        while (lacking := words - len(image) // 2) > 0:
            image.extend(read(len(image) // 2, min(lacking, MAX_SII_WORDS)))

    have(_RAW_WORDS)
    word = _HEADER_WORDS
    while word < _MOST_WORDS:
        have(word + 2)
        kind, length = struct.unpack_from("<HH", image, word * 2)
        if kind == _END:
            break
        word += 2 + length
        have(min(word, _MOST_WORDS))
    return bytes(image)


def raw_lines(image: bytes) -> list[str]:
    """The words that the note's script prints, as it prints them: word address, four bytes."""
    head = image[: _RAW_WORDS * 2]
    return [
        f"{at // 2:04x}: " + "|".join(f"{byte:02x}" for byte in head[at : at + 4])
        for at in range(0, len(head), 4)
    ]


def decode(image: bytes) -> dict[str, Any]:
    """What an image says, by name; what it lacks is empty."""
    vendor, product, revision, serial = struct.unpack_from("<IIII", image, 0x08 * 2)
    out, out_size, back, back_size, protocols = struct.unpack_from("<HHHHH", image, 0x18 * 2)
    parts = _categories(image)
    strings = _strings(parts.get(_STRINGS, b""))
    general = parts.get(_GENERAL, b"").ljust(8, b"\0")

    def text(number: int) -> str:
        return strings[number - 1] if 0 < number <= len(strings) else ""

    return {
        "vendor": vendor,
        "product": product,
        "revision": revision,
        "serial": serial,
        "name": text(general[3]) or text(1),
        "order": text(general[2]),
        "group": text(general[0]),
        "check_byte": image[14],
        "check_byte_right": checksum(image[:14]) == image[14],
        "mailboxes": {"out": [out, out_size], "in": [back, back_size]},
        "protocols": [name for bit, name in _PROTOCOLS if protocols & bit],
        "coe_details": general[5],
        "sync_managers": [
            {"start": start, "size": size, "control": control, "enabled": bool(enable), "kind": _kind(kind)}
            for start, size, control, _, enable, kind in struct.iter_unpack(
                "<HHBBBB", _whole(parts.get(_SYNC_MANAGERS, b""), 8)
            )
        ],
        "fmmus": list(parts.get(_FMMUS, b"").rstrip(b"\xff")),
        "categories": {
            _CATEGORY_NAMES.get(kind, f"category {kind}"): len(body) for kind, body in parts.items()
        },
    }


def _categories(image: bytes) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    at = _HEADER_WORDS * 2
    while at + 4 <= len(image):
        kind, words = struct.unpack_from("<HH", image, at)
        if kind == _END:
            break
        found[kind] = image[at + 4 : at + 4 + words * 2]
        at += 4 + words * 2
    return found


def _strings(body: bytes) -> list[str]:
    found: list[str] = []
    at = 1
    while at < len(body) and len(found) < body[0]:
        text = body[at + 1 : at + 1 + body[at]].decode("ascii", errors="replace")
        found.append(visible(text))
        at += 1 + body[at]
    return found


def _whole(body: bytes, size: int) -> bytes:
    return body[: len(body) // size * size]


def _kind(number: int) -> str:
    return _SM_KINDS[number] if number < len(_SM_KINDS) else f"kind {number}"
