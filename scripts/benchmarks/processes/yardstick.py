"""The floor of this machine: a bare pysoem exchange, a bare message over loopback TCP. Nothing else.

Both loops wake at absolute deadlines and do the one thing.
"""

from __future__ import annotations

import argparse
import socket
import struct
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from scripts.benchmarks.records import connect, sleep_until, steady, write
from scripts.demonstration.child import DemoError

_WARM_UP_S: Final = 0.3
_SIZE: Final = 94
"""A DATA message with 61 bytes of process data."""
_MESSAGE: Final = struct.Struct(f">Q{_SIZE - 8}x")
_OP_ATTEMPTS: Final = 500


def operational_master(ifname: str) -> Any:
    """The least that pysoem needs to bring the virtual sensors to OP."""
    import pysoem  # noqa: PLC0415 - the message programs do without

    master = pysoem.Master()
    master.open(ifname)
    if master.config_init() <= 0:
        raise DemoError(f"no sensor answers on {ifname}")
    master.config_map()
    master.state_check(pysoem.SAFEOP_STATE, 50_000)
    master.state = pysoem.OP_STATE
    master.write_state()
    for _ in range(_OP_ATTEMPTS):
        master.send_processdata()
        master.receive_processdata(2000)
        if master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE:
            return master
    raise DemoError(f"the sensor on {ifname} does not reach OP")


def exchange(arguments: argparse.Namespace) -> None:
    """Writes (wake-up lateness, send and receive) pairs in ns."""
    master = operational_master(arguments.ifname)
    steady(arguments.priority)
    period_ns = int(1e9 / arguments.rate)
    figures = array("q")
    due = time.monotonic_ns()
    warm, end = due + int(_WARM_UP_S * 1e9), due + int((_WARM_UP_S + arguments.seconds) * 1e9)
    while due < end:
        woke = sleep_until(due)
        master.send_processdata()
        master.receive_processdata(period_ns // 1000)
        back = time.monotonic_ns()
        if due > warm:
            figures.extend((woke - due, back - woke))
        due += period_ns * (1 + max(0, back - due) // period_ns)
    master.close()
    write(arguments.path, figures)


def send(arguments: argparse.Namespace) -> None:
    """Sends a message with the time in it, `sensors` of them at each deadline."""
    with socket.create_server(("127.0.0.1", arguments.port)) as listener:
        receiver, _ = listener.accept()
    receiver.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    steady(arguments.priority)
    period_ns = int(1e9 / arguments.rate)
    due = time.monotonic_ns()
    end = due + int((_WARM_UP_S + arguments.seconds) * 1e9)
    with receiver:
        while due < end:
            sleep_until(due)
            for _ in range(arguments.sensors):
                receiver.send(_MESSAGE.pack(time.monotonic_ns()))
            due += period_ns
    write(arguments.path, array("q"))


def receive(arguments: argparse.Namespace) -> None:
    """Writes how long each message took, in ns. Scheduled as any client is."""
    figures = array("q")
    first = 0
    with connect(arguments.port) as connection:
        rest = b""
        while data := connection.recv(65536):
            now = time.monotonic_ns()
            first = first or now
            data = rest + data
            whole = len(data) // _SIZE * _SIZE
            rest = data[whole:]
            if now - first > _WARM_UP_S * 1e9:
                figures.extend(now - sent for (sent,) in _MESSAGE.iter_unpack(data[:whole]))
    write(arguments.path, figures)


def main() -> None:
    """Run one of the parts."""
    parser = argparse.ArgumentParser()
    programs = parser.add_subparsers(required=True)
    parts: tuple[Callable[[argparse.Namespace], None], ...] = (exchange, send, receive)
    for part in parts:
        program = programs.add_parser(part.__name__)
        program.set_defaults(run=part)
        program.add_argument("path", type=Path)
        if part is not exchange:
            program.add_argument("--port", type=int, required=True)
        if part is not receive:
            program.add_argument("--rate", type=float, required=True)
            program.add_argument("--seconds", type=float, required=True)
            program.add_argument("--priority", type=int, default=0)
    programs.choices["exchange"].add_argument("--ifname", required=True)
    programs.choices["send"].add_argument("--sensors", type=int, default=1)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
