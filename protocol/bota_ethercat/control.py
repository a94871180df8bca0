# SPDX-License-Identifier: Apache-2.0
"""Control messages: actions and their keys, error codes, events, replies.

`ACTIONS` is the table of what a request may carry; `parse_request` checks a request against it.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, Final, NamedTuple

from bota_ethercat.errors import ConnectionFailedError, RequestError, SettingError
from bota_ethercat.option_types import OptionType, flag, hexadecimal, integer, number, several, text
from bota_ethercat.sensor.sdo_types import sdo_type
from bota_ethercat.sensor_choice import SensorChoice
from bota_ethercat.settings import check_settings
from bota_ethercat.text import untrusted
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import printable

PROTOCOL_VERSION: Final = 1
MAX_SDO_BYTES: Final = 112  # largest SDO that fits a mailbox of 128 bytes unsegmented
MAX_TARE_SAMPLES: Final = 20_000
_MAX_NAME_LENGTH: Final = 80
MAX_SII_WORDS: Final = 128
SIX_NUMBERS: Final = several(
    number(-sys.float_info.max, sys.float_info.max), (6,), "a list of six finite numbers"
)  # a wrench


class _Text(str, Enum):  # enum.StrEnum needs Python 3.11
    __str__ = str.__str__


class ErrorCode(_Text):
    """The `code` of an error reply."""

    BAD_REQUEST = "bad_request"
    UNKNOWN_ACTION = "unknown_action"
    DENIED = "denied"
    BUSY = "busy"
    NOT_READY = "not_ready"
    SENSOR = "sensor"  # the sensor refused: an SDO abort, with `abort_code`
    INTERNAL = "internal"


class Event(_Text):
    """What the server sends to framed connections unasked."""

    SENSOR_LOST = "sensor_lost"
    SENSOR_BACK = "sensor_back"
    RECONFIGURED = "reconfigured"
    OFFSET_CHANGED = "offset_changed"
    EMERGENCY = "emergency"
    SHUTTING_DOWN = "shutting_down"


_EVENTS: Final[Mapping[str, str]] = {
    Event.SENSOR_LOST: "{} is lost",
    Event.SENSOR_BACK: "{} is back",
    Event.RECONFIGURED: "the settings of {} have changed",
    Event.OFFSET_CHANGED: "the offset of {} has changed",
    Event.EMERGENCY: "{} reports an emergency",
    Event.SHUTTING_DOWN: "the server is shutting down",
}


# Returns the checked value; raises SettingError, or ValueError whose text is what is allowed.
Check = Callable[[object], Any]


class Parameter(NamedTuple):
    """One key that a request may carry."""

    check: Check
    default: Any = None
    required: bool = False


class Action(NamedTuple):
    """One action and its keys besides `action` and `id`."""

    parameters: Mapping[str, Parameter]
    controls: bool = False  # changes something, so it needs control rights
    framed_only: bool = False  # for framed connections only


class Request(NamedTuple):
    """A checked request. `values` has every key of the action, with defaults."""

    action: str
    id: object
    has_id: bool
    values: Mapping[str, Any]


def known_six(value: object) -> tuple[float, ...] | None:
    """Six finite numbers from a message or a file; None if they are none."""
    with contextlib.suppress(ValueError):
        return SIX_NUMBERS.check(value)
    return None


def _settings(value: object) -> Mapping[str, Any]:
    if not isinstance(value, dict) or not value:
        raise ValueError('an object with settings by name, such as {"sinc_length": 64}')
    return check_settings(value)


def _object_number(high: int) -> Check:
    """A check for an index or sub-index: a whole number, or a text such as "0x8010"."""
    known = integer(0, high)
    return OptionType(
        f'{known.allowed}, or a text such as "0x{high:X}"',
        lambda value: known.parse(value) if isinstance(value, str) else known.check(value),
    ).check


_SENSORS: Final = several(
    integer(0, 255), range(1, sys.maxsize), "a list of numbers from 0, such as [0]"
).check
_NAME: Final = text(
    f"a text of 1 to {_MAX_NAME_LENGTH} characters, such as 'Sampling rate'",
    lambda name: 0 < len(name) <= _MAX_NAME_LENGTH,
)
_OBJECT_NAME: Final = Parameter(_NAME.check)
_HEX: Final = Parameter(hexadecimal(1, MAX_SDO_BYTES).check)
_SENSOR: Final = Parameter(SensorChoice.parse, default=SensorChoice(number=0))
_INDEX: Final = _object_number(0xFFFF)
_SUBINDEX: Final = _object_number(0xFF)
_ENTRY: Final = {
    "sensor": _SENSOR,
    "index": Parameter(_INDEX, required=True),
    "subindex": Parameter(_SUBINDEX, default=0),
    "type": Parameter(sdo_type),
}

ACTIONS: Final[Mapping[str, Action]] = {
    "describe": Action({}),
    "subscribe": Action(
        {
            "sensors": Parameter(_SENSORS),
            "terminals": Parameter(_SENSORS, default=()),
            "every": Parameter(integer(1, 1_000_000).check, default=1),
            "fresh_only": Parameter(flag.check, default=True),
        },
        framed_only=True,
    ),
    "unsubscribe": Action({}, framed_only=True),
    "status": Action({}),
    "configure": Action(
        {
            "sensor": _SENSOR,
            "settings": Parameter(_settings, required=True),
            "save": Parameter(flag.check, default=False),
        },
        controls=True,
    ),
    "tare": Action(
        {
            "sensor": _SENSOR,
            "samples": Parameter(integer(1, MAX_TARE_SAMPLES).check, default=400),
            "target": Parameter(SIX_NUMBERS.check, default=(0.0,) * 6),
        },
        controls=True,
    ),
    "sdo_read": Action(
        {**_ENTRY, "index": Parameter(_INDEX), "subindex": Parameter(_SUBINDEX), "name": _OBJECT_NAME}
    ),
    "sdo_write": Action({**_ENTRY, "value": Parameter(lambda value: value), "hex": _HEX}, controls=True),
    "sii_read": Action(
        {
            "sensor": _SENSOR,
            "word": Parameter(_object_number(0xFFFF), required=True),
            "words": Parameter(integer(1, MAX_SII_WORDS).check, default=2),
        },
        controls=True,
    ),
    "trace": Action({"offset": Parameter(integer(0, 2**31 - 1).check, default=0)}, controls=True),
    "shutdown": Action({}, controls=True),
}


def parse_request(message: JsonObject) -> Request:
    """Check a request against its action's table.

    RequestError carries `bad_request`, naming the key that is wrong, or `unknown_action`.
    """
    name, bad = message.get("action"), functools.partial(RequestError, ErrorCode.BAD_REQUEST)
    if not isinstance(name, str):
        wrong = "is missing: say what to do" if name is None else "must be a string"
        raise bad(f"the key 'action' {wrong}")
    action = ACTIONS.get(name)
    if action is None:
        known = ", ".join(ACTIONS)
        raise RequestError(ErrorCode.UNKNOWN_ACTION, f"no action {_short(name)}: the actions are {known}")
    known_keys = ("id", *action.parameters)
    if unknown := [key for key in message if key not in ("action", *known_keys)]:
        raise bad(f"{name} takes no key {_short(unknown[0])}: it takes {', '.join(known_keys)}")
    values: dict[str, Any] = {}
    for key, parameter in action.parameters.items():
        if parameter.required and key not in message:
            raise bad(f"{name} needs the key {key!r}")
        try:
            values[key] = parameter.check(message[key]) if key in message else parameter.default
        except ValueError as error:
            raise bad(f"the key {key!r} must be {error}") from None
        except SettingError as error:
            raise bad(f"the key {key!r} is refused: {error}") from None
    return Request(name, message.get("id"), "id" in message, values)


def _short(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:37] + "...")


def request(action: str, id: object = None, **values: object) -> JsonObject:  # noqa: A002 - the wire's name
    """A request to send; `id` is left out if None."""
    message: JsonObject = {"action": action}
    if id is not None:
        message["id"] = id
    message.update(values)
    return message


def check_version(description: Mapping[str, Any]) -> None:
    """ConnectionFailedError if the server that describes itself so speaks another version of the protocol."""
    version = description.get("protocol")
    if version != PROTOCOL_VERSION or isinstance(version, bool):
        raise ConnectionFailedError(
            f"the server speaks protocol {printable(version, 20)} and this client {PROTOCOL_VERSION}: "
            "install the same version of both"
        )


def reply(message: Request, **values: object) -> JsonObject:
    """The reply that grants `message`."""
    head: JsonObject = {"reply": message.action}
    if message.has_id:
        head["id"] = message.id
    return {**head, "ok": True, **values}


def error_reply(message: JsonObject | None, code: str, text: str, **extra: object) -> JsonObject:
    """The reply that refuses `message`; None if no message could be read."""
    message = message or {}
    action = message.get("action")
    head: JsonObject = {"reply": action if isinstance(action, str) else None}
    if "id" in message:
        head["id"] = message["id"]
    return {**head, "ok": False, "error": {"code": str(code), "message": text, **extra}}


def event(name: Event, **values: object) -> JsonObject:
    """An event to send."""
    return {"event": str(name), **values}


def event_sentence(event: Mapping[str, Any]) -> str:
    """What an event of the server says: its own message, or what it means."""
    if told := untrusted.text(event.get("message")):
        return told
    kind, sensor = str(event.get("event")), untrusted.whole(event.get("sensor"))
    lost_s = untrusted.number(event.get("lost_s"))
    if kind not in _EVENTS:
        return f"the server sent the event {printable(kind, 40)}, which this version does not know"
    is_begun = kind == Event.OFFSET_CHANGED and event.get("offset") is None
    said = "the offset of {} is being changed" if is_begun else _EVENTS[kind]
    said = said.format("the sensor" if sensor is None else f"sensor {sensor}")
    return said if lost_s is None else f"{said} after {lost_s:g} s"
