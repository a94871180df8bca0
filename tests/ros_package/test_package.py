"""The ROS 2 package: its manifest, what pip and colcon install, its layouts."""

from __future__ import annotations

import functools
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
import types
import zipfile
from pathlib import Path
from typing import Any, Final

import pytest
import setuptools
from catkin_pkg.package import parse_package

from tests.ros_package.package_files import PACKAGE, ROOT, SHARED_FOLDERS, commands, shared_files
from tests.test_architecture import imports

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MARKER = "share/ament_index/resource_index/packages"


def test_the_manifest_and_one_version() -> None:
    warnings: list[str] = []
    package = parse_package(str(PACKAGE), warnings=warnings)
    assert not warnings
    assert (package.name, package.licenses, package.package_format) == ("bridge", ["Apache-2.0"], 3)
    assert package.get_build_type() == "ament_python"
    # colcon takes a package with an invalid address for plain Python.
    assert all(re.fullmatch(r"[^@ ]+@[^@ ]+\.[a-z]+", each.email) for each in package.maintainers)
    version = PROJECT["project"]["version"]
    assert parse_package(str(PACKAGE)).version == version
    assert f'version="{version}"' in (PACKAGE / "setup.py").read_text()


def test_everything_that_is_imported_is_a_dependency_once() -> None:
    ours = {"bridge", "ft_compensation", "bota_ethercat", "__future__", *sys.stdlib_module_names}
    ours.add("bota_ethercat_msgs")  # used where it is there
    # Packages that are not named as their modules; the package tf2_ros is C++.
    packages = {"tf2_ros": "tf2_ros_py", "numpy": "python3-numpy"}
    needed = {
        packages.get(name, name)
        for folder in ("bridge", "ft_compensation", "launch")
        for path in (PACKAGE / folder).rglob("*.py")
        for name in {imported.split(".")[0] for imported in imports(path)} - ours
    }
    # xacro is for the files in urdf/.
    depends = [each.name for each in parse_package(str(PACKAGE)).exec_depends]
    assert sorted(needed | {"xacro"}) == sorted(depends)


def test_every_package_of_python_files_is_installed() -> None:
    find = PROJECT["tool"]["setuptools"]["packages"]["find"]
    tops = [ROOT / where / name.strip("*") for where in find["where"] for name in find["include"]]
    for top in filter(Path.is_dir, tops):
        for path in top.rglob("*.py"):
            assert (path.parent / "__init__.py").exists(), path
    assert {top.name for top in tops if top.is_dir()} == {name.strip("*") for name in find["include"]}
    assert (PACKAGE / "bota_ethercat").samefile(ROOT / "protocol" / "bota_ethercat")
    assert (PACKAGE / "resource" / "client").stat().st_mode & 0o111


def data_files_of_pip() -> dict[str, set[str]]:
    return {
        target: {str(path.relative_to(PACKAGE)) for pattern in patterns for path in ROOT.glob(pattern)}
        for target, patterns in PROJECT["tool"]["setuptools"]["data-files"].items()
    }


def data_files_of_colcon(monkeypatch: pytest.MonkeyPatch) -> dict[str, set[str]]:
    asked: dict[str, Any] = {}
    stand_in = types.ModuleType("setuptools")
    stand_in.__dict__["setup"] = lambda **keywords: asked.update(keywords)
    stand_in.__dict__["find_packages"] = setuptools.find_packages
    monkeypatch.setitem(sys.modules, "setuptools", stand_in)
    monkeypatch.chdir(PACKAGE)
    runpy.run_path("setup.py")
    assert "bridge.publishing" in asked["packages"]
    return {target: set(files) for target, files in asked["data_files"]}


def test_both_install_the_same_everything_in_the_shared_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    pip = data_files_of_pip()
    # colcon makes this one itself, from the entry point.
    assert pip.pop("lib/bridge") == {"resource/client"}
    assert pip == data_files_of_colcon(monkeypatch)
    assert pip[MARKER] == {"resource/bridge"}
    assert pip["share/bridge"] == {"package.xml"}
    for folder in SHARED_FOLDERS:
        files = {file for file in shared_files() if Path(file).parent.name == folder}
        assert pip[f"share/bridge/{folder}"] == files != set()
    # A new folder has to be named in both, or it is installed by neither.
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name[0] not in "._"}
    code = {"bridge", "ft_compensation", "bota_ethercat", "resource", "test"}
    assert folders - {"bridge.egg-info"} == {*SHARED_FOLDERS, *code}


