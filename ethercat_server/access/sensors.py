"""The sensors of a server, for `ethercat-sensor` and `ethercat-doctor`: one that runs, or their own."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.control import ErrorCode, Event
from bota_ethercat.errors import (
    ConnectionFailedError,
    NoReplyError,
    ProtocolError,
    RefusedError,
    UnreachableError,
)
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.program.server_choice import default_server, is_address
from bota_ethercat.sensor_choice import SensorChoice
from bota_ethercat.settings import SettingValue
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.access.adapters import find_holder
from ethercat_server.access.private_server import PrivateServer
from ethercat_server.errors import BusError, InterfaceError, SdoAbortError, ServerError, UsageError
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, Clock, Deadline
from ethercat_server.ethercat.slave.coe import Steps, finish
from ethercat_server.process.signals import signals_call, signals_held_back
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.sensor import Found, Identity, Sensor
from ethercat_server.sensor.set_up import NO_SETTINGS, read_in_force
from ethercat_server.sensor.tare import LATER

_ANSWER_TIMEOUT_S: Final = 30.0
# Upper bound for the time per sample of a tare: CHOP may divide 25 Hz by 8, and a tare takes two windows.
_SLOWEST_SAMPLE_S: Final = 1.0
_BACK_S: Final = 10.0
_IDLE_S: Final = 0.05
_SETTLED_WITHIN_S: Final = 10.0  # timeout for what settles
_READ_ATTEMPTS: Final = 3
_READ_PAUSE_S: Final = 0.1


# What is told of a watched sensor, unless the event has a message of its own.
_TOLD: Final[Mapping[str, str]] = {
    Event.SENSOR_LOST: "sensor {sensor} is lost",
    Event.SENSOR_BACK: "sensor {sensor} is back after {lost_s} s",
    Event.EMERGENCY: "sensor {sensor} reports an emergency",
    Event.RECONFIGURED: "the settings of sensor {sensor} have changed",
}


class Sensors:
    """The sensors of one bus, over one framed connection to their server. Errors are ServerErrors.

    Attributes:
        used: description of the interface or server.
        sensors: those that there are, by number.
        restores: whether settings and offsets are written again when a sensor was powered off.
    """

    clock: Clock = SYSTEM_CLOCK

    def __init__(self, client: Client, name: str, used: str, private: PrivateServer | None = None) -> None:
        """`name`: the server's, in messages; `private`: it is this process's own, which `close` ends."""
        self._client, self._name, self._private = client, name, private
        self.used = used
        self.restores = private is None
        self.sensors = [
            Found(row["sensor"], Identity(row["name"], row["serial"], row["hardware"], row["firmware"]))
            for row in client.description["sensors"]
        ]

    @classmethod
    def through(cls, address: Address, used: str | None = None) -> Sensors:
        """Those of the server at `address`."""
        name = f"the server at {address}"
        client = Client(address.port, address.host, stream=False, raw=True, reconnect=False)
        try:
            return cls(client.connect(), name, used or name)
        except UnreachableError as error:
            raise ServerError(error.at(address)) from None
        except ProtocolError as error:
            raise ServerError(
                f"the program at {address} is not a compatible ethercat-server ({error}): "
                "check the port, or install the same version of both"
            ) from None
        except (KeyError, TypeError):
            client.close()
            raise ServerError(f"the program at {address} is not an ethercat-server: check the port") from None

    @classmethod
    def on_interface(cls, ifname: str, **options: Any) -> Sensors:
        """Those on an interface that no server uses, set as they are; see `PrivateServer`."""
        used = f"the interface {ifname}"
        private = PrivateServer(ifname, **options)
        try:
            client = Client(0, stream=False, raw=True, reconnect=False, channel=private.channel)
            return cls(client.connect(), used, used, private)
        except BaseException:
            private.close()
            raise

    def close(self) -> None:
        """End the connection."""
        self._client.close()
        if self._private is not None:
            with signals_call(lambda: None):  # what was asked for is done, and this takes a moment only
                self._private.close()

    def ask(self, action: str, timeout_s: float = _ANSWER_TIMEOUT_S, **values: object) -> JsonObject:
        """The reply to a request; SdoAbortError, UsageError or BusError if it is refused."""
        try:
            return self._client.ask(action, timeout_s, **values)
        except RefusedError as error:
            if error.code == ErrorCode.SENSOR:
                raise SdoAbortError(str(error), error.abort_code or 0) from None
            kind = UsageError if error.code == ErrorCode.BAD_REQUEST else BusError
            raise kind(str(error)) from None
        except NoReplyError as error:
            raise BusError(f"{self._name} gave {error}: ask again") from None
        except ConnectionFailedError as error:
            raise self._closed(error) from None

    def _closed(self, error: ConnectionFailedError) -> Exception:
        if self._private is not None and self._private.error is not None:
            return self._private.error
        return ServerError(f"{self._name} closed the connection ({error}): see its log")

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

    def sdo(self, number: int) -> GuardedSdo:
        """The object dictionary of a sensor."""
        return GuardedSdo(_ServerSdo(self, number))

    def configure(self, number: int, settings: Mapping[str, SettingValue], save: bool) -> None:
        """Change `settings` and verify them; on failure the former ones are restored."""
        with signals_held_back():
            self.ask("configure", sensor=number, settings=dict(settings), save=save)

    def tare(self, number: int, samples: int, target: Sequence[float]) -> dict[str, Any]:
        """Set the force/torque offset; returns the reply of the action `tare`.

        On a signal a private server undoes it, another one completes it in any case.
        """
        timeout_s, signals = _ANSWER_TIMEOUT_S + samples * _SLOWEST_SAMPLE_S, itertools.count()

        def interrupt() -> None:
            if self._private is not None:
                self._private.interrupt()
            elif next(signals):
                raise ServerError(f"interrupted before {self._name} replied: it may still tare the sensor")
            else:
                waits = "waiting for its result; Ctrl-C again leaves without it"
                note(f"{self._name} continues the tare: {waits}")

        with signals_call(interrupt):
            try:
                return self.ask("tare", timeout_s, sensor=number, samples=samples, target=list(target))
            except BusError as error:
                if self._private is None or not str(error).endswith(LATER):
                    raise
                raise BusError(f"{str(error).removesuffix(LATER)}{self._wait_back(number)}") from None

    def _wait_back(self, number: int) -> str:
        """Give a sensor that was lost in a tare the time to come back; what became of its offset."""
        deadline = Deadline(self.clock, _BACK_S)
        while (row := self.ask("describe")["sensors"][number])["state"] != "OP":
            if deadline.passed:
                old = " ".join(f"{value:g}" for value in row["offset"] or ())
                return f"; its offset may be half written (it was {old}): tare it again"
            self.clock.sleep(_IDLE_S)
        return "; it is back with its old offset"

    def watch(
        self, numbers: Sequence[int], on_frame: Callable[[DataMessage], bool], on_idle: Callable[[], bool]
    ) -> None:
        """Stream until `on_frame` or the periodic `on_idle` returns False.

        Samples of settling sensors are left out, and their GAP is the next frame's; it begins when they have
        settled.
        """
        self.wait_settled(numbers)
        self.ask("subscribe", sensors=list(numbers))
        gaps, settling, asked = dict[int, int](), set[int](), Deadline(self.clock, 0.0)
        while on_idle():
            later = settling
            if settling and asked.passed:
                later, asked = self._settling(numbers), Deadline(self.clock, _IDLE_S)
            frames = self._poll()
            for event in self._events():
                if event["event"] == Event.SHUTTING_DOWN:
                    raise ServerError(f"{self._name} is shutting down")
                told = _TOLD.get(str(event["event"]))
                if told is not None and event.get("sensor") in numbers:
                    note(str(event.get("message") or told.format_map({"lost_s": None, **event})))
                    if event["event"] in (Event.SENSOR_BACK, Event.RECONFIGURED):
                        settling = later = later | {event["sensor"]}
            for frame in frames:  # those on the way while it was asked are judged by what it said before
                gap = gaps.pop(frame.sensor, 0) | frame.flags & DataFlag.GAP
                if frame.sensor in settling and not frame.flags & NOT_NEW:
                    gaps[frame.sensor] = gap
                elif not on_frame(frame._replace(flags=frame.flags | gap)):
                    return
            settling = later

    def _poll(self) -> list[DataMessage]:
        try:
            return self._client.poll(_IDLE_S)
        except ConnectionFailedError as error:
            raise self._closed(error) from None

    @property
    def real_time(self) -> bool:
        """Whether a server of this process's own has real-time scheduling."""
        return self._private is not None and self._private.real_time

    @property
    def same_machine(self) -> bool:
        """Whether CLOCK_MONOTONIC is the server's."""
        return self._client.session.same_machine

    def listen(self, seconds: float, on_frames: Callable[[Sequence[DataMessage]], None]) -> list[JsonObject]:
        """Stream every frame of all sensors to `on_frames` for some seconds; the events meanwhile."""
        self.ask("subscribe", fresh_only=False)
        end = Deadline(self.clock, seconds)
        while not end.passed:
            on_frames(self._poll())
        self.ask("unsubscribe")
        return self._events()

    def _events(self) -> list[JsonObject]:
        """The server's since the last call."""
        events = [event for event in self._client.events if isinstance(event, dict)]
        self._client.events.clear()
        return events

    def wait_settled(self, numbers: Sequence[int]) -> None:
        """Wait until the data of these sensors has settled."""
        deadline = Deadline(self.clock, _SETTLED_WITHIN_S)
        while self._settling(numbers) and not deadline.passed:
            self.clock.sleep(_IDLE_S)

    def _settling(self, numbers: Sequence[int]) -> set[int]:
        """Those among these sensors whose data has not settled."""
        rows = self.ask("describe")["sensors"]
        return {row["sensor"] for row in rows if row.get("settling") is True} & set(numbers)


