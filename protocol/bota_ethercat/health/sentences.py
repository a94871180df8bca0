# SPDX-License-Identifier: Apache-2.0
"""What every program says of a condition, in the same words: no server, a sensor that is lost, and so on.

What is wrong with a stream is in `judge`; why a request is denied is said by the server.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from bota_ethercat.control import Event
from bota_ethercat.text.untrusted import number, printable, text, whole

# What others than the doctor advise.
CHECK_IT: Final = "check it with ethercat-doctor"
IT_TELLS: Final = "ethercat-doctor tells which"
STOOD_STILL: Final = f"computer stood still{{}}, {CHECK_IT}"
_EVENTS: Final[Mapping[str, str]] = {
    Event.SENSOR_LOST: "{} is lost",
    Event.SENSOR_BACK: "{} is back",
    Event.RECONFIGURED: "the settings of {} have changed",
    Event.OFFSET_CHANGED: "the offset of {} has changed",
    Event.EMERGENCY: "{} reports an emergency",
    Event.SHUTTING_DOWN: "the server is shutting down",
}


def no_server(address: object, why: object) -> str:
    """Nothing answers at that address."""
    return f"no server at {address} ({why}): start ethercat-server, or give its address"


def did_not_read(seconds: float, *, busy: bool | None = None) -> tuple[str, str]:
    """That this program itself was late, and what to do; `busy`: whether it used the CPU, None if unknown."""
    lasted = f"for {seconds:.1f} s" if seconds >= 1 else f"for {seconds * 1e3:.0f} ms"
    if busy is None:
        return f"this program did not read {lasted}", "It, or this computer, is too busy"
    if busy:
        return f"this program did other things {lasted}", "Have it read more often"
    return (
        f"this computer did not run this program {lasted}",
        "Give it a priority, or the computer less to do",
    )


def event_sentence(event: Mapping[str, Any]) -> str:
    """What an event of the server says: its own message, or what it means."""
    if told := text(event.get("message")):
        return told
    kind, sensor, lost_s = str(event.get("event")), whole(event.get("sensor")), number(event.get("lost_s"))
    if kind not in _EVENTS:
        return f"the server sent the event {printable(kind, 40)}, which this version does not know"
    said = _EVENTS[kind].format("the sensor" if sensor is None else f"sensor {sensor}")
    return said if lost_s is None else f"{said} after {lost_s:g} s"
