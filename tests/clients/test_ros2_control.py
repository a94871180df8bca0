"""The ros2_control package: what it says of itself and, with ROS, what a real controller manager says."""

from __future__ import annotations

import base64
import contextlib
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
import xacro
import yaml
from catkin_pkg.package import parse_package

from tests.clients.cpp_programs import CLIENT, ROOT
from tests.served_simulation import served
from tests.server.running import wait_until

PACKAGE = ROOT / "clients" / "ros2_control"
INCLUDE = PACKAGE / "include" / "bota_ethercat_hardware"
PAGE = (ROOT / "docs" / "ros2-control.md").read_text()
NEEDS = [need.name for need in parse_package(PACKAGE).exec_depends if need.name != "bota_ethercat"]


def names(table: str, file: str) -> list[str]:
    """The strings that begin the rows of a table in C++."""
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


def test_the_controllers_are_those_of_the_arm() -> None:
    controllers = yaml.safe_load((PACKAGE / "config" / "mock_arm_controllers.yaml").read_text())
    arm = (PACKAGE / "urdf" / "mock_arm.urdf.xacro").read_text()
    named = set(controllers["controller_manager"]["ros__parameters"]) - {"update_rate"}
    assert named == controllers.keys() - {"controller_manager"}
    joints = controllers["admittance_controller"]["ros__parameters"]["joints"]
    assert [f'<xacro:mock_joint number="{joint.removeprefix("joint")}"' in arm for joint in joints] == [
        True
    ] * 6


# -- with ROS


def sourced() -> dict[str, str]:
    """The environment that scripts/test was started in."""
    kept = base64.b64decode(os.environ.get("TEST_SOURCED_ROS", ""))
    rows = (row.partition("=") for row in kept.decode(errors="surrogateescape").split("\0") if row)
    environment = {name: value for name, _, value in rows} if kept else dict(os.environ)
    return environment | {
        name: os.environ[name] for name in ("ROS_DOMAIN_ID", "ROS_LOG_DIR") if name in os.environ
    }


def missing() -> list[str]:
    """What a controller manager with the example's controllers needs and this machine has not."""
    environment = sourced()
    prefixes = environment.get("AMENT_PREFIX_PATH", "").split(":")
    index = "share/ament_index/resource_index/packages"
    packages = [name for name in NEEDS if not any((Path(p) / index / name).exists() for p in prefixes)]
    # xacro may come from PyPI, without an entry in the index.
    programs = ("colcon", "cmake", "g++", "ros2", "xacro")
    return sorted({*packages} - {"xacro"}) + [
        p for p in programs if not shutil.which(p, path=environment["PATH"])
    ]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both packages, built by colcon."""
    workspace = tmp_path_factory.mktemp("workspace")
    environment = sourced()
    python = shutil.which("python3", path=environment["PATH"])
    command = f"colcon build --base-paths {CLIENT} {PACKAGE} --cmake-args -DPython3_EXECUTABLE={python}"
    done = subprocess.run(
        command.split(), cwd=workspace, env=environment, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return workspace / "install" / "setup.bash"


@contextlib.contextmanager
def launched(setup: Path, output: Path, **arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    told = " ".join(f"{name}:='{value}'" for name, value in arguments.items())
    line = f". {setup} && exec ros2 launch bota_ethercat_hardware mock_arm.launch.py {told}"
    with output.open("wb") as log:
        process = subprocess.Popen(
            ["bash", "-c", line], env=sourced(), stdout=log, stderr=log, start_new_session=True
        )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(20)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


MISSING = missing()


@pytest.mark.skipif(
    bool(MISSING), reason=f"no ROS 2 with ros2_control is sourced ({', '.join(MISSING[:3])}, ... missing)"
)
@pytest.mark.timeout(300)
def test_a_real_controller_manager(installed: Path, tmp_path: Path) -> None:
    """Real seconds: a launch with the admittance controller, until the server is gone."""
    output = tmp_path / "launch"

    with (
        served() as server,
        launched(installed, output, host="127.0.0.1", port=server.port, virtual="false") as process,
    ):

        def said(text: str) -> None:
            wait_until(lambda: text in output.read_text() or process.poll() is not None, text, 60)
            assert text in output.read_text()

        said("Configured and activated admittance_controller")
        topic = "/force_torque_sensor_broadcaster/wrench geometry_msgs/msg/WrenchStamped"
        echo = f"ros2 topic echo --once --csv {topic} --field wrench"
        told = subprocess.run(
            ["bash", "-c", echo], env=sourced(), check=False, capture_output=True, text=True, timeout=60
        )
        assert told.returncode == 0, told.stderr
        (wrench, *_) = (line.split(",") for line in told.stdout.splitlines() if "," in line)
        assert len(wrench) == 6
        assert all(abs(float(number)) < 1000 for number in wrench)  # and no NaN
        assert "rror" not in output.read_text()
        server.kill()
        said("nobody listens there")
        said("given up: disconnected")
        said(
            "Deactivating following controllers as their hardware components read cycle resulted in an error"
        )
