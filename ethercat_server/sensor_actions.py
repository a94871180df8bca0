"""The actions that talk to a sensor: SDO access, settings, tare. They reply when the sensor has answered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from ethercat_server import objects
from ethercat_server.configuration import Change, apply_in_op, save
from ethercat_server.connection import Connection
from ethercat_server.errors import BusError
from ethercat_server.hub import Hub
from ethercat_server.jobs import Done, Jobs, refusal
from ethercat_server.recovery import Recovery
from ethercat_server.sdo import Sdo, Steps
from ethercat_server.sensor import Sensor, read_offset
from ethercat_server.stream import SensorStream
from ethercat_server.tare import tare
from protocol.control import ErrorCode, Event, Request, error_reply, event, reply
from protocol.errors import RequestError, SettingError
from protocol.framing import JsonObject
from protocol.sdo_types import SdoType
from protocol.sensor_choice import SensorChoice
from protocol.settings import SETTINGS, SettingValue

_MOST_READS: Final = 8
"""Everyone may read objects: with so many jobs waiting no more reads, so that changes have their turn."""


class SensorActions:
    """One method an action; each starts work between the exchanges and answers through the hub."""

    def __init__(
        self,
        hub: Hub,
        recovery: Recovery,
        jobs: Jobs,
        sensors: Sequence[Sensor],
        streams: Sequence[SensorStream],
    ) -> None:
        self.sensors = sensors
        self._hub = hub
        self._recovery = recovery
        self._jobs = jobs
        self._streams = streams
        self._changing: set[int] = set()
        """Sensors that are being configured or tared: one at a time each."""
        self.handlers: Mapping[str, Callable[[Connection, Request], None]] = {
            "sdo_read": self._sdo_read,
            "sdo_write": self._sdo_write,
            "configure": self._configure,
            "tare": self._tare,
        }

    def handle(self, connection: Connection, request: Request) -> None:
        """Start what `request` asks for; RequestError refuses it."""
        place = self._place(request.values["sensor"])
        self._jobs.check_present(place)
        values = {**request.values, "sensor": place}
        self.handlers[request.action](connection, request._replace(values=values))

    def _place(self, choice: SensorChoice) -> int:
        found = [
            sensor.place
            for sensor in self.sensors
            if choice.matches(sensor.place, sensor.identity.name, sensor.identity.serial)
        ]
        if len(found) != 1:
            there = "; ".join(f"{sensor.place}: {sensor.identity}" for sensor in self.sensors)
            many = f"{len(found)} sensors" if found else "no sensor"
            raise RequestError(
                ErrorCode.BAD_REQUEST,
                f"the key 'sensor' is {choice}, which is {many} of those here ({there})",
            )
        return found[0]

    def _start(self, connection: Connection, request: Request, steps: Steps[Mapping[str, Any]]) -> None:
        self._jobs.start(request.values["sensor"], steps, self._answering(connection, request))

    def _answering(self, connection: Connection, request: Request) -> Done:
        def done(values: Mapping[str, Any], error: RequestError | None) -> None:
            self._hub.answer(connection, _answer(request, values, error))

        return done

    def _start_change(self, place: int, steps: Steps[Mapping[str, Any]], done: Done) -> None:
        self._begin_change(place)

        def ended(values: Mapping[str, Any], error: RequestError | None) -> None:
            self._changing.discard(place)
            done(values, error)

        try:
            self._jobs.start(place, steps, ended)
        except RequestError:
            self._changing.discard(place)
            raise

    def _begin_change(self, place: int) -> None:
        if place in self._changing:
            raise RequestError(
                ErrorCode.BUSY, f"sensor {place} is being configured or tared: ask again when that is done"
            )
        self._changing.add(place)

    def _sdo_read(self, connection: Connection, request: Request) -> None:
        values = request.values
        sdo = self._recovery.sdo(values["sensor"])
        steps = _read(sdo, values["index"], values["subindex"], values["type"])
        done = self._answering(connection, request)
        self._jobs.start(values["sensor"], steps, done, most=_MOST_READS)

    def _sdo_write(self, connection: Connection, request: Request) -> None:
        values = request.values
        if values["index"] == objects.FACTORY_CALIBRATION:
            raise RequestError(
                ErrorCode.DENIED, "object 0x2000 holds the factory calibration, which is never written"
            )
        sensor = self.sensors[values["sensor"]]
        sdo = self._recovery.sdo(sensor.place)
        data = _bytes_to_write(values)
        self._start(connection, request, _write(sdo, sensor, values["index"], values["subindex"], data))

    def _tare(self, connection: Connection, request: Request) -> None:
        values = request.values
        sensor = self.sensors[values["sensor"]]
        stream, sdo = self._streams[sensor.place], self._recovery.sdo(sensor.place)
        steps = tare(sdo, sensor, stream, values["samples"], values["target"])
        self._start_change(sensor.place, steps, self._answering(connection, request))

    def _configure(self, connection: Connection, request: Request) -> None:
        values, done = request.values, self._answering(connection, request)
        self.configure(values["sensor"], values["settings"], save_too=values["save"], done=done)

    def configure(
        self, place: int, settings: Mapping[str, SettingValue], *, save_too: bool, done: Done
    ) -> None:
        """Change settings of the sensor at `place` and save them if `save_too`; `done` gets the outcome.

        RequestError refuses it at once.
        """
        self._jobs.check_present(place)
        sensor = self.sensors[place]
        try:
            change = Change(sensor, settings)
        except SettingError as error:
            raise RequestError(ErrorCode.BAD_REQUEST, f"the key 'settings' is refused: {error}") from None
        if not change.needs_preop:
            self._start_change(place, self._change_in_op(sensor, change, save_too), done)
            return
        self._begin_change(place)

        def changed(error: BusError | None) -> None:
            self._changing.discard(place)
            if error is not None:
                done({}, refusal(error, "; the former settings are in force"))
                return
            try:
                self._start_change(place, self._finish_change(sensor, save_too), done)
            except RequestError as refused:
                done({}, refused)

        self._recovery.reconfigure(place, change, changed)

    def _change_in_op(self, sensor: Sensor, change: Change, save_too: bool) -> Steps[Mapping[str, Any]]:
        sdo = self._recovery.sdo(sensor.place)
        yield from apply_in_op(sdo, sensor, change)
        if change.names:
            self._hub.broadcast(
                event(Event.RECONFIGURED, sensor=sensor.place, settings=dict(sensor.settings))
            )
        return (yield from self._finish_change(sensor, save_too))

    def _finish_change(self, sensor: Sensor, save_too: bool) -> Steps[Mapping[str, Any]]:
        if save_too:
            yield from save(self._recovery.sdo(sensor.place), sensor)
        return {
            "sensor": sensor.place,
            "settings": dict(sensor.settings),
            "rate_hz": sensor.rate_hz,
            "saved": save_too,
        }


def _answer(request: Request, values: Mapping[str, Any], error: RequestError | None) -> JsonObject:
    if error is None:
        return reply(request, **values)
    message: JsonObject = {"action": request.action}
    if request.has_id:
        message["id"] = request.id
    return error_reply(message, error.code, str(error), **error.extra)


def _read(sdo: Sdo, index: int, subindex: int, kind: SdoType | None) -> Steps[Mapping[str, Any]]:
    data = yield from sdo.read(index, subindex)
    values: dict[str, Any] = {"index": index, "subindex": subindex, "hex": data.hex()}
    if kind is not None:
        try:
            values |= {"type": kind.name, "value": kind.unpack(data)}
        except ValueError as error:
            raise RequestError(
                ErrorCode.BAD_REQUEST, f"the key 'type' does not fit object 0x{index:04X}:{subindex}: {error}"
            ) from None
    return values


def _bytes_to_write(values: Mapping[str, Any]) -> bytes:
    kind: SdoType | None = values["type"]
    data: bytes | None = values["hex"]
    if (kind is None) == (data is None) or (kind is None) != (values["value"] is None):
        raise RequestError(
            ErrorCode.BAD_REQUEST, "sdo_write needs either the keys 'type' and 'value' or the key 'hex'"
        )
    if data is not None:
        return data
    assert kind is not None
    try:
        return kind.pack(values["value"])
    except ValueError as error:
        raise RequestError(ErrorCode.BAD_REQUEST, f"the key 'value' must be {error}") from None


def _write(sdo: Sdo, sensor: Sensor, index: int, subindex: int, data: bytes) -> Steps[Mapping[str, Any]]:
    yield from sdo.write(index, subindex, data)
    # What was written is to be in force after a power cut too, if it is one of what the server looks after.
    entry = objects.BY_ADDRESS.get((index, subindex))
    if entry is not None and entry.setting is not None:
        try:
            value = entry.decode_setting(data, SETTINGS[entry.setting].is_bool)
        except ValueError:
            value = None
        if value is not None:
            sensor.wanted = {**sensor.wanted, entry.setting: value}
            sensor.hold({**sensor.settings, entry.setting: value})
    if index == objects.FORCE_TORQUE_OFFSET:
        sensor.offset = yield from read_offset(sdo)
    return {"index": index, "subindex": subindex, "hex": data.hex()}
