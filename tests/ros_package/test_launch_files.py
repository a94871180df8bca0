"""The launch files without ROS: which arguments they offer, what they refuse, what the page says of them."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from tests.ros_package.launch_stand_in import arguments_of, stand_in
from tests.ros_package.package_files import PACKAGE, ROOT

LAUNCH = PACKAGE / "launch"
NODE = {
    "params_file", "namespace", "server_host", "server_port", "sensor", "frame_id", "imu_frame_id",
    "array_topic", "respawn", "log_level",
}  # fmt: skip
SERVER = {"server_port", "server_command", "sensor_options"}
# Of each file, the arguments that have an effect: what a file sets itself is none.
ARGUMENTS = {
    "bridge": NODE,
    "virtual_server": SERVER,
    "demo": (NODE | SERVER) - {"server_host"},
    "two_sensors": (NODE | SERVER | {"virtual"})
    - {"namespace", "sensor", "frame_id", "imu_frame_id", "array_topic", "sensor_options"},
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_it_offers_the_arguments_that_have_an_effect(name: str) -> None:
    listed = arguments_of(LAUNCH / f"{name}.launch.py")
    assert set(listed) == ARGUMENTS[name]
    assert len(listed) == len(ARGUMENTS[name])


def start_node(params_file: str) -> list[object]:
    with stand_in():
        actions = runpy.run_path(str(LAUNCH / "bridge.launch.py"))["start_node"]({"params_file": params_file})
    assert isinstance(actions, list)
    return actions


def test_a_parameter_file_that_is_not_there_is_refused() -> None:
    """launch_ros would start the node with its defaults: with the wrong sensor, say."""
    with pytest.raises(FileNotFoundError, match=r"params_file: there is no file /.*/nofile\.yaml"):
        start_node("nofile.yaml")


def test_a_parameter_file_in_the_home_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The shell leaves the ~ of `params_file:=~/robot.yaml` as it is."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "robot.yaml").touch()
    assert len(start_node("~/robot.yaml")) == 1


def test_the_page_names_every_file_and_argument() -> None:
    page = (ROOT / "docs/ros2-workspace.md").read_text()
    assert {file.name for file in LAUNCH.glob("*.launch.py")} == {f"{name}.launch.py" for name in ARGUMENTS}
    for name, arguments in ARGUMENTS.items():
        assert f"`{name}.launch.py`" in page
        assert [argument for argument in arguments if f"`{argument}`" not in page] == []
