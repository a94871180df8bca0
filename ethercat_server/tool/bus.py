"""`adapters`, `find` and `eeprom`: the network interfaces of this machine, which of them has a sensor, and
the EEPROMs (SII) of the slaves. No slave is taken to another state."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from ethercat_server.access.adapters import Adapter, adapters
from ethercat_server.access.private_server import open_interface
from ethercat_server.access.sensors import Sensors, choose, find_server, note
from ethercat_server.errors import BusError, ServerError
from ethercat_server.ethercat.nic import network_trouble
from ethercat_server.ethercat.slave import sii
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.scan import NoSlaveError, read_image, scan_if_free
from ethercat_server.sensor.sensor import FoundSensor, Identity
from ethercat_server.tool.command import DONE, Subcommand, chosen, columns, say, say_json, sensor_arguments


def _adapters(args: argparse.Namespace) -> int:
    found = adapters()
    if args.json:
        names = ("up", "carrier", "loopback")
        say_json({"adapters": [{
            "name": row.name,
            "kind": row.kind,
            "address": row.address.hex(":") or None,
            **{name: getattr(row, name) for name in names},
            "held_by": str(row.holder) if row.holder else None,
            "default_route": row.routes.default,
            "ip_addresses": list(row.routes.addresses),
        } for row in found]})  # fmt: skip
        return DONE
    rows = [("adapter", "state", "address", "use")]
    for row in found:
        what = "loopback" if row.loopback else row.kind
        held = f"in use by {row.holder}" if row.holder else ""
        ip = str(row.routes) if not row.loopback else ""
        if network_trouble(row.name, row.routes):
            ip = f"not for a sensor: {ip}"
        rows.append((row.name, row.state, row.address.hex(":"), "; ".join(filter(None, (what, held, ip)))))
    say(columns(rows))
    return DONE


def _find(args: argparse.Namespace) -> int:
    found = [_search(row) for row in adapters()]
    if args.json:
        say_json({"interfaces": found})
    else:
        found.sort(key=lambda row: (not row["sensors"], not row["looked"]))
        say(columns([("interface", "found"), *((row["name"], row["found"]) for row in found)]))
    return DONE if any(row["sensors"] for row in found) else FAILED


def _search(row: Adapter) -> dict[str, Any]:
    """What is on an interface where looking disturbs nobody; the server that uses it is asked.

    `looked`: whether frames were sent, or its server was asked.
    """
    sensors, others = list[dict[str, Any]](), 0
    found = {"name": row.name, "looked": False, "found": "", "sensors": sensors, "other_slaves": 0}
    where, used = "", f"in use by {row.holder}" if row.holder else ""
    try:
        if row.holder is not None and row.holder.address is not None:
            where = f" (through the server at {row.holder.address}, {row.holder})"
            with contextlib.closing(Sensors.through(row.holder.address)) as server:
                for number, who in server.sensors:
                    sensors.append({"sensor": number, "name": who.name, "serial": who.serial})
        elif why := used or row.unfit:
            return found | {"found": f"left alone: {why}"}
        else:
            # Frames of another master are waited for first; nothing is asked if there are some.
            with open_interface(row.name) as bus:
                slaves = scan_if_free(bus, lambda: None)
            for slave in slaves:
                if slave.is_sensor and slave.sii is not None:
                    sensor = {"sensor": len(sensors), "position": slave.position, "name": slave.name}
                    sensors.append({**sensor, "serial": slave.sii["serial"]})
            others = len(slaves) - len(sensors)
    except NoSlaveError:
        return found | {"looked": True, "found": "no EtherCAT slave answers"}
    except ServerError as error:
        return found | {"found": f"left alone: {used}{': ' * bool(used)}{error}", "sensors": []}
    texts = [f"{sensor['name']}, serial {sensor['serial']}" for sensor in sensors]
    if others:
        texts.append(f"{others} other EtherCAT slaves" if others > 1 else "another EtherCAT slave")
    return found | {"looked": True, "found": "; ".join(texts) + where, "other_slaves": others}


def _eeprom(args: argparse.Namespace) -> int:
    if (server := find_server(args.iface, args.server)) is not None:
        with contextlib.closing(server):
            numbers = [found.number for found in chosen(server, args)]
            slaves = {number: _decoded(sii.read_image, partial(_words, server, number)) for number in numbers}
    else:
        with open_interface(args.iface, allow_ip=args.allow_ip) as bus:
            positions = [slave.position for slave in scan_if_free(bus, lambda: None, force=args.take_over)]
            slaves = {position: _decoded(read_image, bus, position) for position in positions}
        if args.sensor is not None:
            identities = (
                Identity(row.get("name", ""), row.get("serial", 0), "", "") for row in slaves.values()
            )
            position = choose(list(map(FoundSensor, slaves, identities)), args.sensor).number
            slaves = {position: slaves[position]}
    errors = [row["error"] for row in slaves.values() if "error" in row]
    if len(errors) == len(slaves):
        raise BusError(errors[0])
    if args.json:
        say_json({"slaves": [{"sensor": position, **row} for position, row in slaves.items()]})
    for position, row in slaves.items() if not args.json else ():
        if "error" not in row:
            say(f"slave {position}: {row['name'] or 'nameless'}")
            say(columns(_rows(row), indent=2))
            say("\n".join(["word  bytes", *sii.raw_lines(bytes.fromhex(row["raw"]))]))
    for error in errors:
        note(error)
    return FAILED if errors else DONE


def _decoded(read: Callable[..., bytes], *arguments: object) -> dict[str, Any]:
    """The SII that `read` reads, or the `error`."""
    try:
        raw = read(*arguments)
    except BusError as error:
        return {"error": str(error)}
    return {**sii.decode(raw), "raw": raw.hex()}


def _words(server: Sensors, number: int, word: int, words: int) -> bytes:
    """Some words of a sensor's SII."""
    return bytes.fromhex(server.ask("sii_read", sensor=number, word=word, words=words)["hex"])


def _rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    (out, out_size), (back, back_size) = found["mailboxes"]["out"], found["mailboxes"]["in"]
    right = "correct" if found["check_byte_right"] else "WRONG"
    return [
        ("vendor", f"0x{found['vendor']:08X}"),
        *((name, str(found[name])) for name in ("product", "revision", "serial", "name", "group")),
        ("check byte", f"0x{found['check_byte']:02X}, {right}"),
        ("mailbox out", f"0x{out:04X}, {out_size} bytes"),
        ("mailbox in", f"0x{back:04X}, {back_size} bytes"),
        ("protocols", ", ".join(found["protocols"]) or "none"),
        *(
            (f"sync manager {n}", f"0x{row['start']:04X}, {row['size']} bytes, {row['kind']}")
            for n, row in enumerate(found["sync_managers"])
        ),
        ("categories", ", ".join(f"{name} {size} bytes" for name, size in found["categories"].items())),
    ]


COMMANDS: Final = {
    "adapters": Subcommand((), _adapters),
    "find": Subcommand((), _find),
    "eeprom": Subcommand(sensor_arguments(all_if_none=True), _eeprom),
}
