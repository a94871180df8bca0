"""Services and the settings as parameters, in simulated time: granted, refused, unanswered."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from rcl_interfaces.srv import DescribeParameters, SetParametersAtomically
from rclpy.parameter import Parameter

from bota_ethercat.control import ErrorCode, Event, event
from bota_ethercat.settings import SETTINGS as TABLE
from bota_ethercat.text.json_text import JsonObject
from tests.bridge.simulated_node import SETTINGS, Node, Server

NAMES = ("settings.sinc_length", "settings.fir", "settings.acceleration_range_g", "settings.chop")


@pytest.fixture
def scripted() -> Server:
    return Server()


@pytest.fixture
def node(scripted: Server) -> Iterator[Node]:
    with Node(scripted, **{"settings.sinc_length": 64}) as started:
        started.run(0.1)
        assert started.parameters(*NAMES) == [512, False, 2, None], "the server's settings"
        yield started


def refuse(message: str, code: str = ErrorCode.SENSOR) -> JsonObject:
    return {"ok": False, "error": {"code": str(code), "message": message}}


def test_settings_given_at_start_or_set_since_are_applied_on_request(node: Node, scripted: Server) -> None:
    assert "settings given at start: sinc_length; call ~/apply_settings" in node.log
    assert not [r for r in scripted.requests if r["action"] == "configure"]
    asked = configures(scripted)
    text = node.do("apply_settings")
    assert '"sinc_length": 64' in text
    node.set("settings.fir", True)
    node.do("apply_settings")
    assert asked == [{"sinc_length": 64}, {"fir": True}, {"sinc_length": 64, "fir": True}]
    node.do("save_settings")
    assert scripted.requests[-1]["save"] is True
    scripted.answers["configure"] = lambda _: refuse("not for uid 7", ErrorCode.DENIED)
    assert node.trigger("apply_settings") == (False, "not for uid 7 (denied)")
    scripted.reconfigure()


def configures(scripted: Server) -> list[Any]:
    """From now on every setting is taken and told; what is asked for comes into the list."""
    held = dict(SETTINGS)
    asked: list[Any] = []

    def answer(message: JsonObject) -> JsonObject:
        asked.append(message["settings"])
        held.update(message["settings"])
        scripted.send_json(event(Event.RECONFIGURED, sensor=0, settings=held))
        return {"ok": True, "settings": held}

    scripted.answers["configure"] = answer
    return asked


def test_a_refusal_in_the_servers_own_words(node: Node, scripted: Server) -> None:
    scripted.answers["tare"] = lambda _: refuse("sensor 0 is not at rest: hold it still", ErrorCode.NOT_READY)
    assert node.trigger("sensor_tare") == (False, "sensor 0 is not at rest: hold it still (not_ready)")
    scripted.answers["configure"] = lambda _: refuse("not for uid 7", ErrorCode.DENIED)
    assert node.set_parameter("settings.fir", True) == (False, "not for uid 7 (denied)")
    assert node.parameters("settings.fir") == [False]
    assert node.trigger("save_settings") == (False, "not for uid 7 (denied)")


def test_parameters_refused_together_leave_the_sensor_alone(node: Node, scripted: Server) -> None:
    asked: list[JsonObject] = []
    scripted.answers["configure"] = asked.append
    for wrong in (Parameter("gravity", value=[0.0, 0.0, 0.0]), Parameter("tool_mass", value=-1.0)):
        both = [Parameter("settings.sinc_length", value=128), wrong]
        request = SetParametersAtomically.Request(parameters=[one.to_parameter_msg() for one in both])
        result = node.call("set_parameters_atomically", request).result
        assert not result.successful
        assert wrong.name in result.reason
    assert not asked
    del scripted.answers["configure"]


def test_a_setting_is_set_or_is_not(node: Node, scripted: Server) -> None:
    asked = configures(scripted)
    for value in (64, SETTINGS["sinc_length"]):
        node.set("settings.sinc_length", value)
        assert node.parameters("settings.sinc_length") == [value]
    assert asked == [{"sinc_length": 64}, {"sinc_length": 512}]
    scripted.answers["configure"] = lambda _: {"ok": True, "settings": SETTINGS}
    done, reason = node.set_parameter("settings.fir", True)
    assert (done, reason) == (False, "fir is still False: the server did not apply True")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("sinc_length", 5, "range"),
        ("sinc_length", "64", "it must be a whole number from 32 to 2048"),
        ("acceleration_range_g", 3, "it must be one of 2, 4, 8, 16"),
        ("fir", 1, "it must be true or false"),
        ("fir", None, "it must be true or false"),
        ("no_such", 1, "undeclared"),
    ],
)
def test_a_value_that_cannot_be(node: Node, name: str, value: Any, words: str) -> None:
    node.refuse_value(f"settings.{name}", value, words)


def test_the_parameters_follow_others_and_describe_themselves(node: Node, scripted: Server) -> None:
    changed = {**SETTINGS, "sinc_length": 128, "chop": True, "odd": 1, "fir": "x"}
    scripted.send_json(event(Event.RECONFIGURED, sensor=1, settings={"sinc_length": 99}))
    scripted.send_json(event(Event.RECONFIGURED, sensor=0, settings=changed))
    node.run(0.1)
    assert node.parameters(*NAMES) == [128, None, 2, True]
    names = [f"settings.{name}" for name in TABLE]
    response = node.call("describe_parameters", DescribeParameters.Request(names=names))
    assert [row.name for row in response.descriptors] == names
    assert all(row.description for row in response.descriptors)


def test_an_unanswered_request_holds_up_neither_stream_nor_diagnostics(node: Node, scripted: Server) -> None:
    scripted.answers["describe"] = lambda _: None
    samples, arrays = node.hear("sensone_sensor_data"), node.hear("/diagnostics")
    node.run(0.2)
    samples.clear()
    arrays.clear()
    began_ns = scripted.monotonic_ns()
    node.refuse("get_settings", "did not answer describe: no reply within 3 s")
    assert (scripted.monotonic_ns() - began_ns) / 1e9 == pytest.approx(3.0, abs=0.02)
    assert len(samples) in range(299, 303)
    assert len(arrays) >= 2
    del scripted.answers["describe"]
    text = node.do("get_settings")
    assert json.loads(text) == {**SETTINGS, "rate_hz": 100.0}


def test_without_a_server(node: Node, scripted: Server) -> None:
    scripted.answers["tare"] = lambda _: scripted.drop()
    scripted.listens = False
    node.refuse("sensor_tare", "the server at localhost:12001 is gone: the connection ended before the reply")
    node.run(0.1)
    assert node.parameters(*NAMES) == [None] * 4
    refused = "no server at localhost:12001"
    for done, text in (
        node.trigger("sensor_tare"),
        node.trigger("tare"),
        node.trigger("get_settings"),
        node.set_parameter("settings.sinc_length", 64),
        node.trigger("save_settings"),
    ):
        assert not done
        assert refused in text
    scripted.listens = True
    scripted.description["sensors"] = []
    node.run(1.0)
    node.refuse("sensor_tare", "the server has no sensor 0")
