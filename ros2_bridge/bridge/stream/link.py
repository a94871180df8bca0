"""What is known of the server and the sensor, and requests. The reader writes it, every thread may read it.

Attributes are replaced, never changed in place, so that reading one needs no lock. What the server says is
not trusted.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from bota_ethercat.client.client import Client
from bota_ethercat.client.session import Disconnected
from bota_ethercat.control import Event, six_numbers
from bota_ethercat.errors import ConnectionFailedError, NoReplyError, RefusedError, SettingError
from bota_ethercat.settings import SETTINGS, SettingValue
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import number, printable, rows
from bridge.clock import Clock
from ft_compensation.quantities import Wrench, wrench_text

CONFIGURE_TIMEOUT_S: Final = 10.0
DESCRIBE_TIMEOUT_S: Final = 3.0
SHUTDOWN_TIMEOUT_S: Final = 3.0
_MOST_HZ: Final = 1e6


class RequestFailedError(Exception):
    """The server did not do it; the text is its sentence, or says why there is none."""


class RequestRefusedError(RequestFailedError):
    """The server refused; the text is its own sentence."""


class SensorInfo(NamedTuple):
    """What the server says about the sensor, made safe to print."""

    sensor: int
    name: str
    serial: str
    rate_hz: str
    state: str
    hardware: str = "?"
    firmware: str = "?"
    rate: float = 0.0
    """`rate_hz` as a number; 0 if it is none."""
    settings: Mapping[str, SettingValue] = {}
    settling: bool = False
    """Whether its data has not settled."""
    offset: tuple[float, ...] | None = None
    """Its own force/torque offset, N and Nm; None if the server does not say."""

    def __str__(self) -> str:
        """One phrase for the log."""
        return f"sensor {self.sensor} ({self.name}, serial {self.serial}, {self.rate_hz} Hz, {self.state})"


class Link:
    """`on_change` is called, in the writer's thread, after each change of what is known."""

    def __init__(self, client: Client, sensor: int, clock: Clock) -> None:
        self.client = client
        """Of the node's only connection."""
        self.clock = clock
        """What everything is timed by."""
        self.address = printable(client.address)
        self.sensor = sensor
        self.on_change: Callable[[], object] = lambda: None
        self.is_connected = False
        self.info: SensorInfo | None = None
        """The sensor as the server described it last; kept when the connection ends."""
        self.settings: Mapping[str, SettingValue] = {}
        """The sensor's settings; empty without a connection."""
        self.offset: tuple[float, ...] | None = None
        """The sensor's own force/torque offset, part of every sample, N and Nm; None: not known."""
        self.rate_hz = 0.0
        """Samples a second that are to be expected; 0 if the server does not say."""
        self.problem = client.session.problem
        """Why there is no connection."""
        self.is_reachable = False
        """Whether there is a server there for all that; it may be too old, or have no such sensor."""
        self.lost: str | None = None
        """The server's words, while the sensor is lost."""
        self.connects = 0
        self.since_s = clock.monotonic()
        """CLOCK_MONOTONIC when the connection was made or lost."""
        self.ending = False
        """The node ends: whoever waits for something gives up."""
        self.epoch = 0
        """Raised by everything that interrupts the stream or changes its rate."""

    def connected(self, description: JsonObject) -> SensorInfo:
        """The stream begins."""
        self.info = info = find_sensor(description, self.sensor)
        self.settings, self.rate_hz, self.offset = info.settings, info.rate, info.offset
        self.connects += 1
        self.since_s = self.clock.monotonic()
        self.lost = None
        self.epoch += 1
        self.is_connected = True
        self.on_change()
        return info

    @property
    def absence(self) -> str:
        """That there is no connection, and why: the beginning of a sentence."""
        what = "the node is not connected to the server" if self.is_reachable else "there is no server"
        return f"{what} at {self.address} ({self.problem})"

    def disconnected(self, event: Disconnected) -> None:
        """There is no connection (any more)."""
        had, self.is_connected = self.is_connected, False
        self.settings, self.problem, self.lost = {}, event.reason, None
        # One that has just gone away is not there, whatever it said last.
        self.is_reachable = event.reachable and not had
        if had:
            self.since_s = self.clock.monotonic()
            self.on_change()

    def take_event(self, message: JsonObject) -> bool:
        """Learn from an event; False if it is of another sensor."""
        if message.get("sensor", self.sensor) != self.sensor:
            return False
        event = message.get("event")
        if event == Event.SENSOR_LOST:
            self.lost = printable(message.get("message", "the server has lost the sensor"))
            self.epoch += 1
        elif event in (Event.SENSOR_BACK, Event.RECONFIGURED):
            self.lost = None
            self.epoch += 1
            self.take_settings(message)
        elif event != Event.OFFSET_CHANGED:
            return True
        if "offset" in message:
            self.offset = known_offset(message["offset"])
        self.on_change()
        return True

    def take_settings(self, message: JsonObject) -> None:
        """Note the settings, and the rate, that a message says are in force."""
        found = known_settings(message.get("settings"))
        if not found or not self.is_connected:
            return
        rate_hz = known_rate(message.get("rate_hz"))
        if rate_hz not in (0.0, self.rate_hz):
            self.rate_hz = rate_hz
            self.epoch += 1
        self.settings = found

    def described(self, description: JsonObject) -> None:
        """Take a later reply to `describe`. Settings and offset come with events, which are never stale."""
        self.client.session.describe(description)
        with contextlib.suppress(RequestFailedError):  # not there any more: its frames will say so
            self.info = info = find_sensor(description, self.sensor)
            if info.rate != self.rate_hz:
                self.epoch += 1
            self.rate_hz = info.rate

    # -- requests, from other threads than the reader's: every one answered, refused or timed out

    def cancel(self) -> None:
        """Make whoever waits for a reply give up, now and from now on: the node ends."""
        self.ending = True
        self.client.close()

    def ask(self, action: str, timeout_s: float, **values: object) -> JsonObject:
        """The reply that grants the request; RequestFailedError otherwise. Blocks for `timeout_s` at most."""
        if not self.is_connected:
            raise RequestFailedError(f"{self.absence}: ask again when the node is connected")
        try:
            return self.client.ask(action, timeout_s, **values)
        except RefusedError as error:
            raise RequestRefusedError(f"{error} ({error.code})") from None
        except ConnectionFailedError as error:
            if not self.ending and not isinstance(error, NoReplyError):
                raise RequestFailedError(f"the server at {self.address} is gone: {error}") from None
            why = "the node ends" if self.ending else f"no reply within {timeout_s:g} s"
            raise RequestFailedError(
                f"the server at {self.address} did not answer {action}: {why}; "
                "whether it was done is not known"
            ) from None

    def shut_server_down(self, timeout_s: float = SHUTDOWN_TIMEOUT_S) -> str:
        """Ask the server to shut down; a sentence. RequestRefusedError if it will not, RequestFailedError if
        nobody knows.

        Where there is no connection it makes one attempt of its own.
        """
        client, address = self.client, self.address
        try:
            if self.is_connected:
                client.ask("shutdown", timeout_s)
            else:
                host, port = client.address
                with Client(port, host, stream=False, reconnect=False) as own:
                    own.connect().ask("shutdown", timeout_s)
        except RefusedError as error:
            raise RequestRefusedError(
                f"the server at {address} refused to shut down: {error} ({error.code})"
            ) from None
        except NoReplyError:
            raise RequestFailedError(
                f"the server at {address} did not answer the request to shut down"
            ) from None
        except ConnectionFailedError as error:
            raise RequestFailedError(
                f"the server at {address} could not be told to shut down: {error}"
            ) from None
        return f"the server at {address} is shutting down"


