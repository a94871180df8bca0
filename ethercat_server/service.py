"""What a service needs beside its loop: readiness, a status line, its configuration read again.

SIGHUP reads command line and file again in a thread of its own, because names of users may have to be asked
for over the network; the loop takes the result over within a second.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from typing import Final

from ethercat_server.authority import controlling_uids
from ethercat_server.connection import Limits
from ethercat_server.errors import UsageError
from ethercat_server.hub import Hub
from ethercat_server.notify import Notifier
from ethercat_server.options import ServerOptions, parse_options
from ethercat_server.sensor import Sensor
from ethercat_server.sensor_actions import SensorActions
from ethercat_server.server_settings import SERVER_SETTINGS
from protocol.errors import RequestError
from protocol.settings import SettingValue

log = logging.getLogger(__name__)

_NANO: Final = 1e9


class Policy:
    """What of the options is in force at once, names looked up; UsageError if there is no such name."""

    def __init__(self, options: ServerOptions) -> None:
        server = options.server
        self.options = options
        self.control_uids = controlling_uids(server["control_users"], server["control_groups"])
        self.limits = Limits(server["stall_timeout_s"] * _NANO, server["idle_timeout_s"] * _NANO)

    def apply(self, hub: Hub) -> None:
        """Put it in force."""
        hub.door.control_uids = self.control_uids
        hub.limits = self.limits


class Service:
    """One running server, as systemd and its administrator see it."""

    def __init__(
        self,
        argv: Sequence[str] | None,
        policy: Policy,
        hub: Hub,
        on_sensors: SensorActions,
        notifier: Notifier,
    ) -> None:
        self._argv = argv
        self._policy = policy
        self._hub = hub
        self._on_sensors = on_sensors
        self._notifier = notifier
        self._fresh: Policy | UsageError | None = None
        self._reading: threading.Thread | None = None
        self._again = False
        self._pending: list[dict[str, SettingValue]] = [{} for _ in on_sensors.sensors]
        """By place: what a reload asked for that is not in force; the next one tries again."""

    def ready(self) -> None:
        """The server streams."""
        self._notifier.ready()
        self._tell_status()

    def reload(self) -> None:
        """SIGHUP: read the configuration again."""
        self._again = True

    def every_second(self) -> None:
        """The loop's spare moment: take over what was read, tell how things are."""
        if self._again and self._reading is None:
            self._again = False
            self._reading = threading.Thread(target=self._read, daemon=True)
            self._reading.start()
        elif self._reading is not None and not self._reading.is_alive():
            self._reading = None
            self._take_over()
        self._tell_status()

    def _read(self) -> None:
        try:
            self._fresh = Policy(parse_options(self._argv))
        except UsageError as error:
            self._fresh = error

    def _take_over(self) -> None:
        fresh, self._fresh = self._fresh, None
        try:
            if not isinstance(fresh, Policy):
                raise fresh or UsageError("it could not be read")
            changes = [self._changes(sensor, fresh.options) for sensor in self._on_sensors.sensors]
        except UsageError as error:
            log.error("the configuration stays as it was: %s", error)
            return
        was, now = self._policy.options, fresh.options
        fresh.apply(self._hub)
        self._policy = fresh
        changed = [name for name in SERVER_SETTINGS if was.server[name] != now.server[name]]
        later = [f"[server] {name}" for name in changed if not SERVER_SETTINGS[name].at_once]
        at_once = [name for name in changed if SERVER_SETTINGS[name].at_once]
        log.info(
            "configuration read again: [server]: %s",
            f"changed {', '.join(at_once)}" if at_once else "nothing new",
        )
        if later:
            log.warning("a change of %s takes effect at the next start", ", ".join(later))
        try:
            now.check_sensors({sensor.place: sensor.identity for sensor in self._on_sensors.sensors})
        except UsageError as error:
            log.warning("%s", error)  # it is no reason to keep the rest from the sensors that are there
        for place, settings in enumerate(changes):
            self._configure(place, settings)

    def _changes(self, sensor: Sensor, now: ServerOptions) -> dict[str, SettingValue]:
        """What is to be changed of this sensor; UsageError if `now` contradicts itself."""
        who = (sensor.place, sensor.identity.name, sensor.identity.serial)
        before, pending = self._policy.options.wanted_settings(*who), self._pending[sensor.place]
        wanted = now.wanted_settings(*who)
        return {n: value for n, value in wanted.items() if n in pending or before.get(n) != value}

    def _configure(self, place: int, changed: dict[str, SettingValue]) -> None:
        if not changed:
            return
        names = ", ".join(f"{name} = {value}" for name, value in changed.items())
        pending = self._pending[place]
        pending.update(changed)

        def done(_: object, error: RequestError | None) -> None:
            if error is not None:
                log.error(
                    "sensor %d does not have %s, which the next reload tries again: %s", place, names, error
                )
                return
            log.info("sensor %d now has %s", place, names)
            for name, value in changed.items():
                if pending.get(name) == value:  # no later reload asked for another meanwhile
                    del pending[name]

        try:
            self._on_sensors.configure(place, changed, save_too=False, done=done)
        except RequestError as error:
            done(None, error)

    def _tell_status(self) -> None:
        sensors = self._on_sensors.sensors
        lost = [sensor.place for sensor in sensors if sensor.state != "OP"]
        text = f"streaming {len(sensors) - len(lost)} of {len(sensors)} sensors"
        if lost:
            text += f", lost: {', '.join(map(str, lost))}"
        self._notifier.status(f"{text}; {len(self._hub.connections)} clients")
