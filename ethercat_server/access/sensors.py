"""The sensors of a server, for `ethercat-sensor` and `ethercat-doctor`: one that runs, or their own."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.control import ErrorCode
from bota_ethercat.errors import (
    ConnectionFailedError,
    NoReplyError,
    ProtocolError,
    RefusedError,
    UnreachableError,
)
from bota_ethercat.framing import DataMessage
from bota_ethercat.program.server_choice import default_server, is_address
from bota_ethercat.program.signals import signals_call, signals_held_back
from bota_ethercat.replies import Description, SensorInfo, Status
from bota_ethercat.sensor_choice import SensorChoice
from bota_ethercat.settings import SettingValue
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.access.adapters import find_holder
from ethercat_server.access.private_server import PrivateServer
from ethercat_server.errors import BusError, InterfaceError, SdoAbortError, ServerError, UsageError
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, Clock, Deadline
from ethercat_server.ethercat.datagrams import Steps, finish
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.sensor import FoundSensor, Identity, Sensor
from ethercat_server.sensor.set_up import NO_SETTINGS, read_in_force
from ethercat_server.sensor.tare import LATER

_ANSWER_TIMEOUT_S: Final = 30.0
# Upper bound for the time per sample of a tare: CHOP may divide 25 Hz by 8, and a tare takes two windows.
_SLOWEST_SAMPLE_S: Final = 1.0
_BACK_S: Final = 10.0  # how long a sensor that was lost in a tare has to come back
_SETTLED_WITHIN_S: Final = 10.0  # timeout for what settles
_IDLE_S: Final = 0.05
_READ_ATTEMPTS: Final = 3
_READ_PAUSE_S: Final = 0.1


class Sensors:
    """The sensors of one bus, over one framed connection to their server. Errors are ServerErrors.

    Attributes:
        client: the connection.
        private: the server, if it is this process's own, which `close` ends. What it changed is not written
            again when a sensor was powered off.
        used: description of the interface or server.
        sensors: those that there are, by number.
    """

    clock: Clock = SYSTEM_CLOCK

    def __init__(self, client: Client, name: str, used: str, private: PrivateServer | None = None) -> None:
        """`name`: the server's, in messages."""
        self.client, self.used, self.private = client, used, private
        self._name = name
        self.sensors = [
            FoundSensor(info.sensor, Identity(info.name, info.serial or 0, info.hardware, info.firmware))
            for info in Description.parse(client.description).sensors
        ]

    @classmethod
    def through(cls, address: Address, used: str | None = None) -> Sensors:
        name = f"the server at {address}"
        client = Client(address.port, address.host, stream=False, raw=True, reconnect=False)
        try:
            return cls(client.connect(), name, used or name)
        except UnreachableError as error:
            raise ServerError(str(error)) from None
        except (ProtocolError, KeyError, TypeError) as error:
            client.close()
            raise ServerError(
                f"the program at {address} is not a compatible ethercat-server ({error}): "
                "check the port, or install the same version of both"
            ) from None

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
        self.client.close()
        if self.private is not None:
            with signals_call(lambda: None):  # what was asked for is done, and this takes a moment only
                self.private.close()

    def ask(self, action: str, timeout_s: float = _ANSWER_TIMEOUT_S, **values: object) -> JsonObject:
        try:
            return self.client.ask(action, timeout_s, **values)
        except RefusedError as error:
            if error.code == ErrorCode.SENSOR:
                raise SdoAbortError(str(error), error.abort_code or 0) from None
            kind = UsageError if error.code == ErrorCode.BAD_REQUEST else BusError
            raise kind(str(error)) from None
        except NoReplyError as error:
            raise BusError(f"{self._name} gave {error}: ask again") from None
        except ConnectionFailedError as error:
            raise self._closed(error) from None

    def describe(self) -> Description:
        return Description.parse(self.ask("describe"))

    def status(self) -> Status:
        return Status.parse(self.ask("status"))

    def _closed(self, error: ConnectionFailedError) -> Exception:
        if self.private is not None and self.private.error is not None:
            return self.private.error
        return ServerError(f"{self._name} closed the connection ({error}): see its log")

    def read_settings(self, found: FoundSensor, asked: Mapping[str, SettingValue] = NO_SETTINGS) -> Sensor:
        """The sensor with its present settings, also as the wanted ones; see `read_in_force` for `asked`."""
        sensor = Sensor(found.number, found.identity, {})
        finish(read_in_force(self.sdo(found.number), sensor, asked), clock=self.clock)
        return sensor

    def sdo(self, number: int) -> GuardedSdo:
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
            if self.private is not None:
                self.private.interrupt()
            elif next(signals):
                raise ServerError(f"interrupted before {self._name} replied: it may still tare the sensor")
            else:
                waits = "waiting for its result; Ctrl-C again leaves without it"
                note(f"{self._name} continues the tare: {waits}")

        before = self.describe().find(number)
        with signals_call(interrupt):
            try:
                return self.ask("tare", timeout_s, sensor=number, samples=samples, target=list(target))
            except BusError as error:
                if self.private is None or not str(error).endswith(LATER):
                    raise
                raise BusError(f"{str(error).removesuffix(LATER)}{self._wait_back(number, before)}") from None

    def _wait_back(self, number: int, before: SensorInfo | None) -> str:
        """Give a sensor that was lost in a tare the time to come back; what became of its offset."""
        deadline = Deadline(self.clock, _BACK_S)
        while (info := self.describe().find(number)) is None or info.state != "OP":
            if deadline.passed:
                old = " ".join(f"{value:g}" for value in (before and before.offset) or ())
                return f"; its offset may be half written (it was {old}): tare it again"
            self.clock.sleep(_IDLE_S)
        return "; it is back with its old offset"

    def stream(self, **subscription: Any) -> Iterator[list[DataMessage]]:
        """Subscribe; every 50 ms or sooner the frames that have come. Never ends."""
        self.ask("subscribe", **subscription)
        while True:
            try:
                yield self.client.poll(_IDLE_S)
            except ConnectionFailedError as error:
                raise self._closed(error) from None

    def wait_settled(self, numbers: Collection[int]) -> None:
        deadline = Deadline(self.clock, _SETTLED_WITHIN_S)
        while numbers and not deadline.passed:
            if not any(info.settling for info in self.describe().sensors if info.sensor in numbers):
                return
            self.clock.sleep(_IDLE_S)


class _ServerSdo:
    """An `Sdo` through the actions `sdo_read` and `sdo_write`."""

    def __init__(self, sensors: Sensors, number: int) -> None:
        self._sensors, self._number = sensors, number
        self.clock = sensors.clock

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        yield from ()
        for left in reversed(range(_READ_ATTEMPTS)):
            try:
                reply = self._sensors.ask("sdo_read", sensor=self._number, index=index, subindex=subindex)
                break
            except BusError as error:
                if isinstance(error, SdoAbortError) or not left:
                    raise
                self.clock.sleep(_READ_PAUSE_S)  # the sensor may be lost for a moment
        return bytes.fromhex(reply["hex"])

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
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


def choose(sensors: Sequence[FoundSensor], wanted: str | None) -> FoundSensor:
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
