"""A virtual EtherCAT bus: a veth pair, with a virtual sensor in a process of its own on the far end.

The sensor's process creates the pair in its own network namespace and moves the near end into the server's.
However the processes end, the kernel removes the namespace and the pair. Without CAP_SYS_ADMIN both ends
are created in the server's namespace and deleted at the end; without CAP_NET_ADMIN in a user and a network
namespace of the sensor's, which the server enters: its TCP sockets, opened before, stay where they are.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from bota_ethercat.program.real_time import HIGHEST_PRIORITY, make_real_time
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.nic import missing_capabilities
from ethercat_server.process.privileges import become, user_to_become

_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000
_START_TIMEOUT_S: Final = 20.0
_GONE_TIMEOUT_S: Final = 3.0
_USAGE_EXIT_CODE: Final = 2
_FAR_END: Final = "sensor"
_LIBC: Final = ctypes.CDLL(None, use_errno=True)


class VirtualBus:
    """Brings a virtual bus up and down; `ifname` is the end for the master."""

    def __init__(
        self, arguments: str = "", master_priority: int = 0, user: str | None = None, number: int = 0
    ) -> None:
        """`arguments` are `ethercat-virtual-sensor`'s own options, as on a command line.

        The sensor gets a real-time priority above `master_priority`: real sensors do not wait for a CPU. Once
        its interface is open its process becomes `user`, or who ran sudo, as the master does, which could not
        end it otherwise. The default serial numbers go by `number`, unless it is 0.
        """
        self._priority = min(HIGHEST_PRIORITY, master_priority + 1) if master_priority else 0
        self.ifname = f"ecat{os.getpid()}"
        self._arguments = shlex.split(arguments)
        self._user = user or ""
        self._number = number
        self._process: subprocess.Popen[str] | None = None

    @property
    def pid(self) -> int:
        return self._process.pid if self._process else 0

    def start(self) -> None:
        """Start the sensor's process, without waiting for it; UsageError if there is no such user."""
        user_to_become(self._user or None)  # else its process would say so, too
        command = [sys.executable, "-P", "-m", "ethercat_server.virtual_sensor.virtual_bus"]
        command += [self.ifname, str(self._priority), self._user, str(self._number), *self._arguments]
        # A session of its own: Ctrl-C is for the server, which then ends the sensor. Its standard input
        # closes when this process ends, in any way, and ends it too.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )

    def __enter__(self) -> VirtualBus:
        """Wait until the sensor's process answers, started now if need be; ServerError if it does not."""
        if self._process is None:
            self.start()
        assert self._process is not None
        assert self._process.stdout is not None
        poller = select.poll()
        poller.register(self._process.stdout, select.POLLIN)
        ready = poller.poll(1000 * _START_TIMEOUT_S)
        if not ready or not self._process.stdout.readline():
            if ready:  # its standard output has ended, and it is about to
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(_START_TIMEOUT_S)
            code = self._process.poll()
            self.end()
            raise ServerError(_why_not_started(code))
        self._enter_namespaces()
        return self

    def _enter_namespaces(self) -> None:
        """Those of the sensor, if it has a user namespace of its own."""
        own, theirs = Path("/proc/self/ns"), Path(f"/proc/{self.pid}/ns")
        if (own / "user").readlink() == (theirs / "user").readlink():
            return
        with (theirs / "user").open() as user, (theirs / "net").open() as network:
            if any(_LIBC.setns(file.fileno(), 0) for file in (user, network)):
                why = os.strerror(ctypes.get_errno())
                self.end()
                raise ServerError(f"cannot enter the namespaces of the virtual sensor ({why}): use root")

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """End the sensor's process, if it runs."""
        process, self._process = self._process, None
        if process is None:
            return
        try:
            process.communicate(timeout=_GONE_TIMEOUT_S)  # its standard input ends
        except subprocess.TimeoutExpired:
            with contextlib.suppress(PermissionError, subprocess.TimeoutExpired):
                process.kill()
                process.communicate(timeout=_GONE_TIMEOUT_S)
        # The kernel removes a namespace a moment after its last process.
        deadline = time.monotonic() + _GONE_TIMEOUT_S
        while time.monotonic() < deadline and self.ifname in {name for _, name in socket.if_nameindex()}:
            time.sleep(0.01)


