"""Runs `ethercat-doctor` as a process."""

from __future__ import annotations

from typing import Any

from tests.ended import Result, run

MODULE = "ethercat_server.doctor.cli"


_STARVED = "no EtherCAT slave answers"
"""What it finds too when a busy machine lets the virtual sensor's process wait for too long."""
_ATTEMPTS = 3


class Examined(Result):
    """How it ended, and what it found."""

    def findings(self, subject: str) -> dict[str, dict[str, Any]]:
        """The findings of a subject by check; the last one where there are two."""
        return {row["check"]: row for row in self.json["findings"] if row["subject"] == subject}


def doctor(*arguments: object, module: str = MODULE, under: tuple[str, ...] = ()) -> Examined:
    """Run `ethercat-doctor arguments...`."""
    for _ in range(_ATTEMPTS):
        ended = Examined(*run(module, *arguments, under=under))
        if _STARVED not in ended.out:
            break
    assert "fault of the doctor" not in ended.out, ended.out
    return ended


def levels(rows: dict[str, dict[str, Any]]) -> dict[str, str]:
    """The level of each check."""
    return {check: row["level"] for check, row in rows.items()}
