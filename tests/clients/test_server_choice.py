"""Every program names its server alike: --server, $BOTA_SERVER, a file; the old forms keep their meaning."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bota_clients.monitor import cli as monitor
from bota_clients.record import cli as record
from bota_clients.replay import cli as replay
from bota_ethercat.program.server_choice import default_server, is_address, own_server
from ethercat_server.access import sensors

Read = Callable[[list[str]], tuple[str, str]]


def recorded(argv: list[str]) -> tuple[str, str]:
    found = record.parse_options(argv)
    assert found.seconds in (None, 5)
    return str(found.path), str(found.address)


def monitored(argv: list[str]) -> tuple[str, str]:
    return "", str(monitor.parse(argv).address)


def replayed(argv: list[str]) -> tuple[str, str]:
    found = replay.parse_options(argv)
    assert found.loop == ("--loop" in argv)
    return str(found.path), f"{','.join(found.hosts)} {found.port}"


@pytest.mark.parametrize(
    ("read", "argv", "path", "server"),
    [
        (recorded, "a.mcap", "a.mcap", "localhost:12001"),
        (recorded, "a.mcap --server [::1]:14101", "a.mcap", "[::1]:14101"),
        (recorded, "./14101", "14101", "localhost:12001"),
        (monitored, "", "", "localhost:12001"),
        (monitored, "--server robot", "", "robot:12001"),
        (monitored, "--server [::1]:14101", "", "[::1]:14101"),
        (replayed, "a.mcap", "a.mcap", "127.0.0.1,::1 12001"),
        (replayed, "--loop a.mcap --server 14101", "a.mcap", "127.0.0.1,::1 14101"),
        (replayed, "a.mcap --server 0.0.0.0:14101", "a.mcap", "0.0.0.0 14101"),
        (replayed, "a.mcap --server localhost:14101", "a.mcap", "127.0.0.1,::1 14101"),
    ],
)
def test_the_server_and_the_file(read: Read, argv: str, path: str, server: str) -> None:
    assert read(argv.split()) == (path, server)


@pytest.mark.parametrize(
    ("read", "argv", "sentence"),
    [
        (
            recorded,
            "localhost:14101",
            "is a server's address, no file: write FILE.mcap --server localhost:14",
        ),
        (recorded, "14101", "or ./14101 if a file is called so"),
        (recorded, "::1", "is a server's address"),
        (
            recorded,
            "runs/1.CSV",
            "runs/1.CSV: a recording is an MCAP file: write runs/1.mcap, from which ethercat-export",
        ),
        (recorded, "a.mcap robot:1", "unrecognized arguments: robot:1"),
        (monitored, "--server ::1", "in brackets"),
        (replayed, "a.mcap --server robot", "'robot': it must be an IP address of this machine"),
    ],
)
def test_what_is_ambiguous_is_said(
    read: Read, argv: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        read(argv.split())
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize("name", ["run.mcap", "./12001", "folder/a:1", "robot", "a:b", "run.1", ""])
def test_a_file_is_no_address(name: str) -> None:
    assert not is_address(name)


def test_the_variable_comes_before_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    assert str(default_server({"BOTA_SERVER": "[::1]:14103"})) == "[::1]:14103"
    assert str(default_server({})) == "localhost:12001"
    robot = {"BOTA_SERVER": "robot:14102"}
    assert str(own_server(robot)) == "localhost:12001", "nobody can serve at another machine's address"
    assert str(own_server({"BOTA_SERVER": "14103"})) == "localhost:14103"
    monkeypatch.setenv("BOTA_SERVER", "x:y")
    with pytest.raises(ValueError, match=r"\$BOTA_SERVER: 'x:y': it must be HOST:PORT"):
        default_server()


@pytest.mark.parametrize(
    ("iface", "server", "reached"),
    [
        (None, None, "localhost:12001"),
        (None, "[::1]:14101", "[::1]:14101"),
        ("robot:14101", None, "robot:14101"),
    ],
)
def test_the_tool_without_an_interface_asks_the_server(
    iface: str | None, server: str | None, reached: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensors.Sensors, "through", str)
    assert str(sensors.find_server(iface, server)) == reached
