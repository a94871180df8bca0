"""The architecture as one table: which room may import which, read from the sources."""

from __future__ import annotations

import ast
import functools
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parent.parent
ROOTS: Final = {
    "bota_ethercat": ROOT / "protocol",
    "bota_clients": ROOT / "clients",
    **dict.fromkeys(
        ("bota_ethercat_bridge", "bota_ft_compensation", "bridge", "ft_compensation"), ROOT / "ros2_bridge"
    ),
}
S: Final = "ethercat_server"
B: Final = "bota_ethercat_bridge"
C: Final = "bota_ft_compensation"
ROS: Final = {
    "rclpy", "std_msgs", "std_srvs", "geometry_msgs", "sensor_msgs", "diagnostic_msgs", "rcl_interfaces",
    "tf2_ros", "bota_ethercat_msgs",
}  # fmt: skip

PROTOCOL: Final = {
    "bota_ethercat",
    "bota_ethercat.text",
    "bota_ethercat.sensor",
    "bota_ethercat.health",
    "bota_ethercat.program",
    "bota_ethercat.stream",
}
ETHERCAT: Final = {S, f"{S}.ethercat", f"{S}.sampling"}
SENSOR: Final = ETHERCAT | {f"{S}.sensor"} | PROTOCOL
ACQUISITION: Final = SENSOR | {f"{S}.acquisition"}
SERVING: Final = ACQUISITION | {f"{S}.serving"}
DAEMON: Final = SERVING | {f"{S}.server"} | {f"{S}.process", f"{S}.daemon", f"{S}.virtual_sensor"}
ACCESS: Final = (DAEMON - {f"{S}.daemon"}) | {f"{S}.access", "bota_ethercat.client"}
CLIENTS: Final = {"bota_clients", "bota_clients.recording", "bota_ethercat.client"} | PROTOCOL

PUBLIC: Final = ("bota_ethercat", "bota_ethercat.client")
"""What the package gives its users, and loads only when they ask for it."""

ROOMS: Final[dict[str, set[str]]] = {
    "bota_ethercat": PROTOCOL - {"bota_ethercat.health", "bota_ethercat.program"},
    "bota_ethercat.program": {"bota_ethercat", "bota_ethercat.program", "bota_ethercat.sensor"},
    "bota_ethercat.text": {"bota_ethercat.text", "bota_ethercat.errors"},
    "bota_ethercat.sensor": PROTOCOL - {"bota_ethercat.health", "bota_ethercat.program"},
    "bota_ethercat.stream": PROTOCOL - {"bota_ethercat.health", "bota_ethercat.program"},
    "bota_ethercat.health": PROTOCOL,
    "bota_ethercat.client": PROTOCOL | {"bota_ethercat.client"},
    # The server: ethercat <- sensor <- acquisition <- serving <- daemon.
    S: {S, "bota_ethercat.program"},
    f"{S}.sampling": {f"{S}.sampling"},
    f"{S}.ethercat": ETHERCAT,
    f"{S}.sensor": SENSOR,
    f"{S}.acquisition": ACQUISITION,
    f"{S}.serving": SERVING,
    f"{S}.process": {S, f"{S}.process", "bota_ethercat.errors", "bota_ethercat.program"},
    f"{S}.server": SERVING,
    f"{S}.daemon": DAEMON,
    # Programs beside the server.
    f"{S}.virtual_sensor": SENSOR | {f"{S}.process", f"{S}.virtual_sensor"},
    f"{S}.simulation": DAEMON | {f"{S}.simulation", "bota_ethercat.client"},
    f"{S}.access": ACCESS,
    f"{S}.tool": ACCESS | {f"{S}.daemon", f"{S}.tool"},
    f"{S}.doctor": ACCESS | {f"{S}.daemon", f"{S}.doctor"},
    # ROS 2.
    C: {C} | PROTOCOL,
    f"{B}.ft_compensation": {"bota_ethercat.renamed"},
    f"{B}.parameters.table": {C} | PROTOCOL,
    B: {B, C, f"{B}.parameters.table", "bota_ethercat.client"} | PROTOCOL,
    "bridge": {"bota_ethercat.renamed"},  # the old names
    "ft_compensation": {"bota_ethercat.renamed"},
    # Programs that are ordinary clients of the server.
    "bota_clients": {"bota_clients"} | PROTOCOL,
    "bota_clients.recording": CLIENTS,
    "bota_clients.export": CLIENTS
    | {"bota_clients.export", "bota_clients.identify", "bota_ethercat.client", C},
    "bota_clients.record": CLIENTS | {"bota_clients.record"},
    "bota_clients.report": CLIENTS | {"bota_clients.report", "bota_clients.record"},
    "bota_clients.monitor": CLIENTS
    | {"bota_clients.monitor", "bota_clients.record", "bota_clients.export", C},
    "bota_clients.replay": CLIENTS | {"bota_clients.replay", f"{S}.serving", S},
    "bota_clients.identify": CLIENTS | {"bota_clients.identify", C, f"{B}.parameters.table"},
}
"""A room, and the rooms it may import. A room without a line of its own belongs to the one above it."""

