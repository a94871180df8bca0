"""The link through a running server, which goes on streaming meanwhile."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from ethercat_server.errors import BusError, SdoAbortError, ServerError, UsageError
from ethercat_server.sdo import Steps
from ethercat_server.sensor import Identity
from ethercat_server.tool.link import Found, GuardedSdo, Link, OnFrame, signals_held_back
from ethercat_server.tool.show import note
from protocol.control import PROTOCOL_VERSION, ErrorCode, Event, request
from protocol.errors import ProtocolError
from protocol.framing import DataMessage, FrameDecoder, JsonObject, encode_json
from protocol.settings import SettingValue

_CONNECT_TIMEOUT_S: Final = 5.0
_ANSWER_TIMEOUT_S: Final = 30.0
_SLOWEST_SAMPLE_S: Final = 0.2
"""No sampling rate is below 25 Hz; a tare looks at its samples twice."""
_IDLE_S: Final = 0.05
_READ_ATTEMPTS: Final = 3
_READ_PAUSE_S: Final = 0.1


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT; UsageError if it is none."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise UsageError(f"--server {text}: it must be HOST:PORT, for example localhost:12001")
    return host.strip("[]"), int(port)


class ServerLink(Link):
    """One framed connection to the server."""

    def __init__(self, host: str, port: int, used: str | None = None) -> None:
        self._name = f"the server at {host}:{port}"
        self.used = used or self._name
        try:
            self._socket = socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT_S)
        except OSError as error:
            reason = error.strerror or str(error)
            raise ServerError(
                f"no server answers at {host}:{port} ({reason}): start ethercat-server"
            ) from None
        self._decoder = FrameDecoder()
        self._asked = 0
        try:
            described = self.ask("describe", _CONNECT_TIMEOUT_S)
            if described.get("protocol") != PROTOCOL_VERSION:
                raise ServerError(
                    f"{self.used} does not speak version {PROTOCOL_VERSION}: update it or the tool"
                )
            self.sensors = [_found(row) for row in described["sensors"]]
        except (KeyError, TypeError):
            raise ServerError(
                f"what answers at {host}:{port} is no ethercat-server: check the port"
            ) from None
        except BaseException:
            self._socket.close()
            raise

    def close(self) -> None:
        """See `Link`."""
        self._socket.close()

    def ask(self, action: str, timeout_s: float = _ANSWER_TIMEOUT_S, **values: object) -> JsonObject:
        """The reply to a request; SdoAbortError or BusError if it is refused."""
        self._asked += 1
        self._socket.settimeout(timeout_s)
        try:
            self._socket.sendall(encode_json(request(action, self._asked, **values)))
            while True:
                message = self._next()
                if "event" not in message and message.get("id") in (self._asked, None):
                    break
        except TimeoutError:
            raise BusError(f"{self._name} did not answer {action} in {timeout_s:.0f} s: ask again") from None
        except OSError as error:
            raise ServerError(f"{self._name} is gone ({error.strerror or error}): see its log") from None
        except ProtocolError as error:
            raise ServerError(f"{self._name} is no ethercat-server ({error}): check the port") from None
        if message.get("ok"):
            return message
        refused = message.get("error", {})
        if refused.get("code") == ErrorCode.SENSOR:
            raise SdoAbortError(str(refused.get("message")), int(refused.get("abort_code", 0)))
        raise BusError(str(refused.get("message", "refused")))

    def _next(self) -> JsonObject:
        """The next JSON message; frames go to whoever watches."""
        while True:
            message = self._decoder.next_message()
            if message is None:
                data = self._socket.recv(65536)
                if not data:
                    raise ConnectionError("it closed the connection")
                self._decoder.feed(data)
            elif not isinstance(message, DataMessage):
                return message

    def sdo(self, place: int) -> GuardedSdo:
        """See `Link`."""
        return GuardedSdo(_ServerSdo(self, place))

    def sii(self, place: int, word: int, words: int) -> bytes:
        """So many words of a sensor's SII from `word` on."""
        return bytes.fromhex(self.ask("sii_read", sensor=place, word=word, words=words)["hex"])

    def configure(self, place: int, settings: Mapping[str, SettingValue], save: bool) -> None:
        """See `Link`."""
        with signals_held_back():
            self.ask("configure", sensor=place, settings=dict(settings), save=save)

    def tare(self, place: int, samples: int, target: Sequence[float]) -> dict[str, Any]:
        """See `Link`."""
        timeout_s = _ANSWER_TIMEOUT_S + samples * _SLOWEST_SAMPLE_S
        return self.ask("tare", timeout_s, sensor=place, samples=samples, target=list(target))

    def watch(self, places: Sequence[int], on_frame: OnFrame, on_idle: Callable[[], bool]) -> None:
        """See `Link`."""
        self.ask("subscribe", sensors=list(places))
        self._socket.settimeout(_ANSWER_TIMEOUT_S)
        while on_idle():
            for message in self._decoder:
                if isinstance(message, DataMessage):
                    if not on_frame(message):
                        return
                elif message.get("event") == Event.SHUTTING_DOWN:
                    raise ServerError(f"{self._name} is shutting down")
                elif message.get("sensor") in places:
                    _tell(message)
            if select.select((self._socket,), (), (), _IDLE_S)[0]:
                data = self._socket.recv(65536)
                if not data:
                    raise ServerError(f"{self._name} closed the connection: see its log")
                self._decoder.feed(data)


class _ServerSdo:
    """An `Sdo` through the actions `sdo_read` and `sdo_write`."""

    def __init__(self, link: ServerLink, place: int) -> None:
        self._link, self._place = link, place

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """See `Sdo`."""
        yield from ()
        keys = {"sensor": self._place, "index": index, "subindex": subindex}
        for _ in range(_READ_ATTEMPTS - 1):
            try:
                return bytes.fromhex(self._link.ask("sdo_read", **keys)["hex"])
            except SdoAbortError:
                raise
            except BusError:
                time.sleep(_READ_PAUSE_S)  # the sensor may be out for a moment
        return bytes.fromhex(self._link.ask("sdo_read", **keys)["hex"])

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`."""
        yield from ()
        self._link.ask("sdo_write", sensor=self._place, index=index, subindex=subindex, hex=data.hex())


def _tell(event: JsonObject) -> None:
    """Events of the sensors that are watched."""
    place = event["sensor"]
    if event.get("event") == Event.SENSOR_LOST:
        note(str(event.get("message", f"sensor {place} is lost")))
    elif event.get("event") == Event.SENSOR_BACK:
        note(f"sensor {place} is back after {event.get('lost_s')} s")
    elif event.get("event") == Event.RECONFIGURED:
        note(f"sensor {place} has other settings now")


def _found(row: Mapping[str, Any]) -> Found:
    return Found(row["sensor"], Identity(row["name"], row["serial"], row["hardware"], row["firmware"]))
