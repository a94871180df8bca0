"""Runs `ethercat-doctor`: as a process, in this one, or only its examination of a simulated bus."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bota_ethercat.health.limits import Level
from ethercat_server.doctor.bus_checks import examine_bus
from ethercat_server.doctor.cli import main
from ethercat_server.doctor.report import NAMES, CheckResult, worst
from tests import rights
from tests.doctor.made_up import machine
from tests.ended import Result, patiently, run, run_here
from tests.rights import NOBODY
from tests.simulation import SimulatedBus

MODULE = "ethercat_server.doctor.cli"

STARVED = ("no EtherCAT slave answers", "does not answer")
"""What it finds too when a busy machine lets the virtual sensor's process wait for too long."""


class Examined(Result):
    """How it ended, and what it found."""

    def findings(self, subject: str) -> dict[str, dict[str, Any]]:
        """The findings of a subject by check; the last one where there are two."""
        return {row["check"]: row for row in self.json["findings"] if row["subject"] == subject}


def doctor(*arguments: object, under: tuple[str, ...] = (), python: str | Path = sys.executable) -> Examined:
    """Run `ethercat-doctor arguments...`."""
    return _without_errors(patiently(lambda: run(MODULE, *arguments, under=under, python=python), STARVED))


def doctor_here(*arguments: object) -> Examined:
    """Run `ethercat-doctor arguments...` in this process, with ordinary scheduling."""
    return _without_errors(patiently(lambda: run_here(main, *arguments, "--rt-priority", 0), STARVED))


def _without_errors(ended: Result) -> Examined:
    assert "error in ethercat-doctor" not in ended.out, ended.out
    return Examined(*ended)


class BusFindings(list[CheckResult]):
    """What was found on a simulated bus."""

    @property
    def worst(self) -> Level:
        """Decides on the exit code."""
        return worst(self)

    def of(self, subject: str) -> dict[str, CheckResult]:
        """The findings of a subject by check; the last one where there are two."""
        return {finding.check: finding for finding in self if finding.subject == subject}

    def levels(self, subject: str) -> dict[str, str]:
        """The level of each check."""
        return {check: NAMES[finding.level] for check, finding in self.of(subject).items()}


def examined(
    bus: SimulatedBus,
    root: Path,
    seconds: float = 0.2,
    announce: Callable[[str], None] = lambda _: None,
) -> BusFindings:
    """The doctor's examination of `bus` on a good machine."""
    subject = machine(root)
    subject.ifname = bus.near
    found = BusFindings(examine_bus(subject, seconds, announce))
    assert not [finding for finding in found if "error in ethercat-doctor" in finding.found]
    return found


def doctor_of_nobody(*arguments: object) -> Examined:
    """Run `ethercat-doctor arguments...` as the user `nobody`."""
    become = ("setpriv", f"--reuid={NOBODY.pw_uid}", f"--regid={NOBODY.pw_gid}", "--clear-groups")
    rights.need(*become)
    return doctor(*arguments, under=(*rights.readable(), *become), python=rights.PYTHON)


def levels(rows: dict[str, dict[str, Any]]) -> dict[str, str]:
    """The level of each check."""
    return {check: row["level"] for check, row in rows.items()}
