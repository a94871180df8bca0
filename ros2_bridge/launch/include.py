# SPDX-License-Identifier: Apache-2.0
"""Includes another launch file of this folder, for the launch files beside it, which load it by its path."""

from pathlib import Path

from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource


class File(IncludeLaunchDescription):
    """The launch file with these arguments; `--show-args` lists the others only."""

    def __init__(self, name, condition=None, **given):
        # A plain path, so that --show-args can look into the file.
        source = PythonLaunchDescriptionSource(str(Path(__file__).with_name(name)))
        super().__init__(source, condition=condition, launch_arguments=given.items())
        self.given = given

    def get_sub_entities(self):
        (description,) = super().get_sub_entities()
        return [entity for entity in description.entities if getattr(entity, "name", "") not in self.given]
