"""What `ethercat-doctor` does: examines the machine, then the bus, or saves or shows a trace."""

from __future__ import annotations

import argparse
import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from bota_ethercat.health.limits import Level
from bota_ethercat.program.version import VERSION
from bota_ethercat.text.untrusted import visible
from ethercat_server.access.adapters import find_holder, is_elsewhere, server_here
from ethercat_server.doctor import trace
from ethercat_server.doctor.bus_checks import examine_bus
from ethercat_server.doctor.machine import Host
from ethercat_server.doctor.machine_checks import examine_machine
from ethercat_server.doctor.report import CannotLookError, CheckResult, Report, as_json, is_bus_unknown, worst
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.ethercat.nic import name_trouble, own_name
from ethercat_server.ethercat.options import VIRTUAL_INTERFACE
from ethercat_server.process import command_line
from ethercat_server.virtual_sensor.virtual_bus import VirtualBus


def run(args: argparse.Namespace) -> int:
    """Save or show a trace, or examine machine and bus; the exit code follows from the worst finding."""
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
    if args.iface.endswith(".mcap"):
        raise UsageError(f"{args.iface} is a recording: ethercat-report shows it")
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
        title = f"ethercat-doctor {VERSION} on {args.iface}: Linux {header['kernel']}, {who}"
        report.say(visible(title) + "\n")
        for finding in _examined(args, report.wait):
            findings.append(finding)
            report.write(finding)
        report.summary(findings)
    has_failed = worst(findings) is Level.TROUBLE or any(map(is_bus_unknown, findings))
    return command_line.FAILED if has_failed else 0


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
