"""The command line, the checks of this very machine, and how findings are written."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest

from ethercat_server.doctor.cli import main
from ethercat_server.doctor.machine_checks import CHECKS
from ethercat_server.doctor.report import (
    CheckResult,
    Report,
    bad,
    ok,
    wants_color,
)
from ethercat_server.errors import ServerError
from ethercat_server.virtual_sensor.virtual_bus import VirtualBus
from tests.doctor.running import doctor_here
from tests.ended import run_here


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "12001 (Connection refused): name the interface, or start ethercat-server on it\n"),
        (["ens5", "--colour"], "usage: ethercat-doctor"),
        (["ens5", "--seconds", "soon"], "must be a number from 0 to 3600"),
        (["ens5", "--seconds", "-1"], "from 0 to 3600"),
        (["ens5", "--cpu", "4000"], "--cpu 4000: this machine has the processors 0 to"),
        (["ens5", "--rt-priority", "100"], "--rt-priority: '100': it must be a whole number from 0 to 99"),
        (["a-name-that-is-too-long"], "is not an interface name"),
        (["../lo"], "is not an interface name"),
    ],
)
def test_wrong_arguments_are_exit_code_2(arguments: list[str], named: str) -> None:
    ended = run_here(main, *arguments)
    assert (ended.code, ended.out) == (2, "")
    assert named in ended.err
    assert ended.err.splitlines()[-1].startswith("ethercat-doctor: ")


def test_what_failed_is_json_too_and_help_names_the_exit_codes() -> None:
    ended = run_here(main, "a/b", "--json")
    assert (ended.code, "not an interface name" in ended.json["error"]) == (2, True)
    assert "1 trouble" in " ".join(run_here(main, "--help").out.split())


def test_no_such_interface_is_a_finding_and_the_machine_is_looked_at() -> None:
    ended = doctor_here("nosuch0", "--json", "--seconds", 0.05)
    assert ended.code == 1
    assert (ended.json["verdict"], ended.json["worst"]) == ("trouble", "bad")
    assert (ended.json["interface"], ended.json["seconds"]) == ("nosuch0", 0.05)
    assert isinstance(ended.json["root"], bool)
    assert ended.findings("interface")["link"]["found"] == "no network interface 'nosuch0'"
    there = {(row["subject"], row["check"]) for row in ended.json["findings"]}
    assert {check for check in CHECKS if check[0] in {"kernel", "rights", "processors"}} <= there
    assert "no network interface 'nosuch0'" in ended.findings("bus")["slaves"]["found"]
    assert ended.findings("measurement")["all"]["level"] == "skipped"


def test_the_loopback_interface_is_no_place_for_a_sensor() -> None:
    ended = doctor_here("lo", "--seconds", 0)
    assert ended.code == 1
    assert "the loopback interface" in ended.out
    assert "not checked: the bus is not accessed" in ended.out
    _, _, end = ended.out.partition("\nTrouble: 1 bad, ")
    assert end.splitlines()[1] == "  bad      interface, link: the loopback interface"
    assert "flush" not in ended.out, "the machine needs its addresses"
    assert " lo gro" not in ended.out
    assert "\x1b" not in ended.out


def test_virtual_where_there_is_no_virtual_bus_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: object) -> None:
        raise ServerError("no namespaces")

    monkeypatch.setattr(VirtualBus, "__enter__", refuse)
    ended = doctor_here("virtual", "--json", "--seconds", 0)
    assert (ended.code, json.loads(ended.out)["verdict"]) == (1, "not-possible"), (
        "nothing is known to be good"
    )
    assert "there is no virtual bus: no namespaces" in ended.findings("bus")["slaves"]["found"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def named(finding: CheckResult, subject: str = "kernel", check: str = "preemption") -> CheckResult:
    return replace(finding, subject=subject, check=check)


def written(*findings: CheckResult, stream: io.StringIO | None = None) -> str:
    stream = stream or io.StringIO()
    report = Report(stream)
    for finding in findings:
        report.write(finding)
    report.summary(findings)
    return stream.getvalue()


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
    assert " a?[2Jb c?\n" in written(named(ok("a\x1b[2Jb\rc\x07")))
    shown = written(named(ok("name \x1b]0;evil\x07 \x9b31m")), stream=Terminal())
    assert "\x1b]" not in shown
    assert "\x9b" not in shown


def test_the_docs_have_every_check() -> None:
    docs = (Path(__file__).parent.parent.parent / "docs" / "doctor.md").read_text()
    assert not [
        (subject, name)
        for subject, name in CHECKS
        if f"| `{subject}` |" not in docs or f"`{name}`" not in docs
    ]
