"""Requests are checked against one table before anything acts on them."""

from __future__ import annotations

from typing import Any

import pytest

from bota_ethercat.control import (
    ACTIONS,
    SIX_NUMBERS,
    ErrorCode,
    Event,
    error_reply,
    event,
    parse_request,
    reply,
    request,
)
from bota_ethercat.errors import RequestError


def test_subscribe_takes_what_the_contract_names_and_has_its_defaults() -> None:
    parsed = parse_request({"action": "subscribe"})
    assert parsed.values == {"sensors": None, "terminals": (), "every": 1, "fresh_only": True}
    message = request("subscribe", 5, sensors=[0, 2], terminals=[1], every=4, fresh_only=False)
    values = {"sensors": (0, 2), "terminals": (1,), "every": 4, "fresh_only": False}
    assert parse_request(message).values == values


def test_only_what_changes_something_needs_authority() -> None:
    free = {"describe", "subscribe", "unsubscribe", "status", "sdo_read", "sii_read"}
    assert {name for name, action in ACTIONS.items() if not action.controls} <= free
    assert ACTIONS["shutdown"].controls


@pytest.mark.parametrize(
    ("message", "code", "word"),
    [
        ({}, ErrorCode.BAD_REQUEST, "action"),
        ({"action": 5}, ErrorCode.BAD_REQUEST, "string"),
        ({"action": "dance"}, ErrorCode.UNKNOWN_ACTION, "dance"),
        ({"action": "x" * 5000}, ErrorCode.UNKNOWN_ACTION, "no action"),
        ({"action": "describe", "loud": 1}, ErrorCode.BAD_REQUEST, "loud"),
        ({"action": "subscribe", "every": 0}, ErrorCode.BAD_REQUEST, "every"),
        ({"action": "subscribe", "every": True}, ErrorCode.BAD_REQUEST, "every"),
        ({"action": "subscribe", "sensors": []}, ErrorCode.BAD_REQUEST, "sensors"),
        ({"action": "subscribe", "sensors": [256]}, ErrorCode.BAD_REQUEST, "sensors"),
        ({"action": "subscribe", "sensors": [False]}, ErrorCode.BAD_REQUEST, "sensors"),
        ({"action": "subscribe", "sensors": 0}, ErrorCode.BAD_REQUEST, "sensors"),
        ({"action": "subscribe", "fresh_only": 1}, ErrorCode.BAD_REQUEST, "fresh_only"),
    ],
)
def test_what_is_wrong_is_named(message: dict[str, Any], code: ErrorCode, word: str) -> None:
    with pytest.raises(RequestError) as caught:
        parse_request(message)
    assert caught.value.code == code
    assert word in str(caught.value)
    assert len(str(caught.value)) < 400


def test_replies_refusals_and_events_are_the_contracts() -> None:
    for identifier in (0, None, "x", [1, {}]):
        parsed = parse_request({"action": "describe", "id": identifier})
        assert reply(parsed, sensors=[]) == {
            "reply": "describe", "id": identifier, "ok": True, "sensors": []
        }  # fmt: skip
    assert reply(parse_request({"action": "describe"})) == {"reply": "describe", "ok": True}
    refused = {"ok": False, "error": {"code": "sensor", "message": "why", "abort_code": 1}}
    for message, repeated in (
        ({"action": "tare", "id": 3}, {"reply": "tare", "id": 3}),
        ({"action": {}}, {"reply": None}),
        (None, {"reply": None}),
    ):
        assert error_reply(message, ErrorCode.SENSOR, "why", abort_code=1) == repeated | refused
    names = ["sensor_lost", "sensor_back", "reconfigured", "offset_changed", "emergency", "shutting_down"]
    assert [str(e) for e in Event] == names
    assert event(Event.SENSOR_LOST, sensor=1) == {"event": "sensor_lost", "sensor": 1}


def test_six_numbers() -> None:
    assert SIX_NUMBERS.check([1, 2.5, 0, 0, 0, 0]) == (1.0, 2.5, 0.0, 0.0, 0.0, 0.0)
    odd = [[number] * 6 for number in (True, float("nan"), float("inf"), 10**400)]
    for wrong in ([1, 2, 3], "123456", None, *odd):
        with pytest.raises(ValueError, match="six finite numbers"):
            SIX_NUMBERS.check(wrong)
