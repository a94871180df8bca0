"""The ROS 2 package: its manifest, what pip and colcon install, its layouts."""

from __future__ import annotations

import configparser
import functools
import re
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Final

import pytest
from catkin_pkg.changelog import Changelog, populate_changelog_from_rst
from catkin_pkg.package import parse_package
from catkin_pkg.packages import find_packages
from docutils.core import publish_doctree

from bota_ethercat.program.version import VERSION
from scripts.completions import PLACES
from scripts.ros_packages import changelog, folders, main
from tests.ros_package.package_files import PACKAGE, PACKAGES, ROOT, SHARED_FOLDERS, shared_files
from tests.test_architecture import imports

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CLIENTS = tomllib.loads((ROOT / "clients/pyproject.toml").read_text())
MARKER = "share/ament_index/resource_index/packages"


def test_the_manifests_and_one_version() -> None:
    warnings: list[str] = []
    found = find_packages(str(ROOT), warnings=warnings)
    assert not warnings
    folders = {"clients/cpp": "bota_ethercat", "clients/ros2_control": "bota_ethercat_hardware"}
    folders["clients/bota_ethercat_msgs"] = "bota_ethercat_msgs"
    folders |= {str(folder.relative_to(ROOT)): name for name, folder in PACKAGES.items()}
    assert {path: package.name for path, package in found.items()} == folders
    version = PROJECT["project"]["version"]
    assert CLIENTS["project"]["version"] == version == VERSION
    for package in found.values():
        assert (package.version, package.licenses, package.package_format) == (version, ["Apache-2.0"], 3)
        # colcon takes a package with an invalid address for plain Python.
        assert all(re.fullmatch(r"[^@ ]+@[^@ ]+\.[a-z]+", each.email) for each in package.maintainers)
        assert not any("example" in each.email for each in package.maintainers)
        if package.name in PACKAGES:
            assert package.get_build_type() == "ament_python"
            metadata = setup_of(PACKAGES[package.name])["metadata"]
            assert dict(metadata) == {"name": package.name, "version": version}


def test_the_folder_of_each_package_has_by_itself_what_an_index_takes() -> None:
    markdown, license_text = (ROOT / "CHANGELOG.md").read_text(), (ROOT / "LICENSE").read_bytes()
    assert {folder.relative_to(ROOT) for folder in folders()} == set(map(Path, find_packages(str(ROOT))))
    for folder in folders():
        package = parse_package(str(folder))
        assert [(folder / each.file).read_bytes() for each in package.licenses] == [license_text]
        assert not (folder / package.licenses[0].file).is_symlink()  # an archive of the folder has no target
        assert (folder / "README.md").read_text().startswith(f"# {package.name}\n")
        assert (folder / "CHANGELOG.rst").read_text() == changelog(package.name, markdown)


# catkin_pkg uses what docutils calls obsolete.
@pytest.mark.filterwarnings("ignore:nodes.Node.traverse:DeprecationWarning")
def test_a_changelog_has_catkins_form() -> None:
    text = """# Changelog
## [Unreleased]
### Added
- not yet
## [1.10.0] - 2026-03-01
### Added
- Node: `rest.*_drift` and
  [`--at`](docs/a.md) of a_ *link*.
### Removed
- That.
## [1.9.1] - 2026-02-03
### Changed
- This.
"""
    made = changelog("some_package", text)
    publish_doctree(made, settings_overrides={"halt_level": 2, "report_level": 5})  # a warning is an error
    parsed = populate_changelog_from_rst(Changelog("some_package"), made)
    versions = {
        version: (f"{date:%F}", str(content[0])) for version, date, content in parsed.foreach_version()
    }
    assert {version: date for version, (date, _) in versions.items()} == {
        "1.10.0": "2026-03-01", "1.9.1": "2026-02-03",
    }  # fmt: skip
    assert "* Node: ``rest.*_drift`` and ``--at`` of a\\_ \\*link\\*.\n\n* Removed\n\n  * That." in made
    assert "not yet" not in made