def known_settings(settings: object) -> dict[str, SettingValue]:
    """Those of `settings`, a message's, that are in the table and have a value that they can have."""
    found: dict[str, SettingValue] = {}
    for name, value in settings.items() if isinstance(settings, dict) else ():
        if name in SETTINGS:
            with contextlib.suppress(SettingError):
                found[name] = SETTINGS[name].check(value)
    return found


def known_rate(rate_hz: object) -> float:
    """The sampling rate that a message gives, Hz; 0 if it is none."""
    return float(rate_hz) if isinstance(rate_hz, int | float) and 0 < rate_hz <= _MOST_HZ else 0.0


def known_offset(offset: object) -> tuple[float, ...] | None:
    """The sensor's own offset from a message; None if missing or invalid."""
    try:
        return six_numbers(offset)
    except ValueError:
        return None


def find_sensor(description: Mapping[str, Any], sensor: int) -> SensorInfo:
    """The row of `sensor` in a `describe` reply; RequestFailedError if there is none."""
    found = rows(description.get("sensors"))
    for row in found:
        if row.get("sensor") == sensor and not isinstance(row.get("sensor"), bool):
            name, serial, rate, state, hardware, firmware = (
                printable(row.get(key, "?"), 40)
                for key in ("name", "serial", "rate_hz", "state", "hardware", "firmware")
            )
            number = known_rate(row.get("rate_hz"))
            settings, settling = known_settings(row.get("settings")), row.get("settling") is True
            offset = known_offset(row.get("offset"))
            return SensorInfo(
                sensor, name, serial, rate, state, hardware, firmware, number, settings, settling, offset
            )
    there = ", ".join(printable(row.get("sensor"), 10) for row in found[:16]) or "none"
    raise RequestFailedError(
        f"the server has no sensor {sensor} (it has: {there}): set the parameter 'sensor' to one it has"
    )


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
