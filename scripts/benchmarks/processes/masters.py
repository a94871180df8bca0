"""What is compared with the server, one client each: the C program of yardstick.c, the polling design.

Arguments: FILE IFACE RATE_HZ, and for the C program PROGRAM PRIORITY. pysoem brings the sensors to OP. The
polling design exchanges, sends the raw bytes, sleeps for a period; nothing is added but the figures that both
write at SIGTERM: (wake-up lateness, exchange) pairs in ns.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from array import array
from pathlib import Path
from typing import Any, Final

from ethercat_server.ethercat.soem import packet_sockets
from scripts.benchmarks.chain import ScriptError
from scripts.benchmarks.records import PORT, write

_OP_ATTEMPTS: Final = 500


def build(folder: Path) -> Path:
    """The C program, optimized. ScriptError if it cannot be built."""
    if shutil.which("gcc") is None:
        raise ScriptError("there is no C compiler (sudo apt install gcc)")
    source, program = Path(__file__).with_name("yardstick.c"), folder / "yardstick"
    command = ["gcc", "-std=gnu11", "-O2", "-Wall", "-Wextra", str(source), "-o", str(program)]
    made = subprocess.run(command, check=False, capture_output=True, text=True)
    if made.returncode:
        raise ScriptError(f"gcc could not build {source.name}:\n{made.stderr}")
    return program


def operational_master(ifname: str) -> Any:
    """The least that pysoem needs to bring the virtual sensors to OP."""
    import pysoem  # noqa: PLC0415 - whoever builds the program does without

    master = pysoem.Master()
    master.open(ifname)
    if master.config_init() <= 0:
        raise ScriptError(f"no sensor answers on {ifname}")
    master.config_map()
    master.state_check(pysoem.SAFEOP_STATE, 50_000)
    master.state = pysoem.OP_STATE
    master.write_state()
    for _ in range(_OP_ATTEMPTS):
        master.send_processdata()
        master.receive_processdata(2000)
        if master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE:
            return master
    raise ScriptError(f"the sensor on {ifname} does not reach OP")


def become(
    program: str, priority: str, *, path: str, master: Any, client: socket.socket, rate_hz: str
) -> None:
    """Hand the sensors and the client over to the C program."""
    (raw,) = packet_sockets()
    for descriptor in (raw, client.fileno()):
        os.set_inheritable(descriptor, True)
    outputs = sum(len(slave.output) for slave in master.slaves)
    numbers = (raw, client.fileno(), rate_hz, priority, outputs, len(master.slaves))
    os.execv(program, [program, "master", *map(str, numbers), path])  # noqa: S606 - built here


def poll(path: str, master: Any, client: socket.socket, rate_hz: str) -> None:
    """Exchange, send, sleep."""
    stopping: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: stopping.append(number))
    period_s = 1 / float(rate_hz)
    figures = array("q")
    asleep = time.monotonic_ns()
    while not stopping:
        woke = time.monotonic_ns()
        select.select([client], [], [], 0)  # for a shutdown request
        sent = time.monotonic_ns()
        master.send_processdata()
        master.receive_processdata(int(period_s * 1e6))
        figures.extend((woke - asleep - int(period_s * 1e9), time.monotonic_ns() - sent))
        try:
            client.sendall(master.slaves[0].input)
        except ConnectionError:
            break
        asleep = time.monotonic_ns()
        time.sleep(period_s)
    master.close()
    write(Path(path), figures)


def main(path: str, ifname: str, rate_hz: str, *c_program: str) -> None:
    """Wait for the client, bring the sensors to OP, pass samples on."""
    with socket.create_server(("127.0.0.1", PORT)) as listener:
        client, _ = listener.accept()
    master = operational_master(ifname)
    if c_program:
        become(*c_program, path=path, master=master, client=client, rate_hz=rate_hz)
    poll(path, master, client, rate_hz)


if __name__ == "__main__":
    main(*sys.argv[1:])
