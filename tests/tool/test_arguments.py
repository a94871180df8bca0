"""Wrong arguments, and the guard that keeps the factory calibration: no bus is needed."""

from __future__ import annotations

import ast
import json
import runpy
from pathlib import Path

import pytest

from bota_ethercat.settings import sinc_length_of
from ethercat_server.access import holder
from ethercat_server.access.holder import find_holder
from ethercat_server.errors import ForbiddenWriteError
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.slave.coe import Steps, finish
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.objects.dictionary import FACTORY_CALIBRATION
from ethercat_server.tool.commands.snapshot import RESTORABLE
from tests.bridge.scripted_server import ScriptedServer, description
from tests.server.running import needs_bus
from tests.tool.running import one_sentence, tool_here

ROOT = Path(__file__).parent.parent.parent


class Recorder:
    """An `Sdo` that remembers what was written."""

    clock = SYSTEM_CLOCK

    def __init__(self) -> None:
        self.written: list[tuple[int, int, bytes]] = []

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        yield from ()
        return b"\0"

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        yield from ()
        self.written.append((index, subindex, data))


def test_the_guard_lets_no_write_of_the_factory_calibration_through() -> None:
    sdo = Recorder()
    guarded = GuardedSdo(sdo)
    for subindex in range(256):
        with pytest.raises(ForbiddenWriteError, match="never written"):
            finish(guarded.write(FACTORY_CALIBRATION, subindex, b"\0"))
    assert not sdo.written
    finish(guarded.write(0x8000, 1, b"\0"))
    assert sdo.written == [(0x8000, 1, b"\0")]
    assert finish(guarded.read(FACTORY_CALIBRATION, 1)) == b"\0", "it may be looked at"


def test_all_that_can_write_is_behind_the_guard() -> None:
    unguarded = {"MailboxSdo", "_ServerSdo", "sdo"}
    server = ROOT / "ethercat_server"
    for path in [*(server / "tool").rglob("*.py"), *(server / "access").glob("*.py")]:
        tree = ast.parse(path.read_text())
        inside = {
            id(call)
            for outer in ast.walk(tree)
            if isinstance(outer, ast.Call) and _name(outer) == "GuardedSdo"
            for call in outer.args
        }
        for call in ast.walk(tree):
            if not isinstance(call, ast.Call) or _name(call) not in unguarded:
                continue
            is_guarded = _name(call) == "sdo" and "recovery" not in ast.unparse(call.func)
            assert is_guarded or id(call) in inside, f"{path.name}: {ast.unparse(call)}"
        assert "sdo_write(" not in path.read_text(), path
    assert not [row for row in RESTORABLE if row.index in {FACTORY_CALIBRATION, 0x7000, 0x8030}]


def _name(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


@pytest.mark.parametrize(
    ("read", "rate", "length"),
    [
        (64, 800, 64),
        (2048, 150, 341),
        (341, 150, 341),
        (51, 1003, 51),
        (None, 250, 205),
        (64, None, 64),
        (64, 0, 64),
        (768, 400, 128),
        (12288, 25, 2048),
        (2048, 25, 2048),
    ],
)
def test_the_rate_decides_which_sinc_length_is_in_force(
    read: int | None, rate: int | None, length: int
) -> None:
    assert sinc_length_of(read, rate) == length


@pytest.mark.parametrize(
    ("read", "rate", "chop", "asked", "length"),
    [
        (2048, 150, False, 342, 342),
        (2048, 150, False, 338, 341),
        (341, 150, False, 342, 341),
        (768, 400, False, 64, 128),
        (64, 400, True, 128, 64),
        (384, 400, True, 64, 64),
        (384, 400, True, None, 128),
        (12288, 4, True, None, 2048),
    ],
)
def test_of_lengths_with_one_rate_it_is_the_one_read_or_asked_for(
    read: int, rate: int, chop: bool, asked: int | None, length: int
) -> None:
    assert sinc_length_of(read, rate, chop, asked) == length


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["objects", "ens5", "--server", "localhost:12001"], "either an interface"),
        (["objects", "--server", "localhost:port"], "HOST:PORT"),
        (["objects", "--server", "localhost:0"], "0 is no port"),
        (["plan", "ens5"], "no settings given"),
        (["plan", "ens5", "--set", "sinc_length"], "NAME=VALUE"),
        (["apply", "ens5", "--set", "colour=1"], "no setting 'colour'"),
        (["apply", "ens5", "--set", "sinc_length=0"], "from 32 to 2048"),
        (["plan", "ens5", "--config", "/nonexistent.toml"], "/nonexistent.toml"),
        (["read", "ens5"], "a NAME is missing, or the interface beside 'ens5'"),
        (["tare", "ens5", "--target", "-1e-3", "-.5", "0", "0", "0", "-inf"], "six finite numbers"),
        (["tare", "ens5", "--samples", "0"], "from 1 to 20000"),
        (["tare", "ens5", "--target", "1", "2", "3", "4", "5", "inf"], "six finite numbers"),
        (["tare", "ens5", "--target", "1e300", "0", "0", "0", "0", "0"], "larger than a REAL32 can be"),
        (["watch", "ens5", "--samples", "0"], "1 or more"),
        (["restore", "ens5", "/nonexistent.json"], "/nonexistent.json"),
    ],
)
def test_wrong_arguments_are_one_sentence_and_exit_code_2(arguments: list[str], named: str) -> None:
    assert named in one_sentence(tool_here(*arguments, code=2))


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("/nonexistent/a.json", "/nonexistent/a.json cannot be written: No such file"),
        ("/", "/ cannot be written: Is a directory"),
        ("", ". cannot be written: Is a directory"),
        ("/tmp/" + "x" * 300, "File name too long"),
        (__file__, "exists: choose another name, or use --force"),
    ],
)
def test_a_snapshot_that_cannot_be_written_is_said_before_the_sensor_is_read(file: str, said: str) -> None:
    assert said in one_sentence(tool_here("snapshot", "ens5", file, code=1))


