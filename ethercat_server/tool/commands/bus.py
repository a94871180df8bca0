"""`eeprom`: the EEPROMs (SII) of the slaves."""

from __future__ import annotations

import argparse
import contextlib
import functools
from collections.abc import Callable
from typing import Any

from ethercat_server.access.raw import read_images
from ethercat_server.access.sensors import choose, find_server, note
from ethercat_server.errors import BusError
from ethercat_server.ethercat.slave import sii
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.sensor import Found, Identity
from ethercat_server.tool.command import DONE, Command, add_sensor_arguments, columns, say, say_json


def _eeprom_arguments(parser: argparse.ArgumentParser) -> None:
    add_sensor_arguments(parser, all_if_none=True)


def _images(args: argparse.Namespace) -> dict[int, bytes | BusError]:
    """The SII of each selected slave by position, or the error of reading it."""
    if (server := find_server(args.iface, args.server)) is not None:
        with contextlib.closing(server):
            return {
                found.number: _image(functools.partial(server.sii, found.number))
                for found in server.chosen(args.sensor)
            }
    images = read_images(args.iface, force=args.take_over, allow_ip=args.allow_ip)
    if args.sensor is None:
        return images
    found = [_identified(position, image) for position, image in images.items()]
    position = choose(found, args.sensor).number
    return {position: images[position]}


def _image(read: Callable[[int, int], bytes]) -> bytes | BusError:
    try:
        return sii.read_image(read)
    except BusError as error:
        return error


def _identified(position: int, image: bytes | BusError) -> Found:
    row: dict[str, Any] = {"name": "", "serial": 0}
    if isinstance(image, bytes):
        row = sii.decode(image)
    return Found(position, Identity(row["name"], row["serial"], "", ""))


def _eeprom(args: argparse.Namespace) -> int:
    images = _images(args)
    read = {n: image for n, image in images.items() if isinstance(image, bytes)}
    errors = {n: image for n, image in images.items() if isinstance(image, BusError)}
    if not read:
        raise next(iter(errors.values()))
    decoded = {n: sii.decode(image) for n, image in read.items()}
    if args.json:
        rows = [{"sensor": n, **row, "raw": read[n].hex()} for n, row in decoded.items()]
        rows += [{"sensor": n, "error": str(error)} for n, error in errors.items()]
        say_json({"slaves": sorted(rows, key=lambda row: row["sensor"])})
    else:
        for n, row in decoded.items():
            say(f"slave {n}: {row['name'] or 'nameless'}")
            say(columns(_rows(row), indent=2))
            say("\n".join(sii.raw_lines(read[n])))
    for error in errors.values():
        note(str(error))
    return FAILED if errors else DONE


def _rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    mailboxes, protocols = found["mailboxes"], ", ".join(found["protocols"]) or "none"
    rows = [
        ("vendor", f"0x{found['vendor']:08X}"),
        ("product", str(found["product"])),
        ("revision", str(found["revision"])),
        ("serial", str(found["serial"])),
        ("name", found["name"]),
        ("group", found["group"]),
        ("check byte", f"0x{found['check_byte']:02X}, {'correct' if found['check_byte_right'] else 'WRONG'}"),
        ("mailbox out", f"0x{mailboxes['out'][0]:04X}, {mailboxes['out'][1]} bytes"),
        ("mailbox in", f"0x{mailboxes['in'][0]:04X}, {mailboxes['in'][1]} bytes"),
        ("protocols", protocols),
    ]
    for n, row in enumerate(found["sync_managers"]):
        rows.append((f"sync manager {n}", f"0x{row['start']:04X}, {row['size']} bytes, {row['kind']}"))
    rows.append(
        ("categories", ", ".join(f"{name} {size} bytes" for name, size in found["categories"].items()))
    )
    return rows


COMMANDS = (
    Command("eeprom", "read the slaves' SII (EEPROM): decoded, and raw words", _eeprom_arguments, _eeprom),
)
