"""Command line and configuration file, and what each complaint names."""

from __future__ import annotations

from pathlib import Path

import pytest

from ethercat_server.daemon.options import SERVER_SETTINGS, parse_options
from ethercat_server.errors import UsageError


def test_both_forms_of_the_command() -> None:
    short = parse_options(["ens5", "12001"])
    assert (short.ifname, short.sensor_name, short.port) == ("ens5", None, 12001)
    note = parse_options(["ens5", "BFT-SENS-ECAT-M8", "12001"])
    assert (note.ifname, note.sensor_name, note.port) == ("ens5", "BFT-SENS-ECAT-M8", 12001)


def test_options_may_stand_anywhere() -> None:
    options = parse_options(["--set", "sinc_length=128", "ens5", "--set", "fir=yes", "12001"])
    assert options.asked_settings(0, "BFT-SENS-ECAT-M8", 1) == {"sinc_length": 128, "fir": True}


def test_defaults_are_the_notes() -> None:
    wanted = parse_options(["ens5", "1"]).wanted_settings(0, "BFT-SENS-ECAT-M8", 1)
    assert wanted == {
        "calibration_matrix": True,
        "temperature_compensation": False,
        "imu_active": 1,
        "acceleration_range_g": 2,
        "angular_rate_range_dps": 250,
        "acceleration_filter": 1,
        "angular_rate_filter": 3,
        "fir": False,
        "fast": False,
        "chop": False,
        "sinc_length": 64,
    }


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["ens5"], "PORT is missing: usage is ethercat-server IFACE"),
        (["a", "b", "c", "d"], "unexpected argument 'd'"),
        (["ens5", "port"], "'port' is not a number"),
        (["ens5", "0"], "port 0 is out of range"),
        (["ens5", "70000"], "port 70000 is out of range"),
        (["ens5", "1", "--set", "colour=red"], "no setting 'colour'"),
        (["ens5", "1", "--set", "fir"], "NAME=VALUE"),
        (["ens5", "1", "--set", "fir=maybe"], "true or false"),
        (["ens5", "1", "--set", "sinc_length=0"], "from 32 to 2048"),
        (["ens5", "1", "--set", "acceleration_range_g=3"], "one of 2, 4, 8, 16"),
        (["ens5", "1", "--set", "angular_rate_filter=2"], "from 3 to 9"),
        (["ens5", "1", "--set", "fast=true"], "fast is true but fir is false"),
        (["ens5", "1", "--virtual", "--pdo 77"], "requires the interface 'virtual'"),
    ],
)
def test_wrong_arguments_are_refused_by_name(arguments: list[str], complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint) as error:
        parse_options(arguments)
    assert error.value.exit_code == 2
    assert "\n" not in str(error.value)


