"""The ros2_control package: what it says of itself. In a controller manager: scripts/try-ros2-control."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest
import xacro
from catkin_pkg.package import parse_package

from tests.clients.cpp_programs import INCLUDE as CLIENT
from tests.clients.cpp_programs import ROOT, needs_gxx

PACKAGE = ROOT / "clients" / "ros2_control"
INCLUDE = PACKAGE / "include" / "bota_ethercat_hardware"
PAGE = (ROOT / "docs" / "ros2-control.md").read_text()


def names(table: str, file: str) -> list[str]:
    text = (INCLUDE / file).read_text()
    rows = text[text.index(table) :].split("\n};", 1)[0]
    return re.findall(r'^    \{"([\w.]+)"' if "Row" in table else r'"([\w.]+)"', rows, re.MULTILINE)


PARAMETERS = names("Row kRows[] = {", "parameters.hpp")
SIGNALS = names("kSignals = {", "sensor_loop.hpp")


def test_the_page_has_every_parameter_and_no_other() -> None:
    table = PAGE.split("| Parameter |", 1)[1].split("\n\n", 1)[0]
    assert (
        re.findall(r"`([\w.]+)`", "\n".join(row.split("|")[1] for row in table.splitlines()[2:]))
        == PARAMETERS
    )


def test_the_package_names_its_plugin() -> None:
    library = ElementTree.parse(PACKAGE / "bota_ethercat_hardware.xml").getroot()
    plugin = library.find("class")
    assert plugin is not None
    source = (PACKAGE / "src" / "force_torque_sensor.cpp").read_text()
    assert f"PLUGINLIB_EXPORT_CLASS({plugin.get('type')}, {plugin.get('base_class_type')})" in source
    macro = (PACKAGE / "urdf/bota_force_torque_sensor.ros2_control.xacro").read_text()
    assert f"<plugin>{plugin.get('name')}</plugin>" in macro
    assert library.get("path") == parse_package(PACKAGE).name


def test_the_macro_lists_what_is_asked_for(tmp_path: Path) -> None:
    macro = PACKAGE / "urdf" / "bota_force_torque_sensor.ros2_control.xacro"
    description = tmp_path / "robot.xacro"
    for flag in ("false", "true"):
        flags = " ".join(f'{name}="{flag}"' for name in ("imu", "orientation", "temperature", "compensated"))
        description.write_text(
            '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
            f'<xacro:include filename="{macro}"/>'
            f'<xacro:bota_force_torque_sensor name="wrist" {flags}>'
            '<parameters><param name="port">12002</param></parameters>'
            "</xacro:bota_force_torque_sensor></robot>"
        )
        robot = ElementTree.fromstring(xacro.process_file(str(description)).toxml())
        sensors = {str(each.get("name")): each.findall("state_interface") for each in robot.iter("sensor")}
        assert list(sensors) == ["wrist", "wrist_compensated"][: 1 + (flag == "true")]
        listed = [str(each.get("name")) for each in sensors["wrist"]]
        listed += [f"compensated.{each.get('name')}" for each in sensors.get("wrist_compensated", ())]
        assert len(set(listed)) == len(listed)
        assert set(listed) == set(SIGNALS if flag == "true" else [*SIGNALS[:6], "age", "condition"])
        assert [(p.get("name"), p.text) for p in robot.iter("param")] == [("port", "12002")]


@needs_gxx
@pytest.mark.timeout(300)
def test_the_plugin_compiles_against_the_ros2_control_that_is_installed() -> None:
    """Of any release, as its interface changes; what is deprecated in the newest is an error here."""
    prefixes = map(Path, filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))
    found = [folder for prefix in prefixes for folder in (prefix / "include").glob("*")]
    if not any((folder / "hardware_interface").is_dir() for folder in found):
        pytest.skip("no ros2_control here: source a ROS 2 that has ros-jazzy-ros2-control or newer")
    options = [
        "-std=c++17",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-fsyntax-only",
        f"-I{CLIENT}",
        f"-I{INCLUDE.parent}",
    ]
    system = [option for folder in found for option in ("-isystem", str(folder))]
    source = PACKAGE / "src" / "force_torque_sensor.cpp"
    compiled = subprocess.run(["g++", *options, *system, source], capture_output=True, text=True, check=False)
    assert not compiled.returncode, compiled.stderr
