"""package.xml: complete, in order, and naming what the package imports."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from xml.etree import ElementTree

from catkin_pkg.package import parse_package

from tests.ros_package.package_files import PACKAGE

MANIFEST = ElementTree.parse(PACKAGE / "package.xml").getroot()


def texts(tag: str) -> list[str]:
    return [element.text or "" for element in MANIFEST.findall(tag)]


def imports(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).split(".")[0])
    return names


def test_it_has_what_format_3_requires() -> None:
    assert MANIFEST.tag == "package"
    assert MANIFEST.get("format") == "3"
    for tag in ("name", "version", "description"):
        assert len(texts(tag)) == 1, tag
    assert texts("name") == ["bridge"]
    assert texts("license") == ["Apache-2.0"]
    assert [element.get("email") for element in MANIFEST.findall("maintainer")] != [None]
    assert [element.text for element in MANIFEST.findall("export/build_type")] == ["ament_python"]


def test_everything_that_is_imported_is_a_dependency() -> None:
    ours = {"bridge", "ft_compensation", "protocol", "__future__", *sys.stdlib_module_names}
    # Packages that are not named as their modules; the package tf2_ros is C++.
    packages = {"tf2_ros": "tf2_ros_py", "numpy": "python3-numpy"}
    needed = {
        packages.get(name, name)
        for folder in ("bridge", "ft_compensation", "launch")
        for path in (PACKAGE / folder).rglob("*.py")
        for name in imports(path) - ours
    }
    # xacro is for the files in urdf/.
    assert needed | {"xacro"} == set(texts("exec_depend"))


def test_no_dependency_is_named_twice() -> None:
    assert len(texts("exec_depend")) == len(set(texts("exec_depend")))


def test_catkin_pkg_finds_nothing_wrong() -> None:
    warnings: list[str] = []
    package = parse_package(str(PACKAGE), warnings=warnings)
    assert not warnings
    assert package.get_build_type() == "ament_python"
