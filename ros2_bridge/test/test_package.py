# SPDX-License-Identifier: Apache-2.0
"""What `colcon test` runs: the package is whole. What it does is tested in the repository's tests/."""

import importlib
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "name", ["bridge.client", "bridge.stream.link", "bridge.stream.frame_selector", "bota_ethercat.framing"]
)
def test_it_imports_without_ros(name: str) -> None:
    assert importlib.import_module(name)


def test_the_node_imports_with_ros() -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not sourced")
    assert importlib.import_module("bridge.node")


def test_the_program_says_how_it_is_used() -> None:
    run = subprocess.run(
        [sys.executable, "-m", "bridge.client", "--help"], check=True, capture_output=True, text=True
    )
    assert run.stdout.startswith("examples:\n  ros2 run bridge client")
    assert "\nusage: ros2 run bridge client" in run.stdout
