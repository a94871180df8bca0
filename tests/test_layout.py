"""What must be the same everywhere: versions and packages."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
PRODUCT = sorted(
    path
    for folder in (
        "protocol",
        "ethercat_server",
        "clients",
        "ros2_bridge/bridge",
        "ros2_bridge/ft_compensation",
    )
    for path in (ROOT / folder).rglob("*.py")
    if "ros2_control" not in path.parts  # a ROS package in C++
)


def test_one_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    for name, pattern in (("package.xml", r"<version>(.*?)</version>"), ("setup.py", r'version="(.*?)"')):
        found = re.search(pattern, (ROOT / "ros2_bridge" / name).read_text())
        assert found is not None
        assert found[1] == version, name


def test_every_package_of_python_files_is_installed() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    for path in PRODUCT:
        package = ".".join(path.relative_to(ROOT).parent.parts).removeprefix("ros2_bridge.")
        assert package in listed, path
    assert "packages=find_packages(" in (ROOT / "ros2_bridge" / "setup.py").read_text()


def test_the_ros_package_is_whole() -> None:
    package = ROOT / "ros2_bridge"
    manifest = (package / "package.xml").read_text()
    # colcon takes a package with an invalid address for plain Python.
    assert re.search(r'<maintainer email="[^@" ]+@[^@" ]+\.[a-z]+">', manifest)
    assert "<build_type>ament_python</build_type>" in manifest
    assert (package / "resource" / "bridge").exists()
    assert (package / "resource" / "client").stat().st_mode & 0o111
    assert (package / "protocol" / "framing.py").samefile(ROOT / "protocol" / "framing.py")
