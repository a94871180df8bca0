"""The actions that access a sensor: objects, EEPROM, settings, tare. They reply when it has answered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from bota_ethercat.control import ErrorCode, Event, Request, error_reply, event, reply
from bota_ethercat.errors import RequestError, SettingError
from ethercat_server.acquisition.jobs import Done, Jobs, refusal
from ethercat_server.acquisition.recovery import Recovery
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.errors import BusError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.datagrams import Steps
from ethercat_server.ethercat.slave.sii import read_sii
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.objects.access import bytes_to_write, entry_named, read, read_named, write
from ethercat_server.sensor.sensor import Sensor
from ethercat_server.sensor.set_up import Change, apply_in_op, save
from ethercat_server.sensor.tare import tare
from ethercat_server.serving.connection import Connection
from ethercat_server.serving.hub import Hub

# Reads that may wait for one sensor: everyone may read, and changes must still get their turn.
_MOST_READS: Final = 8

_CHANGES: Final = frozenset({"configure", "tare"})  # a sensor does one of these at a time


class SensorActions:
    """One method for each action; it starts work between the exchanges, which answers through the hub."""

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
        self._handlers: Mapping[str, Callable[[Connection, Request], None]] = {
            "sdo_read": self._sdo_read,
            "sdo_write": self._sdo_write,
            "sii_read": self._sii_read,
            "configure": self._configure,
            "tare": self._tare,
        }

    def handle(self, connection: Connection, request: Request) -> None:
        """Start `request`; RequestError refuses it."""
        number = request.values["sensor"]
        if request.action in _CHANGES:
            self._check_unchanging(number)  # the sensor may be out of OP because of a change
        self._jobs.check_present(number)
        self._handlers[request.action](connection, request)

    def _answering(self, connection: Connection, request: Request) -> Done:
        def done(values: Mapping[str, Any], error: RequestError | None) -> None:
            if error is None:
                answer = reply(request, **values)
            else:
                message = {"action": request.action, **({"id": request.id} if request.has_id else {})}
                answer = error_reply(message, error.code, str(error), **error.extra)
            self._hub.answer(connection, answer)

        return done

    def _start_change(self, number: int, steps: Steps[Mapping[str, Any]], done: Done) -> None:
        self._check_unchanging(number)
        self._jobs.start(number, steps, done, changes=True)

    def _check_unchanging(self, number: int) -> None:
        if self._jobs.is_changing(number) or self._recovery.sensors[number].is_changing:
            raise RequestError(
                ErrorCode.BUSY, f"sensor {number} is being configured or tared: try again when that is done"
            )

    def _sdo_read(self, connection: Connection, request: Request) -> None:
        values = request.values
        sdo = self._recovery.sensors[values["sensor"]].sdo
        if (values["index"] is None) == (values["name"] is None):
            raise RequestError(
                ErrorCode.BAD_REQUEST, "sdo_read needs either the key 'index' or the key 'name'"
            )
        if values["name"] is not None and values["subindex"] is not None:
            raise RequestError(
                ErrorCode.BAD_REQUEST,
                "the key 'subindex' requires the key 'index': a name includes it",
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
        if values["index"] == dictionary.FACTORY_CALIBRATION:
            raise RequestError(
                ErrorCode.DENIED, "object 0x2000 is the factory calibration, which is never written"
            )
        sensor = self.sensors[values["sensor"]]
        sdo = self._recovery.sensors[sensor.number].sdo
        data = bytes_to_write(values)

        def steps() -> Steps[Mapping[str, Any]]:
            before, index, subindex = sensor.settings, values["index"], values["subindex"]
            written = yield from write(sdo, sensor, index, subindex, data, self._announce_offset)
            if sensor.settings != before:
                self._announce_change(sensor)
            return written

        self._jobs.start(sensor.number, steps(), self._answering(connection, request))

    def _tare(self, connection: Connection, request: Request) -> None:
        values = request.values
        sensor = self.sensors[values["sensor"]]
        stream, sdo = self._streams[sensor.number], self._recovery.sensors[sensor.number].sdo
        samples, target = values["samples"], values["target"]
        steps = tare(sdo, sensor, stream, samples, target, self._announce_offset)
        self._start_change(sensor.number, steps, self._answering(connection, request))

    def _configure(self, connection: Connection, request: Request) -> None:
        number, save_too = request.values["sensor"], request.values["save"]
        done, sensor = self._answering(connection, request), self.sensors[number]
        try:
            change = Change(sensor, request.values["settings"])
        except SettingError as error:
            raise RequestError(ErrorCode.BAD_REQUEST, f"the key 'settings' is refused: {error}") from None
        if not change.needs_preop:
            self._start_change(number, self._change_in_op(sensor, change, save_too), done)
            return

        def changed(error: BusError | None) -> None:
            if error is not None:
                done({}, refusal(error))
                return
            try:
                self._start_change(number, self._finish_change(sensor, save_too), done)
            except RequestError as refused:
                done({}, refused)

        self._recovery.sensors[number].reconfigure(change, changed)

    def _change_in_op(self, sensor: Sensor, change: Change, save_too: bool) -> Steps[Mapping[str, Any]]:
        sdo = self._recovery.sensors[sensor.number].sdo
        yield from apply_in_op(sdo, sensor, change)
        if change.names:
            self._announce_change(sensor)
        return (yield from self._finish_change(sensor, save_too))

    def _announce_change(self, sensor: Sensor) -> None:
        self._streams[sensor.number].drift.begin("change")
        self._hub.broadcast(event(Event.RECONFIGURED, sensor=sensor.number, **sensor.as_message()))

    def _announce_offset(self, sensor: Sensor) -> None:
        if sensor.offset_is_certain:
            self._streams[sensor.number].drift.begin("tare")
        self._hub.broadcast(event(Event.OFFSET_CHANGED, sensor=sensor.number, offset=sensor.reported_offset))

    def _finish_change(self, sensor: Sensor, save_too: bool) -> Steps[Mapping[str, Any]]:
        if save_too:
            yield from save(self._recovery.sensors[sensor.number].sdo, sensor)
        return {"sensor": sensor.number, **sensor.as_message(), "saved": save_too}
