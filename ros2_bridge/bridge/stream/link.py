"""What is known of the server and the sensor. The reader writes it, every thread may read it.

Attributes are replaced, never changed in place, so that reading one needs no lock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from bridge.clock import Clock
from bridge.stream.connection import Connection, SensorInfo, known_offset, known_rate, known_settings
from protocol.control import Event
from protocol.settings import SettingValue, sampling_rate_hz
from protocol.text.json_text import JsonObject
from protocol.text.visible import printable

NEVER_CONNECTED: Final = "no connection yet"


class Link:
    """`on_change` is called, in the writer's thread, after each change of what is known."""

    def __init__(self, address: str, sensor: int, clock: Clock) -> None:
        self.clock = clock
        """What everything is timed by."""
        self.address = address
        self.sensor = sensor
        self.on_change: Callable[[], object] = lambda: None
        self.connection: Connection | None = None
        """The connection, while its stream runs."""
        self.info: SensorInfo | None = None
        """The sensor as the server described it last; kept when the connection ends."""
        self.settings: Mapping[str, SettingValue] = {}
        """The sensor's settings; empty without a connection."""
        self.offset: tuple[float, ...] | None = None
        """The sensor's own force/torque offset, part of every sample, N and Nm; None: not known."""
        self.rate_hz = 0.0
        """Samples a second that are to be expected; 0 if the server does not say."""
        self.problem = NEVER_CONNECTED
        """Why there is no connection."""
        self.is_reachable = False
        """Whether there is a server there for all that; it may be too old, or have no such sensor."""
        self.lost: str | None = None
        """The server's words, while the sensor is lost."""
        self.connects = 0
        self.since_s = clock.monotonic()
        """CLOCK_MONOTONIC when the connection was made or lost."""
        self.epoch = 0
        """Raised by everything that interrupts the stream or changes its rate."""

    def connected(self, connection: Connection, info: SensorInfo) -> None:
        """The stream begins."""
        self.info, self.settings, self.rate_hz = info, info.settings, info.rate
        self.offset = info.offset
        self.connects += 1
        self.since_s = self.clock.monotonic()
        self.lost = None
        self.epoch += 1
        self.connection = connection
        self.on_change()

    @property
    def absence(self) -> str:
        """That there is no connection, and why: the beginning of a sentence."""
        what = "the node is not connected to the server" if self.is_reachable else "there is no server"
        return f"{what} at {self.address} ({self.problem})"

    def disconnected(self, problem: str, *, is_reachable: bool = False) -> None:
        """There is no connection (any more)."""
        if self.connection is not None:
            self.since_s = self.clock.monotonic()
        had, self.connection = self.connection, None
        self.settings, self.problem, self.lost = {}, problem, None
        # One that has just gone away is not there, whatever it said last.
        self.is_reachable = is_reachable and had is None
        if had is not None:
            self.on_change()

    def take_event(self, message: JsonObject) -> bool:
        """Learn from an event; False if it is of another sensor, and so nothing to us."""
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
        if not found or self.connection is None:
            return
        rate_hz = known_rate(message.get("rate_hz"))
        if (
            not rate_hz
            and (length := found.get("sinc_length")) != self.settings.get("sinc_length")
            and length
        ):
            rate_hz = float(sampling_rate_hz(int(length)))  # the server is an older one
        if rate_hz not in (0.0, self.rate_hz):
            self.rate_hz = rate_hz
            self.epoch += 1
        self.settings = found

    def described(self, info: SensorInfo) -> None:
        """Take a later reply to `describe`. Settings and offset come with events, which are never stale."""
        if info.rate != self.rate_hz:
            self.epoch += 1
        self.info, self.rate_hz = info, info.rate
