"""The link through a running server, which continues to stream."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from ethercat_server.errors import BusError, SdoAbortError, ServerError, UsageError
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, Clock, Deadline
from ethercat_server.ethercat.slave.coe import Steps
from ethercat_server.links.link import (
    Found,
    Link,
    OnFrame,
    SettledFrames,
    note,
    signals_call,
    signals_held_back,
)
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.sensor import Identity
from protocol.address import Address
from protocol.client import Client
from protocol.control import ErrorCode, Event
from protocol.errors import (
    ConnectionFailedError,
    NoReplyError,
    ProtocolError,
    RefusedError,
    UnreachableError,
)
from protocol.framing import DataMessage
from protocol.settings import SettingValue
from protocol.text.json_text import JsonObject

_CONNECT_TIMEOUT_S: Final = 5.0
_ANSWER_TIMEOUT_S: Final = 30.0
_SLOWEST_SAMPLE_S: Final = 1.0
"""Upper bound for the time per sample of a tare: CHOP may divide 25 Hz by 8, and a tare takes two windows."""
_IDLE_S: Final = 0.05
_SETTLED_WITHIN_S: Final = 10.0
"""Timeout for what settles."""
_READ_ATTEMPTS: Final = 3
_READ_PAUSE_S: Final = 0.1


class ServerLink(Link):
    """One framed connection to the server."""

    clock: Clock = SYSTEM_CLOCK
    restores = True

    def __init__(self, address: Address, used: str | None = None) -> None:
        self._name = f"the server at {address}"
        self.used = used or self._name
        try:
            self._client = Client(address.port, address.host, timeout_s=_CONNECT_TIMEOUT_S)
        except UnreachableError as error:
            raise ServerError(error.at(address)) from None
        except ProtocolError as error:
            raise ServerError(
                f"the program at {address} is not a compatible ethercat-server ({error}): "
                "check the port, or install the same version of both"
            ) from None
        try:
            self.sensors = [_found(row) for row in self._client.description["sensors"]]
        except (KeyError, TypeError):
            self._client.close()
            raise ServerError(f"the program at {address} is not an ethercat-server: check the port") from None

    def close(self) -> None:
        """See `Link`."""
        self._client.close()

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
            raise ServerError(f"{self._name} closed the connection ({error}): see its log") from None

    def sdo(self, number: int) -> GuardedSdo:
        """See `Link`."""
        return GuardedSdo(_ServerSdo(self, number))

    def sii(self, number: int, word: int, words: int) -> bytes:
        """`words` words of a sensor's SII from `word` on."""
        return bytes.fromhex(self.ask("sii_read", sensor=number, word=word, words=words)["hex"])

    def configure(self, number: int, settings: Mapping[str, SettingValue], save: bool) -> None:
        """See `Link`."""
        with signals_held_back():
            self.ask("configure", sensor=number, settings=dict(settings), save=save)

    def tare(self, number: int, samples: int, target: Sequence[float]) -> dict[str, Any]:
        """See `Link`."""
        timeout_s = _ANSWER_TIMEOUT_S + samples * _SLOWEST_SAMPLE_S
        with signals_call(self._stay()):
            return self.ask("tare", timeout_s, sensor=number, samples=samples, target=list(target))

    def _stay(self) -> Callable[[], None]:
        """Signal handler during a tare, which the server completes in any case."""
        heard: list[None] = []

        def hear() -> None:
            if heard:
                raise ServerError(f"interrupted before {self._name} replied: it may still tare the sensor")
            heard.append(None)
            note(f"{self._name} continues the tare: waiting for its result; Ctrl-C again leaves without it")

        return hear

    def watch(self, numbers: Sequence[int], on_frame: OnFrame, on_idle: Callable[[], bool]) -> None:
        """See `Link`."""
        self.wait_settled(numbers)
        self.ask("subscribe", sensors=list(numbers))
        settled, settling, asked = SettledFrames(on_frame), set[int](), Deadline(self.clock, 0.0)
        while on_idle():
            later = settling
            if settling and asked.passed:
                later, asked = self._settling(numbers), Deadline(self.clock, _IDLE_S)
            try:
                frames = self._client.receive(_IDLE_S)
            except ConnectionFailedError as error:
                raise ServerError(f"{self._name} closed the connection ({error}): see its log") from None
            while self._client.events:
                event = self._client.events.popleft()
                if event["event"] == Event.SHUTTING_DOWN:
                    raise ServerError(f"{self._name} is shutting down")
                if event.get("sensor") in numbers:
                    _tell(event)
                    if event["event"] in (Event.SENSOR_BACK, Event.RECONFIGURED):
                        settling = later = later | {event["sensor"]}
            for frame in frames:  # those on the way while it was asked are judged by what it said before
                if not settled.take(frame, frame.sensor in settling):
                    return
            settling = later

    @property
    def same_machine(self) -> bool:
        """Whether CLOCK_MONOTONIC is the server's."""
        return self._client.connection.same_machine

    def listen(self, seconds: float, on_frames: Callable[[Sequence[DataMessage]], None]) -> list[JsonObject]:
        """Stream every frame of all sensors to `on_frames` for some seconds; the events meanwhile."""
        self.ask("subscribe", fresh_only=False)
        end = Deadline(self.clock, seconds)
        while not end.passed:
            try:
                on_frames(self._client.receive(_IDLE_S))
            except ConnectionFailedError as error:
                raise ServerError(f"{self._name} closed the connection ({error}): see its log") from None
        self.ask("unsubscribe")
        return list(self._client.events)

    def wait_settled(self, numbers: Sequence[int]) -> None:
        """See `Link`."""
        deadline = Deadline(self.clock, _SETTLED_WITHIN_S)
        while self._settling(numbers) and not deadline.passed:
            self.clock.sleep(_IDLE_S)

    def _settling(self, numbers: Sequence[int]) -> set[int]:
        """Those among these sensors whose data has not settled."""
        rows = self.ask("describe")["sensors"]
        return {row["sensor"] for row in rows if row.get("settling") is True} & set(numbers)


class _ServerSdo:
    """An `Sdo` through the actions `sdo_read` and `sdo_write`."""

    def __init__(self, link: ServerLink, number: int) -> None:
        self._link, self._number = link, number
        self.clock = link.clock

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """See `Sdo`."""
        yield from ()
        keys = {"sensor": self._number, "index": index, "subindex": subindex}
        for _ in range(_READ_ATTEMPTS - 1):
            try:
                return bytes.fromhex(self._link.ask("sdo_read", **keys)["hex"])
            except SdoAbortError:
                raise
            except BusError:
                self.clock.sleep(_READ_PAUSE_S)  # the sensor may be lost for a moment
        return bytes.fromhex(self._link.ask("sdo_read", **keys)["hex"])

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`."""
        yield from ()
        self._link.ask("sdo_write", sensor=self._number, index=index, subindex=subindex, hex=data.hex())


def _tell(event: JsonObject) -> None:
    """Print an event of a watched sensor."""
    number = event["sensor"]
    if event.get("event") == Event.SENSOR_LOST:
        note(str(event.get("message", f"sensor {number} is lost")))
    elif event.get("event") == Event.SENSOR_BACK:
        note(f"sensor {number} is back after {event.get('lost_s')} s")
    elif event.get("event") == Event.EMERGENCY:
        note(str(event.get("message", f"sensor {number} reports an emergency")))
    elif event.get("event") == Event.RECONFIGURED:
        note(f"the settings of sensor {number} have changed")


def _found(row: Mapping[str, Any]) -> Found:
    return Found(row["sensor"], Identity(row["name"], row["serial"], row["hardware"], row["firmware"]))
