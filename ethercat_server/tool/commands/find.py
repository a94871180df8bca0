"""`adapters` and `find`: the network interfaces of this machine, and which of them has a sensor."""

from __future__ import annotations

import argparse
import contextlib
from typing import Any, NamedTuple

from ethercat_server.access.adapters import Adapter, adapters
from ethercat_server.access.raw import look_on
from ethercat_server.access.sensors import Sensors
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.nic import network_trouble
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.scan import NoSlaveError
from ethercat_server.tool.command import DONE, Command, columns, say, say_json


class _Found(NamedTuple):
    """What is on one interface."""

    adapter: Adapter
    looked: bool
    """Whether frames were sent, or its server was asked."""
    text: str
    sensors: list[dict[str, Any]]
    others: int = 0
    """Slaves that are no sensors."""


def _no_arguments(_: argparse.ArgumentParser) -> None:
    """They have none."""


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
    return {
        "name": row.name,
        "kind": row.kind,
        "address": row.address,
        "up": row.up,
        "carrier": row.carrier,
        "loopback": row.loopback,
        "held_by": str(row.holder) if row.holder else None,
        "default_route": row.routes.default,
        "ip_addresses": list(row.routes.addresses),
    }


def _find(args: argparse.Namespace) -> int:
    found = [_look(row) for row in adapters()]
    if args.json:
        rows = [
            {"name": row.adapter.name, "looked": row.looked, "found": row.text}
            | {"sensors": row.sensors, "other_slaves": row.others}
            for row in found
        ]
        say_json({"interfaces": rows})
    else:
        found.sort(key=lambda row: (not row.sensors, not row.looked))
        say(columns([("interface", "found"), *((row.adapter.name, row.text) for row in found)]))
    return DONE if any(row.sensors for row in found) else FAILED


def _look(row: Adapter) -> _Found:
    if row.holder is not None:
        return _ask(row)
    if row.unfit is not None:
        return _Found(row, False, f"left alone: {row.unfit}", [])
    try:
        slaves = look_on(row.name)
    except NoSlaveError:
        return _Found(row, True, "no EtherCAT slave answers", [])
    except ServerError as error:
        return _Found(row, False, f"left alone: {error}", [])
    sensors = [
        {"sensor": number, "position": slave.position, "name": slave.name, "serial": slave.sii["serial"]}
        for number, slave in enumerate(slave for slave in slaves if slave.is_sensor)
        if slave.sii is not None
    ]
    return _described(row, sensors, len(slaves) - len(sensors), "")


def _ask(row: Adapter) -> _Found:
    """Have the server that uses the interface say what is on it."""
    assert row.holder is not None
    if row.holder.address is None:
        return _Found(row, False, f"left alone: in use by {row.holder}", [])
    where = f"through the server at {row.holder.address}, {row.holder}"
    try:
        with contextlib.closing(Sensors.through(row.holder.address)) as server:
            sensors = [
                {"sensor": found.number, "name": found.identity.name, "serial": found.identity.serial}
                for found in server.sensors
            ]
    except ServerError as error:
        return _Found(row, False, f"left alone: in use by {row.holder}: {error}", [])
    return _described(row, sensors, 0, f" ({where})")


def _described(row: Adapter, sensors: list[dict[str, Any]], others: int, where: str) -> _Found:
    texts = [f"{sensor['name']}, serial {sensor['serial']}" for sensor in sensors]
    if others:
        texts.append(f"{others} other EtherCAT slaves" if others > 1 else "another EtherCAT slave")
    return _Found(row, True, "; ".join(texts) + where, sensors, others)


COMMANDS = (
    Command("adapters", "list the network adapters of this machine", _no_arguments, _adapters),
    Command("find", "look for sensors on all interfaces, without disturbing others", _no_arguments, _find),
)
