"""The program: arguments, ready line, control socket, how it ends."""

from __future__ import annotations

import argparse
import contextlib
import json
import socket
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from ethercat_server.virtual_sensor import link
from ethercat_server.virtual_sensor.cli import UsageError, build_parser, main, options_from
from ethercat_server.virtual_sensor.options import BusOptions
from tests.virtual_sensor.conftest import SensorProcess

Start = Callable[..., SensorProcess]


def parse(*words: str) -> argparse.Namespace:
    return build_parser().parse_args(["veth0", *words])


def test_defaults() -> None:
    [sensor] = options_from(parse()).sensors
    assert (sensor.model, sensor.serial, sensor.pdo_size) == ("BFT-SENS-ECAT-M8", 1, 61)
    assert (sensor.signal, sensor.noise, sensor.ppm, sensor.sinc_length) == ("scene", True, 0.0, None)


def test_a_chain() -> None:
    options = options_from(
        parse("--sensors", "3", "--model", "A,B", "--serial", "5", "--ppm", "1.5", "--ppm=-2", "--seed", "7")
    )
    assert [s.model for s in options.sensors] == ["A", "B", "B"]
    assert [s.serial for s in options.sensors] == [5, 6, 7]
    assert [s.ppm for s in options.sensors] == [1.5, -2.0, -2.0]
    assert [s.seed for s in options.sensors] == [7, 8, 9]
    assert len(options_from(parse("--model", "A", "--model", "B")).sensors) == 2


@pytest.mark.parametrize(
    "words",
    [
        ["--sensors", "0"], ["--sensors", "many"], ["--sensors", "17"], ["--sensors", "1", "--model", "A,B"],
        ["--serial", "-1"], ["--ppm", "nan"], ["--sinc", "31"], ["--eeprom-ms", "-1"],
        ["--model", "x" * 21], ["--model", "é"],
    ],
)  # fmt: skip
def test_wrong_arguments(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError):
        options_from(parse(*words))
    assert main(["veth0", *words]) == 2
    assert capsys.readouterr().err.startswith("ethercat-virtual-sensor: ")


def test_a_name_too_long_and_an_interface_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["x" * 16]) == 2
    assert "15" in capsys.readouterr().err
    assert main(["nosuchiface0"]) == 1
    assert "nosuchiface0" in capsys.readouterr().err


@pytest.mark.bus
def test_an_interface_that_is_down(veth: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    subprocess.run(["ip", "link", "set", veth[0], "down"], check=True)
    assert main([veth[0]]) == 1
    assert "is down" in capsys.readouterr().err


@pytest.mark.bus
def test_it_says_when_it_is_ready_and_ends_on_sigterm(veth: tuple[str, str], start: Start) -> None:
    sensor = start(veth[0], "--sensors", "2")
    assert sensor.ready.startswith(f"ready: 2 sensor(s) BFT-SENS-ECAT-M8 on {veth[0]},")
    assert sensor.end() == (0, "")


@pytest.mark.bus
def test_each_interface_has_serial_numbers_of_its_own(veth: tuple[str, str], start: Start) -> None:
    def serials(ifname: str) -> list[int]:
        sensor = start(ifname, "--sensors", "2")
        answer = json.loads(sensor.command("stats").removeprefix("ok "))
        sensor.end()
        return [each["serial"] for each in answer["sensors"]]

    for number, end in enumerate(veth):  # as of two ports of one card
        subprocess.run(["ip", "link", "set", end, "address", f"02:00:00:00:00:0{number}"], check=True)
    one, other, again = (serials(ifname) for ifname in (*veth, veth[0]))
    assert len({*one, *other}) == 4
    assert again == one, "the same sensors, started again"


@pytest.mark.bus
def test_quit_and_end_of_input(veth: tuple[str, str], start: Start) -> None:
    sensor = start(veth[0])
    assert sensor.process.stdin is not None
    sensor.process.stdin.write("quit\n")
    sensor.process.stdin.flush()
    assert sensor.process.wait(30) == 0
    sensor = start(veth[0], "--exit-on-eof")
    assert sensor.process.stdin is not None
    sensor.process.stdin.close()
    assert sensor.process.wait(30) == 0


@pytest.mark.bus
def test_it_goes_on_without_input(veth: tuple[str, str], start: Start, tmp_path: Path) -> None:
    path = tmp_path / "control"
    sensor = start(veth[0], "--control", str(path))
    assert sensor.process.stdin is not None
    sensor.process.stdin.close()
    with socket.socket(socket.AF_UNIX) as peer:
        peer.connect(str(path))
        peer.sendall(b"lose 1\n")
        assert peer.recv(100) == b"ok\n"
    assert sensor.end()[0] == 0


@pytest.mark.bus
def test_the_control_socket(veth: tuple[str, str], start: Start, tmp_path: Path) -> None:
    path = tmp_path / "control"
    sensor = start(veth[0], "--control", str(path))
    assert sensor.command("lose 1") == "ok"
    with (
        socket.socket(socket.AF_UNIX) as one,
        socket.socket(socket.AF_UNIX) as other,
        contextlib.ExitStack() as stack,
    ):
        for peer in (one, other):
            peer.connect(str(path))
        other.sendall(b"sta")
        one.sendall(b"nonsense\nhear\n")
        answers = stack.enter_context(one.makefile())
        assert answers.readline().startswith("error: ")
        assert answers.readline() == "ok\n"
        other.sendall(b"ts\n")
        answer = stack.enter_context(other.makefile()).readline()
        assert json.loads(answer.removeprefix("ok "))["frames"] == 0
        one.sendall(b"quit\n")
        assert answers.readline() == "ok\n"
    assert sensor.process.wait(30) == 0
    assert not path.exists(), "nothing is left behind"


@pytest.mark.bus
def test_a_control_socket_in_use_and_one_left_behind(
    veth: tuple[str, str], start: Start, tmp_path: Path
) -> None:
    path = tmp_path / "control"
    start(veth[0], "--control", str(path))
    second = start(veth[1], "--control", str(path))
    code, errors = second.end()
    assert (code, second.ready) == (1, "")
    assert str(path) in errors
    left = tmp_path / "left"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(left))
    assert start(veth[1], "--control", str(left)).ready.startswith("ready")
    not_ours = tmp_path / "file"
    not_ours.write_text("precious")
    assert start(veth[1], "--control", str(not_ours)).end()[0] == 1
    assert not_ours.read_text() == "precious"


@pytest.mark.bus
def test_an_interface_that_disappears(veth: tuple[str, str], start: Start) -> None:
    sensor = start(veth[0])
    subprocess.run(["ip", "link", "del", veth[0]], check=True)
    assert sensor.process.wait(30) == 1
    assert sensor.process.stderr is not None
    message = sensor.process.stderr.read()
    assert veth[0] in message
    assert message.count("\n") == 1


@pytest.mark.bus
def test_run_in_a_thread(veth: tuple[str, str]) -> None:
    ready, stop = threading.Event(), threading.Event()
    thread = threading.Thread(
        target=link.run, args=(veth[0], BusOptions()), kwargs={"on_ready": ready.set, "should_stop": stop}
    )
    thread.start()
    assert ready.wait(30)
    stop.set()
    thread.join(30)
    assert not thread.is_alive()
