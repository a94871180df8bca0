"""The program: arguments, ready line, control socket, how it ends."""

from __future__ import annotations

import json
import os
import re
import select
import signal
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest

from ethercat_server.ethercat.wire import ETHERTYPE
from ethercat_server.virtual_sensor.cli import build_parser, main, options_from
from ethercat_server.virtual_sensor.faults import COMMANDS, LONGEST_LINE
from ethercat_server.virtual_sensor.link import obey_lines, open_interface
from ethercat_server.virtual_sensor.options import SensorOptions
from tests import rights
from tests.server.running import VirtualSensor
from tests.virtual_sensor.conftest import Start
from tests.virtual_sensor.raw_master import RawMaster


def sensors(*words: str) -> list[SensorOptions]:
    slaves = options_from(build_parser().parse_args(["veth0", *words]))
    return [slave for slave in slaves if isinstance(slave, SensorOptions)]


def test_options_go_along_the_chain() -> None:
    assert sensors() == [
        SensorOptions(model="BFT-SENS-ECAT-M8", serial=1, pdo_size=61, signal="scene", seed=0)
    ]
    options = sensors(*["--sensors", "3", "--model", "A,B", "--serial", "5", "--ppm", "1.5", "--ppm=-2"])
    found = [(sensor.model, sensor.serial, sensor.ppm, sensor.seed) for sensor in options]
    assert found == [("A", 5, 1.5, 0), ("B", 6, -2.0, 1), ("B", 7, -2.0, 2)]
    assert len(sensors("--model", "A", "--model", "B")) == 2
    chain = sensors(*["--dc", "none,32-bit+late=5", "--chain", "BOTA,EK1100,BOTA"])
    assert [sensor.dc for sensor in chain] == ["none", "32-bit+late=5"]


@pytest.mark.parametrize(
    "words",
    [
        "--sensors 0", "--sensors many", "--sensors 17", "--sensors 1 --model A,B", "--serial -1",
        "--ppm nan", "--sinc 31", "--model " + "x" * 21, "--model é", "--dc late",
        "--chain BOTA,EL9999", "--chain DRIVE:BOOT", "--chain BOTA,,BOTA", "--chain ,",
        "--chain " + ",".join(["EK1100"] * 17), "--chain BOTA --sensors 1",
        "--chain EK1100,BOTA --serial 1,2",
    ],
)  # fmt: skip
def test_wrong_arguments(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["veth0", *words.split()])
    option, *others = [word for word in words.split() if word.startswith("--")]
    named = "" if others else f"argument {option}: "
    assert f"ethercat-virtual-sensor: error: {named}" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["nosuchiface0", "x" * 16, ""])
def test_an_interface_that_is_not_there(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name]) == 1
    assert f"no network interface {name!r}" in capsys.readouterr().err


