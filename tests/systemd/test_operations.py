"""docs/operations.md explains every line that the server logs or ends with, and every event."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from protocol.control import Event
from tests.systemd.staging import ROOT

ROOMS = ("ethercat", "sensor", "acquisition", "serving", "process", "daemon")
"""What runs in the server; programs beside it have pages of their own."""
SERVER = [path for room in ROOMS for path in sorted((ROOT / "ethercat_server" / room).rglob("*.py"))]
SERVER.append(ROOT / "ethercat_server/virtual_sensor/virtual_bus.py")
ERRORS = {"ServerError", "InterfaceError", "BusError", "NoSlaveError", "SdoAbortError"}
"""UsageError is not one of them: it answers what was just typed, and has one line for all."""
GENERAL = {"check cable and power", "power it off and on", "power the sensor off and on", "then start again"}
"""Advice that many messages end with."""
LEVELS = {"info", "warning", "error", "exception"}


def texts(node: ast.expr) -> Iterator[str]:
    """The constant parts of a text, with what is put in left out."""
    for part in ast.walk(node):
        if isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield from re.split(r"%[-+.0-9]*[a-zA-Z%]|[:;,]", part.value)


def messages() -> Iterator[tuple[str, list[str]]]:
    """Where each message is, and its constant parts that are long enough to be looked for."""
    for path in SERVER:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or not node.args:
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            logs = name in LEVELS and ast.unparse(node.func).startswith("log.")
            parts = [part.strip() for part in texts(node.args[0])]
            parts = [part for part in parts if len(part) >= 8 and part not in GENERAL]
            if (logs or name in ERRORS) and parts:
                yield f"{path.name}:{node.lineno}", parts


def test_every_message_is_explained() -> None:
    text = " ".join((ROOT / "docs" / "operations.md").read_text().split())
    found = list(messages())
    assert len(found) > 20
    assert not [message for message in found if not any(part in text for part in message[1])]


def test_every_event_is_explained() -> None:
    text = (ROOT / "docs" / "operations.md").read_text()
    for event in Event:
        assert f"`{event}`" in text, event
