"""Command line and configuration file, and what each complaint names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from bota_ethercat.settings import start_up_defaults
from ethercat_server.daemon.options import SERVER_SETTINGS, ServerOptions, parse_options
from ethercat_server.errors import UsageError

NAME = "BFT-SENS-ECAT-M8"
Configured = Callable[..., ServerOptions]


@pytest.fixture
def configured(tmp_path: Path) -> Configured:
    """With this configuration file and these arguments."""

    def parse(text: str | bytes, *arguments: str) -> ServerOptions:
        file = tmp_path / "c.toml"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return parse_options(["ens5", "1", "--config", str(file), *arguments])

    return parse


@pytest.mark.parametrize(
    ("arguments", "name", "port"),
    [
        ([], None, 12001),
        (["12005"], None, 12005),
        ([NAME], NAME, 12001),
        ([NAME, "12005"], NAME, 12005),
        (["--force", "12005"], None, 12005),
    ],
)
def test_the_forms_of_the_command(arguments: list[str], name: str | None, port: int) -> None:
    options = parse_options(["ens5", *arguments])
    assert (options.ifname, options.sensor_name, options.port) == ("ens5", name, port)


def test_options_may_stand_anywhere() -> None:
    options = parse_options(["--set", "sinc_length=128", "ens5", "--set", "fir=yes", "12001"])
    assert options.asked_settings(0, NAME, 1) == {"sinc_length": 128, "fir": True}


def test_what_nobody_sets_has_the_notes_defaults() -> None:
    assert parse_options(["ens5", "1"]).wanted_settings(0, NAME, 1) == start_up_defaults()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["ens5", "1", "--set", "colour=red"], "no setting 'colour'"),
        (["ens5", "1", "--set", "fir"], "NAME=VALUE"),
        (["ens5", "1", "--set", "fir=maybe"], "true or false"),
        (["ens5", "1", "--set", "sinc_length=0"], "from 32 to 2048"),
        (["ens5", "1", "--set", "fast=true"], "fast is true but fir is false"),
        (["ens5", "1", "--virtual", "--bogus"], "requires the interface 'virtual'"),
        (["ens5", "1", "--virtual", "--pdo 77"], "requires the interface 'virtual'"),
        (["ens5", "1", "--config", "/no/such/file.toml"], "No such file"),
    ],
)
def test_wrong_arguments_are_refused_by_name(arguments: list[str], complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint) as error:
        parse_options(arguments)
    assert error.value.exit_code == 2
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "required: IFACE"),
        (["a", "b", "1", "d"], "unrecognized arguments: d"),
        (["ens5", "1200l"], "PORT: '1200l': it must be a whole number from 1 to 65535"),
        (["ens5", NAME, "port"], "PORT: 'port': it must be a whole number from 1 to 65535"),
        (["ens5", "0"], "'0': it must be"),
        (
            ["ens5", "1", "--rt-priority", "100"],
            "--rt-priority: '100': it must be a whole number from 0 to 99",
        ),
    ],
)
def test_what_argparse_refuses(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        parse_options(arguments)
    assert ended.value.code == 2
    assert complaint in capsys.readouterr().err


def test_the_command_line_is_stronger_than_the_file(configured: Configured) -> None:
    text = "[sensor]\nsinc_length = 128\nfir = true\n[sensor.1]\nsinc_length = 256\n"
    options = configured(text, "--set", "fir=off")
    assert options.asked_settings(0, NAME, 1) == {"sinc_length": 128, "fir": False}
    assert options.asked_settings(1, NAME, 2) == {"sinc_length": 256, "fir": False}


def test_single_sensors_have_tables_by_place_serial_number_and_name(configured: Configured) -> None:
    options = configured(
        "[sensor]\nsinc_length = 128\n[sensor.BFT-ROKS-ECAT-M8]\nsinc_length = 205\nimu_active = 2\n"
        '[sensor."serial:77"]\nsinc_length = 256\nimu_active = 3\n[sensor.1]\nsinc_length = 341\n'
    )
    for position, name, serial, expected in (
        (0, "BFT-SENS-ECAT-M8", 1, (128, None)),
        (0, "BFT-ROKS-ECAT-M8", 1, (205, 2)),
        (0, "BFT-ROKS-ECAT-M8", 77, (256, 3)),
        (1, "BFT-ROKS-ECAT-M8", 77, (341, 3)),
    ):
        found = options.asked_settings(position, name, serial)
        assert (found["sinc_length"], found.get("imu_active")) == expected


def test_tables_that_contradict_one_another_for_one_sensor_are_named(configured: Configured) -> None:
    options = configured(
        "[sensor]\nfir = true\n[sensor.BFT-SENS-ECAT-M8]\nfir = false\n[sensor.0]\nfast = true\n"
    )
    assert options.wanted_settings(0, "BFT-ROKS-ECAT-M8", 7)["fast"] is True
    with pytest.raises(UsageError, match=r"sensor 0 .BFT-SENS-ECAT-M8, serial 7. are inconsistent") as error:
        options.wanted_settings(0, NAME, 7)
    assert str(error.value).endswith("correct one of [sensor], [sensor.BFT-SENS-ECAT-M8], [sensor.0]")
    assert error.value.exit_code == 2


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[sensor]\nfir = 1\n", "fir is 1"),
        ("[sensor]\ncolour = 1\n", "no setting 'colour'"),
        ("[sensor.0]\nsinc = 128\n", "did you mean 'sinc_length'?"),
        ("[other]\n", "unexpected 'other'"),
        ("[server]\ncolour = 1\n", "no 'colour'"),
        ("[server]\nrt_priority = 100\n", "from 0 to 99"),
        ("[server]\nrt_priority = true\n", "a whole number"),
        ("[server]\nhosts = ['localhost']\n", "an IP address"),
        ("[server]\nidle_timeout_s = 0\n", "seconds"),
        ("[server]\nunset_settings = 'perhaps'\n", "must be one of defaults, keep"),
        *((f"[server]\nterminals = ['{text}']\n", "must be 0xVENDOR") for text in ("", "0x2:0x3@", "EL1008")),
        ("sensor = 3\n", "unexpected 'sensor'"),
        ('[sensor."serial:x"]\nfir = true\n', "named by a number"),
        ("[sensor.0]\nfast = true\n", "fast is true but fir is false"),
        ("[sensor\n", "not valid TOML"),
        (b"\xff\xfe\x00", r"c.toml is not a text file: it must be TOML in UTF-8$"),
    ],
)
def test_a_wrong_file_is_refused_by_name(configured: Configured, text: str | bytes, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        configured(text)


def test_a_file_as_editors_of_windows_write_it(configured: Configured) -> None:
    options = configured("\ufeff[sensor]\r\nsinc_length = 128\r\n")
    assert options.asked_settings(0, NAME, 1) == {"sinc_length": 128}


def test_the_servers_own_settings_from_file_and_command_line(configured: Configured) -> None:
    text = '[server]\ncontrol_users = ["anna", "ben"]\nrt_priority = 50\nstall_timeout_s = 2.5\n'
    plain = parse_options(["ens5", "1"]).server
    assert plain == {name: setting.default for name, setting in SERVER_SETTINGS.items()}
    from_file = configured(text).server
    assert (from_file["control_users"], from_file["rt_priority"]) == (("anna", "ben"), 50)
    assert from_file["stall_timeout_s"] == 2.5
    assert configured('[server]\ncontrol_users = "anna"\n').server["control_users"] == ("anna",)
    both = configured(text, "--rt-priority", "0", "--control-user", "carl").server
    assert (both["control_users"], both["rt_priority"]) == (("carl",), 0), "the command line wins"
    hosts = parse_options(["ens5", "1", "--host", "10.0.0.1", "--host", "::1"]).server["hosts"]
    assert hosts == ("10.0.0.1", "::1")


def test_unset_settings_are_the_defaults_or_the_sensors(configured: Configured) -> None:
    text = '[server]\nunset_settings = "keep"\n[sensor]\nfast = true\n'
    kept = configured(text)
    assert kept.keep_unset
    assert kept.wanted_settings(0, NAME, 1) == {"fast": True}, "fir is the sensor's"
    assert not parse_options(["ens5", "1"]).keep_unset
    with pytest.raises(UsageError, match="fast is true but fir is false"):
        configured(text, "--unset-settings", "defaults")


def test_every_server_setting_is_on_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse_options(["--help"])
    text = capsys.readouterr().out
    for setting in SERVER_SETTINGS.values():
        assert f"{setting.flag} {setting.metavar}" in text