@pytest.mark.bus
def test_an_interface_that_is_down(veth: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    subprocess.run(["ip", "link", "set", veth[0], "down"], check=True)
    assert main([veth[0]]) == 1
    assert "is down" in capsys.readouterr().err


@pytest.mark.bus
def test_an_interface_that_has_one(veth: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    with open_interface(veth[0], ETHERTYPE):
        assert main([veth[0]]) == 1
    assert "in use by another virtual sensor" in capsys.readouterr().err


def told(sensor: VirtualSensor) -> list[str]:
    """Its lines, without that on the priority that an ordinary user does not have.

    And without that on another virtual sensor of this user, of a second run of the tests, say.
    """
    unlike = "not granted: SCHED_FIFO", "--send does not reach"
    return [line for line in sensor.said().splitlines() if not any(each in line for each in unlike)]


def test_a_typed_line_comes_in_pieces(capfd: pytest.CaptureFixture[str]) -> None:
    bus, (there, here), begun, poller = RawMaster().bus, os.pipe(), bytearray(), select.poll()
    poller.register(there, select.POLLIN)
    for typed in (b"deaf-a", b"fter 3\n\nhe", b"ar\n" + b"x" * 5000, b"\nhear", b""):
        if typed:
            os.write(here, typed)
        else:
            os.close(here)
        obey_lines(there, begun, bus, poller, exit_on_eof=True)
        assert len(begun) <= LONGEST_LINE
    os.close(there)
    first, second, third, last = capfd.readouterr().out.splitlines()
    assert (first, second, last) == ("ok", "ok", "ok")
    assert third.startswith("error: ")
    assert bus.quit


@pytest.mark.bus
def test_it_says_when_it_is_ready_and_how_it_ends_and_each_interface_has_serial_numbers_of_its_own(
    veth: tuple[str, str], start: Start
) -> None:
    def serials(sensor: VirtualSensor) -> list[int]:
        return [each["serial"] for each in json.loads(sensor.command("stats"))["sensors"]]

    for number, end in enumerate(veth):  # as of two ports of one card
        subprocess.run(["ip", "link", "set", end, "address", f"02:00:00:00:00:0{number}"], check=True)
    sensor, other = start(veth[0], "--sensors", "2"), start(veth[1], "--sensors", "2")
    one, others = serials(sensor), serials(other)
    assert len({*one, *others}) == 4
    sensor.signal(signal.SIGTERM)
    assert sensor.wait() == 0
    ready, _stats = told(sensor)
    assert ready.startswith(f"ready: 2 sensor(s) BFT-SENS-ECAT-M8 on {veth[0]},")
    other.command("quit")
    assert other.wait() == 0
    ending = start(veth[0], "--sensors", "2", "--exit-on-eof")
    assert serials(ending) == one, "the same sensors, started again"
    assert ending.process.stdin is not None
    ending.process.stdin.close()
    assert ending.wait() == 0


@pytest.mark.bus
def test_the_control_socket(
    veth: tuple[str, str], start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "control"
    sensor = start(veth[0], "--control", str(path))
    sensor.command("lose 1")
    assert sensor.process.stdin is not None
    sensor.process.stdin.close()  # it goes on without input
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as peer:
        for line in (b"nonsense", b"\xff" * 5000, b""):  # its sender does not wait for the answer
            peer.sendto(line, str(path))
        for command, answer in (
            ("lose 2", "ok\n"),
            ("lose", "error: wrong number of arguments: lose N\n"),
            ("", "error: an empty line: type `help` for the commands\n"),
            ("lose 1\nhear", "error: wrong number of arguments: lose N\n"),
        ):
            assert main(["--control", str(path), "--send", command]) == (answer != "ok\n")
            assert capsys.readouterr().out == answer
    assert main(["--control", str(path), "--send", "help"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(COMMANDS)
    assert main(["--control", str(path), "--send", "stats"]) == 0
    assert json.loads(capsys.readouterr().out.removeprefix("ok "))["frames"] == 0
    assert main(["--control", str(path), "--send", "quit"]) == 0
    assert sensor.wait() == 0
    assert not path.exists(), "nothing is left behind"
    assert main(["--control", str(path), "--send", "help"]) == 1
    assert f"no virtual sensor of yours answers at {path} (No such file" in capsys.readouterr().err


@pytest.mark.bus
def test_without_a_place_it_listens_where_commands_are_sent_to_or_says_that_it_does_not(
    veth: tuple[str, str], start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    sensor = start(veth[0])
    second = start(veth[1])
    assert re.search(
        "--send does not reach this virtual sensor, .*already in use: .*--control", second.said()
    )
    assert main(["--send", "quit"]) == 0
    assert sensor.wait() == 0


@rights.needs_root
@pytest.mark.long
@pytest.mark.bus
def test_it_is_scheduled_above_a_server_or_says_that_it_is_not(veth: tuple[str, str], start: Start) -> None:
    assert os.sched_getscheduler(start(veth[0]).process.pid) == os.SCHED_FIFO
    lacking = start(veth[1], under=("prlimit", "--rtprio=0", "setpriv", "--bounding-set=-sys_nice"))
    assert "not granted: SCHED_FIFO 81" in lacking.said()


@pytest.mark.bus
def test_a_control_socket_in_use_and_one_left_behind(
    veth: tuple[str, str], start: Start, tmp_path: Path
) -> None:
    path, left, not_ours = (tmp_path / name for name in ("control", "left", "file"))
    not_ours.write_text("precious")
    start(veth[0], "--control", str(path))
    for used in (path, not_ours):
        second = start(veth[1], "--control", str(used), ready=False)
        assert second.wait() == 1
        assert str(used) in second.said()
    assert not_ours.read_text() == "precious"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(left))
    start(veth[1], "--control", str(left))


@pytest.mark.bus
def test_an_interface_that_disappears(veth: tuple[str, str], start: Start) -> None:
    sensor = start(veth[0])
    subprocess.run(["ip", "link", "del", veth[0]], check=True)
    assert sensor.wait() == 1
    _ready, message = told(sensor)
    assert veth[0] in message
