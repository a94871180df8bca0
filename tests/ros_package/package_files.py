"""The ROS 2 packages' files, and the commands of their documentation pages as they are written there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "ros2_bridge"
ALIAS = ROOT / "clients" / "bridge"
PACKAGES = {
    "bota_ethercat_protocol": ROOT / "protocol",
    "bota_ethercat_bridge": PACKAGE,
    "bridge": ALIAS,
}
SHARED_FOLDERS = ("config", "launch", "urdf")
PROGRAMS = ("ros2", "colcon", "rosdep", "xacro", "rviz2", "export", "sudo")
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def shared_files(package: Path) -> set[str]:
    """Every file of the shared folders, as a path within the package."""
    paths = [path for folder in SHARED_FOLDERS for path in package.glob(f"{folder}/*")]
    return {str(path.relative_to(package)) for path in paths if path.is_file()}


def commands(page: str) -> list[str]:
    """Those of the console blocks, then those in the prose and in the tables."""
    text = (ROOT / "docs" / page).read_text()
    blocks = [block for language, block in _FENCED.findall(text) if language == "console"]
    typed = [found for block in blocks for found in re.findall(r"^\$ ((?:.*\\\n)*.*\n)", block, re.MULTILINE)]
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", _FENCED.sub("", text))]
    return typed + [span for span in spans if span.split()[0] in PROGRAMS and " " in span]
