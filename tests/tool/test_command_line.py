"""Wrong arguments, the documentation, and the guard that keeps the factory calibration: no bus is needed."""

from __future__ import annotations

import json
import runpy
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.control import MAX_SII_WORDS
from bota_ethercat.settings import SETTINGS, sinc_length_of
from ethercat_server.access import adapters as holder
from ethercat_server.access.adapters import find_holder
from ethercat_server.errors import ForbiddenWriteError
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.datagrams import Steps, finish
from ethercat_server.ethercat.slave.sii import decode, raw_lines, read_image
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.objects.dictionary import BY_SETTING, FACTORY_CALIBRATION
from ethercat_server.tool.cli import COMMANDS
from ethercat_server.tool.settings import RESTORABLE
from ethercat_server.virtual_sensor.device import build_image
from ethercat_server.virtual_sensor.dictionary import sensor_device
from tests.bridge.scripted_server import ScriptedServer
from tests.descriptions import description
from tests.server.running import needs_bus
from tests.tool.running import one_sentence, refused, tool_here

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
    assert not {row.index for row in RESTORABLE} & {FACTORY_CALIBRATION, 0x7000, 0x8030}


@pytest.mark.parametrize(
    ("read", "rate", "chop", "asked", "length"),
    [
        (64, 800, None, None, 64), (2048, 150, None, None, 341), (341, 150, None, None, 341),
        (51, 1003, None, None, 51), (None, 250, None, None, 205), (64, None, None, None, 64),
        (64, 0, None, None, 64), (768, 400, None, None, 128), (12288, 25, None, None, 2048),
        (2048, 25, None, None, 2048),
        # Of lengths with one rate it is the one that was read or asked for.
        (2048, 150, False, 342, 342), (2048, 150, False, 338, 341), (341, 150, False, 342, 341),
        (768, 400, False, 64, 128), (64, 400, True, 128, 64), (384, 400, True, 64, 64),
        (384, 400, True, None, 128), (12288, 4, True, None, 2048),
    ],
)  # fmt: skip
def test_the_rate_decides_which_sinc_length_is_in_force(
    read: int | None, rate: int | None, chop: bool | None, asked: int | None, length: int
) -> None:
    assert sinc_length_of(read, rate, chop, asked) == length


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["objects", "ens5", "--server", "localhost:12001"], "either an interface"),
        (["objects", "--server", "localhost:port"], "HOST:PORT"),
        (["objects", "--server", "localhost:0"], "0 is no port"),
        (["apply", "ens5"], "no settings given"),
        (["apply", "ens5", "--set", "sinc_length"], "NAME=VALUE"),
        (["apply", "ens5", "--config", "/nonexistent.toml"], "/nonexistent.toml"),
        (["read", "ens5"], "a NAME is missing, or the interface beside 'ens5'"),
        (["tare", "ens5", "--target", "-1e-3", "-.5", "0", "0", "0", "-inf"], "six finite numbers"),
        (["tare", "ens5", "--undo", "--clear"], "exclude each other"),
        (["tare", "ens5", "--target", "1e300", "0", "0", "0", "0", "0"], "larger than a REAL32 can be"),
        (["restore", "ens5", "/nonexistent.json"], "/nonexistent.json"),
    ],
)
def test_wrong_arguments_are_one_sentence_and_exit_code_2(arguments: list[str], named: str) -> None:
    assert named in refused(*arguments, code=2)


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("/nonexistent/a.json", "/nonexistent/a.json cannot be written: No such file"),
        ("/", "/ cannot be written: Is a directory"),
        ("/tmp/" + "x" * 300, "File name too long"),
        (__file__, "exists: choose another name, or use --force"),
    ],
)
def test_a_snapshot_that_cannot_be_written_is_said_before_the_sensor_is_read(file: str, said: str) -> None:
    assert said in refused("snapshot", "ens5", file)


