"""`adapters`, `find` and `eeprom`: the network interfaces of this machine, which of them has a sensor, and
the EEPROMs (SII) of the slaves. No slave is taken to another state."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from ethercat_server.access.adapters import Adapter, adapters, promiscuity_kept
from ethercat_server.access.private_server import open_interface
from ethercat_server.access.sensors import Sensors, choose, find_server, note
from ethercat_server.errors import BusError, ServerError
from ethercat_server.ethercat.nic import network_trouble
from ethercat_server.ethercat.slave import sii
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.scan import NoSlaveError, look_safely, read_image
from ethercat_server.sensor.sensor import Found, Identity
from ethercat_server.tool.command import DONE, Command, columns, say, say_json, sensor_arguments


def _adapters(args: argparse.Namespace) -> int:
    found = adapters()
    if args.json:
        say_json({"adapters": [_as_json(row) for row in found]})
        return DONE
    rows = [("adapter", "state", "address", "")]
    for row in found:
        what = "loopback" if row.loopback else row.kind
        held = f"in use by {row.holder}" if row.holder else ""
        ip = str(row.routes) if not row.loopback else ""
        if network_trouble(row.name, row.routes):
            ip = f"not for a sensor: {ip}"
        rows.append((row.name, row.state, row.address or "", "; ".join(filter(None, (what, held, ip)))))
    say(columns(rows))
    return DONE


def _as_json(row: Adapter) -> dict[str, Any]:
    names = ("name", "kind", "address", "up", "carrier", "loopback")
    return {
        **{name: getattr(row, name) for name in names},
        "held_by": str(row.holder) if row.holder else None,
        "default_route": row.routes.default,
        "ip_addresses": list(row.routes.addresses),
    }


class _Found(NamedTuple):
    """What is on one interface."""

    name: str
    looked: bool  # whether frames were sent, or its server was asked
    found: str
    sensors: Sequence[dict[str, Any]] = ()
    other_slaves: int = 0


def _find(args: argparse.Namespace) -> int:
    found = [_look(row) for row in adapters()]
    if args.json:
        say_json({"interfaces": [row._asdict() for row in found]})
    else:
        found.sort(key=lambda row: (not row.sensors, not row.looked))
        say(columns([("interface", "found"), *((row.name, row.found) for row in found)]))
    return DONE if any(row.sensors for row in found) else FAILED


def _look(row: Adapter) -> _Found:
    """On an interface where that disturbs nobody; the server that uses it is asked."""
    where, others, sensors = "", 0, list[dict[str, Any]]()
    try:
        if row.holder is not None and row.holder.address is not None:
            where = f" (through the server at {row.holder.address}, {row.holder})"
            with contextlib.closing(Sensors.through(row.holder.address)) as server:
                for found in server.sensors:
                    who = found.identity
                    sensors.append({"sensor": found.number, "name": who.name, "serial": who.serial})
        elif why := row.unfit if row.holder is None else f"in use by {row.holder}":
            return _Found(row.name, False, f"left alone: {why}")
        else:
            # Frames of another master are waited for first; nothing is asked if there are some.
            with promiscuity_kept(row.name), open_interface(row.name) as bus:
                slaves = look_safely(bus, lambda: None)
            for slave in slaves:
                if slave.is_sensor and slave.sii is not None:
                    sensor = {"sensor": len(sensors), "position": slave.position, "name": slave.name}
                    sensors.append({**sensor, "serial": slave.sii["serial"]})
            others = len(slaves) - len(sensors)
    except NoSlaveError:
        return _Found(row.name, True, "no EtherCAT slave answers")
    except ServerError as error:
        used = f"in use by {row.holder}: " if row.holder else ""
        return _Found(row.name, False, f"left alone: {used}{error}")
    texts = [f"{sensor['name']}, serial {sensor['serial']}" for sensor in sensors]
    if others:
        texts.append(f"{others} other EtherCAT slaves" if others > 1 else "another EtherCAT slave")
    return _Found(row.name, True, "; ".join(texts) + where, sensors, others)


def _images(args: argparse.Namespace) -> dict[int, bytes | BusError]:
    """The SII of each selected slave by position, or the error of reading it."""
    if (server := find_server(args.iface, args.server)) is not None:
        with contextlib.closing(server):
            numbers = [found.number for found in server.chosen(args.sensor)]
            return {number: _image(sii.read_image, partial(_words, server, number)) for number in numbers}
    with open_interface(args.iface, allow_ip=args.allow_ip) as bus:
        slaves = look_safely(bus, lambda: None, force=args.take_over)
        images = {slave.position: _image(read_image, bus, slave.position) for slave in slaves}
    if args.sensor is None:
        return images
    position = choose([_identified(*each) for each in images.items()], args.sensor).number
    return {position: images[position]}


def _image(read: Callable[..., bytes], *arguments: object) -> bytes | BusError:
    try:
        return read(*arguments)
    except BusError as error:
        return error


def _words(server: Sensors, number: int, word: int, words: int) -> bytes:
    """Some words of a sensor's SII."""
    return bytes.fromhex(server.ask("sii_read", sensor=number, word=word, words=words)["hex"])


def _identified(position: int, image: bytes | BusError) -> Found:
    row: dict[str, Any] = {"name": "", "serial": 0}
    if isinstance(image, bytes):
        row = sii.decode(image)
    return Found(position, Identity(row["name"], row["serial"], "", ""))


def _eeprom(args: argparse.Namespace) -> int:
    images = _images(args)
    errors = {n: image for n, image in images.items() if isinstance(image, BusError)}
    read = {n: image for n, image in images.items() if isinstance(image, bytes)}
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


COMMANDS = (
    Command("adapters", "list the network adapters of this machine", (), _adapters),
    Command("find", "look for sensors on all interfaces, without disturbing others", (), _find),
    Command(
        "eeprom", "read the slaves' SII (EEPROM): decoded, and raw words",
        sensor_arguments(all_if_none=True), _eeprom,
    ),
)  # fmt: skip
