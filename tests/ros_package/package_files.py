"""The ROS 2 package's files, and the commands of its documentation pages as they are written there."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "ros2_bridge"
SHARED_FOLDERS = ("config", "launch", "urdf")
PROGRAMS = ("ros2", "colcon", "rosdep", "xacro", "rviz2", "export", "sudo")
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"\$ ((?:.*\\\n)*.*\n)([^$]*)")


def shared_files() -> set[str]:
    """Every file of the shared folders, as a path within the package."""
    return {
        str(path.relative_to(PACKAGE))
        for folder in SHARED_FOLDERS
        for path in (PACKAGE / folder).iterdir()
        if path.is_file()
    }


@dataclass(frozen=True)
class Command:
    """What follows the `$` and the lines that the page shows below it."""

    text: str
    output: str = ""


def console(page: str) -> list[Command]:
    """Those of the console blocks, in their order."""
    blocks = [block for language, block in _FENCED.findall(_text(page)) if language == "console"]
    return [Command(text, output) for block in blocks for text, output in _COMMAND.findall(block)]


def in_text(page: str) -> list[Command]:
    """Those in the prose and in the tables."""
    prose = _FENCED.sub("", _text(page))
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose)]
    return [Command(span) for span in spans if span.split()[0] in PROGRAMS and " " in span]


def _text(page: str) -> str:
    return (ROOT / "docs" / page).read_text()
