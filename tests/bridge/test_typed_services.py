"""The services of the types in clients/bota_ethercat_msgs: as rosidl generates them or, where it has not,
stand-ins with the fields of the .srv files."""

from __future__ import annotations

import ctypes
import importlib
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import field, make_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.parameter import parameter_value_to_python

from bota_ethercat_bridge import services
from tests.bridge.real_node import Listener, Start
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.simulated_node import QUICK, SETTINGS, UP, Node, Server, Stages, sensed, six
from tests.compensation.making import AXES, BIAS, TOOL

PACKAGE = Path(__file__).parents[2] / "clients" / "bota_ethercat_msgs"
SERVICES = {
    "tare": "Tare", "sensor_tare": "Tare", "get_settings": "GetSettings", "identify/solve": "Identify"
}  # fmt: skip
PLAIN: dict[str, type] = {"bool": bool, "string": str, "uint32": int, "float64": float}


def stand_in(kind: str) -> Any:
    """A service whose request and response have the fields of the .srv file, and no others."""
    parts = {}
    text = (PACKAGE / "srv" / f"{kind}.srv").read_text()
    for name, part in zip(("Request", "Response"), text.split("---\n"), strict=True):
        fields = []
        for of_type, field_name in re.findall(r"^([\w/\[\]]+) +(\w+)", part, re.MULTILINE):
            package, _, plain = of_type.rpartition("/")
            found = (
                getattr(importlib.import_module(f"{package}.msg"), plain, list) if package else PLAIN[plain]
            )
            fields.append((field_name, found, field(default_factory=found)))
        parts[name] = make_dataclass(name, fields, slots=True)
    return SimpleNamespace(**parts)


@pytest.fixture
def server() -> Server:
    return Server()


@pytest.fixture
def node(server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Node]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    if not services.TYPED:
        monkeypatch.setattr(services, "TYPED", {name: stand_in(kind) for name, kind in SERVICES.items()})
    with Node(server, **QUICK) as started:
        started.run(0.1)
        yield started


def ask(node: Node, name: str, force_z: float = 0.0, samples: int = 0) -> Any:
    """The response to a request."""
    request = services.TYPED[name].Request()
    if "tare" in name:
        request.target.force.z, request.samples = force_z, samples
    return node.call(f"typed/{name}", request)


def numbers(wrench: Any) -> list[float]:
    return [getattr(part, axis) for part in (wrench.force, wrench.torque) for axis in "xyz"]


def test_a_tare_of_the_sensor(node: Node, server: Server) -> None:
    told = {"old_offset": [1, 2, 3, 4, 5, 6], "new_offset": [0.5] * 6, "residual": [1e-3] * 6}
    server.answers["tare"] = lambda _: {"ok": True, **told}
    node.do("sensor_tare", "old offset Fx 1.0000 Fy 2.0000", "new offset Fx 0.5000", "residual Fx 0.0010")
    response = ask(node, "sensor_tare", -5.0, 300)
    usual, asked = (
        [request[key] for key in ("sensor", "samples", "target")] for request in server.requests[-2:]
    )
    assert usual == [0, 50, [0.0] * 6], "half a second"
    assert asked == [0, 300, [0.0, 0.0, -5.0, 0.0, 0.0, 0.0]]
    assert response.success
    assert numbers(response.bias) == [-0.5] * 6, "what is subtracted"
    assert numbers(response.residual) == [1e-3] * 6
    assert all(map(math.isnan, numbers(response.spread))), "the server did not say"
    server.answers["tare"] = lambda _: {"ok": False, "error": {"code": "not_ready", "message": "it moves"}}
    response = ask(node, "sensor_tare")
    assert (response.success, response.message) == (False, "it moves (not_ready)")


def test_a_tare_of_the_node(node: Node, server: Server) -> None:
    server.hold(UP, bias=BIAS)
    node.set("tool_mass", TOOL.mass)
    node.set("tool_center_of_gravity", [*TOOL.center])
    stages = Stages(node)
    response = ask(node, "tare", -5.0, 40)
    assert response.success
    assert response.message.startswith("bias of 40 samples: ")
    stages.settle([0.0, 0.0, -5.0, 0.0, 0.0, 0.0])
    assert numbers(response.bias) == list(node.parameters("bias")[0]) == pytest.approx(six(stages.bias[-1]))
    assert numbers(response.spread) == numbers(response.residual) == pytest.approx([0.0] * 6, abs=1e-5)
    for number in range(60):
        server.once(process_data=sensed(UP, bias=BIAS, force_x=0.005 * number))
    response = ask(node, "tare", samples=40)
    assert response.residual.force.x == pytest.approx(15 * 0.005, abs=1e-5)
    assert response.spread.force.x == pytest.approx(0.005 * math.sqrt(40 * 41 / 12), rel=1e-3)
    bias = node.parameters("bias")
    response = ask(node, "tare", math.nan)
    assert (response.success, node.parameters("bias")) == (False, bias)
    assert response.message.startswith("a target is 3 finite numbers")


