# SPDX-License-Identifier: Apache-2.0
"""What is known of the server and the sensor, and requests.

The reader writes it, and the monitor what it has asked for; every thread may read it without a lock:
attributes are replaced, never changed in place. What the server says is not trusted.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from bota_ethercat.client.client import Client
from bota_ethercat.client.session import Disconnected
from bota_ethercat.control import Event, event_sentence, known_six
from bota_ethercat.errors import ConnectionFailedError, NoReplyError, RefusedError
from bota_ethercat.health.sentences import no_server
from bota_ethercat.replies import Description, SensorInfo
from bota_ethercat.settings import SettingValue, known_settings
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import printable
from bota_ft_compensation.quantities import Wrench, wrench_text

CONFIGURE_TIMEOUT_S: Final = 10.0
DESCRIBE_TIMEOUT_S: Final = 3.0
SHUTDOWN_TIMEOUT_S: Final = 3.0


class NodeClock:
    """Time as the node's threads see it; tests have a clock of their own, and let it pass as they like."""

    monotonic = staticmethod(time.monotonic)
    monotonic_ns = staticmethod(time.monotonic_ns)
    time_ns = staticmethod(time.time_ns)
    wait = staticmethod(threading.Event.wait)  # until an event is set, so many seconds at most; whether it is


SYSTEM_CLOCK: Final = NodeClock()


class RequestFailedError(Exception):
    """The server did not do it; the text is its sentence, or says why there is none."""


class RequestRefusedError(RequestFailedError):
    """The server refused; the text is its own sentence."""


class Link:
    """`on_change` is called, in the writer's thread, after each change of what is known."""

    def __init__(self, client: Client, sensor: int, clock: NodeClock) -> None:
        self.client = client  # of the node's only connection
        self.clock = clock  # what everything is timed by
        self.address = printable(client.address)
        self.sensor = sensor
        self.on_change: Callable[[], object] = lambda: None
        self.is_connected = False
        self.in_force = InForce(SensorInfo(sensor))  # of the sensor that is or was there
        self.problem = client.session.problem  # why there is no connection
        # Whether there is a server there for all that; it may be too old, or have no such sensor.
        self.is_reachable = False
        self.connects = 0
        self.since_s = clock.monotonic()  # CLOCK_MONOTONIC when the connection was made or lost
        self.ending = False  # the node ends: services that wait give up

    def connected(self) -> None:
        """There is a connection; what is in force follows."""
        self.connects += 1
        self.since_s, self.is_connected = self.clock.monotonic(), True

    def tell(self, in_force: InForce) -> None:
        """What is in force from here on."""
        self.in_force = in_force
        self.on_change()

    @property
    def info(self) -> SensorInfo:
        """Of the sensor that is or was there."""
        return self.in_force.info

    @property
    def settings(self) -> Mapping[str, SettingValue]:
        """Those in force; none are known without a connection."""
        return self.info.settings if self.is_connected else {}

    @property
    def lost(self) -> str | None:
        """The server's words, while the sensor is lost."""
        return self.in_force.lost if self.is_connected else None

    @property
    def absence(self) -> str:
        """That there is no connection, and why: a sentence."""
        if self.is_reachable:
            return f"the node is not connected to the server at {self.address} ({self.problem})"
        return no_server(self.address, self.problem)

    def disconnected(self, event: Disconnected) -> None:
        had, self.is_connected = self.is_connected, False
        self.problem = event.reason
        # One that has just gone away is not there, whatever it said last.
        self.is_reachable = event.reachable and not had
        if had:
            self.since_s = self.clock.monotonic()
            self.on_change()

    # -- requests, from other threads than the reader's: every one answered, refused or timed out

    def cancel(self) -> None:
        """Fail all requests, now and from now on: the node ends."""
        self.ending = True
        self.client.close()

    def ask(self, action: str, timeout_s: float, **values: object) -> JsonObject:
        """The reply that grants the request; RequestFailedError otherwise. Blocks for `timeout_s` at most."""
        if not self.is_connected:
            raise RequestFailedError(f"{self.absence}; ask again when the node is connected")
        try:
            return self.client.ask(action, timeout_s, **values)
        except RefusedError as error:
            raise RequestRefusedError(f"{error} ({error.code})") from None
        except ConnectionFailedError as error:
            text = f"is gone: {error}"
            if self.ending or isinstance(error, NoReplyError):
                why = "the node ends" if self.ending else f"no reply within {timeout_s:g} s"
                text = f"did not answer {action}: {why}; whether it was done is not known"
            raise RequestFailedError(f"the server at {self.address} {text}") from None

    def shut_server_down(self) -> str:
        """Ask the server to shut down, over a connection made for this if there is none; a sentence.

        RequestRefusedError if it refuses, RequestFailedError if its answer is unknown.
        """
        host, port = self.client.address
        try:
            if self.is_connected:
                self.client.ask("shutdown", SHUTDOWN_TIMEOUT_S)
            else:
                with Client(port, host, stream=False, reconnect=False) as own:
                    own.connect().ask("shutdown", SHUTDOWN_TIMEOUT_S)
        except RefusedError as error:
            text = f"the server at {self.address} refused to shut down: {error} ({error.code})"
            raise RequestRefusedError(text) from None
        except ConnectionFailedError as error:
            why = f"could not be told to shut down: {error}"
            if isinstance(error, NoReplyError):
                why = "did not answer the request to shut down"
            raise RequestFailedError(f"the server at {self.address} {why}") from None
        return f"the server at {self.address} is shutting down"


def offset_text(offset: object) -> str:
    known = known_six(offset)
    return "unknown" if known is None else wrench_text(Wrench.of(known))


def find_sensor(description: Mapping[str, Any], sensor: int) -> SensorInfo:
    """The row of `sensor` in a `describe` reply; RequestFailedError if there is none."""
    known = Description.parse(description)
    if (info := known.find(sensor)) is not None:
        return info
    there = ", ".join(str(each.sensor) for each in known.sensors[:16]) or "none"
    raise RequestFailedError(
        f"the server has no sensor {sensor} (it has: {there}): set the parameter 'sensor' to one it has"
    )


def sentence(message: JsonObject, before: Mapping[str, SettingValue]) -> str:
    """What an event says, and what it changed; `before` are the settings that were in force."""
    event, text = message["event"], event_sentence(message)
    if event == Event.RECONFIGURED:
        settings = known_settings(message.get("settings")).items()
        changed = [f"{name} {str(value).lower()}" for name, value in settings if before.get(name) != value]
        return f"{text}: {', '.join(changed)}" if changed else text
    if event == Event.OFFSET_CHANGED and message.get("offset") is not None:
        return f"{text}: it is {offset_text(message['offset'])}"
    return text