def test_configuration_file(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[sensor]\nsinc_length = 128\nfir = true\n[sensor.1]\nsinc_length = 256\n")
    options = parse_options(["ens5", "1", "--config", str(file), "--set", "fir=off"])
    assert options.asked_settings(0, "BFT-SENS-ECAT-M8", 1) == {"sinc_length": 128, "fir": False}
    assert options.asked_settings(1, "BFT-SENS-ECAT-M8", 2) == {"sinc_length": 256, "fir": False}


def test_single_sensors_have_tables_by_place_serial_number_and_name(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text(
        "[sensor]\nsinc_length = 128\n[sensor.BFT-ROKS-ECAT-M8]\nsinc_length = 205\nimu_active = 2\n"
        '[sensor."serial:77"]\nsinc_length = 256\nimu_active = 3\n[sensor.1]\nsinc_length = 341\n'
    )
    options = parse_options(["ens5", "1", "--config", str(file)])

    def asked(position: int, name: str, serial: int) -> tuple[object, object]:
        found = options.asked_settings(position, name, serial)
        return found["sinc_length"], found.get("imu_active")

    assert asked(0, "BFT-SENS-ECAT-M8", 1) == (128, None)
    assert asked(0, "BFT-ROKS-ECAT-M8", 1) == (205, 2)
    assert asked(0, "BFT-ROKS-ECAT-M8", 77) == (256, 3)
    assert asked(1, "BFT-ROKS-ECAT-M8", 77) == (341, 3)


def test_tables_that_contradict_one_another_for_one_sensor_are_named(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[sensor]\nfir = true\n[sensor.BFT-SENS-ECAT-M8]\nfir = false\n[sensor.0]\nfast = true\n")
    options = parse_options(["ens5", "1", "--config", str(file)])
    assert options.wanted_settings(0, "BFT-ROKS-ECAT-M8", 7)["fast"] is True
    with pytest.raises(UsageError, match=r"sensor 0 .BFT-SENS-ECAT-M8, serial 7. are inconsistent") as error:
        options.wanted_settings(0, "BFT-SENS-ECAT-M8", 7)
    assert str(error.value).endswith("correct one of [sensor], [sensor.BFT-SENS-ECAT-M8], [sensor.0]")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[sensor]\nfir = 1\n", "fir is 1"),
        ("[sensor]\ncolour = 1\n", "no setting 'colour'"),
        ("[other]\n", "unexpected 'other'"),
        ("server = 1\n", "unexpected 'server'"),
        ("[server]\ncolour = 1\n", "no 'colour'"),
        ("[server]\nrt_priority = 100\n", "from 0 to 99"),
        ("[server]\nrt_priority = true\n", "a number"),
        ("[server]\ncontrol_users = 'anna'\n", "a list of strings"),
        ("[server]\nhosts = ['localhost']\n", "an IP address"),
        ("[server]\nidle_timeout_s = 0\n", "seconds"),
        ("sensor = 3\n", "unexpected 'sensor'"),
        ('[sensor."serial:x"]\nfir = true\n', "named by a number"),
        ("[sensor.0]\nfast = true\n", "fast is true but fir is false"),
        ("[sensor\n", "not valid TOML"),
    ],
)
def test_wrong_configuration_is_refused_by_name(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(UsageError, match=complaint):
        parse_options(["ens5", "1", "--config", str(file)])
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match=r"c.toml is not a text file: it must be TOML in UTF-8$"):
        parse_options(["ens5", "1", "--config", str(file)])


def test_the_servers_own_settings_from_file_and_command_line(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text('[server]\ncontrol_users = ["anna", "ben"]\nrt_priority = 50\nstall_timeout_s = 2.5\n')
    plain = parse_options(["ens5", "1"]).server
    assert plain == {name: setting.default for name, setting in SERVER_SETTINGS.items()}
    from_file = parse_options(["ens5", "1", "--config", str(file)]).server
    assert (from_file["control_users"], from_file["rt_priority"]) == (("anna", "ben"), 50)
    assert from_file["stall_timeout_s"] == 2.5
    both = ["ens5", "1", "--config", str(file), "--rt-priority", "0", "--control-user", "carl"]
    assert parse_options(both).server["rt_priority"] == 0, "the command line wins"
    assert parse_options(both).server["control_users"] == ("carl",)
    assert parse_options(["ens5", "1", "--host", "10.0.0.1", "--host", "::1"]).server["hosts"] == (
        "10.0.0.1",
        "::1",
    )


def test_unset_settings_are_the_defaults_or_the_sensors(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text('[server]\nunset_settings = "keep"\n[sensor]\nfast = true\n')
    kept = parse_options(["ens5", "1", "--config", str(file)])
    assert kept.keep_unset
    assert kept.wanted_settings(0, "BFT-SENS-ECAT-M8", 1) == {"fast": True}, "fir is the sensor's"
    assert not parse_options(["ens5", "1"]).keep_unset
    with pytest.raises(UsageError, match="fast is true but fir is false"):
        parse_options(["ens5", "1", "--config", str(file), "--unset-settings", "defaults"])
    file.write_text('[server]\nunset_settings = "perhaps"\n')
    with pytest.raises(UsageError, match="must be 'defaults' or 'keep'"):
        parse_options(["ens5", "1", "--config", str(file)])


def test_every_server_setting_is_on_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse_options(["--help"])
    text = capsys.readouterr().out
    for setting in SERVER_SETTINGS.values():
        assert f"{setting.flag} {setting.metavar}" in text


def test_missing_configuration_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        parse_options(["ens5", "1", "--config", str(tmp_path / "none.toml")])
