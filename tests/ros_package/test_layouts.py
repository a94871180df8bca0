"""PlotJuggler, Foxglove and RViz files: they can be read, and show topics and fields that the node has."""

from __future__ import annotations

import functools
import json
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from tests.ros_package.package_files import PACKAGE

CONFIG = PACKAGE / "config"
# Topics of the node in the root namespace, with their types.
TOPICS = {
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
    assert topic in TOPICS
    package, name = TOPICS[topic].split("/")
    messages = pytest.importorskip(f"{package}.msg", reason="ROS messages are missing")
    value = functools.reduce(getattr, fields, getattr(messages, name)())
    assert isinstance(value, float), fields


def plotjuggler() -> ElementTree.Element:
    return ElementTree.parse(CONFIG / "plotjuggler_layout.xml").getroot()


def plotjuggler_topics() -> set[str]:
    selected = plotjuggler().find("Plugins/plugin/selected_topics")
    assert selected is not None
    return set(str(selected.get("value")).split(";"))


def test_plotjuggler_subscribes_to_topics_of_the_node() -> None:
    root = plotjuggler()
    assert root.tag == "root"
    assert plotjuggler_topics() <= set(TOPICS)
    streamer, plugin = root.find("previouslyLoaded_Streamer"), root.find("Plugins/plugin")
    assert streamer is not None
    assert plugin is not None
    assert streamer.get("name") == plugin.get("ID") == "ROS2 Topic Subscriber"


def test_plotjuggler_curves_are_fields_of_the_topics_it_subscribes_to() -> None:
    curves = [str(curve.get("name")) for curve in plotjuggler().iter("curve")]
    assert curves
    shown = set()
    for curve in curves:
        (topic,) = [topic for topic in plotjuggler_topics() if curve.startswith(topic + "/")]
        assert_shown(topic, curve.removeprefix(topic + "/").split("/"))
        shown.add(topic)
    assert shown == plotjuggler_topics()


def foxglove() -> dict[str, Any]:
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text())
    assert isinstance(layout, dict)
    return layout


def test_foxglove_plots_fields_of_the_node_s_topics_and_shows_the_diagnostics() -> None:
    panels = foxglove()["configById"].values()
    values = [path["value"] for panel in panels for path in panel.get("paths", ())]
    assert values
    for value in values:
        topic, *fields = value.split(".")
        assert_shown(topic, fields)
    assert {panel["topicToRender"] for panel in panels if "topicToRender" in panel} == {"/diagnostics"}


def test_rviz_shows_the_wrenches() -> None:
    manager = yaml.safe_load((CONFIG / "wrench.rviz").read_text())["Visualization Manager"]
    wrenches = [
        display for display in manager["Displays"] if display["Class"] == "rviz_default_plugins/Wrench"
    ]
    topics = {display["Topic"]["Value"] for display in wrenches}
    assert topics == {"/wrench", "/wrench_compensated"}
    (model,) = [display for display in manager["Displays"] if display["Class"].endswith("/RobotModel")]
    assert model["Description Topic"]["Value"] == "/robot_description"  # of robot_state_publisher
    named = {display["Topic"]["Value"] for display in manager["Displays"] if "Topic" in display}
    assert named == topics
    assert all("Topic" not in tool for tool in manager["Tools"])
    assert manager["Global Options"]["Fixed Frame"] == "base_link"  # of urdf/example.urdf.xacro
