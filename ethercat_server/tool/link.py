"""How the tool reaches sensors: the interface that its two links share, and the guard on all their writes."""

from __future__ import annotations

import contextlib
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from ethercat_server.errors import BusError, SdoAbortError, UsageError
from ethercat_server.objects import BY_SETTING, SAMPLING_RATE
from ethercat_server.sdo import Sdo, Steps, check_writable, finish
from ethercat_server.sensor import Identity, Sensor, read_settings
from protocol.filters import FORCE_TORQUE_FILTERS
from protocol.framing import DataMessage
from protocol.sensor_choice import SensorChoice
from protocol.settings import BASE_SAMPLING_RATE_HZ, SettingValue


class GuardedSdo:
    """An `Sdo` that never writes the factory calibration: all that the tool writes goes through it."""

    def __init__(self, sdo: Sdo) -> None:
        self._sdo = sdo

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """See `Sdo`."""
        return (yield from self._sdo.read(index, subindex))

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`; ForbiddenWriteError for the factory calibration."""
        check_writable(index)
        yield from self._sdo.write(index, subindex, data)


class Found(NamedTuple):
    """A sensor that a link leads to."""

    place: int
    identity: Identity
    has_objects: bool = True
    """False for a slave without a CoE mailbox."""

    def __str__(self) -> str:
        """As a person names it."""
        return f"sensor {self.place}: {self.identity.name}, serial {self.identity.serial}"

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return {"sensor": self.place, **self.identity._asdict()}


OnFrame = Callable[[DataMessage], bool]
"""Takes a DATA message; returns whether more are wanted."""


class Link(ABC):
    """A way to the sensors of one bus. Errors are ServerErrors, each one sentence."""

    used: str
    """What it goes through, for people."""
    sensors: list[Found]

    @abstractmethod
    def sdo(self, place: int) -> GuardedSdo:
        """The object dictionary of the sensor at `place`."""

    @abstractmethod
    def configure(self, place: int, settings: Mapping[str, SettingValue], save: bool) -> None:
        """Put `settings` in force and verify them; on failure the former ones are in force again."""

    @abstractmethod
    def tare(self, place: int, samples: int, target: Sequence[float]) -> dict[str, Any]:
        """Set the force/torque offset; returns what the action `tare` replies. The last thing a link does."""

    @abstractmethod
    def watch(self, places: Sequence[int], on_frame: OnFrame, on_idle: Callable[[], bool]) -> None:
        """Stream until `on_frame`, or `on_idle` every now and then, returns False. The last thing it does."""

    @abstractmethod
    def close(self) -> None:
        """End the link."""

    def choose(self, wanted: str | None) -> Found:
        """The sensor that `--sensor` means; UsageError if that is unclear."""
        return choose(self.sensors, wanted)

    def chosen(self, wanted: str | None) -> list[Found]:
        """The same for what only looks: all of them if None."""
        return self.sensors if wanted is None else [self.choose(wanted)]

    def in_force(self, found: Found) -> Sensor:
        """The sensor with the settings that it holds now, which are also those wanted of it."""
        sensor = Sensor(found.place, found.identity, {})
        finish(read_in_force(self.sdo(found.place), sensor))
        return sensor


def choose(sensors: Sequence[Found], wanted: str | None) -> Found:
    """The sensor that `wanted` names, the only one if None; UsageError if that is unclear.

    A number that is no place on the bus is taken for a serial number.
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
    if choice.place is not None and choice.place >= len(sensors):
        choice = SensorChoice(serial=choice.place)
    found = [s for s in sensors if choice.matches(s.place, s.identity.name, s.identity.serial)]
    if len(found) != 1:
        many = f"{len(found)} sensors" if found else "no sensor"
        raise UsageError(f"--sensor {wanted} is {many} of those here ({there}): choose another")
    return found[0]


def read_in_force(sdo: Sdo, sensor: Sensor) -> Steps[None]:
    """Find out settings and rate, and want nothing else."""
    rate = yield from _number(sdo, SAMPLING_RATE)
    length = yield from _number(sdo, _SINC)
    sensor.rate_hz = rate or 0
    held = sinc_length_in_force(length, rate)
    sensor.wanted = {"sinc_length": held or 0}
    yield from read_settings(sdo, sensor)
    if not held:
        sensor.hold({name: value for name, value in sensor.settings.items() if name != "sinc_length"})
    sensor.wanted = dict(sensor.settings)


_SINC: Final = BY_SETTING["sinc_length"].address


def sinc_length_in_force(read: int | None, rate_hz: int | None) -> int | None:
    """The SINC length, from what object 0x8006:1 and the sampling rate read.

    The rate decides: a real device read back 2048 while it sampled with 341.
    """
    if not rate_hz:
        return read
    if read and abs(rate_hz - BASE_SAMPLING_RATE_HZ / read) <= 1.0:
        return read
    published = [length for length, row in FORCE_TORQUE_FILTERS.items() if row.rate_hz == rate_hz]
    return published[0] if published else round(BASE_SAMPLING_RATE_HZ / rate_hz)


def _number(sdo: Sdo, address: tuple[int, int]) -> Steps[int | None]:
    try:
        return int.from_bytes((yield from sdo.read(*address)), "little")
    except SdoAbortError:
        return None


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Within it SIGINT and SIGTERM wait: something is half done."""
    signals = {signal.SIGINT, signal.SIGTERM}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def signals_call(hear: Callable[[], None]) -> Iterator[None]:
    """Within it SIGINT and SIGTERM call `hear` and do nothing else."""
    before = {number: signal.signal(number, lambda *_: hear()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def failed_change(error: BusError) -> BusError:
    """The same, saying that nothing has changed."""
    return BusError(f"{error}; the former settings are in force")