def test_help_names_every_command_and_the_exit_codes() -> None:
    shown = tool_here("--help").out
    for name in (
        "adapters",
        "eeprom",
        "watch",
        "objects",
        "plan",
        "apply",
        "save",
        "tare",
        "snapshot",
        "restore",
    ):
        assert f"\n  {name} " in shown
    assert "3 plan: there are changes" in shown
    assert "--set NAME=VALUE" in tool_here("plan", "--help").out


@needs_bus
@pytest.mark.parametrize("command", ["eeprom", "watch", "objects", "save", "tare"])
def test_no_such_interface(command: str) -> None:
    failed = tool_here(command, "nosuch0", "--json", code=1)
    assert "no network interface 'nosuch0'" in one_sentence(failed)
    assert "nosuch0" in json.loads(failed.out)["error"]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{", "not valid JSON"),
        ("[]", "not a snapshot"),
        ('{"format": "ethercat-sensor snapshot", "version": 2}', "not a snapshot"),
        ('{"format": "ethercat-sensor snapshot", "version": 1}', "damaged"),
    ],
)
def test_a_file_that_is_no_snapshot(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    assert named in one_sentence(tool_here("restore", "ens5", path, code=2))


def test_nobody_holds_an_interface_that_is_not_there() -> None:
    assert find_holder("nosuch0") is None


def test_a_server_of_another_user_says_itself_which_interface_it_uses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What it listens on cannot be seen; only what it says of the interface in question counts."""
    monkeypatch.setattr(holder, "master_sockets", lambda _: {1})
    monkeypatch.setattr(holder, "users_of", lambda *_: [])
    with ScriptedServer() as server:
        server.description = description(interface="ens5")
        monkeypatch.setenv("BOTA_SERVER", f"127.0.0.1:{server.port}")
        assert str(find_holder("ens5")) == "ethercat-server"
        assert find_holder("ens5") == (None, "ethercat-server", ("127.0.0.1", server.port))
        assert str(find_holder("ens6")) == "another EtherCAT master"


@pytest.mark.parametrize(
    ("script", "command"),
    [
        ("find_ethernet_adapters", "adapters"),
        ("read_eeprom", "eeprom"),
        ("bota_ethercat_minimal_example", "watch"),
        ("sensor_configuration_SDO_reader", "objects"),
    ],
)
def test_the_notes_scripts_are_these_commands(
    script: str, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", [script, "--help"])
    with pytest.raises(SystemExit):
        runpy.run_path(str(ROOT / "scripts" / f"{script}.py"))
    assert f"usage: ethercat-sensor {command} " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "guess"),
    [
        (["wach", "ens5"], "did you mean 'watch'?"),
        (["apply", "ens5", "--set", "sinc_lenght=64"], "did you mean 'sinc_length'?"),
        (["apply", "ens5", "--set", "FIR_filter=on"], "fast, chop"),
        (["xyzzy"], "there are adapters, "),
    ],
)
def test_a_name_that_there_is_not_is_answered_with_the_nearest(arguments: list[str], guess: str) -> None:
    said = tool_here(*arguments, code=2).err
    assert guess in said
    assert ("did you mean" in said) == ("did you mean" in guess)
