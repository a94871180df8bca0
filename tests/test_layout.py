"""Who may import whom, read from the sources; and what must be the same everywhere."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PROTOCOL = sorted((ROOT / "protocol").rglob("*.py"))
SERVER = sorted((ROOT / "ethercat_server").rglob("*.py"))
CLIENTS = sorted((ROOT / "clients").rglob("*.py"))
BRIDGE = sorted((ROOT / "ros2_bridge" / "bridge").rglob("*.py"))
OTHERS = [
    ROOT / "ros2_bridge" / "setup.py",
    *(
        p
        for folder in ("ros2_bridge/launch", "ros2_bridge/test", "scripts", "tests")
        for p in sorted((ROOT / folder).rglob("*.py"))
    ),
]


def imports(path: Path) -> set[str]:
    """The top-level names that a file imports, wherever in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(str(node.module).split(".")[0])
    return names


def modules(path: Path) -> set[str]:
    """The modules that a file imports from, whole names."""
    return {str(n.module) for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom)}


def importers(paths: list[Path], name: str) -> Iterator[str]:
    return (str(path.relative_to(ROOT)) for path in paths if name in imports(path))


def test_protocol_is_standard_library_without_threads_and_one_file_opens_sockets() -> None:
    assert PROTOCOL
    allowed = set(sys.stdlib_module_names) | {"protocol"}
    with_sockets = {"connection.py": {"socket"}, "client.py": {"select"}}
    forbidden = {"socket", "socketserver", "select", "selectors", "asyncio", "ssl", "threading", "_thread"}
    forbidden |= {"multiprocessing", "concurrent", "subprocess", "queue"}
    for path in PROTOCOL:
        assert imports(path) <= (allowed - forbidden) | with_sockets.get(path.name, set()), path


def test_what_needs_no_socket_does_not_load_the_client() -> None:
    """The server and every decoder get by with the half of `protocol` that has no sockets in it."""
    for path in PROTOCOL:
        if path.name not in ("connection.py", "client.py"):
            assert not {"protocol.connection", "protocol.client"} & modules(path), path


def test_server_and_bridge_do_not_know_each_other() -> None:
    assert SERVER
    assert BRIDGE
    assert not list(importers(SERVER, "bridge"))
    assert not list(importers(BRIDGE, "ethercat_server"))


def test_pysoem_is_used_in_at_most_one_file() -> None:
    assert not list(importers(PROTOCOL + BRIDGE, "pysoem"))
    assert len(list(importers(SERVER, "pysoem"))) <= 1


def test_ros_is_used_by_the_bridge_only() -> None:
    for name in ("rclpy", "std_msgs", "diagnostic_msgs", "sensor_msgs", "geometry_msgs", "tf2_ros"):
        assert not list(importers(PROTOCOL + SERVER, name))


def test_connection_and_selection_need_no_ros() -> None:
    for name in ("client", "connection", "selection", "signals"):
        assert not imports(ROOT / "ros2_bridge" / "bridge" / f"{name}.py") & {"rclpy", "std_msgs"}, name


def test_compensation_is_numpy_and_the_standard_library() -> None:
    compensation = [path for path in BRIDGE if path.parent.name == "compensation"]
    assert compensation
    for path in compensation:
        assert imports(path) <= set(sys.stdlib_module_names) | {"numpy", "protocol", "bridge"}, path
        ours = set(re.findall(r"^\s*(?:from|import) (bridge[\w.]*)", path.read_text(), re.MULTILINE))
        assert all(name.startswith("bridge.compensation") for name in ours), path


def test_nothing_imports_the_clients_and_they_need_neither_ros_nor_the_bus() -> None:
    assert CLIENTS
    assert not list(importers(PROTOCOL + SERVER + BRIDGE, "clients"))
    for name in ("rclpy", "std_msgs", "sensor_msgs", "geometry_msgs", "pysoem"):
        assert not list(importers(CLIENTS, name))


def test_of_the_clients_only_the_replay_uses_the_server() -> None:
    using = set(importers(CLIENTS, "ethercat_server"))
    assert all(path.startswith("clients/replay/") for path in using), using


def test_of_the_clients_only_identify_uses_the_bridge_and_only_its_compensation() -> None:
    using = [path for path in CLIENTS if "bridge" in imports(path)]
    assert {path.parent.name for path in using} <= {"identify"}
    for path in using:
        assert not re.search(
            r"^\s*(from|import) bridge(?!\.compensation\.)", path.read_text(), re.MULTILINE
        ), path


def test_recordings_are_opened_in_one_place() -> None:
    assert set(importers(PROTOCOL + SERVER + BRIDGE + CLIENTS, "mcap")) <= {
        "clients/recording/chunk.py",
        "clients/recording/container.py",
        "clients/recording/writer.py",
    }


def test_the_monitor_knows_the_protocol_only() -> None:
    monitor = [path for path in CLIENTS if path.is_relative_to(ROOT / "clients" / "monitor")]
    allowed = set(sys.stdlib_module_names) | {"clients", "protocol", "rich", "textual"}
    assert monitor
    for path in monitor:
        assert imports(path) <= allowed, path
        others = {module for module in modules(path) if module.startswith("clients.")}
        shared = {"clients.arguments", "clients.endings", "clients.version"}
        assert all(m.startswith("clients.monitor") for m in others - shared), path
    assert [path.name for path in monitor if "textual" in imports(path)] == ["app.py"]


@pytest.mark.parametrize(
    "path", PROTOCOL + SERVER + BRIDGE + CLIENTS + OTHERS, ids=lambda p: str(p.relative_to(ROOT))
)
def test_every_file_says_what_it_is_for(path: Path) -> None:
    text = path.read_text()
    assert not text or ast.get_docstring(ast.parse(text)), path


def test_one_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    for name, pattern in (("package.xml", r"<version>(.*?)</version>"), ("setup.py", r'version="(.*?)"')):
        found = re.search(pattern, (ROOT / "ros2_bridge" / name).read_text())
        assert found is not None
        assert found[1] == version, name


def test_every_package_of_python_files_is_installed() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    setup = (ROOT / "ros2_bridge" / "setup.py").read_text()
    for path in PROTOCOL + SERVER + BRIDGE + CLIENTS:
        package = ".".join(path.relative_to(ROOT).parent.parts).removeprefix("ros2_bridge.")
        assert package in listed, path
        assert not package.startswith("bridge") or f'"{package}"' in setup, path


def test_the_ros_package_is_whole() -> None:
    package = ROOT / "ros2_bridge"
    manifest = (package / "package.xml").read_text()
    # colcon takes a package with an invalid address for plain Python.
    assert re.search(r'<maintainer email="[^@" ]+@[^@" ]+\.[a-z]+">', manifest)
    assert "<build_type>ament_python</build_type>" in manifest
    assert (package / "resource" / "bridge").exists()
    assert (package / "resource" / "client").stat().st_mode & 0o111
    assert (package / "protocol" / "framing.py").samefile(ROOT / "protocol" / "framing.py")
