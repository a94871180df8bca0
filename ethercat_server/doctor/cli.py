"""`ethercat-doctor`: the command line; the exit code follows from the worst finding."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from bota_ethercat.health.limits import Level
from bota_ethercat.program import server_choice
from bota_ethercat.program.arguments import Parser, number
from bota_ethercat.program.output import ends_with_its_reader
from bota_ethercat.program.version import VERSION
from bota_ethercat.text.untrusted import visible
from ethercat_server.access.adapters import find_holder, is_elsewhere, server_here
from ethercat_server.daemon.options import SERVER_SETTINGS, VIRTUAL_INTERFACE
from ethercat_server.doctor import trace
from ethercat_server.doctor.bus_checks import examine_bus
from ethercat_server.doctor.machine import Host
from ethercat_server.doctor.machine_checks import examine_machine
from ethercat_server.doctor.report import CannotLookError, CheckResult, Report, as_json, worst
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.ethercat.nic import ALLOW_IP, ALLOW_IP_HELP, name_trouble, own_name
from ethercat_server.process import command_line
from ethercat_server.virtual_sensor.virtual_bus import VirtualBus

_PROGRAM: Final = "ethercat-doctor"
_EXIT_CODES: Final = "exit codes: 0 good or worth a look, 1 trouble, failed or stopped, 2 wrong arguments"
_LONGEST_S: Final = 3600.0


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = Parser(
        _PROGRAM,
        "Diagnoses latency and lost samples: kernel, processors, network card, other software, "
        "bus; then measures. Read-only. Run as root for a complete report.",
        _EXIT_CODES,
    )
    parser.add_argument(
        "iface", metavar="IFACE", nargs="?",
        help="interface the sensors are connected to ('virtual' for a virtual sensor); by default that of "
        f"the server {server_choice.HELP}; a FILE{trace.SUFFIX} is shown",
    )  # fmt: skip
    parser.add_argument(
        "--seconds", type=number(0, _LONGEST_S), default=10.0, metavar="N",
        help="duration of the measurement (default 10; 0: none)",
    )  # fmt: skip
    for name in ("rt_priority", "cpu"):
        setting = SERVER_SETTINGS[name]
        parser.add_argument(
            setting.flag, dest=name, type=setting.parse_argument, metavar=setting.metavar,
            default=setting.default, help=f"measure like a server with this option: {setting.meaning}",
        )  # fmt: skip
    parser.add_argument(ALLOW_IP, action="store_true", help=ALLOW_IP_HELP)
    parser.add_argument(
        "--trace", type=Path, metavar="FILE",
        help="only write a trace of the server's last minute to FILE: which samples were late or lost",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    return parser


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    """Run the doctor; returns the exit code. argparse exits with 2."""
    command_line.begin(_PROGRAM)
    # Missing privileges are a finding.
    logging.getLogger("ethercat_server.process.realtime").setLevel(logging.ERROR)
    args = build_parser().parse_args(argv)
    return command_line.run(_PROGRAM, lambda: _run(args), as_json=args.json)


def _run(args: argparse.Namespace) -> int:
    if args.trace is not None:
        print(trace.save(args.trace))
        return 0
    if args.iface is not None and args.iface.endswith(trace.SUFFIX):
        print(*trace.show(Path(args.iface)), sep="\n")
        return 0
    if args.iface is None:
        try:
            _, args.iface = server_here()
        except ServerError as error:
            raise UsageError(f"{error}: name the interface, or start ethercat-server on it") from None
    if problem := name_trouble(args.iface):
        raise UsageError(problem)
    args.iface = own_name(args.iface)
    last = (os.cpu_count() or 1) - 1
    if args.cpu is not None and args.cpu > last:
        raise UsageError(f"--cpu {args.cpu}: this machine has the processors 0 to {last}")
    header = {"interface": args.iface, "version": VERSION, "time": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
    header |= {"kernel": os.uname().release, "root": os.geteuid() == 0, "seconds": args.seconds}
    if args.json:
        findings = list(_examined(args, lambda _: None))
        print(as_json(header, findings))
    else:
        report, findings = Report(), []
        who = "as root" if header["root"] else "not as root"
        report.say(visible(f"{_PROGRAM} {VERSION} on {args.iface}: Linux {header['kernel']}, {who}") + "\n")
        for finding in _examined(args, report.wait):
            findings.append(finding)
            report.write(finding)
        report.summary(findings)
    return command_line.FAILED if worst(findings) is Level.TROUBLE else 0


def _examined(args: argparse.Namespace, announce: Callable[[str], None]) -> Iterator[CheckResult]:
    """What is found on this machine and the interface; on a virtual bus for `virtual`."""
    machine = Host(args.iface, args.iface, rt_priority=args.rt_priority, cpu=args.cpu, allow_ip=args.allow_ip)
    with contextlib.ExitStack() as cleanup:
        if is_elsewhere(args.iface) and find_holder(args.iface) is not None:
            machine.facts["link"] = CannotLookError("it is in a network namespace of its server's own")
        if args.iface == VIRTUAL_INTERFACE:
            try:
                machine.ifname = cleanup.enter_context(VirtualBus("", args.rt_priority)).ifname
            except ServerError as error:
                machine.facts["link"] = CannotLookError(f"there is no virtual bus: {error}")
        yield from examine_machine(machine)
        yield from examine_bus(machine, args.seconds, announce)


if __name__ == "__main__":
    sys.exit(main())
