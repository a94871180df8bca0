"""The SII, a slave's EEPROM: its layout, its decoding, and reading it through the controller's registers.

It is never written. Sources: ETG.1000.4, registers 0x0500 to 0x050F, ETG.1000.6 and ETG.2010. pysoem's own
reading takes an EEPROM that cannot be read for one full of zeros, after minutes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum, IntFlag
from typing import Any, Final

from ethercat_server.errors import BusError
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.datagrams import Registers, Steps, repeat
from ethercat_server.ethercat.slave.registers import SII_CONTROL, SII_OWNER

Sii = dict[str, Any]  # what `decode` returns


class Category(IntEnum):
    """Categories, as numbered in the SII."""

    STRINGS = 10
    GENERAL = 30
    FMMUS = 40
    SYNC_MANAGERS = 41
    TXPDOS = 50
    RXPDOS = 51
    CLOCKS = 60
    END = 0xFFFF


class MailboxProtocol(IntFlag):
    """Mailbox protocols that a slave supports, as in word 0x1C."""

    AoE = 0x01
    EoE = 0x02
    CoE = 0x04
    FoE = 0x08
    SoE = 0x10
    VoE = 0x20


IDENTITY: Final = struct.Struct("<IIII")  # vendor, product code, revision, serial number
IDENTITY_BYTE: Final = 0x08 * 2
# Offset and size of the receive mailbox, of the send mailbox, protocols.
MAILBOXES: Final = struct.Struct("<HHHHH")
MAILBOXES_BYTE: Final = 0x18 * 2
CHECKED_BYTES: Final = 14  # the check byte follows them
CATEGORIES_WORD: Final = 0x40  # the categories begin here
CATEGORY_HEADER: Final = struct.Struct("<HH")  # category, length in words
SYNC_MANAGER: Final = struct.Struct("<HHBBBB")  # start, length, control, status, enable, type
# Of a PDO: index, number of its entries, sync manager, clock, name, flags. Of each of them, which follow it:
# index, subindex, name, data type, bits, flags.
PDO: Final = struct.Struct("<HBBBBH")

_RAW_WORDS: Final = 0x80
_MOST_WORDS: Final = 0x2000
_WORDS_AT_ONCE: Final = 128  # the most that a server reads for one request
_CATEGORY_NAMES: Final[dict[int, str]] = {
    Category.STRINGS: "strings", Category.GENERAL: "general", Category.FMMUS: "FMMUs",
    Category.SYNC_MANAGERS: "sync managers", Category.TXPDOS: "TxPDOs", Category.RXPDOS: "RxPDOs",
    Category.CLOCKS: "clocks",
}  # fmt: skip
_SM_KINDS: Final = ("unused", "mailbox out", "mailbox in", "outputs", "inputs")


def checksum(data: bytes | bytearray) -> int:
    """The check byte of the configuration area: CRC-8, polynomial 0x07, start value 0xFF."""
    value = 0xFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x07 if value & 0x80 else value << 1) & 0xFF
    return value


def read_image(read: Callable[[int, int], bytes]) -> bytes:
    """The SII up to the end of its categories; `read(word, count)` returns `count` words from `word` on.

    Reading is slow, so a blank EEPROM, and what no EEPROM has room for, end them as the end mark does.
    """
    image = bytearray()

    def have(words: int) -> None:
        while (lacking := words - len(image) // 2) > 0:
            image.extend(read(len(image) // 2, min(lacking, _WORDS_AT_ONCE)))

    have(_RAW_WORDS)
    word = CATEGORIES_WORD
    while word < _MOST_WORDS:
        have(word + 2)
        kind, length = CATEGORY_HEADER.unpack_from(image, word * 2)
        if _is_end(kind, length) or word + 2 + length > _MOST_WORDS:
            break
        word += 2 + length
        have(word)
    return bytes(image)


def _is_end(kind: int, length: int) -> bool:
    """Whether there are no more categories: the end mark, which is blank memory, or the other blank."""
    return kind == Category.END or kind == length == 0


def raw_lines(image: bytes) -> list[str]:
    """The first words as text: word address, four bytes."""
    head = image[: _RAW_WORDS * 2]
    return [
        f"{at // 2:04x}: " + "|".join(f"{byte:02x}" for byte in head[at : at + 4])
        for at in range(0, len(head), 4)
    ]


def decode(image: bytes) -> Sii:
    """The content of an image by name; what it lacks is empty."""
    vendor, product, revision, serial = IDENTITY.unpack_from(image, IDENTITY_BYTE)
    out, out_size, back, back_size, protocols = MAILBOXES.unpack_from(image, MAILBOXES_BYTE)
    parts = _categories(image)
    strings = _strings(parts.get(Category.STRINGS, b""))
    general = parts.get(Category.GENERAL, b"").ljust(8, b"\0")
    managers = parts.get(Category.SYNC_MANAGERS, b"")

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
        "check_byte": image[CHECKED_BYTES],
        "check_byte_right": checksum(image[:CHECKED_BYTES]) == image[CHECKED_BYTES],
        "mailboxes": {"out": [out, out_size], "in": [back, back_size]},
        "protocols": [bit.name for bit in MailboxProtocol if protocols & bit],
        "coe_details": general[5],
        "sync_managers": [
            {"start": start, "size": size, "control": control, "enabled": bool(enable), "kind": _kind(kind)}
            for start, size, control, _, enable, kind in SYNC_MANAGER.iter_unpack(
                managers[: len(managers) // SYNC_MANAGER.size * SYNC_MANAGER.size]
            )
        ],
        "tx_pdos": _pdos(parts.get(Category.TXPDOS, b""), text),
        "rx_pdos": _pdos(parts.get(Category.RXPDOS, b""), text),
        "fmmus": list(parts.get(Category.FMMUS, b"").rstrip(b"\xff")),
        "categories": {
            _CATEGORY_NAMES.get(kind, f"category {kind}"): len(body) for kind, body in parts.items()
        },
    }


def _categories(image: bytes) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    at = CATEGORIES_WORD * 2
    while at + 4 <= len(image):
        kind, words = CATEGORY_HEADER.unpack_from(image, at)
        if _is_end(kind, words):
            break
        found[kind] = image[at + 4 : at + 4 + words * 2]
        at += 4 + words * 2
    return found


def _pdos(body: bytes, text: Callable[[int], str]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    missing = 0  # entries of the last PDO that are to come
    for index, second, third, fourth, fifth, _ in PDO.iter_unpack(body[: len(body) // PDO.size * PDO.size]):
        if missing:
            missing -= 1
            entry = {"index": index, "subindex": second, "name": text(third), "type": fourth, "bits": fifth}
            found[-1]["entries"].append(entry)
        else:
            missing = second
            found.append({"index": index, "name": text(fifth), "sync_manager": third, "entries": []})
    return found


def _strings(body: bytes) -> list[str]:
    found: list[str] = []
    at = 1
    while at < len(body) and len(found) < body[0]:
        text = body[at + 1 : at + 1 + body[at]].decode("ascii", errors="replace")
        found.append("".join(c if c.isprintable() else "?" for c in text))
        at += 1 + body[at]
    return found


def _kind(number: int) -> str:
    return _SM_KINDS[number] if number < len(_SM_KINDS) else f"kind {number}"


OF_FIRMWARE: Final = b"\x01"
OF_MASTER: Final = b"\x00"
_TAKE: Final = b"\x02"
_IN_USE: Final = 0x01  # of the byte after the owner: the firmware is accessing it

_REGISTERS: Final = struct.Struct("<HI8s")  # control and status, the word's address, the data
_COMMAND: Final = struct.Struct("<HI")
_READ: Final = 0x0100
_NONE: Final = 0x0000
_BUSY: Final = 0x8000
_ERRORS: Final = 0x7800
_EIGHT_BYTES: Final = 0x0040
_ATTEMPTS_TO_GIVE_BACK: Final = 3
_PAUSE_S: Final = 0.0002  # between two questions whether it has read a word: 1 to 3 ms
_WORD_S: Final = 1.5  # an EEPROM behind a busy bus is slow


def read_sii(bus: Registers, slave: int, word: int, count: int, owner: bytes = OF_FIRMWARE) -> Steps[bytes]:
    """`count` words of the SII from `word` on, two bytes each; BusError if it cannot be read.

    `owner` is who has the right to use it afterwards, as in register 0x0500.
    """
    try:
        data = yield from _read_words(bus, slave, word, count)
    except GeneratorExit:
        raise
    except BaseException:  # whatever it is, also that the caller has aborted
        yield from repeat(_ATTEMPTS_TO_GIVE_BACK, bus.write_register, slave, SII_OWNER, owner)
        raise
    yield from repeat(_ATTEMPTS_TO_GIVE_BACK, bus.write_register, slave, SII_OWNER, owner)
    return data


def _read_words(bus: Registers, slave: int, word: int, count: int) -> Steps[bytes]:
    data = bytearray()
    yield from _wait_for_firmware(bus, slave)
    yield from _write(bus, slave, SII_OWNER, _TAKE, word)
    yield from _write(bus, slave, SII_OWNER, OF_MASTER, word)
    while len(data) < 2 * count:
        data += yield from _read_word(bus, slave, word + len(data) // 2)
    return bytes(data[: 2 * count])


def _wait_for_firmware(bus: Registers, slave: int) -> Steps[None]:
    """Wait until the slave's own firmware has finished an access, for a limited time."""
    deadline = Deadline(bus.clock, _WORD_S)
    while not deadline.passed:
        found = yield from bus.read_register(slave, SII_OWNER, 2)
        if found and not (found[0] & 1 and found[1] & _IN_USE):
            return
        yield _PAUSE_S