@pytest.mark.long
def test_what_is_for_an_index_is_built_and_checked_and_has_its_files_where_ros_looks(tmp_path: Path) -> None:
    if (wheels := os.environ.get("TEST_WHEELS")) is None:
        pytest.skip("build and twine come from PyPI: run scripts/test --long with a network")
    copy = tmp_path / "copy"  # what is built would otherwise be left in the checkout
    ignored = shutil.ignore_patterns(".*", "build", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, copy, symlinks=True, ignore=ignored)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--find-links", wheels]
    subprocess.run([*pip, "--target", tmp_path / "tools", "build", "twine"], check=True)
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "tools")}

    def run(*command: str | Path) -> None:
        done = subprocess.run(
            [sys.executable, "-m", *command], env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr

    run("build", "--no-isolation", "--outdir", tmp_path / "dist", copy)
    wheel, source = sorted((tmp_path / "dist").iterdir(), key=lambda path: path.suffix, reverse=True)
    assert (wheel.suffix, source.suffix) == (".whl", ".gz")
    run("twine", "check", "--strict", wheel, source)
    with zipfile.ZipFile(wheel) as archive:
        names = {name.partition(".data/data/")[2] for name in archive.namelist()}
    assert {f"share/bridge/{file}" for file in shared_files()} <= names
    assert {f"{MARKER}/bridge", "share/bridge/package.xml", "lib/bridge/client"} <= names

    bota = tmp_path / "bota"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", bota], check=True)
    pip = [sys.executable, "-m", "pip", f"--python={bota}/bin/python", "install", "--quiet"]
    subprocess.run([*pip, "--no-deps", "--no-index", wheel], check=True)
    (export,) = [command for command in commands("ros2-workspace.md") if command.startswith("export")]
    shell = f'{export}; cd "${{AMENT_PREFIX_PATH%%:*}}" && ls {MARKER}/bridge && lib/bridge/client --help'
    environment = os.environ | {"HOME": str(tmp_path)}
    used = subprocess.run(["bash", "-c", shell], env=environment, check=True, capture_output=True, text=True)
    assert "usage: ros2 run bridge client" in used.stdout


# Topics of the node in the root namespace, with what a layout plots of them.
PLOTTED: Final = {
    "/sensone_sensor_data": "std_msgs/Float64MultiArray",
    "/wrench": "geometry_msgs/WrenchStamped",
    "/wrench_compensated": "geometry_msgs/WrenchStamped",
    "/compensation/bias": "geometry_msgs/WrenchStamped",
    "/compensation/tool": "geometry_msgs/WrenchStamped",
    "/imu/data_raw": "sensor_msgs/Imu",
    "/temperature": "sensor_msgs/Temperature",
}


@pytest.mark.parametrize(
    ("layout", "path"),
    [
        ("plotjuggler_layout.xml", r'curve [^>]*name="([^"]+)"'),
        ("foxglove_layout.json", r'"value": "(/[^"]+)"'),
        ("wrench.rviz", r"Value: (/wrench.*)"),
    ],
)
def test_a_layout_plots_fields_of_the_nodes_topics(layout: str, path: str) -> None:
    shown = set(re.findall(path, (PACKAGE / "config" / layout).read_text()))
    assert shown
    for each in shown:
        topic = max((topic for topic in PLOTTED if re.match(rf"{topic}(?![a-z_])", each)), key=len)
        package, name = PLOTTED[topic].split("/")
        messages = pytest.importorskip(f"{package}.msg", reason="ROS messages are missing")
        fields = re.split(r"[./]", each.removeprefix(topic))[1:]
        value = functools.reduce(getattr, fields, getattr(messages, name)())
        assert not fields or isinstance(value, float), each
