"""The C++ headers as a package: CMake installs them, a program finds them; colcon and rosdep can name them."""

from __future__ import annotations

import os
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from tests.clients.cpp_programs import CLIENT, ROOT


@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake here: sudo apt install cmake")
def test_cmake_installs_the_header_without_a_compiler(tmp_path: Path) -> None:
    prefix = tmp_path / "prefix"
    commands = (
        ("cmake", "-Werror=dev", "-S", CLIENT, "-B", tmp_path / "b", f"-DCMAKE_INSTALL_PREFIX={prefix}"),
        ("cmake", "--install", tmp_path / "b"),
    )
    for command in commands:
        done = subprocess.run(
            command, check=False, capture_output=True, text=True, env={**os.environ, "CXX": "false"}
        )
        assert done.returncode == 0, done.stdout + done.stderr
    assert (prefix / "include/bota_ethercat.hpp").read_bytes() == (
        CLIENT / "include/bota_ethercat.hpp"
    ).read_bytes()
    config = (prefix / "share/bota_ethercat/cmake/bota_ethercat-config.cmake").read_text()
    assert "bota_ethercat::client" in config
    user = tmp_path / "user"
    user.mkdir()
    (user / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.14)\nproject(user LANGUAGES NONE)\n"
        "find_package(bota_ethercat 0.1 REQUIRED)\n"
    )
    use = ("cmake", "-S", user, "-B", user / "b", f"-DCMAKE_PREFIX_PATH={prefix}")
    done = subprocess.run(use, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_version_is_the_projects() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"project(bota_ethercat VERSION {project['version']} " in (CLIENT / "CMakeLists.txt").read_text()