def _read_word(bus: Registers, slave: int, word: int) -> Steps[bytes]:
    """The two or four words of one read command."""
    deadline = Deadline(bus.clock, _WORD_S)
    answer, asked = "no answer", False
    while not deadline.passed:
        if not asked:
            asked = yield from bus.write_register(slave, SII_CONTROL, _COMMAND.pack(_READ, word))
        elif found := (yield from bus.read_register(slave, SII_CONTROL, _REGISTERS.size)):
            status, address, data = _REGISTERS.unpack(found)
            if status & _BUSY:
                answer = f"it stays busy (status 0x{status:04X})"
            elif status & _ERRORS or address != word:
                answer = f"it refuses (status 0x{status:04X})"
                yield from bus.write_register(slave, SII_CONTROL, _COMMAND.pack(_NONE, word))
                asked = False
            else:
                return bytes(data if status & _EIGHT_BYTES else data[:4])
        yield _PAUSE_S
    raise _unreadable(slave, word, answer)


def _write(bus: Registers, slave: int, address: int, data: bytes, word: int) -> Steps[None]:
    deadline = Deadline(bus.clock, _WORD_S)
    while not (yield from bus.write_register(slave, address, data)):
        if deadline.passed:
            raise _unreadable(slave, word, "no answer")
        yield _PAUSE_S


def _unreadable(slave: int, word: int, why: str) -> BusError:
    return BusError(
        f"the SII of slave {slave} cannot be read at word 0x{word:04X}: {why}; power it off and on, "
        "then try again"
    )
