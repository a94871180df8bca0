"""colcon builds, installs and tests the package."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from catkin_pkg.packages import find_packages

from tests.ros_package.package_files import PACKAGE, ROOT, commands, shared_files

# What colcon needs for a Python package comes from PyPI; setuptools 80 has lost what --symlink-install needs.
TOOLS = ("colcon-common-extensions", "rosdep", "setuptools<80", "pytest")


@pytest.fixture(scope="module")
def colcon(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with colcon's program: the machine's, or one from PyPI (with rosdep's)."""
    found = shutil.which("colcon")
    if found is not None:
        return Path(found).parent
    environment = tmp_path_factory.mktemp("colcon")
    made = subprocess.run([sys.executable, "-m", "venv", environment], check=False)
    pip = [str(environment / "bin/pip"), "install", "--quiet", "--disable-pip-version-check", *TOOLS]
    if wheels := os.environ.get("TEST_WHEELS"):
        pip += ["--no-index", "--find-links", wheels]
    if made.returncode or subprocess.run(pip, check=False, env=clean_environment()).returncode:
        pytest.skip("colcon is missing and cannot be had from PyPI: run scripts/test --long with a network")
    return environment / "bin"


def clean_environment() -> dict[str, str]:
    """Ours without what belongs to this Python only."""
    dropped = {"PYTHONPATH", "AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    return {name: value for name, value in os.environ.items() if name not in dropped}


@pytest.mark.long
@pytest.mark.parametrize("how", [(), ("--symlink-install",)], ids=["copied", "linked"])
def test_a_workspace_with_only_this_repository(colcon: Path, tmp_path: Path, how: tuple[str, ...]) -> None:
    (tmp_path / "src").mkdir()
    (tmp_path / "src/repository").symlink_to(ROOT)
    environment = clean_environment() | {"PATH": f"{colcon}:{os.environ['PATH']}", "PYTHONWARNINGS": ""}

    def run(*command: str | Path) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, check=False, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    listed = [line.split() for line in run("colcon", "list").splitlines()]
    assert ["bota_ethercat", "src/repository/clients/cpp", "(ros.cmake)"] in listed
    assert ["bridge", "src/repository/ros2_bridge", "(ros.ament_python)"] in listed
    assert {name for name, *_ in listed} <= {"bridge", "bota_ethercat", "bota_ethercat_hardware"}
    cpp = [] if shutil.which("cmake") is None else ["bota_ethercat"]
    run("colcon", "build", *how, "--packages-select", "bridge", *cpp)
    installed = tmp_path / "install/bridge"
    for file in shared_files():
        copy = installed / "share/bridge" / file
        assert copy.read_bytes() == (PACKAGE / file).read_bytes()
        assert bool(how) == (copy.resolve() == PACKAGE / file)
    assert (installed / "share/bridge/package.xml").exists()
    assert (installed / "share/ament_index/resource_index/packages/bridge").exists()
    # In the sourced workspace, from elsewhere: with the package's own protocol, and for `ros2 run` to find.
    sourced = f"cd / && . {tmp_path}/install/setup.sh && "
    assert run("sh", "-c", sourced + "echo $AMENT_PREFIX_PATH").strip() == str(installed)
    used = run("sh", "-c", sourced + f"{installed}/lib/bridge/client --help")
    assert used.startswith("usage: ros2 run bridge client")
    run("colcon", "test", "--return-code-on-test-failure", "--packages-select", "bridge")
    assert "0 errors, 0 failures" in run("colcon", "test-result")


def test_the_link_makes_no_loop_in_a_workspace_inside_the_repository(tmp_path: Path) -> None:
    """rosdep searches with catkin_pkg, which follows links and refuses a package that it finds twice."""
    (tmp_path / "ros2_bridge").mkdir()
    shutil.copy(PACKAGE / "package.xml", tmp_path / "ros2_bridge")
    (link,) = [command for command in commands("ros2-workspace.md") if "ln -s" in command]
    for _ in range(2):  # A second time, which must not put a link into the package.
        subprocess.run(
            ["bash", "-c", link], cwd=tmp_path, env=os.environ | {"HOME": str(tmp_path)}, check=True
        )
    assert [path.name for path in (tmp_path / "ros2_bridge").iterdir()] == ["package.xml"]
    assert list(find_packages(str(tmp_path / "ws/src"))) == ["bridge"]
