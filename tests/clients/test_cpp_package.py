"""The C++ headers as a package that CMake, colcon and rosdep can find."""

from __future__ import annotations

import os
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from catkin_pkg.package import parse_package
from catkin_pkg.packages import find_packages

from tests.clients.cpp_programs import CLIENT, HEADERS, INCLUDE, ROOT, needs_gxx

USER = {
    "CMakeLists.txt": """
cmake_minimum_required(VERSION 3.14)
project(user LANGUAGES CXX)
find_package(bota_ethercat 99.1 QUIET)
if(bota_ethercat_FOUND)
  message(FATAL_ERROR "another version was found")
endif()
find_package(bota_ethercat 0.1 REQUIRED)
add_executable(user user.cpp)
target_link_libraries(user PRIVATE bota_ethercat::client)
""",
    "user.cpp": """
#include <bota_ethercat/stream.hpp>
int main() { return bota_ethercat::Client().latest().fresh(); }
""",
}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def run(*command: str | Path, **environment: str) -> str:
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, env={**os.environ, **environment}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake here: sudo apt install cmake")
@needs_gxx
def test_cmake_installs_the_headers_and_a_program_finds_them(tmp_path: Path) -> None:
    """Installed without a compiler, below a prefix as colcon has it."""
    prefix, user = tmp_path / "prefix", tmp_path / "user"
    settings = (f"-DCMAKE_INSTALL_PREFIX={prefix}", "-Werror=dev")
    run("cmake", "-S", CLIENT, "-B", tmp_path / "b", *settings, CXX="false")
    run("cmake", "--install", tmp_path / "b")
    installed = {path.relative_to(prefix / "include"): path for path in prefix.rglob("*.hpp")}
    assert {name: path.read_bytes() for name, path in installed.items()} == {
        path.relative_to(INCLUDE): path.read_bytes() for path in HEADERS
    }
    assert (prefix / "share/bota_ethercat/package.xml").exists()
    user.mkdir()
    for name, text in USER.items():
        (user / name).write_text(text)
    run("cmake", "-S", user, "-B", user / "b", f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", user / "b")
    run(user / "b/user")


def test_the_version_is_the_projects() -> None:
    text = (CLIENT / "CMakeLists.txt").read_text()
    assert f"project(bota_ethercat VERSION {PROJECT['version']} " in text


def test_the_package_is_named_as_the_ros_one_is() -> None:
    """rosdep and colcon read package.xml; it needs nothing but CMake."""
    package, bridge = (parse_package(path) for path in (CLIENT, ROOT / "ros2_bridge"))
    assert (package.name, package.version) == ("bota_ethercat", PROJECT["version"])
    assert package.get_build_type() == "cmake"
    assert [need.name for need in package.buildtool_depends] == ["cmake"]
    assert not [*package.build_depends, *package.exec_depends, *package.test_depends]
    for name in ("version", "licenses", "package_format"):
        assert getattr(package, name) == getattr(bridge, name), name
    assert str(package.maintainers[0]) == str(bridge.maintainers[0])
    assert package.validate() is None


def test_the_repository_in_a_workspace_is_its_packages_and_nothing_else() -> None:
    expected = {"ros2_bridge": "bridge", "clients/cpp": "bota_ethercat"}
    if (ROOT / "clients/ros2_control/package.xml").exists():
        expected["clients/ros2_control"] = "bota_ethercat_hardware"
    found = find_packages(str(ROOT))
    assert {path: package.name for path, package in found.items()} == expected
