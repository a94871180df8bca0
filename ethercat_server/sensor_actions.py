"""The actions that talk to a sensor: SDO access, settings, tare. They reply when the sensor has answered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from ethercat_server import objects
from ethercat_server.bus import Bus
from ethercat_server.configuration import Change, apply_in_op, save
from ethercat_server.connection import Connection
from ethercat_server.errors import BusError
from ethercat_server.hub import Hub
from ethercat_server.jobs import Done, Jobs, refusal
from ethercat_server.object_access import bytes_to_write, entry_named, read, read_named, write
from ethercat_server.recovery import Recovery
from ethercat_server.sdo import Steps
from ethercat_server.sensor import Sensor
from ethercat_server.sii import read_sii
from ethercat_server.stream import SensorStream
from ethercat_server.tare import tare
from protocol.control import ErrorCode, Event, Request, error_reply, event, reply
from protocol.errors import RequestError, SettingError
from protocol.json_text import JsonObject
from protocol.sensor_choice import SensorChoice
from protocol.settings import SettingValue

_MOST_READS: Final = 8
"""Everyone may read objects: with so many jobs waiting no more reads, so that changes have their turn."""


_CHANGES: Final = frozenset({"configure", "tare"})
"""Of these a sensor does one at a time."""


class SensorActions:
    """One method an action; each starts work between the exchanges and answers through the hub."""

    def __init__(
        self,
        bus: Bus,
        hub: Hub,
        recovery: Recovery,
        jobs: Jobs,
        sensors: Sequence[Sensor],
        streams: Sequence[SensorStream],
    ) -> None:
        self.sensors = sensors
        self._bus = bus
        self._hub = hub
        self._recovery = recovery
        self._jobs = jobs
        self._streams = streams
        self.handlers: Mapping[str, Callable[[Connection, Request], None]] = {
            "sdo_read": self._sdo_read,
            "sdo_write": self._sdo_write,
            "sii_read": self._sii_read,
            "configure": self._configure,
            "tare": self._tare,
        }

    def handle(self, connection: Connection, request: Request) -> None:
        """Start what `request` asks for; RequestError refuses it."""
        place = self._place(request.values["sensor"])
        if request.action in _CHANGES:
            self._check_unchanging(place)  # a change may be why the sensor is out of OP
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
        self._check_unchanging(place)
        self._jobs.start(place, steps, done, changes=True)

    def _check_unchanging(self, place: int) -> None:
        if self._jobs.is_changing(place) or self._recovery.is_changing(place):
            raise RequestError(
                ErrorCode.BUSY, f"sensor {place} is being configured or tared: ask again when that is done"
            )

    def _sdo_read(self, connection: Connection, request: Request) -> None:
        values = request.values
        sdo = self._recovery.sdo(values["sensor"])
        if (values["index"] is None) == (values["name"] is None):
            raise RequestError(
                ErrorCode.BAD_REQUEST, "sdo_read needs the key 'index', or the key 'name' in its place"
            )
        if values["name"] is not None and values["subindex"] is not None:
            raise RequestError(
                ErrorCode.BAD_REQUEST, "the key 'subindex' goes with the key 'index': a name has its own"
            )
        if values["name"] is not None:
            steps = read_named(sdo, entry_named(values["name"]), values["type"])
        else:
            steps = read(sdo, values["index"], values["subindex"] or 0, values["type"])
        self._start_reading(connection, request, steps)

    def _sii_read(self, connection: Connection, request: Request) -> None:
        word, words = request.values["word"], request.values["words"]

        def steps() -> Steps[Mapping[str, Any]]:
            data = yield from read_sii(self._bus, request.values["sensor"], word, words)
            return {"word": word, "words": words, "hex": data.hex()}

        self._start_reading(connection, request, steps())

    def _start_reading(
        self, connection: Connection, request: Request, steps: Steps[Mapping[str, Any]]
    ) -> None:
        done = self._answering(connection, request)
        self._jobs.start(request.values["sensor"], steps, done, most=_MOST_READS)

    def _sdo_write(self, connection: Connection, request: Request) -> None:
        values = request.values
        if values["index"] == objects.FACTORY_CALIBRATION:
            raise RequestError(
                ErrorCode.DENIED, "object 0x2000 holds the factory calibration, which is never written"
            )
        sensor = self.sensors[values["sensor"]]
        sdo = self._recovery.sdo(sensor.place)
        data = bytes_to_write(values)

        def steps() -> Steps[Mapping[str, Any]]:
            before = sensor.settings
            written = yield from write(sdo, sensor, values["index"], values["subindex"], data)
            if sensor.settings != before:
                self._tell_reconfigured(sensor)
            return written

        self._start(connection, request, steps())

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
        self._check_unchanging(place)
        self._jobs.check_present(place)
        sensor = self.sensors[place]
        try:
            change = Change(sensor, settings)
        except SettingError as error:
            raise RequestError(ErrorCode.BAD_REQUEST, f"the key 'settings' is refused: {error}") from None
        if not change.needs_preop:
            self._start_change(place, self._change_in_op(sensor, change, save_too), done)
            return

        def changed(error: BusError | None) -> None:
            if error is not None:
                done({}, refusal(error))
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
            self._tell_reconfigured(sensor)
        return (yield from self._finish_change(sensor, save_too))

    def _tell_reconfigured(self, sensor: Sensor) -> None:
        self._hub.broadcast(event(Event.RECONFIGURED, sensor=sensor.place, settings=dict(sensor.settings)))

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
