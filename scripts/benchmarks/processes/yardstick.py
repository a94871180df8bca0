"""The yardstick's master: brings the sensors to OP, then becomes the C program of yardstick.c."""

from __future__ import annotations

import argparse
import os
import shutil
import socket
import subprocess
from pathlib import Path
from typing import Any, Final

from ethercat_server.ethercat.raw_socket import packet_sockets
from scripts.benchmarks.chain import ScriptError

_SOURCE: Final = Path(__file__).with_suffix(".c")
_OP_ATTEMPTS: Final = 500


def build(folder: Path) -> Path:
    """The C program, optimized. ScriptError if it cannot be built."""
    if shutil.which("gcc") is None:
        raise ScriptError("there is no C compiler (sudo apt install gcc)")
    program = folder / "yardstick"
    command = ["gcc", "-std=gnu11", "-O2", "-Wall", "-Wextra", str(_SOURCE), "-o", str(program)]
    made = subprocess.run(command, check=False, capture_output=True, text=True)
    if made.returncode:
        raise ScriptError(f"gcc could not build {_SOURCE.name}:\n{made.stderr}")
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


def main() -> None:
    """Wait for the client, bring the sensors to OP, and hand both sockets over."""
    parser = argparse.ArgumentParser()
    parser.add_argument("program", type=Path)
    parser.add_argument("path", type=Path)
    parser.add_argument("--ifname", required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--rate", type=float, required=True)
    parser.add_argument("--priority", type=int, default=0)
    arguments = parser.parse_args()
    with socket.create_server(("127.0.0.1", arguments.port)) as listener:
        client, _ = listener.accept()
    master = operational_master(arguments.ifname)
    (raw,) = packet_sockets()
    for descriptor in (raw, client.fileno()):
        os.set_inheritable(descriptor, True)
    outputs = sum(len(slave.output) for slave in master.slaves)
    numbers = (raw, client.fileno(), arguments.rate, arguments.priority, outputs, len(master.slaves))
    os.execv(  # noqa: S606 - built here
        arguments.program, [str(arguments.program), "master", *map(str, numbers), str(arguments.path)]
    )


if __name__ == "__main__":
    main()
