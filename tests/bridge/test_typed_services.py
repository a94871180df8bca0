"""The services of the types in clients/bota_ethercat_msgs: as rosidl generates them or, where it has not,
stand-ins with the fields of the .srv files."""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Iterator
from dataclasses import field, make_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.parameter import parameter_value_to_python

from bridge import services
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


def test_without_the_package_there_are_the_triggers_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(services, "TYPED", {})
    with Node(Server()) as node:
        offered = {one.service_name.removeprefix(f"{node.name}/") for one in node.node.services}
    assert {"tare", "sensor_tare", "get_settings", "identify/solve"} <= offered
    assert not [name for name in offered if name.startswith("typed/")]
