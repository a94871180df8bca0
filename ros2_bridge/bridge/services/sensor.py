"""Services, all `std_srvs/Trigger`, that the server does the work for; the message says what came of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Final

from rclpy.node import Node
from std_srvs.srv import Trigger

from bridge.parameters.sensor_settings import SettingsParameters
from bridge.stream.link import CONFIGURE_TIMEOUT_S, DESCRIBE_TIMEOUT_S, Link, RequestFailedError, find_sensor
from ft_compensation.quantities import Wrench, wrench_text

_TARE_S: Final = 0.5
"""How long a tare averages."""
_FEWEST_SAMPLES, _MOST_SAMPLES = 20, 2000
_TARE_PATIENCE: Final = 6.0
"""The server may take so many times as long as the samples should: it takes them twice."""
_TARE_EXTRA_S: Final = 4.0


def create_triggers(node: Node, acts: Mapping[str, Callable[[], str]], failure: type[Exception]) -> None:
    """A service `~/NAME` for each act, which returns what it did; a `failure` says why it was not done."""
    for name, act in acts.items():

        def answer(_request: Any, response: Any, name: str = name, act: Callable[[], str] = act) -> Any:
            try:
                response.message = act()
                response.success = True
            except failure as error:
                response.message = str(error)
                response.success = False
                node.get_logger().warning(f"{name} failed: {error}")
            return response

        node.create_service(Trigger, f"~/{name}", answer)


class Services:
    """Each blocks the executor until the server has answered or a time-out, and never the stream."""

    def __init__(
        self,
        node: Node,
        link: Link,
        settings: SettingsParameters,
        after_tare: Callable[[], str],
    ) -> None:
        """`after_tare` says what a new offset in the sensor means for the rest of the node; "" if nothing."""
        self._after_tare = after_tare
        self._link, self._log = link, node.get_logger()
        self._settings = settings
        acts = {
            "sensor_tare": self._sensor_tare,
            "get_settings": self._get_settings,
            "apply_settings": self._apply_settings,
            "save_settings": self._save_settings,
        }
        create_triggers(node, acts, RequestFailedError)

    def _sensor_tare(self) -> str:
        rate_hz = self._link.rate_hz or 800.0
        samples = min(max(round(_TARE_S * rate_hz), _FEWEST_SAMPLES), _MOST_SAMPLES)
        timeout_s = _TARE_EXTRA_S + _TARE_PATIENCE * samples / rate_hz
        reply = self._link.ask("tare", timeout_s, sensor=self._link.sensor, samples=samples)
        titles = ("old_offset", "old offset"), ("new_offset", "new offset"), ("residual", "residual")
        parts = [f"{title} {_wrench_text(reply.get(key))}" for key, title in titles]
        text = f"sensor {self._link.sensor} tared: " + "; ".join(parts)
        if also := self._after_tare():
            text += f". {also}"
        self._log.info(text)
        return text

    def _get_settings(self) -> str:
        reply = self._link.ask("describe", DESCRIBE_TIMEOUT_S)
        info = find_sensor(reply, self._link.sensor)
        return json.dumps({**info.settings, "rate_hz": info.rate})

    def _apply_settings(self) -> str:
        text = f"sensor {self._link.sensor} has these settings now: {json.dumps(self._settings.apply())}"
        self._log.info(text)
        return text

    def _save_settings(self) -> str:
        # `configure` wants at least one setting: one as it is.
        setting = next(iter(self._link.settings.items()), None)
        if setting is None:
            raise RequestFailedError(
                f"the settings of sensor {self._link.sensor} are not known: there is no server at "
                f"{self._link.address}, or the sensor has none"
            )
        name, value = setting
        self._link.ask(
            "configure", CONFIGURE_TIMEOUT_S, sensor=self._link.sensor, settings={name: value}, save=True
        )
        text = f"sensor {self._link.sensor} keeps its settings and offset in its flash now"
        self._log.info(text)
        return text


def _wrench_text(values: object) -> str:
    try:
        return wrench_text(Wrench.of(values))
    except ValueError:
        return "unknown"
