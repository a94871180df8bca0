"""The service manager's side of the server: readiness, status line, watchdog, reload.

SIGHUP reads command line and file again in a thread, because looking up user names can require a directory
server; the loop applies the result within a second.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
from collections.abc import Sequence
from typing import Final

from bota_ethercat.errors import RequestError
from bota_ethercat.settings import SettingValue
from ethercat_server.daemon.options import SERVER_SETTINGS, ServerOptions, parse_options
from ethercat_server.errors import UsageError
from ethercat_server.process import realtime
from ethercat_server.sensor.sensor import Sensor
from ethercat_server.server import Server
from ethercat_server.serving.connection import Limits
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.permissions import controlling_uids, local_names

log = logging.getLogger(__name__)

_NANO: Final = 1e9
_NEVER_NS: Final = 1 << 62


class Notifier:
    """The service manager's socket (sd_notify(3)); sending never blocks and never fails.

    Without systemd it does nothing.
    """

    def __init__(self) -> None:
        name = os.environ.pop("NOTIFY_SOCKET", "")
        self._status = ""
        self._socket: socket.socket | None = None
        self.feed_every_ns = _watchdog_ns() // 3  # a third of the watchdog's timeout
        if name:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            with contextlib.suppress(OSError):
                # A name that starts with @ is in the abstract namespace.
                self._socket.connect("\0" + name[1:] if name.startswith("@") else name)

    def feed(self) -> None:
        """The acquisition loop is running."""
        self.send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`; sent only if it has changed."""
        if text != self._status:
            self._status = text
            self.send(f"STATUS={text}")

    def send(self, text: str) -> None:
        """A state such as READY=1."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(text.encode())


def _watchdog_ns() -> int:
    """Timeout of the watchdog."""
    microseconds, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not microseconds.isdecimal() or process not in {"", str(os.getpid())}:
        return _NEVER_NS
    return int(microseconds) * 1000


class Policy:
    """The options that a reload applies, with user names looked up; UsageError if there is no such name."""

    def __init__(self, options: ServerOptions) -> None:
        server = options.server
        self.options = options
        self.control_uids = controlling_uids(server["control_users"], server["control_groups"])
        self.names = local_names()
        self.limits = Limits(server["stall_timeout_s"] * _NANO, server["idle_timeout_s"] * _NANO)

    def apply(self, hub: Hub) -> None:
        """Apply it."""
        hub.permissions.control_uids = self.control_uids | {os.geteuid()}
        hub.permissions.names = self.names
        hub.limits = self.limits


class Service:
    """The running server as systemd and its administrator see it."""

    def __init__(
        self, argv: Sequence[str] | None, policy: Policy, server: Server, notifier: Notifier
    ) -> None:
        self._argv, self._policy = argv, policy
        self._server, self._notifier = server, notifier
        self._fresh: Policy | UsageError | None = None
        self._reading: threading.Thread | None = None
        self._again = False
        # By number: settings that a reload could not apply; the next one tries again.
        self._pending: list[dict[str, SettingValue]] = [{} for _ in server.sensors]

    def ready(self) -> None:
        """The server streams."""
        self._notifier.send("READY=1")
        self._update_status()

    def reload(self) -> None:
        """SIGHUP: read the configuration again."""
        self._again = True

    def every_second(self) -> None:
        """Apply a configuration that has been read; update the status line."""
        if self._again and self._reading is None:
            self._again = False
            self._reading = threading.Thread(target=self._read, daemon=True)
            self._reading.start()
        elif self._reading is not None and not self._reading.is_alive():
            self._reading = None
            self._take_over()
        self._update_status()

    def _read(self) -> None:
        realtime.leave()
        try:
            self._fresh = Policy(parse_options(self._argv))
        except UsageError as error:
            self._fresh = error

    def _take_over(self) -> None:
        fresh, self._fresh = self._fresh, None
        try:
            if not isinstance(fresh, Policy):
                raise fresh or UsageError("it cannot be read")
            changes = [self._changes(sensor, fresh.options) for sensor in self._server.sensors]
        except UsageError as error:
            log.error("reload failed, the configuration is unchanged: %s", error)
            return
        was, now = self._policy.options, fresh.options
        fresh.apply(self._server.hub)
        self._policy = fresh
        changed = [name for name in SERVER_SETTINGS if was.server[name] != now.server[name]]
        later = [f"[server] {name}" for name in changed if not SERVER_SETTINGS[name].at_once]
        at_once = [name for name in changed if SERVER_SETTINGS[name].at_once]
        told = f"changed {', '.join(at_once)}" if at_once else "no changes"
        log.info("configuration reloaded: [server]: %s", told)
        if later:
            log.warning("a change of %s requires a restart", ", ".join(later))
        try:
            now.check_sensors({sensor.number: sensor.identity for sensor in self._server.sensors})
        except UsageError as error:
            log.warning("%s", error)  # the other sensors get their settings
        for number, settings in enumerate(changes):
            self._configure(number, settings)

    def _changes(self, sensor: Sensor, now: ServerOptions) -> dict[str, SettingValue]:
        """The settings of this sensor that change; UsageError if `now` is inconsistent."""
        who = (sensor.number, sensor.identity.name, sensor.identity.serial)
        before, pending = self._policy.options.wanted_settings(*who), self._pending[sensor.number]
        wanted = now.wanted_settings(*who)
        return {n: value for n, value in wanted.items() if n in pending or before.get(n) != value}

    def _configure(self, number: int, changed: dict[str, SettingValue]) -> None:
        if not changed:
            return
        names = ", ".join(f"{name} = {value}" for name, value in changed.items())
        pending = self._pending[number]
        pending.update(changed)

        def done(_: object, error: RequestError | None) -> None:
            if error is not None:
                log.error(
                    "sensor %d: could not apply %s, the next reload tries again: %s", number, names, error
                )
                return
            log.info("sensor %d: applied %s", number, names)
            for name, value in changed.items():
                if pending.get(name) == value:  # unless a later reload set another value
                    del pending[name]

        try:
            self._server.actions.configure(number, changed, save_too=False, done=done)
        except RequestError as error:
            done(None, error)

    def _update_status(self) -> None:
        sensors = self._server.sensors
        lost = [sensor.number for sensor in sensors if not sensor.streams]
        text = f"streaming {len(sensors) - len(lost)} of {len(sensors)} sensors"
        if lost:
            text += f", lost: {', '.join(map(str, lost))}"
        self._notifier.status(f"{text}; {len(self._server.hub.connections)} clients")
