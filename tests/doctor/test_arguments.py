"""The command line, and the checks of this very machine; signals and pipes need a process of their own."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from ethercat_server.doctor.cli import main
from ethercat_server.doctor.machine import Machine
from ethercat_server.doctor.machine_checks import CHECKS
from tests.doctor.running import MODULE, doctor_here
from tests.ended import run_here
from tests.server.running import PATIENCE_S


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "usage: ethercat-doctor"),
        (["a", "b"], "usage: ethercat-doctor"),
        (["ens5", "--colour"], "usage: ethercat-doctor"),
        (["ens5", "--seconds", "soon"], "invalid number value"),
        (["ens5", "--seconds", "-1"], "from 0 to 3600"),
        (["ens5", "--seconds", "nan"], "from 0 to 3600"),
        (["ens5", "--cpu", "x"], "whole number"),
        (["ens5", "--cpu", "4000"], "--cpu 4000: this machine has the processors 0 to"),
        (["ens5", "--rt-priority", "100"], "--rt-priority 100: it must be a whole number from 0 to 99"),
        (["a-name-that-is-too-long"], "is not an interface name"),
        (["../lo"], "is not an interface name"),
        ([""], "is not an interface name"),
    ],
)
def test_wrong_arguments_are_exit_code_2(arguments: list[str], named: str) -> None:
    ended = run_here(main, *arguments)
    assert (ended.code, ended.out) == (2, "")
    assert named in ended.err
    assert ended.err.splitlines()[-1].startswith("ethercat-doctor: ")


def test_what_failed_is_json_too() -> None:
    ended = run_here(main, "a/b", "--json")
    assert ended.code == 2
    assert "not an interface name" in ended.json["error"]


def test_help_names_the_exit_codes() -> None:
    assert "1 trouble" in " ".join(run_here(main, "--help").out.split())


def test_no_such_interface_is_a_finding_and_the_machine_is_looked_at() -> None:
    ended = doctor_here("nosuch0", "--json", "--seconds", 0.05)
    assert ended.code == 1
    assert (ended.json["verdict"], ended.json["worst"]) == ("trouble", "bad")
    assert ended.findings("interface")["link"]["found"] == "no network interface 'nosuch0'"
    there = {(row["subject"], row["check"]) for row in ended.json["findings"]}
    assert {(c.subject, c.name) for c in CHECKS if c.subject in {"kernel", "rights", "processors"}} <= there
    assert "there is no such interface" in ended.findings("bus")["slaves"]["found"]
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


def test_reader_that_has_enough() -> None:
    piped = subprocess.Popen(
        [sys.executable, "-m", MODULE, "lo", "--seconds", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert piped.stdout is not None
    assert piped.stderr is not None
    piped.stdout.readline()
    piped.stdout.close()
    assert piped.wait(timeout=PATIENCE_S) == 1
    assert piped.stderr.read() == ""
    piped.stderr.close()


def test_json_says_on_what_and_how_long() -> None:
    found = json.loads(doctor_here("nosuch0", "--json", "--seconds", 0).out)
    assert (found["interface"], found["seconds"]) == ("nosuch0", 0)
    assert isinstance(found["root"], bool)


def test_virtual_without_rights_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Machine, "has_capability", lambda *_: False)
    ended = doctor_here("virtual", "--json", "--seconds", 0)
    assert ended.code == 0
    assert "there is no virtual bus: CAP_NET_RAW" in ended.findings("bus")["slaves"]["found"]
    assert ended.err == ""