class _ServerSdo:
    """An `Sdo` through the actions `sdo_read` and `sdo_write`."""

    def __init__(self, sensors: Sensors, number: int) -> None:
        self._sensors, self._number = sensors, number
        self.clock = sensors.clock

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """See `Sdo`."""
        yield from ()
        keys = {"sensor": self._number, "index": index, "subindex": subindex}
        for _ in range(_READ_ATTEMPTS - 1):
            try:
                return bytes.fromhex(self._sensors.ask("sdo_read", **keys)["hex"])
            except SdoAbortError:
                raise
            except BusError:
                self.clock.sleep(_READ_PAUSE_S)  # the sensor may be lost for a moment
        return bytes.fromhex(self._sensors.ask("sdo_read", **keys)["hex"])

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`."""
        yield from ()
        self._sensors.ask("sdo_write", sensor=self._number, index=index, subindex=subindex, hex=data.hex())


def find_server(ifname: str | None, server: str | None) -> Sensors | None:
    """The named server, or with a note the one that uses the interface; None if the interface is not in use.

    With neither, the default server; an `ifname` such as localhost:12001 is a server too. UsageError if both
    are given.
    """
    if ifname is not None and server is not None:
        raise UsageError("name either an interface, such as ens5, or a server with --server HOST:PORT")
    if ifname is None or (":" in ifname and is_address(ifname)):
        text = server or ifname
        try:
            return Sensors.through(default_server() if text is None else Address.parse(text))
        except ValueError as error:
            raise UsageError(f"--server {error}" if server else str(error)) from None
    holder = find_holder(ifname)
    if holder is None:
        return None
    if holder.address is None:
        if holder.pid is None:
            hint = "run as root, or name its server with --server HOST:PORT"
        else:
            hint = "it serves no TCP port, so stop it first"
        raise InterfaceError(f"{ifname} is in use by {holder}: {hint}")
    used = f"the server at {holder.address}, {holder}, which uses {ifname}"
    note(f"going through {used}")
    return Sensors.through(holder.address, used)


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
