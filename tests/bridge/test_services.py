"""Services and the settings as parameters: granted, refused, unanswered; the stream goes on meanwhile."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from std_srvs.srv import Trigger

from bridge.stream.requests import CONFIGURE_TIMEOUT_S
from protocol.control import ErrorCode, Event, event
from protocol.settings import SETTINGS as TABLE
from protocol.text.json_text import JsonObject
from tests.bridge.conftest import PATIENCE_S, Listener, NodeThread, starter, wait_until
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.shared import listener, server, stream
from tests.bridge.streaming import SETTINGS, Stream

__all__ = ["listener", "server", "stream"]
pytestmark = pytest.mark.ros
NAMES = ("settings.sinc_length", "settings.fir", "settings.acceleration_range_g", "settings.chop")


@pytest.fixture(scope="module")
def _node(server: ScriptedServer, stream: Stream, listener: Listener) -> Iterator[NodeThread]:
    with starter(listener) as start:
        yield start(server.port, **{"settings.sinc_length": 64})


@pytest.fixture(autouse=True)
def node(_node: NodeThread, listener: Listener) -> Iterator[NodeThread]:
    wait_until(lambda: listener.parameters(*NAMES) == [512, False, 2, None], "the server's settings")
    yield _node
    assert _node.is_running
    assert "Traceback" not in _node.log


def refuse(message: str, code: str = ErrorCode.SENSOR) -> JsonObject:
    return {"ok": False, "error": {"code": str(code), "message": message}}


def test_settings_given_at_start_are_not_taken_in_silence(node: NodeThread, server: ScriptedServer) -> None:
    assert "settings given at start: sinc_length; call ~/apply_settings" in node.log
    assert not [r for r in server.requests if r["action"] == "configure"]


def configures(server: ScriptedServer) -> list[Any]:
    """From now on every setting is taken and told; what is asked for comes into the list."""
    held = dict(SETTINGS)
    asked: list[Any] = []

    def answer(message: JsonObject) -> JsonObject:
        asked.append(message["settings"])
        held.update(message["settings"])
        server.send_json(event(Event.RECONFIGURED, sensor=0, settings=held))
        return {"ok": True, "settings": held}

    server.answers["configure"] = answer
    return asked


def test_settings_given_at_start_or_set_since_are_applied_together(
    node: NodeThread, server: ScriptedServer, listener: Listener
) -> None:
    asked = configures(server)
    done, text = listener.trigger("apply_settings")
    assert done, text
    assert '"sinc_length": 64' in text
    assert listener.set_parameter("settings.fir", True) == (True, "")
    assert listener.trigger("apply_settings")[0]
    assert asked == [{"sinc_length": 64}, {"fir": True}, {"sinc_length": 64, "fir": True}]
    server.answers["configure"] = lambda _: refuse("not for uid 7", ErrorCode.DENIED)
    assert listener.trigger("apply_settings") == (False, "not for uid 7 (denied)")
    server.send_json(event(Event.RECONFIGURED, sensor=0, settings=SETTINGS))


def test_tare(server: ScriptedServer, listener: Listener) -> None:
    asked: list[JsonObject] = []

    def answer(message: JsonObject) -> JsonObject:
        asked.append(message)
        return {"ok": True, "old_offset": [1, 2, 3, 4, 5, 6], "new_offset": [0.5] * 6, "residual": [1e-3] * 6}

    server.answers["tare"] = answer
    done, text = listener.trigger("sensor_tare")
    assert done
    assert "old offset Fx 1.0000 Fy 2.0000" in text
    assert "new offset Fx 0.5000" in text
    assert "residual Fx 0.0010" in text
    assert (asked[0]["sensor"], asked[0]["samples"]) == (0, 50)  # half a second


def test_a_refusal_in_the_servers_own_words(server: ScriptedServer, listener: Listener) -> None:
    server.answers["tare"] = lambda _: refuse("sensor 0 is not at rest: hold it still", ErrorCode.NOT_READY)
    assert listener.trigger("sensor_tare") == (False, "sensor 0 is not at rest: hold it still (not_ready)")
    server.answers["configure"] = lambda _: refuse("not for uid 7", ErrorCode.DENIED)
    assert listener.set_parameter("settings.fir", True) == (False, "not for uid 7 (denied)")
    assert listener.parameters("settings.fir") == [False]
    assert listener.trigger("save_settings") == (False, "not for uid 7 (denied)")


def test_parameters_refused_together_leave_the_sensor_alone(
    server: ScriptedServer, listener: Listener
) -> None:
    from rcl_interfaces.srv import SetParametersAtomically
    from rclpy.parameter import Parameter

    asked: list[JsonObject] = []
    server.answers["configure"] = asked.append
    for wrong in (Parameter("gravity", value=[0.0, 0.0, 0.0]), Parameter("tool_mass", value=-1.0)):
        both = [Parameter("settings.sinc_length", value=128), wrong]
        request = SetParametersAtomically.Request(parameters=[one.to_parameter_msg() for one in both])
        result = listener.call(SetParametersAtomically, "set_parameters_atomically", request).result
        assert not result.successful
        assert wrong.name in result.reason
    assert not asked
    del server.answers["configure"]


def test_settings_are_shown_and_saved(server: ScriptedServer, listener: Listener) -> None:
    done, text = listener.trigger("get_settings")
    assert done
    assert json.loads(text) == {**SETTINGS, "rate_hz": 100.0}
    asked: list[JsonObject] = []

    def answer(message: JsonObject) -> JsonObject:
        asked.append(message)
        return {"ok": True, "settings": SETTINGS, "saved": True}

    server.answers["configure"] = answer
    done, text = listener.trigger("save_settings")
    assert done, text
    assert asked[0]["save"] is True
    assert asked[0]["settings"].items() <= SETTINGS.items()


def test_a_setting_is_set(server: ScriptedServer, listener: Listener) -> None:
    asked = configures(server)
    for value in (64, SETTINGS["sinc_length"]):
        assert listener.set_parameter("settings.sinc_length", value) == (True, "")
        assert listener.parameters("settings.sinc_length") == [value]
    assert asked == [{"sinc_length": 64}, {"sinc_length": 512}]


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
def test_a_value_that_cannot_be(listener: Listener, name: str, value: Any, words: str) -> None:
    done, reason = listener.set_parameter(f"settings.{name}", value)
    assert not done
    assert words in reason


def test_a_change_that_did_not_take(server: ScriptedServer, listener: Listener) -> None:
    server.answers["configure"] = lambda _: {"ok": True, "settings": SETTINGS}
    done, reason = listener.set_parameter("settings.fir", True)
    assert (done, reason) == (False, "fir is still False: the server did not apply True")


def test_the_parameters_follow_what_others_change(server: ScriptedServer, listener: Listener) -> None:
    changed = {**SETTINGS, "sinc_length": 128, "chop": True, "odd": 1, "fir": "x"}
    server.send_json(event(Event.RECONFIGURED, sensor=1, settings={"sinc_length": 99}))
    server.send_json(event(Event.RECONFIGURED, sensor=0, settings=changed))
    wait_until(lambda: listener.parameters(*NAMES) == [128, None, 2, True], "the changed settings")
    server.send_json(event(Event.RECONFIGURED, sensor=0, settings=SETTINGS))


def test_an_unanswered_request_holds_up_neither_stream_nor_node(
    server: ScriptedServer, listener: Listener, stream: Stream
) -> None:
    answer = server.answers.pop("describe", None)
    server.answers["describe"] = lambda _: None
    began = time.monotonic()
    response = listener.ask(Trigger, "get_settings")
    time.sleep(0.3)
    listener.numbers()
    numbers = [listener.next_number() for _ in range(50)]
    assert numbers == sorted(set(numbers))
    assert "did not answer describe: no reply within 3 s" in response.get(timeout=PATIENCE_S).message
    assert time.monotonic() - began > 2.5
    del server.answers["describe"]
    if answer is not None:
        server.answers["describe"] = answer
    assert listener.trigger("get_settings")[0]


def test_without_a_server(server: ScriptedServer, listener: Listener, stream: Stream) -> None:
    description, server.description = server.description, {**server.description, "sensors": []}
    try:
        server.drop()
        wait_until(lambda: listener.parameters(*NAMES) == [None] * 4, "no settings")
        for done, text in (
            listener.trigger("sensor_tare"),
            listener.trigger("get_settings"),
            listener.set_parameter("settings.sinc_length", 64),
        ):
            assert not done
            # Just dropped, or connected to again, which is of no use without the sensor.
            assert "there is no server at localhost:" in text or "has no sensor 0" in text
        assert not listener.trigger("save_settings")[0]
    finally:
        server.description = description


def test_every_setting_is_a_parameter_that_describes_itself(listener: Listener) -> None:
    from rcl_interfaces.srv import DescribeParameters

    names = [f"settings.{name}" for name in TABLE]
    response = listener.call(
        DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names)
    )
    assert [row.name for row in response.descriptors] == names
    assert all(row.description for row in response.descriptors)


def test_the_node_ends_while_a_service_waits(
    server: ScriptedServer, listener: Listener, stream: Stream
) -> None:
    other = Listener()
    try:
        with ScriptedServer() as mute, starter(other) as start:
            node = start(mute.port)
            mute.answers["tare"] = lambda _: None
            assert mute.subscribed.wait(20)
            other.parameters("server_port")  # its services are there
            other.ask(Trigger, "sensor_tare")
            wait_until(lambda: any(r["action"] == "tare" for r in mute.requests), "the request")
            began = time.monotonic()
            node.finish()
            assert node.ends() == 0
            assert time.monotonic() - began < CONFIGURE_TIMEOUT_S  # it did not wait for the reply
            assert "Traceback" not in node.log
    finally:
        other.close()
