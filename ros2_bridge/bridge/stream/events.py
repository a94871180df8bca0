"""The server's events as sentences for the log. Their content is not trusted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bridge.stream.connection import known_offset, known_settings
from ft_compensation.quantities import Wrench, wrench_text
from protocol.control import Event
from protocol.settings import SettingValue
from protocol.text.json_text import JsonObject
from protocol.text.untrusted import number
from protocol.text.visible import printable


def sentence(message: JsonObject, before: Mapping[str, SettingValue]) -> str:
    """What an event says; `before` are the settings that were in force."""
    event = message["event"]
    told = message.get("message")
    if event == Event.SENSOR_LOST:
        return printable(told) if isinstance(told, str) and told else "the server has lost the sensor"
    if event == Event.SENSOR_BACK:
        lost_s = number(message.get("lost_s"))
        return "the sensor is back" + ("" if lost_s is None else f" after {lost_s:g} s")
    if event == Event.RECONFIGURED:
        return f"the sensor was reconfigured{_changes(message, before)}"
    if event == Event.OFFSET_CHANGED:
        offset = known_offset(message.get("offset"))
        now = "no longer known" if offset is None else f"{wrench_text(Wrench.of(offset))} now"
        return f"the sensor's own offset is {now}"
    if event == Event.EMERGENCY:
        return "the sensor reports an emergency" + (f": {printable(told)}" if isinstance(told, str) else "")
    if event == Event.SHUTTING_DOWN:
        return "the server is shutting down"
    return f"the server sent the event {printable(event, 40)}, which this version does not know"


def _changes(message: Mapping[str, Any], before: Mapping[str, SettingValue]) -> str:
    now = known_settings(message.get("settings"))
    changed = [f"{name} {str(value).lower()}" for name, value in now.items() if before.get(name) != value]
    return f": {', '.join(changed)}" if changed else ""