PACKAGES: Final[dict[str, set[str]]] = {
    "pysoem": {f"{S}.ethercat.soem"},
    "pyroute2": {S},
    "numpy": {B, C, "bota_clients"},
    "mcap": {"bota_clients.recording", "bota_clients.export.ros_topics"},
    "zstandard": {"bota_clients.recording"},
    "lz4": {"bota_clients.recording"},
    "jinja2": {"bota_clients.report.page"},
    "rich": {"bota_clients"},
    "textual": {"bota_clients.monitor.app"},
    "websockets": {"bota_clients.monitor.web.server"},
    "pyarrow": {"bota_clients.export"},
    "zarr": {"bota_clients.export"},
    "rosbags": {"bota_clients.export"},
    "yaml": {"bota_clients.export", "bota_clients.identify"},
} | {package: {B} for package in ROS}
"""Everything that is not the standard library, and which modules may load it."""

WITHOUT_ROS: Final = (
    f"{B}.stream", f"{B}.client", f"{B}.process", f"{B}.parameters.table",
)  # fmt: skip
"""What can run, and be tested, where there is no ROS; `client` loads it later."""
SOCKETS: Final = {"socket", "socketserver", "select", "selectors", "asyncio", "ssl"}
THREADS: Final = {"threading", "_thread", "multiprocessing", "concurrent", "subprocess", "queue"}


def modules() -> Iterator[tuple[str, Path]]:
    """Every module of the product: its dotted name and its file."""
    for package in ("bota_ethercat", S, B, C, "bridge", "ft_compensation", "bota_clients"):
        root = ROOTS.get(package, ROOT)
        for path in sorted((root / package).rglob("*.py")):
            if "ros2_control" in path.parts:  # a ROS package in C++; this is its launch file
                continue
            parts = path.relative_to(root).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


MODULES: Final = dict(modules())


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@functools.cache
def imports(path: Path) -> set[str]:
    """Whole names of what a file imports, modules where they are ours."""
    return names_in(tree(path))


