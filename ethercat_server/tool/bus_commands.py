"""`adapters` and `eeprom`: what is there before any sensor is asked anything."""

from __future__ import annotations

import argparse
import contextlib
import functools
from typing import Any

from ethercat_server.sdo import finish
from ethercat_server.sensor import Identity
from ethercat_server.sii import read_sii
from ethercat_server.tool import sii
from ethercat_server.tool.command import DONE, Command, add_link_arguments
from ethercat_server.tool.direct import scan_only
from ethercat_server.tool.holder import find_holder
from ethercat_server.tool.link import Found, choose
from ethercat_server.tool.reach import find_server
from ethercat_server.tool.show import columns, say, say_json


def _no_arguments(_: argparse.ArgumentParser) -> None:
    """`adapters` takes none."""


def _adapters(args: argparse.Namespace) -> int:
    from pyroute2 import IPRoute  # noqa: PLC0415 - takes a moment, and only this needs it

    found = []
    with IPRoute() as route:
        for interface in route.get_links():
            info = interface.get_attr("IFLA_LINKINFO")
            name = interface.get_attr("IFLA_IFNAME")
            holder = find_holder(name)
            found.append(
                {
                    "name": name,
                    "kind": (info.get_attr("IFLA_INFO_KIND") if info else None) or "",
                    "address": interface.get_attr("IFLA_ADDRESS"),
                    "up": bool(interface["flags"] & 0x1),
                    "carrier": interface.get_attr("IFLA_CARRIER") == 1 and bool(interface["flags"] & 0x1),
                    "loopback": bool(interface["flags"] & 0x8),
                    "held_by": str(holder) if holder else None,
                }
            )
    if args.json:
        say_json({"adapters": found})
        return DONE
    rows = [("adapter", "state", "address", "")]
    for row in found:
        state = "down" if not row["up"] else "up" if row["carrier"] else "up, no carrier"
        what = "loopback: no sensor here" if row["loopback"] else row["kind"]
        held = f"held by {row['held_by']}" if row["held_by"] else ""
        rows.append((row["name"], state, row["address"] or "", ", ".join(filter(None, (what, held)))))
    say(columns(rows))
    return DONE


def _eeprom_arguments(parser: argparse.ArgumentParser) -> None:
    add_link_arguments(parser, all_if_none=True)


def _images(args: argparse.Namespace) -> list[bytes]:
    """The SII of every slave, by place."""
    with contextlib.ExitStack() as cleanup:
        link = find_server(args.iface, args.server)
        if link is not None:
            cleanup.callback(link.close)
            return [sii.read_image(functools.partial(link.sii, sensor.place)) for sensor in link.sensors]
        bus, slaves = scan_only(args.iface, cleanup)

        def read(place: int, word: int, words: int) -> bytes:
            return finish(read_sii(bus, place, word, words), pause_s=0)

        return [sii.read_image(functools.partial(read, place)) for place in range(len(slaves))]


def _eeprom(args: argparse.Namespace) -> int:
    images = _images(args)
    decoded = [sii.decode(image) for image in images]
    found = [Found(n, Identity(row["name"], row["serial"], "", "")) for n, row in enumerate(decoded)]
    places = [choose(found, args.sensor).place] if args.sensor is not None else range(len(found))
    if args.json:
        say_json({"slaves": [{"sensor": n, **decoded[n], "raw": images[n].hex()} for n in places]})
        return DONE
    for n in places:
        say(f"slave {n}: {decoded[n]['name'] or 'nameless'}")
        say("\n".join(sii.raw_lines(images[n])))
        say(columns(_rows(decoded[n]), indent=2))
    return DONE


def _rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    mailboxes, protocols = found["mailboxes"], ", ".join(found["protocols"]) or "none"
    rows = [
        ("vendor", f"0x{found['vendor']:08X}"),
        ("product", str(found["product"])),
        ("revision", str(found["revision"])),
        ("serial", str(found["serial"])),
        ("name", found["name"]),
        ("group", found["group"]),
        ("check byte", f"0x{found['check_byte']:02X}, {'right' if found['check_byte_right'] else 'WRONG'}"),
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
    Command("adapters", "list the network adapters of this machine", _no_arguments, _adapters),
    Command("eeprom", "read the slaves' SII (EEPROM): raw words, and decoded", _eeprom_arguments, _eeprom),
)
