"""colcon builds, installs and tests the package; docs/ros2-workspace.md is followed word for word."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import pytest
from catkin_pkg.packages import find_packages

from tests.ros_package.package_files import PACKAGE, ROOT, Command, console, in_text, shared_files

# What colcon needs for a Python package comes from PyPI; setuptools 80 has lost what --symlink-install needs.
TOOLS = ("colcon-common-extensions", "rosdep", "setuptools<80", "pytest")
PAGE = "ros2-workspace.md"
# Not run with the others: one writes to /etc; test_data_files.py and the first test below have the other two.
ELSEWHERE = ("sudo rosdep init", "export AMENT_PREFIX_PATH=", "colcon build --symlink-install")
COMMANDS = [*console(PAGE), *(c for c in in_text(PAGE) if not c.text.startswith(ELSEWHERE))]
ENDLESS_S = 5


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
    asked = 'python3 -c "from bridge.client import PROFILES; print(PROFILES.read_text())"'
    assert "nackSupressionDuration" in run("sh", "-c", sourced + asked)
    run("colcon", "test", "--return-code-on-test-failure", "--packages-select", "bridge")
    assert "0 errors, 0 failures" in run("colcon", "test-result")


@dataclass(frozen=True)
class Ran:
    status: int
    output: str
    missing: str


# Where there is no ROS, what needs it is missing, but not the others; endless programs get Ctrl-C.
SHELL = """
source() { [ "$1" = /opt/ros/jazzy/setup.bash ] && ! [ -e "$1" ] || builtin source "$@"; }
ros2() { timeout --signal=INT --preserve-status ENDLESS_S "$(type -P ros2)" "$@"; }
rviz2() { timeout --signal=INT --preserve-status ENDLESS_S "$(type -P rviz2)" "$@"; }
"""


def rosdep_database(folder: Path) -> dict[str, str]:
    """The environment for a rosdep that asks this folder and not the network."""
    needs = {
        depend.text for depend in ElementTree.parse(PACKAGE / "package.xml").iter() if "depend" in depend.tag
    }
    (folder / "sources").mkdir(parents=True)
    (folder / "sources/20-default.list").write_text(f"yaml file://{folder}/base.yaml")
    (folder / "base.yaml").write_text(
        "".join(f"{need}: {{ubuntu: []}}\n" for need in sorted(map(str, needs)))
    )
    (folder / "index.yaml").write_text(
        "distributions: {jazzy: {distribution: [jazzy.yaml], distribution_type: ros2, python_version: 3}}\n"
        "type: index\nversion: 4\n"
    )
    (folder / "jazzy.yaml").write_text(
        "type: distribution\nversion: 2\nrelease_platforms: {ubuntu: [noble]}\nrepositories: {}\n"
    )
    return {
        "ROSDEP_SOURCE_PATH": f"{folder}/sources",
        "ROSDISTRO_INDEX_URL": f"file://{folder}/index.yaml",
        "ROS_OS_OVERRIDE": "ubuntu:24.04:noble",
        "ROS_DISTRO": "jazzy",
        "ROS_HOME": f"{folder}/home",
    }


@pytest.fixture(scope="module")
def session(colcon: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ran]:
    """One shell in this repository, into which the page's commands are typed one after the other."""
    home = tmp_path_factory.mktemp("home")
    environment = clean_environment() | rosdep_database(home / "rosdep") | {
        "HOME": str(home),
        "PATH": f"{colcon}:{os.environ['PATH']}",
        "PYTHONWARNINGS": "",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }  # fmt: skip
    typed = [SHELL.replace("ENDLESS_S", str(ENDLESS_S))]
    for number, command in enumerate(COMMANDS):
        quoted = shlex.quote(command.text.replace("FILE", "/dev/null"))
        typed.append(
            f"eval {quoted} >{home}/{number}.output 2>&1 </dev/null; echo $? >{home}/{number}.status"
        )
    subprocess.run(["bash", "-c", "\n".join(typed)], cwd=ROOT, env=environment, check=True)
    return {
        command.text: Ran(
            int((home / f"{number}.status").read_text()),
            (home / f"{number}.output").read_text(),
            missing(command, environment["PATH"]),
        )
        for number, command in enumerate(COMMANDS)
    }


def missing(command: Command, path: str) -> str:
    """The program that the command needs and this machine lacks, if any."""
    for name in ("rosdep", "colcon", "ros2", "xacro", "rviz2"):
        if name in command.text.split() and shutil.which(name, path=path) is None:
            return name
    return "a display" if "rviz2" in command.text and "DISPLAY" not in os.environ else ""


@pytest.mark.long
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.text.strip()[:40])
def test_a_command_of_the_page(session: dict[str, Ran], command: Command) -> None:
    """Those that do not end by themselves take real seconds: what they show needs their processes."""
    ran = session[command.text]
    if ran.missing:
        pytest.skip(f"{ran.missing} is missing")
    if re.search(r"Package '(?!bridge')\w+' not found", ran.output):
        pytest.skip(ran.output.strip())
    assert ran.status == 0, ran.output
    if command.text.startswith("ros2 run bridge client"):
        assert "no server at localhost:12001" in ran.output


def test_the_link_makes_no_loop_in_a_workspace_inside_the_repository(tmp_path: Path) -> None:
    """rosdep searches with catkin_pkg, which follows links and refuses a package that it finds twice."""
    (tmp_path / "ros2_bridge").mkdir()
    shutil.copy(PACKAGE / "package.xml", tmp_path / "ros2_bridge")
    (link,) = [command.text for command in COMMANDS if "ln -s" in command.text]
    for _ in range(2):  # A second time, which must not put a link into the package.
        subprocess.run(
            ["bash", "-c", link], cwd=tmp_path, env=os.environ | {"HOME": str(tmp_path)}, check=True
        )
    assert [path.name for path in (tmp_path / "ros2_bridge").iterdir()] == ["package.xml"]
    assert list(find_packages(str(tmp_path / "ws/src"))) == ["bridge"]
