"""pip (pyproject.toml) and colcon (setup.py) install the same files: all in the package's folders."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
import tomllib
import types
import zipfile
from pathlib import Path
from typing import Any

import pytest
import setuptools

from tests.ros_package.package_files import PACKAGE, ROOT, SHARED_FOLDERS, shared_files
from tests.ros_package.page_commands import in_text

MARKER = "share/ament_index/resource_index/packages"


def data_files_of_pip() -> dict[str, set[str]]:
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["data-files"]
    return {
        target: {str(path.relative_to(PACKAGE)) for pattern in patterns for path in ROOT.glob(pattern)}
        for target, patterns in table.items()
    }


def data_files_of_colcon(monkeypatch: pytest.MonkeyPatch) -> dict[str, set[str]]:
    asked: dict[str, Any] = {}
    stand_in = types.ModuleType("setuptools")
    stand_in.__dict__["setup"] = lambda **keywords: asked.update(keywords)
    stand_in.__dict__["find_packages"] = setuptools.find_packages
    monkeypatch.setitem(sys.modules, "setuptools", stand_in)
    monkeypatch.chdir(PACKAGE)
    runpy.run_path("setup.py")
    return {target: set(files) for target, files in asked["data_files"]}


def test_both_install_everything_in_the_shared_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    pip = data_files_of_pip()
    # colcon makes this one itself, from the entry point.
    assert pip.pop("lib/bridge") == {"resource/client"}
    assert pip == data_files_of_colcon(monkeypatch)
    assert pip[MARKER] == {"resource/bridge"}
    assert pip["share/bridge"] == {"package.xml"}
    found = [pip[f"share/bridge/{folder}"] for folder in SHARED_FOLDERS]
    assert set().union(*found) == shared_files()
    for folder, files in zip(SHARED_FOLDERS, found, strict=True):
        assert all(Path(file).parent.name == folder for file in files)


def test_no_other_folder_has_files() -> None:
    """A new folder has to be named in both, or it is installed by neither."""
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name[0] not in "._"}
    assert folders - {"bridge.egg-info"} == {
        *SHARED_FOLDERS, "bridge", "ft_compensation", "protocol", "resource", "test",
    }  # fmt: skip


def copied(folder: Path) -> Path:
    """The checkout: what is built would otherwise be left in it."""
    copy = folder / "copy"
    shutil.copytree(
        ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(".*", "build", "*.egg-info", "__pycache__")
    )
    return copy


@pytest.mark.long
def test_what_is_for_an_index_is_built_and_checked(tmp_path: Path) -> None:
    if (wheels := os.environ.get("TEST_WHEELS")) is None:
        pytest.skip("build and twine come from PyPI: run scripts/test --long with a network")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--find-links", wheels]
    subprocess.run([*pip, "--target", tmp_path / "tools", "build", "twine"], check=True)
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "tools")}

    def run(*command: str | Path) -> None:
        done = subprocess.run(
            [sys.executable, "-m", *command], env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr

    run("build", "--no-isolation", "--outdir", tmp_path / "dist", copied(tmp_path))
    made = sorted((tmp_path / "dist").iterdir())
    assert [path.suffix for path in made] == [".whl", ".gz"]
    run("twine", "check", "--strict", *made)


@pytest.mark.long
def test_the_wheel_has_them_where_ros_looks(tmp_path: Path) -> None:
    copy = copied(tmp_path)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "-w", tmp_path, copy], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = {name.partition(".data/data/")[2] for name in archive.namelist()}
    assert {f"share/bridge/{file}" for file in shared_files()} <= names
    assert {f"{MARKER}/bridge", "share/bridge/package.xml", "lib/bridge/client"} <= names

    bota = tmp_path / "bota"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", bota], check=True)
    pip = [sys.executable, "-m", "pip", f"--python={bota}/bin/python", "install", "--quiet"]
    subprocess.run([*pip, "--no-deps", "--no-index", wheel], check=True)
    (export,) = [
        command.text for command in in_text("ros2-workspace.md") if command.text.startswith("export")
    ]
    shell = f'{export}; cd "${{AMENT_PREFIX_PATH%%:*}}" && ls {MARKER}/bridge && lib/bridge/client --help'
    environment = os.environ | {"HOME": str(tmp_path)}
    used = subprocess.run(["bash", "-c", shell], env=environment, check=True, capture_output=True, text=True)
    assert "usage: ros2 run bridge client" in used.stdout
