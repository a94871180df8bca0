"""package.xml: valid, and naming what the package imports."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

from catkin_pkg.package import parse_package

from tests.ros_package.package_files import PACKAGE


def imports(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).split(".")[0])
    return names


def test_it_is_valid_and_everything_that_is_imported_is_a_dependency() -> None:
    warnings: list[str] = []
    package = parse_package(str(PACKAGE), warnings=warnings)
    assert not warnings
    assert (package.name, package.package_format, package.licenses) == ("bridge", 3, ["Apache-2.0"])
    assert package.get_build_type() == "ament_python"
    assert all(maintainer.email for maintainer in package.maintainers)
    ours = {"bridge", "ft_compensation", "protocol", "__future__", *sys.stdlib_module_names}
    # Packages not named as their modules (the package tf2_ros is C++); xacro is for the files in urdf/.
    packages = {"tf2_ros": "tf2_ros_py", "numpy": "python3-numpy"}
    needed = {
        packages.get(name, name)
        for folder in ("bridge", "ft_compensation", "launch")
        for path in (PACKAGE / folder).rglob("*.py")
        for name in imports(path) - ours
    }
    assert sorted(needed | {"xacro"}) == sorted(depend.name for depend in package.exec_depends)
