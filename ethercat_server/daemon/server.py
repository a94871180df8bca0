"""One run of the server: start-up, acquisition loop, shutdown; what the service manager is told of it."""

from __future__ import annotations

import contextlib
import gc
import ipaddress
import logging
import os
import socket
from functools import partial
from typing import TYPE_CHECKING, Final

from bota_ethercat.program.signals import Signals
from ethercat_server.daemon.histories import kept
from ethercat_server.daemon.loss_traces import LossTraces
from ethercat_server.daemon.options import ServerOptions
from ethercat_server.errors import StopRequestedError
from ethercat_server.ethercat.nic import check_unused
from ethercat_server.ethercat.soem import open_bus
from ethercat_server.process import realtime
from ethercat_server.process.privileges import User, become, forbid_new_privileges, user_to_become
from ethercat_server.server import Server
from ethercat_server.serving.connection import Timeouts
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.permissions import Permissions
from ethercat_server.serving.transport import SocketTransport

if TYPE_CHECKING:
    from ethercat_server.virtual_sensor.virtual_bus import VirtualBus

_NEVER_NS: Final = 1 << 62

log = logging.getLogger(__name__)


def serve(options: ServerOptions, signals: Signals, virtual: VirtualBus | None = None) -> None:
    """Start up, stream until asked to stop, shut down; ServerError says what failed.

    On the bus `virtual`, if there is one, in place of the interface of the options.
    """
    user = user_to_become(options.server["user"])
    if user is not None:
        forbid_new_privileges()  # before the log's thread starts
    permissions = Permissions(
        options.server["control_users"], options.server["control_groups"], user and user.uid
    )
    notifier = SystemdNotifier()
    with contextlib.ExitStack() as cleanup:
        if virtual is None:  # whoever has it may have the port, too, and another port would not help
            check_unused(options.ifname)
        hub = Hub(SocketTransport(options.server["hosts"], options.port))
        hub.permissions = permissions
        cleanup.callback(hub.close)
        ifname, priority = options.ifname, options.server["rt_priority"]
        if virtual is not None:
            ifname = cleanup.enter_context(virtual).ifname
        bus = cleanup.enter_context(open_bus(ifname, allow_ip=options.allow_ip))
        realtime.prepare(priority, options.server["cpu"], becomes_user=user is not None)
        _give_up_root(user, options)
        hub.timeouts = Timeouts(
            *(options.server[name] * 1e9 for name in ("stall_timeout_s", "idle_timeout_s"))
        )

        def check_interrupt() -> None:
            if signals.asked:
                raise StopRequestedError("stopped during start-up")

        server = Server(bus, hub, options, check_interrupt, watchdog=notifier)
        server.cycle.every_second = partial(every_second, server, notifier, LossTraces(server))
        signals.call(server.stop)
        for sensor in server.sensors:
            log.info(
                "sensor %d: %s, serial %d, firmware %s, %d bytes at %d Hz",
                sensor.number, sensor.identity.name, sensor.identity.serial, sensor.identity.firmware,
                sensor.pdo_size, sensor.rate_hz,
            )  # fmt: skip
        for host in options.server["hosts"]:
            if not ipaddress.ip_address(host).is_loopback:
                log.warning("listening on %s: every machine that can reach it may read the sensors", host)
        log.info("streaming %s on port %d", bus.ifname, options.port)
        notifier.send("READY=1")
        notifier.update(server)
        try:
            with kept([stream.drift for stream in server.streams]):
                server.run()
        finally:
            notifier.send("STOPPING=1")
        log.info("shutting down: the sensors go to INIT")


def every_second(server: Server, notifier: SystemdNotifier, traces: LossTraces) -> None:
    """What the loop has done once a second.

    Nothing should be left in reference cycles. For what is all the same, a look at what was made since the
    last one takes 20 to 40 µs, and sets a limit to the memory of a server that runs for months.
    """
    gc.collect(0)
    notifier.update(server)
    traces.each_second()


def _give_up_root(user: User | None, options: ServerOptions) -> None:
    """Become `user`; what that will hinder is logged now."""
    if user is None:
        if os.geteuid() == 0 and options.server["user"] is None:
            log.warning("running as root: name a user with --user ([server] user), or start it with sudo")
        return
    become(user)
    log.info("running as user %s from here on, without privileges", user)


class SystemdNotifier:
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
        self.send("WATCHDOG=1")

    def update(self, server: Server) -> None:
        """One line for `systemctl status`; sent only if it has changed."""
        sensors = server.sensors
        lost = [sensor.number for sensor in sensors if not sensor.streams]
        text = f"streaming {len(sensors) - len(lost)} of {len(sensors)} sensors"
        if lost:
            text += f", lost: {', '.join(map(str, lost))}"
        text += f"; {len(server.hub.connections)} clients"
        if text != self._status:
            self._status = text
            self.send(f"STATUS={text}")

    def send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(text.encode())


def _watchdog_ns() -> int:
    """Timeout of the watchdog."""
    microseconds, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not microseconds.isdecimal() or process not in {"", str(os.getpid())}:
        return _NEVER_NS
    return int(microseconds) * 1000