def _why_not_started(code: int | None) -> str:
    """A sentence; `code` is that of its process, None if that goes on."""
    what = "the virtual sensor did not start"
    if code is None:
        return f"{what} within {_START_TIMEOUT_S:g} s: this computer is too busy, start it again later"
    if code < 0:
        return f"{what}: its process was ended by {signal.Signals(-code).name}, start it again"
    text = f"{what} (exit code {code}): see its message above"
    rights = "; it needs root, or a kernel with user namespaces"
    return text + rights if code != _USAGE_EXIT_CODE and missing_capabilities() else text


def _enter_own_namespaces() -> None:
    """Have every capability in a user and a network namespace, as the same user; OSError."""
    ids = {"uid": os.geteuid(), "gid": os.getegid()}
    if _LIBC.unshare(_CLONE_NEWUSER | _CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
    for kind, number in ids.items():
        Path(f"/proc/self/{kind}_map").write_text(f"{number} {number} 1", encoding="ascii")


@contextlib.contextmanager
def veth_pair(near: str, *, apart: bool) -> Iterator[str]:
    """Create the pair and bring it up; yields the name of the far end, in this process's namespace.

    `apart`: if possible that is another one than the near end's.
    """
    from pyroute2 import IPRoute  # noqa: PLC0415 - only this process needs it

    with open("/proc/self/ns/net", "rb") as namespace, IPRoute() as outer:  # noqa: PTH123
        own_namespace = apart and _LIBC.unshare(_CLONE_NEWNET) == 0
        far = _FAR_END if own_namespace else f"{near[:14]}s"
        with IPRoute() as inner:
            peer = {"ifname": near, "net_ns_fd": namespace.fileno()} if own_namespace else {"ifname": near}
            inner.link("add", ifname=far, kind="veth", peer=peer)
            try:
                for route, name in ((inner, far), (outer, near)):
                    route.link("set", index=route.link_lookup(ifname=name)[0], state="up")
                yield far
            finally:
                # This process may have given up the right to; the kernel does it with its own namespace.
                for index in () if own_namespace else inner.link_lookup(ifname=far):
                    inner.link("del", index=index)


def main(argv: Sequence[str]) -> int:
    """The sensor's process: near end's name, priority, user or "", number, the sensor's options."""
    if unprivileged := bool(missing_capabilities()):
        with contextlib.suppress(OSError):  # said when the pair cannot be created
            _enter_own_namespaces()
    from pyroute2.netlink.exceptions import NetlinkError  # noqa: PLC0415 - only this process needs it

    from ethercat_server.virtual_sensor import cli  # noqa: PLC0415 - likewise

    near, priority, user, number, *arguments = argv
    with contextlib.ExitStack() as made:
        try:
            far = made.enter_context(veth_pair(near, apart=not unprivileged))
        except (OSError, NetlinkError) as error:
            why = os.strerror(error.code) if isinstance(error, NetlinkError) else error.strerror or error
            sys.stderr.write(f"ethercat-virtual-sensor: cannot create a veth pair: {why}\n")
            return 1

        def opened() -> None:
            make_real_time(
                int(priority), keeps_rights=False
            )  # the master says what it was not granted itself
            # Deleting an interface in the server's namespace takes rights.
            if far == _FAR_END and (found := user_to_become(user or None)):
                become(found)

        try:
            return cli.main([far, "--exit-on-eof", *arguments], opened, int(number))
        except ServerError as error:
            sys.stderr.write(f"ethercat-virtual-sensor: {error}\n")
            return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
