"""Whatever the files hold, and whichever are not there: each check says something, and none fails."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bota_ethercat.health.verdict import Level
from ethercat_server.doctor.finding import CannotLookError, Finding, ok
from ethercat_server.doctor.machine import InterfaceFacts, Link, Machine
from ethercat_server.doctor.machine_checks import CHECKS, examine, examine_machine
from ethercat_server.errors import BusError
from tests.doctor.made_up import CARD, GOOD, but, machine

GARBAGE = ("", "\0\0", "-", "99999999999999999999", "x" * 5000, "1 2 3\n" * 50, b"\xff\xfe\x80", "(", "0-")
NOTHING_KNOWN = InterfaceFacts(
    link=Link(index=7), routes="no", settings="no", driver="no", coalescing="no", offloads="no", eee="no"
)


def faults(subject: Machine) -> list[Finding]:
    return [finding for finding in examine_machine(subject) if "fault of the doctor" in finding.found]


@pytest.mark.parametrize("number", range(len(GARBAGE)))
def test_garbage_in_every_file(tmp_path: Path, number: int) -> None:
    assert faults(machine(tmp_path, dict.fromkeys(GOOD, GARBAGE[number]))) == []


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(st.sampled_from(sorted(GOOD)), st.one_of(st.text(max_size=40), st.binary(max_size=40)))
)
def test_any_text_in_any_file(tmp_path: Path, files: dict[str, str | bytes]) -> None:
    with tempfile.TemporaryDirectory(dir=tmp_path) as folder:
        assert faults(machine(Path(folder), files)) == []


def test_no_files_at_all(tmp_path: Path) -> None:
    bare = Machine("ens5", facts=NOTHING_KNOWN, root=tmp_path)
    found = list(examine_machine(bare))
    assert {finding.check for finding in found} == {check.name for check in CHECKS}
    assert {finding.level for finding in found} <= {Level.GOOD, Level.NOT_POSSIBLE}
    skipped = [finding for finding in found if finding.level is Level.NOT_POSSIBLE]
    assert len(skipped) > len(CHECKS) // 2
    assert all(finding.found.startswith("not checked: ") for finding in skipped)
    assert any("/proc/interrupts: No such file" in finding.found for finding in skipped)


def test_files_that_are_folders(tmp_path: Path) -> None:
    for name in GOOD:
        (tmp_path / name.lstrip("/")).mkdir(parents=True)
    assert faults(Machine("ens5", facts=but(link=CARD), root=tmp_path)) == []


def test_an_endless_file_is_not_read_to_its_end(tmp_path: Path) -> None:
    (tmp_path / "proc").mkdir()
    for name in ("version", "config.gz"):
        (tmp_path / "proc" / name).symlink_to("/dev/zero")
    assert faults(machine(tmp_path)) == []


@pytest.mark.parametrize(
    ("error", "level", "said"),
    [
        (CannotLookError("why"), Level.NOT_POSSIBLE, "not checked: why"),
        (PermissionError(13, "Permission denied"), Level.NOT_POSSIBLE, "not checked: Permission denied"),
        (BusError("slave 0 does not answer"), Level.TROUBLE, "slave 0 does not answer"),
        (ZeroDivisionError("oh"), Level.NOT_POSSIBLE, "an error in ethercat-doctor"),
    ],
)
def test_a_check_that_fails_is_one_finding_more(error: Exception, level: Level, said: str) -> None:
    def look() -> Iterator[Finding]:
        yield ok("first")
        raise error

    first, second = examine("bus", "slaves", look)
    assert (first.found, first.subject, first.check) == ("first", "bus", "slaves")
    assert (second.level, second.check) == (level, "slaves")
    assert said in second.found
