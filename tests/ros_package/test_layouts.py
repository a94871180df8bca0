"""PlotJuggler, Foxglove and RViz files: they can be read, and show topics and fields that the node has."""

from __future__ import annotations

import functools
import json
from typing import Final
from xml.etree import ElementTree

import pytest
import yaml

from tests.ros_package.package_files import PACKAGE

CONFIG: Final = PACKAGE / "config"
# Topics of the node in the root namespace, with their types.
TOPICS: Final = {
    "/sensone_sensor_data": "std_msgs/Float64MultiArray",
    "/wrench": "geometry_msgs/WrenchStamped",
    "/wrench_compensated": "geometry_msgs/WrenchStamped",
    "/compensation/bias": "geometry_msgs/WrenchStamped",
    "/compensation/tool": "geometry_msgs/WrenchStamped",
    "/imu/data_raw": "sensor_msgs/Imu",
    "/temperature": "sensor_msgs/Temperature",
    "/diagnostics": "diagnostic_msgs/DiagnosticArray",
}


def assert_shown(topic: str, fields: list[str]) -> None:
    """The topic is the node's, and its messages have the field (if ROS is there to tell)."""
    package, name = TOPICS[topic].split("/")
    messages = pytest.importorskip(f"{package}.msg", reason="ROS messages are missing")
    assert isinstance(functools.reduce(getattr, fields, getattr(messages, name)()), float), fields


def test_plotjuggler_plots_fields_of_the_nodes_topics() -> None:
    root = ElementTree.parse(CONFIG / "plotjuggler_layout.xml").getroot()
    streamer, plugin = root.find("previouslyLoaded_Streamer"), root.find("Plugins/plugin")
    selected = root.find("Plugins/plugin/selected_topics")
    assert streamer is not None
    assert plugin is not None
    assert selected is not None
    assert streamer.get("name") == plugin.get("ID") == "ROS2 Topic Subscriber"
    subscribed = set(str(selected.get("value")).split(";"))
    shown = set()
    for curve in [str(curve.get("name")) for curve in root.iter("curve")]:
        (topic,) = [topic for topic in subscribed if curve.startswith(topic + "/")]
        assert_shown(topic, curve.removeprefix(topic + "/").split("/"))
        shown.add(topic)
    assert shown == subscribed


def test_foxglove_plots_fields_of_the_nodes_topics_and_shows_the_diagnostics() -> None:
    panels = json.loads((CONFIG / "foxglove_layout.json").read_text())["configById"].values()
    values = [path["value"] for panel in panels for path in panel.get("paths", ())]
    assert values
    for value in values:
        topic, *fields = value.split(".")
        assert_shown(topic, fields)
    assert {panel["topicToRender"] for panel in panels if "topicToRender" in panel} == {"/diagnostics"}


def test_rviz_shows_the_wrenches() -> None:
    manager = yaml.safe_load((CONFIG / "wrench.rviz").read_text())["Visualization Manager"]
    shown = {
        display["Topic"]["Value"]: display["Class"] for display in manager["Displays"] if "Topic" in display
    }
    assert shown == dict.fromkeys(("/wrench", "/wrench_compensated"), "rviz_default_plugins/Wrench")
    (model,) = [display for display in manager["Displays"] if display["Class"].endswith("/RobotModel")]
    assert model["Description Topic"]["Value"] == "/robot_description"  # of robot_state_publisher
    assert all("Topic" not in tool for tool in manager["Tools"])
    assert manager["Global Options"]["Fixed Frame"] == "base_link"  # of urdf/example.urdf.xacro
