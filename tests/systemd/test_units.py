"""The unit files: what systemd makes of them, and that they leave the server no more than it needs."""

from __future__ import annotations

import os
import subprocess
import tomllib
from pathlib import Path

import pytest

from bota_ethercat.settings import check_settings, start_up_defaults
from bridge.parameters.table import PARAMETERS
from ethercat_server.daemon.options import EMPTY, SERVER_SETTINGS, parse_options, read_config
from ethercat_server.ethercat import nic
from ethercat_server.process import realtime
from tests.systemd.staging import (
    BRIDGE_UNIT,
    CAPABILITIES,
    SERVER_UNIT,
    UNITS,
    Stage,
    need_systemd,
    stage,
    values,
)

__all__ = ["stage"]
MOST_EXPOSURE = 2.5


def analyze(*arguments: str, units: Path | None = None) -> subprocess.CompletedProcess[str]:
    # The colon adds the system's own units, of which ours need some targets.
    path = {"SYSTEMD_UNIT_PATH": f"{units}:"} if units else {}
    return subprocess.run(
        ["systemd-analyze", *arguments],
        check=False, capture_output=True, text=True, env={**os.environ, **path, "LC_ALL": "C"},
    )  # fmt: skip


def test_the_installed_units_are_without_fault(stage: Stage) -> None:
    stage.install("--bridge", "enp3s0-1")
    folder = stage.path / "etc/systemd/system"
    units = [folder / SERVER_UNIT.name, folder / BRIDGE_UNIT.name]
    for unit in units:
        unit.write_text(unit.read_text().replace("/opt/ethercat-server", str(stage.prefix)))
    checked = analyze("verify", "--man=no", "--recursive-errors=no", *map(str, units), units=folder)
    ours = [line for line in checked.stderr.splitlines() if "ethercat" in line]
    assert not ours
    assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("unit", [SERVER_UNIT, BRIDGE_UNIT], ids=lambda unit: unit.name)
def test_little_is_exposed(unit: Path) -> None:
    need_systemd()
    checked = analyze("security", "--offline=true", f"--threshold={MOST_EXPOSURE * 10:.0f}", str(unit))
    assert checked.returncode == 0, checked.stdout + checked.stderr


@pytest.mark.parametrize(
    ("unit", "key", "expected"),
    [
        (SERVER_UNIT, "AmbientCapabilities", [" ".join(CAPABILITIES)]),
        (SERVER_UNIT, "CapabilityBoundingSet", [" ".join(CAPABILITIES)]),
        (SERVER_UNIT, "RestrictRealtime", []),
        (SERVER_UNIT, "LimitRTPRIO", ["99"]),
        (SERVER_UNIT, "LimitMEMLOCK", ["infinity"]),
        (SERVER_UNIT, "RuntimeDirectory", [nic.DIRECTORY.relative_to("/run").name]),
        (SERVER_UNIT, "RuntimeDirectoryPreserve", ["yes"]),  # other instances use it
        (SERVER_UNIT, "Restart", ["on-failure"]),
        (BRIDGE_UNIT, "AmbientCapabilities", []),
        (BRIDGE_UNIT, "CapabilityBoundingSet", [""]),
        (BRIDGE_UNIT, "RestrictRealtime", []),
        (BRIDGE_UNIT, "LimitMEMLOCK", ["infinity"]),
        (BRIDGE_UNIT, "Restart", ["on-failure"]),
        # The node does not depend on the server.
        *((BRIDGE_UNIT, key, []) for key in ("Requires", "BindsTo", "PartOf", "Requisite")),
    ],
)
def test_a_unit_says(unit: Path, key: str, expected: list[str]) -> None:
    assert values(unit, key) == expected


def test_the_nodes_real_time_priority_is_below_the_servers() -> None:
    (limit,) = values(BRIDGE_UNIT, "LimitRTPRIO")
    (node,) = (row.default for row in PARAMETERS if row.name == "rt_priority")
    assert isinstance(node, int)
    assert node <= int(limit) < realtime.DEFAULT_PRIORITY


def test_a_usage_error_is_not_tried_again_and_each_service_has_a_user_of_its_own() -> None:
    for unit in (SERVER_UNIT, BRIDGE_UNIT):
        (prevented,) = values(unit, "RestartPreventExitStatus")
        assert "2" in prevented.split()
    lines = (UNITS / "ethercat-server.sysusers.conf").read_text().splitlines()[1:]
    users = [line.split()[1] for line in lines]
    assert users == values(SERVER_UNIT, "User") + values(BRIDGE_UNIT, "User")


def test_the_default_configuration_says_nothing_new() -> None:
    text = (UNITS / "default.toml").read_text()
    assert tomllib.loads(text) == {"server": {}, "sensor": {}}
    taken_out = [
        line.removeprefix("# ") for line in text.splitlines() if line.startswith("# ") and " = " in line
    ]
    servers, sensors = "\n".join(taken_out).split("calibration_matrix")
    assert tomllib.loads(servers).keys() == SERVER_SETTINGS.keys()
    for name, value in tomllib.loads(servers).items():
        setting = SERVER_SETTINGS[name]
        checked = setting.check(value)
        assert checked == setting.default or name in {"control_users", "control_groups", "cpu", "user"}, name
    assert read_config(UNITS / "default.toml") == EMPTY
    common = tomllib.loads("calibration_matrix" + sensors.rpartition("\n")[0])
    assert check_settings(common) == start_up_defaults()


def test_the_unit_starts_the_server_as_it_wants_to_be_started(tmp_path: Path) -> None:
    (command,) = values(SERVER_UNIT, "ExecStart")
    (settings,) = values(SERVER_UNIT, "Environment")
    variables = dict(word.split("=", 1) for word in settings.split())
    variables["CONFIG"] = str(tmp_path / "empty.toml")
    Path(variables["CONFIG"]).touch()
    for model in ("", "BFT-SENS-ECAT-M8"):
        variables["SENSOR_NAME"] = model
        words = command.replace("%I", "ens5")
        for name, value in variables.items():
            words = words.replace(f"${{{name}}}", value).replace(f"${name}", value)
        options = parse_options(words.split()[1:])
        assert (options.ifname, options.port, options.sensor_name) == ("ens5", 12001, model or None)
