"""`ethercat-doctor`: the command line; the exit code follows from the worst finding."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Final

from bota_ethercat.program.completion import add_completion
from ethercat_server import __version__
from ethercat_server.daemon.options import SERVER_SETTINGS, VIRTUAL_INTERFACE
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.ethercat.nic import ALLOW_IP, ALLOW_IP_HELP, MAX_NAME_LENGTH
from ethercat_server.process import command_line

if TYPE_CHECKING:
    from ethercat_server.doctor.finding import Finding
    from ethercat_server.doctor.machine import Machine

_PROGRAM: Final = "ethercat-doctor"
_EXIT_CODES: Final = "exit codes: 0 good or worth a look, 1 trouble, failed or stopped, 2 wrong arguments"
_LONGEST_S: Final = 3600.0


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog=_PROGRAM,
        description="Diagnoses latency and lost samples: kernel, processors, network card, other software, "
        "bus; then measures. Read-only. Run as root for a complete report.",
        epilog=_EXIT_CODES,
    )
    parser.add_argument(
        "iface",
        metavar="IFACE",
        help="interface the sensors are connected to ('virtual' for a virtual sensor)",
    )
    parser.add_argument(
        "--seconds",
        type=_seconds,
        default=10.0,
        metavar="N",
        help="duration of the measurement (default 10; 0: none)",
    )
    for name in ("rt_priority", "cpu"):
        setting = SERVER_SETTINGS[name]
        parser.add_argument(
            setting.flag, dest=name, type=_whole, metavar=setting.metavar, default=setting.default,
            help=f"measure like a server with this option: {setting.meaning}",
        )  # fmt: skip
    parser.add_argument(ALLOW_IP, action="store_true", help=ALLOW_IP_HELP)
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    add_completion(parser)
    return parser


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 <= value <= _LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text} must be from 0 to {_LONGEST_S:.0f} seconds")
    return value


_seconds.__name__ = "number"


def _whole(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number, 0 or more")
    return int(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the doctor; returns the exit code. argparse exits with 2."""
    command_line.begin(_PROGRAM)
    # Missing privileges are a finding.
    logging.getLogger("ethercat_server.process.realtime").setLevel(logging.ERROR)
    args = build_parser().parse_args(argv)
    # KeyboardInterrupt in an import may be lost in Python's own code: load all before there can be one.
    from ethercat_server.doctor import bus_checks, report  # noqa: F401, PLC0415

    return command_line.run(_PROGRAM, lambda: _run(args), as_json=args.json)


def _run(args: argparse.Namespace) -> int:
    from ethercat_server.doctor.report import EXIT_CODES, Report, as_json, worst  # noqa: PLC0415

    _check(args)
    findings: list[Finding] = []
    report = None if args.json else Report()
    header = {"interface": args.iface, "version": __version__, "time": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
    header |= {"kernel": os.uname().release, "root": os.geteuid() == 0, "seconds": args.seconds}
    if report is not None:
        who = "as root" if header["root"] else "not as root"
        report.heading(f"{_PROGRAM} {__version__} on {args.iface}: Linux {header['kernel']}, {who}")
    for finding in _examined(args, report.wait if report is not None else lambda _: None):
        findings.append(finding)
        if report is not None:
            report.write(finding)
    if report is None:
        print(as_json(header, findings))
    else:
        report.summary(findings)
    return EXIT_CODES[worst(findings)]


def _examined(args: argparse.Namespace, announce: Callable[[str], None]) -> Iterator[Finding]:
    from ethercat_server.doctor.bus_checks import Request, examine_bus  # noqa: PLC0415
    from ethercat_server.doctor.machine_checks import examine_machine  # noqa: PLC0415

    with contextlib.ExitStack() as cleanup:
        machine = _machine(args, cleanup)
        yield from examine_machine(machine)
        yield from examine_bus(machine, Request(args.seconds, args.cpu, announce))


def _machine(args: argparse.Namespace, cleanup: contextlib.ExitStack) -> Machine:
    """This machine and the interface; a virtual bus for `virtual`, closed by `cleanup`."""
    from ethercat_server.doctor.bus_checks import check_rights  # noqa: PLC0415
    from ethercat_server.doctor.finding import CannotLookError  # noqa: PLC0415
    from ethercat_server.doctor.machine import (  # noqa: PLC0415
        InterfaceFacts,
        Machine,
        collect,
    )
    from ethercat_server.virtual_sensor.virtual_bus import VirtualBus  # noqa: PLC0415

    resolution = time.clock_getres(time.CLOCK_MONOTONIC)
    own = {"asked": args.iface, "timer_resolution_s": resolution, "rt_priority": args.rt_priority}
    own["allow_ip"] = args.allow_ip
    if args.iface != VIRTUAL_INTERFACE:
        return Machine(args.iface, facts=collect(args.iface), **own)
    machine = Machine(args.iface, **own)
    try:
        check_rights(machine)
        machine.ifname = cleanup.enter_context(VirtualBus("", args.rt_priority)).ifname
        machine.facts = collect(machine.ifname)
    except (CannotLookError, ServerError) as error:
        machine.facts = InterfaceFacts(link=f"there is no virtual bus: {error}")
    return machine


def _check(args: argparse.Namespace) -> None:
    """UsageError for impossible arguments."""
    if not 0 < len(os.fsencode(args.iface)) <= MAX_NAME_LENGTH or "/" in args.iface:
        raise UsageError(
            f"{args.iface!r} is not an interface name: it must have 1 to {MAX_NAME_LENGTH} "
            "characters; "
            "'ethercat-sensor adapters' lists them"
        )
    for name in ("rt_priority", "cpu"):
        value, setting = getattr(args, name), SERVER_SETTINGS[name]
        if value is not None:
            try:
                setting.parse(str(value))
            except ValueError as error:
                raise UsageError(f"{setting.flag} {value}: it must be {error}") from None
    if args.cpu is not None and args.cpu >= (os.cpu_count() or 1):
        raise UsageError(
            f"--cpu {args.cpu}: this machine has the processors 0 to {(os.cpu_count() or 1) - 1}"
        )


if __name__ == "__main__":
    sys.exit(main())