@needs_bus
@pytest.mark.parametrize("command", ["eeprom", "objects", "save", "tare"])
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
        ('\ufeff{"format": "ethercat-sensor snapshot", "version": 1}', "damaged"),
    ],
)
def test_a_file_that_is_no_snapshot(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    assert named in refused("restore", "ens5", path, code=2)


def test_a_server_of_another_user_is_asked_for_its_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it listens on cannot be seen; only what it says of the interface in question counts."""
    monkeypatch.setattr(holder, "master_sockets", lambda _: {1})
    monkeypatch.setattr(holder, "users_of", lambda *_: [])
    with ScriptedServer() as server:
        server.description = description(interface="ens5")
        monkeypatch.setenv("BOTA_SERVER", f"127.0.0.1:{server.port}")
        assert str(find_holder("ens5")) == "ethercat-server"
        assert find_holder("ens5") == (None, "ethercat-server", ("127.0.0.1", server.port))
        assert str(find_holder("ens6")) == "another EtherCAT master"
        monkeypatch.setattr(holder, "master_sockets", lambda _: set())
        assert find_holder("ens5") == (None, "ethercat-server", ("127.0.0.1", server.port)), "elsewhere"
        assert find_holder("nosuch0") is None


@pytest.mark.parametrize(
    ("script", "command"),
    [
        ("find_ethernet_adapters", "adapters"),
        ("read_eeprom", "eeprom"),
        ("bota_ethercat_minimal_example", "read"),
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
        (["raed", "ens5"], "did you mean 'read'?"),
        (["apply", "ens5", "--set", "sinc_lenght=64"], "did you mean 'sinc_length'?"),
        (["apply", "ens5", "--set", "sinc=128"], "did you mean 'sinc_length'?"),
        (
            ["apply", "ens5", "--set", "Filter=3"],
            "did you mean 'acceleration_filter' or 'angular_rate_filter'?",
        ),
        (["apply", "ens5", "--set", "IMU=1"], "did you mean 'imu_active'?"),
        (["read", "ens5", "rate"], "did you mean Sampling rate or "),
        (
            ["read", "ens5", "sinc"],
            "did you mean SINC length or Force/torque filter SINC length?",
        ),
        (["apply", "ens5", "--set", "FIR_filter=on"], "fast, chop"),
        (["xyzzy"], "there are adapters, "),
        (["tare", "ens5", "--samples", "0"], "'0': it must be a whole number from 1 to 20000"),
        (["filters", "--loop", "abc"], "'abc': it must be a number from 0.1 to 100000"),
    ],
)
def test_a_name_that_there_is_not_is_answered_with_the_nearest(arguments: list[str], guess: str) -> None:
    said = tool_here(*arguments, code=2).err
    assert guess in said
    assert ("did you mean" in said) == ("did you mean" in guess)


def test_the_table_of_subcommands_is_what_their_modules_have() -> None:
    """The table is read without loading them."""
    for module in {module for module, _ in COMMANDS.values()}:
        commands = import_module(f"ethercat_server.tool.{module}").COMMANDS
        assert [*commands] == [name for name, (of, _) in COMMANDS.items() if of == module]


def test_the_docs_show_every_setting_and_subcommand() -> None:
    docs = (ROOT / "docs" / "sensor-tool.md").read_text()
    for name, setting in SETTINGS.items():
        entry = BY_SETTING[name]
        states = ("PREOP", "SAFEOP", "OP") if entry.index == 0x8010 else ("PREOP",)
        assert entry.access.write_states == states
        default = "left alone" if setting.default is None else str(setting.default).lower()
        assert f"\n| `{name}` | 0x{entry.index:04X}:{entry.subindex} | {default} |" in docs
    assert not [name for name in COMMANDS if f"$ ethercat-sensor {name}" not in docs]


def reader(image: bytes) -> bytes:
    def read(word: int, words: int) -> bytes:
        assert 1 <= words <= MAX_SII_WORDS
        return image[word * 2 : (word + words) * 2].ljust(words * 2, b"\xff")

    return read_image(read)


def test_an_image_is_read_to_the_end_of_its_categories_and_no_further() -> None:
    image = build_image(sensor_device("BFT-ROKS-ECAT-M8", 7, 77))
    read = reader(image)
    assert image.startswith(read)
    assert len(read) < len(image)
    found = decode(read)
    assert (found["name"], found["serial"], found["check_byte_right"]) == ("BFT-ROKS-ECAT-M8", 7, True)
    assert list(found["categories"]) == ["strings", "general", "FMMUs", "sync managers", "TxPDOs", "RxPDOs"]
    assert not decode(image[:2] + bytes([image[2] ^ 1]) + image[3:])["check_byte_right"]


@pytest.mark.parametrize("blank", [b"\0", b"\xff"])
def test_blank_memory_ends_an_image_as_the_end_mark_does(blank: bytes) -> None:
    whole = reader(build_image(sensor_device("BFT-ROKS-ECAT-M8", 7, 61)))
    for kept in (0, 0x80, len(whole) - 4):
        read = reader(whole[:kept].ljust(0x8000, blank))
        assert len(read) == max(0x100, kept + 4)
        assert decode(read)["categories"] == (decode(whole)["categories"] if kept > 0x80 else {})


def test_a_category_that_no_eeprom_has_room_for_is_not_read() -> None:
    assert len(reader(b"\xaa" * 0x8000)) == 0x100
    assert raw_lines(reader(b""))[0] == "0000: ff|ff|ff|ff"


@given(st.binary(max_size=600))
def test_nonsense_is_taken_apart_without_complaint(tail: bytes) -> None:
    read = reader(build_image(sensor_device("BFT-ROKS-ECAT-M8", 7, 61))[:0x80] + tail)
    decode(read)
    assert len(read) <= 2 * 0x2000 + 8