def test_the_settings(node: Node) -> None:
    response = ask(node, "get_settings")
    assert response.success
    assert "{" not in response.message
    assert response.rate_hz == 100.0
    assert {row.name: parameter_value_to_python(row.value) for row in response.settings} == SETTINGS


def test_an_identification(node: Node, server: Server) -> None:
    response = ask(node, "identify/solve")
    assert (response.success, response.mass) == (False, 0.0)
    assert "call identify/start first" in response.message
    node.do("identify/start")
    for up in AXES:
        server.hold(up, bias=BIAS)
        node.do("identify/add_pose")
    response = ask(node, "identify/solve")
    assert (response.success, response.poses, response.confidence) == (True, 6, 0.95)
    center, half = ([getattr(v, axis) for axis in "xyz"] for v in (response.center, response.center_interval))
    assert response.mass == pytest.approx(TOOL.mass, abs=1e-4)
    assert center == pytest.approx(TOOL.center, abs=1e-5)
    assert numbers(response.bias) == pytest.approx(BIAS.values, abs=1e-4)
    assert 0.0 < response.mass_interval < 1e-3
    assert 0.0 < max(half) < 1e-3
    assert 0.0 < max(numbers(response.bias_interval)) < 0.1
    assert 0.0 < response.force_residual < 1e-3
    assert 0.0 < response.torque_residual < 1e-3


@pytest.fixture
def generated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The services as rosidl generates them, with the packages of PyPI."""
    if services.TYPED:
        return services.TYPED
    if not (Path(sys.prefix) / "share/rosidl_default_generators").exists() or not shutil.which("cmake"):
        pytest.skip("rosidl (the extra of that name) or cmake is missing")
    base, installed = tmp_path / "ros", tmp_path / "installed"
    shutil.copytree(Path(sys.prefix) / "share", base / "share")
    for folder in ("bin", "include", "lib"):
        (base / folder).symlink_to(Path(sys.prefix) / folder)
    for file in base.glob("share/*/cmake/*_pyExport.cmake"):  # has paths of the machine that made the wheel
        file.write_text(re.sub(r'(INTERFACE_INCLUDE_DIRECTORIES) "[^"]*"', r'\1 ""', file.read_text()))
    at = {"CMAKE_INSTALL_PREFIX": installed, "CMAKE_INSTALL_RPATH": installed / "lib"}
    defined = [f"-D{name}={value}" for name, value in (at | {"Python3_EXECUTABLE": sys.executable}).items()]
    for command in (
        ["cmake", "-S", str(PACKAGE), "-B", str(tmp_path / "build"), *defined],
        ["cmake", "--build", str(tmp_path / "build"), "--target", "install", "--parallel", "2"],
    ):
        environment = os.environ | {"AMENT_PREFIX_PATH": str(base), "CMAKE_PREFIX_PATH": str(base)}
        done = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    for library in installed.glob("lib/*.so"):  # which ROS looks for by name
        ctypes.CDLL(str(library))
    (modules,) = installed.glob("lib/python*/site-packages")
    monkeypatch.syspath_prepend(modules)
    for name in ("bota_ethercat_msgs", "bota_ethercat_msgs.srv"):  # its folder in clients/ passes for it
        monkeypatch.delitem(sys.modules, name, raising=False)
    made = importlib.import_module("bota_ethercat_msgs.srv")
    return {name: getattr(made, kind) for name, kind in SERVICES.items()}


@pytest.mark.long
@pytest.mark.timeout(1800)  # of compiling
def test_as_generated_over_the_middleware(
    generated: dict[str, Any], listener: Listener, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(services, "TYPED", generated)

    def ask(name: str, **fields: object) -> Any:
        return listener.ask(generated[name], f"typed/{name}", generated[name].Request(**fields))

    with ScriptedServer() as server:
        server.description["sensors"][0]["settings"] = SETTINGS
        told = {"old_offset": [1] * 6, "new_offset": [0.5] * 6, "residual": [1e-3] * 6}
        server.answers["tare"] = lambda _: {"ok": True, **told}
        start(server.port).says("connected to")
        assert numbers(ask("sensor_tare", samples=300).bias) == [-0.5] * 6
        assert server.requests[-1]["samples"] == 300
        response = ask("get_settings")
        assert {row.name: parameter_value_to_python(row.value) for row in response.settings} == SETTINGS
        assert "came in" in ask("tare").message
        assert "call identify/start first" in ask("identify/solve").message


def test_without_the_package_there_are_the_triggers_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(services, "TYPED", {})
    with Node(Server()) as node:
        offered = {one.service_name.removeprefix(f"{node.name}/") for one in node.node.services}
    assert {"tare", "sensor_tare", "get_settings", "identify/solve"} <= offered
    assert not [name for name in offered if name.startswith("typed/")]
