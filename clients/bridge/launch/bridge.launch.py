# SPDX-License-Identifier: Apache-2.0
"""The launch file of the same name of `bota_ethercat_bridge`; the other files here are links to this one."""

from pathlib import Path

from ament_index_python.packages import get_package_share_path
from launch.actions import IncludeLaunchDescription

from launch import LaunchDescription


def generate_launch_description():
    file = get_package_share_path("bota_ethercat_bridge") / "launch" / Path(__file__).name
    return LaunchDescription([IncludeLaunchDescription(str(file))])
