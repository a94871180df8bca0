"""Where the ROS 2 package's files are, and which of them are for share/bridge."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "ros2_bridge"
SHARED_FOLDERS = ("config", "launch", "urdf")


def shared_files() -> set[str]:
    """Every file of the shared folders, as a path within the package."""
    return {
        str(path.relative_to(PACKAGE))
        for folder in SHARED_FOLDERS
        for path in (PACKAGE / folder).iterdir()
        if path.is_file()
    }
