"""docs/doctor.md has every check, and every level with its exit code."""

from __future__ import annotations

from pathlib import Path

from ethercat_server.doctor.cli import build_parser
from ethercat_server.doctor.finding import NAMES
from ethercat_server.doctor.machine_checks import CHECKS
from ethercat_server.doctor.report import EXIT_CODES

DOCS = (Path(__file__).parent.parent.parent / "docs" / "doctor.md").read_text()


def rows() -> dict[str, list[str]]:
    """The checks of the table by subject, in its order."""
    found: dict[str, list[str]] = {}
    subject = ""
    for line in DOCS.partition("| Subject | Check |")[2].splitlines()[2:]:
        if not line.startswith("|"):
            break
        cells = [cell.strip().strip("`") for cell in line.split("|")[1:-1]]
        subject = cells[0] or subject
        found.setdefault(subject, []).append(cells[1])
    return found


def test_the_table_has_every_check_in_its_order() -> None:
    table = rows()
    for subject in dict.fromkeys(check.subject for check in CHECKS):
        assert table[subject] == [check.name for check in CHECKS if check.subject == subject]


def test_the_example_is_of_these_checks() -> None:
    example = DOCS.partition("$ sudo ethercat-doctor virtual\n")[2]
    for check in CHECKS:
        assert f"  {check.name.ljust(20)}  " in example, check.name
    for subject in ("bus", "measurement"):
        for name in rows()[subject]:
            assert f"  {name.replace('slave N', 'slave 0').ljust(20)}  " in example, name


def test_levels_and_exit_codes() -> None:
    for level, code in EXIT_CODES.items():
        row = next(line for line in DOCS.splitlines() if line.startswith(f"| `{NAMES[level]}` |"))
        assert row.endswith(f"| {code} |")
        if code:
            assert f" {code} " in " ".join(str(build_parser().epilog).replace(",", " ").split())


def test_every_option_is_there() -> None:
    for option in ("--seconds", "--rt-priority", "--cpu", "--json"):
        assert f"`{option}" in DOCS
        assert option in build_parser().format_help()