def statements(tree: ast.AST) -> Iterator[ast.stmt]:
    """All of them, at any depth."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.stmt):
            yield node
        if isinstance(node, ast.stmt | ast.excepthandler | ast.match_case):
            yield from statements(node)


def names_in(tree: ast.AST) -> set[str]:
    """What a part of a file imports."""
    found: set[str] = set()
    for node in statements(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            base = str(node.module)
            found |= {f"{base}.{a.name}" if f"{base}.{a.name}" in MODULES else base for a in node.names}
    return found


def room(module: str) -> str:
    """The room a module stands in: the longest line of the table that is its package or above it."""
    parts = module.split(".")
    while ".".join(parts) not in ROOMS:
        parts.pop()
    return ".".join(parts)


def is_below(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def may_import(module: str, imported: str) -> bool:
    if imported in MODULES:
        return not {room(imported), imported}.isdisjoint(ROOMS[room(module)])
    package = imported.split(".", maxsplit=1)[0]
    return package in sys.stdlib_module_names or any(
        room(module) == B if package in ROS else is_below(module, position)
        for position in PACKAGES.get(package, ())
    )


def test_imports_follow_the_table() -> None:
    arrows = [(name, imported) for name, path in MODULES.items() for imported in imports(path)]
    assert [arrow for arrow in arrows if not may_import(*arrow)] == [PUBLIC]


def test_every_room_and_package_of_the_tables_is_there() -> None:
    assert set(ROOMS) <= set(MODULES)
    used = {imported.split(".")[0] for path in MODULES.values() for imported in imports(path)}
    assert set(PACKAGES) <= used


def test_there_is_no_import_cycle() -> None:
    arrows = {name: imports(path) & set(MODULES) - {name} for name, path in MODULES.items()}
    while ends := {name for name, targets in arrows.items() if not targets}:
        arrows = {name: targets - ends for name, targets in arrows.items() if name not in ends}
    assert not arrows


def test_no_check_is_an_assert() -> None:
    """PYTHONOPTIMIZE leaves them out: they may only tell mypy a type, or that something is not None."""
    checks = [
        f"{path}:{node.lineno}"
        for folder in ("protocol", "ethercat_server", "clients", "ros2_bridge", "scripts", "docs/examples")
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_bytes()))
        if isinstance(node, ast.Assert) and not _narrows(node.test)
    ]
    assert checks == []


def _narrows(test: ast.expr) -> bool:
    match test:
        case ast.Call(func=ast.Name("isinstance")):
            return True
        case ast.UnaryOp(ast.Not(), operand):
            return _narrows(operand)
        case ast.BoolOp(_, values):
            return all(map(_narrows, values))
        case ast.Compare(ast.Name() | ast.Attribute(), [ast.IsNot()], [ast.Constant(None)]):
            return True
    return False


def test_what_an_option_may_be_is_said_in_one_place() -> None:
    said = re.compile(r"\ba (whole )?number from|^true or false|^one of ")
    found = [
        f"{name}: {text}"
        for name, path in MODULES.items()
        if name != "bota_ethercat.option_types"
        for text in texts(tree(path))
        if said.search(text)
    ]
    assert found == []


def texts(tree: ast.Module) -> list[str]:
    """Those that are no docstrings."""
    apart = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    every = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in apart)
    return [node.value for node in every if isinstance(node.value, str)]


def test_the_protocol_is_sans_io_but_for_its_client() -> None:
    """Of the client, two files alone have sockets; futures start no thread."""
    may_have = {
        "bota_ethercat.client.world": {"socket"},
        "bota_ethercat.client.channel": SOCKETS | {"threading"},
        "bota_ethercat.client.client": {"concurrent", "threading"},
        "bota_ethercat.client.session": {"concurrent"},
    }
    for name, path in MODULES.items():
        if is_below(name, "bota_ethercat"):
            found = {imported.split(".")[0] for imported in imports(path)} & (THREADS | SOCKETS)
            assert found <= may_have.get(name, set()), name


def test_sampling_is_pure() -> None:
    allowed = {"__future__", "collections.abc", "enum", "itertools", "json", "math", "struct", "typing"}
    for name, path in MODULES.items():
        if room(name) == f"{S}.sampling":
            assert {each for each in imports(path) if each not in MODULES} <= allowed, name


def test_sampling_is_timed_by_a_clock_that_is_not_slewed() -> None:
    """Only stamps are of CLOCK_MONOTONIC; a start-up and its time-outs may be slewed."""
    may_have = {f"{S}.acquisition.stream": 2, f"{S}.acquisition.terminals": 1}
    for name, path in MODULES.items():
        if room(name) in {f"{S}.acquisition", f"{S}.sampling", f"{S}.serving"} or "exchange" in name:
            nodes = [node for node in ast.walk(tree(path)) if isinstance(node, ast.Attribute)]
            found = [node for node in nodes if node.attr in {"monotonic", "monotonic_ns", "perf_counter_ns"}]
            assert len(found) == may_have.get(name, 0), name


@functools.cache
def imports_on_top(module: str) -> set[str]:
    """What a module imports, but for what a function imports."""
    nodes = tree(MODULES[module]).body
    top: list[ast.stmt] = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    return names_in(ast.Module(top, []))


def reached(module: str) -> set[str]:
    """All that a module imports, also through others."""
    found: set[str] = set()
    waiting = {module}
    while waiting:
        name = waiting.pop()
        found.add(name)
        if name in MODULES:
            waiting |= imports_on_top(name) - found
    return found


@pytest.mark.parametrize("part", WITHOUT_ROS)
def test_what_needs_no_ros_loads_none(part: str) -> None:
    for name in MODULES:
        if is_below(name, part):
            ros = {found for found in reached(name) if found.split(".")[0] in ROS}
            assert not ros, name