@pytest.mark.parametrize(
    "wrong",
    ["", "example", "http://git.bota.test/ft/x", "https://git.bota.test", "https://localhost/ft/x", "https://example.com/ft/x",
     "https://github.com/OWNER/x", "https://github.com/your-name/x", "https://github.com/ft/TODO"],
)  # fmt: skip
def test_the_urls_are_asked_for_once_and_a_placeholder_is_refused(
    wrong: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in folders():
        (tmp_path / folder.relative_to(ROOT)).mkdir(parents=True)
        shutil.copy(folder / "package.xml", tmp_path / folder.relative_to(ROOT))
    shutil.copy(ROOT / "CHANGELOG.md", tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    assert main([wrong] if wrong else [], tmp_path) == 1
    assert "give that of this project" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before
    for given in ("https://github.com/ft/first", "https://git.bota.test/ft/x/"), (), ():
        for each in given:
            assert main([each], tmp_path) == 0
        assert given or main([], tmp_path) == 0
        for folder in folders(tmp_path):
            urls = {url.type: url.url for url in parse_package(str(folder)).urls if url.type != "website"}
            url = "https://git.bota.test/ft/x"
            assert urls == {"bugtracker": f"{url}/issues", "repository": url}


def test_everything_that_is_imported_is_a_dependency_once() -> None:
    ours = {"bota_ethercat_bridge", "bota_ft_compensation", "bota_ethercat", "__future__"}
    ours |= sys.stdlib_module_names
    ours.add("bota_ethercat_msgs")  # used where it is there
    # Packages that are not named as their modules; the package tf2_ros is C++.
    packages = {"tf2_ros": "tf2_ros_py", "numpy": "python3-numpy"}
    needed = {
        packages.get(name, name)
        for folder in ("bota_ethercat_bridge", "bota_ft_compensation", "bridge", "ft_compensation", "launch")
        for path in (PACKAGE / folder).rglob("*.py")
        for name in {imported.split(".")[0] for imported in imports(path)} - ours
    }
    # xacro is for the files in urdf/.
    depends = [each.name for each in parse_package(str(PACKAGE)).exec_depends]
    assert sorted(needed | {"xacro", "bota_ethercat_protocol"}) == sorted(depends)


def test_every_package_of_python_files_is_installed() -> None:
    find = PROJECT["tool"]["setuptools"]["packages"]["find"]
    tops = [ROOT / where / name.strip("*") for where in find["where"] for name in find["include"]]
    tops = [top for top in tops if (top / "__init__.py").exists()]
    for path in (path for top in tops for path in top.rglob("*.py")):
        assert (path.parent / "__init__.py").exists(), path
    assert {top.name for top in tops} == {name.strip("*") for name in find["include"]}
    assert all(
        (PACKAGE / "resource" / name).stat().st_mode & 0o111 for name in ("client", "check_subscription")
    )


def setup_of(package: Path) -> configparser.ConfigParser:
    setup = configparser.ConfigParser()
    setup.read(package / "setup.cfg")
    return setup


def test_both_install_the_same_everything_in_the_shared_folders() -> None:
    pip = {
        target: {path for pattern in patterns for path in ROOT.glob(pattern)}
        for target, patterns in PROJECT["tool"]["setuptools"]["data-files"].items()
    }
    expected: dict[str, set[Path]] = {MARKER: set()}
    for name, package in PACKAGES.items():
        colcon = {
            target: set(package.glob(pattern))
            for target, pattern in setup_of(package)["options.data_files"].items()
        }
        assert colcon.pop(MARKER) == {package / "resource" / name}
        expected[MARKER].add(package / "resource" / name)
        assert colcon == {f"share/{name}": {package / "package.xml"}} | {
            f"share/{name}/{folder}": {
                package / file for file in shared_files(package) if file.startswith(folder)
            }
            for folder in SHARED_FOLDERS
            if (package / folder).exists()
        }
        expected |= colcon
    # colcon makes these itself, from the entry points.
    started = {name: PACKAGE / "resource" / name for name in ("client", "check_subscription")}
    expected |= {"lib/bridge": {started["client"]}, "lib/bota_ethercat_bridge": {*started.values()}}
    generated = {f"share/{Path(place).parent}" for place in PLACES.values()}
    assert {target: paths for target, paths in pip.items() if target not in generated} == expected
    assert generated < pip.keys()
    # A new folder has to be named in both, or it is installed by neither.
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name[0] not in "._"}
    code = {"bota_ethercat_bridge", "bota_ft_compensation", "bridge", "ft_compensation", "resource"}
    assert {name for name in folders if not name.endswith(".egg-info")} == {*SHARED_FOLDERS, *code}


# Topics of the node in the root namespace, with what a layout plots of them.
PLOTTED: Final = {
    "/sensone_sensor_data": "std_msgs/Float64MultiArray",
    "/wrench": "geometry_msgs/WrenchStamped",
    "/wrench_compensated": "geometry_msgs/WrenchStamped",
    "/compensation/bias": "geometry_msgs/WrenchStamped",
    "/compensation/tool": "geometry_msgs/WrenchStamped",
    "/imu/data_raw": "sensor_msgs/Imu",
    "/temperature": "sensor_msgs/Temperature",
    "/contact": "geometry_msgs/PoseWithCovarianceStamped",
}


@pytest.mark.parametrize(
    ("layout", "path"),
    [
        ("plotjuggler_layout.xml", r'curve [^>]*name="([^"]+)"'),
        ("foxglove_layout.json", r'"value": "(/[^"]+)"'),
        ("wrench.rviz", r"Value: (/(?:wrench|contact).*)"),
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
