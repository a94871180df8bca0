"""The interface of the two links to sensors, and the guard on all their writes."""

from __future__ import annotations

import contextlib
import signal
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from ethercat_server.errors import BusError, UsageError
from ethercat_server.ethercat.clock import Clock
from ethercat_server.ethercat.slave.coe import finish
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.sensor import Identity, Sensor
from ethercat_server.sensor.set_up import NO_SETTINGS, read_in_force
from protocol.accounting import NOT_NEW
from protocol.framing import DataFlag, DataMessage
from protocol.sensor_choice import SensorChoice
from protocol.settings import SettingValue


class Found(NamedTuple):
    """A sensor reached through a link, or the foreign slave that was asked for."""

    number: int
    identity: Identity
    what: str = "sensor"

    def __str__(self) -> str:
        """Its description in messages."""
        return f"{self.what} {self.number}: {self.identity.name}, serial {self.identity.serial}"

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        return {self.what: self.number, **self.identity._asdict()}


OnFrame = Callable[[DataMessage], bool]
"""Receives a DATA message; returns whether to continue."""


class SettledFrames:
    """Hands frames to `on_frame` but for the samples of settling sensors, whose GAP the next frame gets."""

    def __init__(self, on_frame: OnFrame) -> None:
        self._on_frame = on_frame
        self._gaps: dict[int, int] = {}

    def take(self, frame: DataMessage, settling: bool) -> bool:
        """A frame of a sensor that is or is not `settling`; returns whether to continue."""
        if settling and not frame.flags & NOT_NEW:
            self._gaps[frame.sensor] = self._gaps.get(frame.sensor, 0) | frame.flags & DataFlag.GAP
            return True
        if self._gaps and (gap := self._gaps.pop(frame.sensor, 0)):
            frame = frame._replace(flags=frame.flags | gap)
        return self._on_frame(frame)


class Link(ABC):
    """Access to the sensors of one bus. Errors are ServerErrors."""

    used: str
    """Description of the interface or server."""
    restores = False
    """Whether settings and offsets are written again when a sensor was powered off."""
    sensors: list[Found]
    clock: Clock
    """The time that passes on the bus, and waiting."""

    @abstractmethod
    def sdo(self, number: int) -> GuardedSdo:
        """The object dictionary of the sensor `number`."""

    @abstractmethod
    def configure(self, number: int, settings: Mapping[str, SettingValue], save: bool) -> None:
        """Change `settings` and verify them; on failure the former ones are restored."""

    @abstractmethod
    def tare(self, number: int, samples: int, target: Sequence[float]) -> dict[str, Any]:
        """Set the force/torque offset; returns the reply of the action `tare`. The last call on a link."""

    @abstractmethod
    def watch(self, numbers: Sequence[int], on_frame: OnFrame, on_idle: Callable[[], bool]) -> None:
        """Stream until `on_frame` or the periodic `on_idle` returns False. The last call on a link.

        Samples of settling sensors are left out; it begins when they have settled.
        """

    def wait_settled(self, numbers: Sequence[int]) -> None:  # noqa: B027
        """Wait until the data of these sensors has settled; in PREOP it has."""

    @abstractmethod
    def close(self) -> None:
        """Close the link."""

    def choose(self, wanted: str | None) -> Found:
        """The sensor selected by `--sensor`; UsageError if it is not unique."""
        return choose(self.sensors, wanted)

    def chosen(self, wanted: str | None) -> list[Found]:
        """The same for read-only commands: all sensors if None."""
        return self.sensors if wanted is None else [self.choose(wanted)]

    def in_force(self, found: Found, asked: Mapping[str, SettingValue] = NO_SETTINGS) -> Sensor:
        """The sensor with its present settings, also as the wanted ones; see `read_in_force` for `asked`."""
        sensor = Sensor(found.number, found.identity, {})
        finish(read_in_force(self.sdo(found.number), sensor, asked), clock=self.clock)
        return sensor


def choose(sensors: Sequence[Found], wanted: str | None) -> Found:
    """The sensor that `wanted` selects, the only one if None; UsageError if it is not unique.

    A number that no sensor has is taken as a serial number.
    """
    if wanted is None and len(sensors) == 1:
        return sensors[0]
    there = "; ".join(map(str, sensors))
    if wanted is None:
        raise UsageError(f"there are {len(sensors)} sensors: choose one with --sensor ({there})")
    try:
        choice = SensorChoice.parse(wanted)
    except ValueError as error:
        if not wanted.isdecimal():
            raise UsageError(f"--sensor {wanted}: it must be {error}") from None
        choice = SensorChoice(serial=int(wanted))
    if choice.number is not None and choice.number >= len(sensors):
        choice = SensorChoice(serial=choice.number)
    found = [s for s in sensors if choice.matches(s.number, s.identity.name, s.identity.serial)]
    if len(found) != 1:
        many = "more than one sensor" if found else "no sensor"
        raise UsageError(f"--sensor {wanted}: {many} matches (available: {there})")
    return found[0]


def note(text: str) -> None:
    """One line for people on standard error."""
    sys.stderr.write(f"ethercat-sensor: {text}\n")


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Defer SIGINT and SIGTERM during a change."""
    signals = {signal.SIGINT, signal.SIGTERM}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def signals_call(hear: Callable[[], None]) -> Iterator[None]:
    """SIGINT and SIGTERM only call `hear`."""
    before = {number: signal.signal(number, lambda *_: hear()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def failed_change(error: BusError) -> BusError:
    """The same, with the addition that nothing has changed."""
    return BusError(f"{error}; the former settings are in force")
