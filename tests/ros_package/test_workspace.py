"""colcon builds, installs and tests the packages."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from catkin_pkg.packages import find_packages

from tests.clients.cpp_programs import CLIENT as CPP
from tests.ros_package.package_files import PACKAGES, ROOT, commands, shared_files

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
@pytest.mark.parametrize("how", [(), ("--symlink-install",)], ids=["archives", "linked"])
def test_a_workspace_with_only_this_repository(colcon: Path, tmp_path: Path, how: tuple[str, ...]) -> None:
    """Whole and linked, or with an archive of each package's own folder, as a release has it."""
    environment = clean_environment() | {"PATH": f"{colcon}:{os.environ['PATH']}", "PYTHONWARNINGS": ""}

    def run(*command: str | Path) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, check=False, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    folders = PACKAGES | {"bota_ethercat": CPP}
    if how:
        (tmp_path / "src").symlink_to(ROOT)
    else:
        for name, folder in folders.items():
            (tmp_path / "src" / name).mkdir(parents=True)
            archive = f"git -C {ROOT} archive HEAD:{folder.relative_to(ROOT)} | tar x -C src/{name}"
            run("bash", "-c", f"set -o pipefail; {archive}")
    listed = {name: kind for name, _, kind in map(str.split, run("colcon", "list").splitlines())}
    for optional in ("bota_ethercat_hardware", "bota_ethercat_msgs"):
        listed.pop(optional, None)
    assert listed == {**dict.fromkeys(PACKAGES, "(ros.ament_python)"), "bota_ethercat": "(ros.cmake)"}
    names = [name for name in folders if name != "bota_ethercat" or shutil.which("cmake")]
    run("colcon", "build", *how, "--packages-select", *names)
    # In the sourced workspace, from elsewhere.
    sourced = f"cd / && . {tmp_path}/install/setup.sh && "
    prefixes = run("sh", "-c", sourced + "echo $AMENT_PREFIX_PATH").strip().split(":")
    assert sorted(prefixes) == sorted(f"{tmp_path}/install/{name}" for name in names)
    for name in names:
        installed = tmp_path / "install" / name
        assert (installed / "share/ament_index/resource_index/packages" / name).exists()
        source = folders[name] if how else tmp_path / "src" / name
        for file in {"package.xml", *shared_files(source)}:
            copy = installed / "share" / name / file
            assert copy.read_bytes() == (source / file).read_bytes()
            linked = copy.resolve() == (source / file).resolve()
            assert linked == (bool(how) and name in PACKAGES)  # CMake copies
    for name in ("bridge", "bota_ethercat_bridge"):  # For `ros2 run` to find.
        used = run("sh", "-c", sourced + f"{tmp_path}/install/{name}/lib/{name}/client --help")
        assert used.startswith("examples:\n  ros2 run bridge client")
        assert "\nusage: ros2 run bridge client" in used
    run("colcon", "test", "--return-code-on-test-failure", "--packages-select", *names)
    assert "0 errors, 0 failures" in run("colcon", "test-result")


def test_the_links_make_no_loop_in_a_workspace_inside_the_repository(tmp_path: Path) -> None:
    """rosdep searches with catkin_pkg, which follows links and refuses a package that it finds twice."""
    for folder in PACKAGES.values():
        shutil.copytree(folder, tmp_path / folder.relative_to(ROOT), symlinks=True)
    (link,) = [command for command in commands("ros2-workspace.md") if "ln -s" in command]
    for _ in range(2):  # A second time, which must not put a link into the package.
        subprocess.run(
            ["bash", "-c", link], cwd=tmp_path, env=os.environ | {"HOME": str(tmp_path)}, check=True
        )
    found = find_packages(str(tmp_path / "ws/src"))
    assert sorted(package.name for package in found.values()) == sorted(PACKAGES)
