"""How findings are written: aligned, coloured only where that is wanted, nothing harmful let through."""

from __future__ import annotations

import io
import json

import pytest

from bota_ethercat.health.verdict import Level
from ethercat_server.doctor.finding import Finding, bad, note, ok, skipped, warning
from ethercat_server.doctor.report import EXIT_CODES, Report, as_json, printable, wants_color, worst


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def named(finding: Finding, subject: str = "kernel", check: str = "tick") -> Finding:
    return Finding(
        finding.level, finding.found, finding.why, finding.commands, finding.values, subject, check
    )


def written(*findings: Finding, stream: io.StringIO | None = None) -> str:
    stream = stream or io.StringIO()
    report = Report(stream)
    for finding in findings:
        report.write(finding)
    report.summary(findings)
    return stream.getvalue()


def test_everything_is_aligned_below_its_subject() -> None:
    long = "word " * 60
    shown = written(
        named(ok("250 Hz")), named(warning(long, "because", "echo 1 | sudo tee /x"), "processors", "governor")
    ).splitlines()
    assert shown[0] == "kernel"
    assert shown[2:4] == ["", "processors"]
    at = shown[1].index("250 Hz")
    assert all(line[at - 1] == " " and line[at] != " " for line in shown[4:-4])
    assert shown[-5] == " " * at + "$ echo 1 | sudo tee /x"
    assert shown[-6].strip() == "because"
    assert max(map(len, shown)) <= 120
    assert shown[-3] == "Worth a look: 1 warning, 1 ok"


def test_the_end_repeats_what_matters_for_the_rest_scrolls_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    found = [named(ok("x"))] * 30 + [named(warning("slow " * 40, "y"))] * 9 + [named(bad("gone", "y"), "bus")]
    end = written(*found, stream=Terminal()).rpartition("\n\n")[2].splitlines()
    assert len(end) < 24
    assert max(len(line) for line in end[1:]) <= 80
    assert "Trouble" in end[0]
    assert end[1] == "  bad      bus, tick: gone"
    assert end[-1] == "  and 2 more above"


def test_commands_are_never_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    command = "sudo ethtool -C ens5 adaptive-rx off adaptive-tx off rx-usecs 0 tx-usecs 0 and more of it"
    assert f"$ {command}\n" in written(named(note("x", "y", command)), stream=Terminal())


def test_colour_only_on_a_terminal_and_not_against_the_users_will(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert "\x1b" not in written(named(bad("x", "y")))
    assert "\x1b[1;31mbad" in written(named(bad("x", "y")), stream=Terminal())
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b" not in written(named(bad("x", "y")), stream=Terminal())
    assert not wants_color(Terminal(), {"TERM": "dumb"})
    assert wants_color(Terminal(), {"NO_COLOR": ""}), "empty means not set"


def test_what_devices_say_cannot_reach_the_terminal() -> None:
    assert printable("a\x1b[2Jb\rc\x07") == "a?[2Jb?c?"
    shown = written(named(ok("name \x1b]0;evil\x07 \x9b31m")), stream=Terminal())
    assert "\x1b]" not in shown
    assert "\x9b" not in shown


def test_the_worst_finding_is_the_exit_code() -> None:
    assert EXIT_CODES[worst([])] == 0
    assert EXIT_CODES[worst([ok("a"), note("b", "c"), skipped("d")])] == 0
    assert EXIT_CODES[worst([skipped("d"), warning("b", "c")])] == 0
    assert EXIT_CODES[worst([bad("b", "c"), warning("b", "c")])] == 1
    assert worst([skipped("d")]) is Level.GOOD
    assert 2 not in EXIT_CODES.values(), "that is wrong usage"


def test_json_has_it_all() -> None:
    found = json.loads(as_json({"interface": "ens5"}, [named(warning("b", "c", "d", n=1))]))
    assert (found["interface"], found["verdict"], found["worst"]) == ("ens5", "look", "warning")
    assert found["findings"] == [
        {
            "subject": "kernel",
            "check": "tick",
            "level": "warning",
            "found": "b",
            "why": "c",
            "commands": ["d"],
            "values": {"n": 1},
        }
    ]
