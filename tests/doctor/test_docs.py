"""docs/doctor.md has every check."""

from __future__ import annotations

from pathlib import Path

from ethercat_server.doctor.machine_checks import CHECKS

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
