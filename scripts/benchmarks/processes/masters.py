"""Becomes the C program of yardstick.c, with which the server is compared, for one client.

Arguments: IFACE RATE_HZ PROGRAM PRIORITY. pysoem brings the sensors to OP.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

from ethercat_server.ethercat.soem import packet_sockets
from scripts.benchmarks.records import PORT
from scripts.chain import ScriptError

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


def main(ifname: str, rate_hz: str, program: str, priority: str) -> None:
    """Wait for the client, bring the sensors to OP, hand both over to the C program."""
    with socket.create_server(("127.0.0.1", PORT)) as listener:
        client, _ = listener.accept()
    master = operational_master(ifname)
    (raw,) = packet_sockets()
    for descriptor in (raw, client.fileno()):
        os.set_inheritable(descriptor, True)
    outputs = sum(len(slave.output) for slave in master.slaves)
    numbers = (raw, client.fileno(), rate_hz, priority, outputs, len(master.slaves))
    os.execv(program, [program, "master", *map(str, numbers)])  # noqa: S606 - built here


if __name__ == "__main__":
    main(*sys.argv[1:])
