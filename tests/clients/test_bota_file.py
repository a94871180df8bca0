"""The file of Bota's payload utilities: to the node's parameters and back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bota_clients.identify.cli import main
from bota_clients.identify.tool_file import read_bota, write_bota
from bota_ethercat.pdo import Vector3
from bota_ft_compensation.quantities import ELEMENTS, Payload
from tests.compensation.making import written_parameters
from tests.ended import run_here

TOOL = Payload(1.5, (0.05, -0.03, 0.07), (0.009, 0.011, 0.006, 0.001, -0.002, 0.001))
# By the estimator of bota-payload-utils 1.0.3, from 16 s of slow turns of 1.5 kg.
ESTIMATED = """{
  "payload_compensator_config": {
    "payload_properties": {
      "mass": 1.49963,
      "com": {
        "x": -0.0329777,
        "y": 0.0483734,
        "z": 0.0399691
      },
      "inertia": {
        "Ixx": 0.00665378,
        "Ixy": 0.00318691,
        "Ixz": 0.00196781,
        "Iyy": 0.00566324,
        "Iyz": -0.00321067,
        "Izz": 0.00798172
      },
      "bias": {
        "Fx": -0.0241493,
        "Fy": -0.00736444,
        "Fz": -0.00938012,
        "Tx": 1.10584e-05,
        "Ty": -0.00998484,
        "Tz": 0.00418914
      }
    },
    "enable_dynamic_compensation": false 
  }
}
"""  # noqa: W291 - as it is


def properties(path: Path) -> Any:
    return json.loads(path.read_text())["payload_compensator_config"]["payload_properties"]


def converted(*arguments: object) -> str:
    ended = run_here(main, *arguments)
    assert ended.code == 0, ended.err
    return ended.err


def refused(*arguments: object) -> str:
    ended = run_here(main, *arguments)
    assert (ended.code, ended.err.count("\n")) == (1, 1)
    return ended.err


def about_the_origin(mass: float, center: Vector3, inertia: tuple[float, ...]) -> list[float]:
    """By eight point masses that have this mass, center and inertia, each at its own place."""
    xx, yy, zz, xy, xz, yz = inertia
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    second, axes = np.linalg.eigh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(8, 3)
    x, y, z = (corners * np.sqrt(np.maximum(second, 0.0) / mass) @ axes.T + center).T
    parts = y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z
    return [mass / 8 * float(part.sum()) for part in parts]


def test_there_and_back_the_tool_is_the_same_and_its_inertia_is_about_another_point(tmp_path: Path) -> None:
    write_bota(tmp_path / "tool.json", TOOL)
    inertia = properties(tmp_path / "tool.json")["inertia"]
    assert [inertia[f"I{name}"] for name in ELEMENTS] == pytest.approx(about_the_origin(*TOOL[:3]))
    assert "tool.yaml" in converted(tmp_path / "tool.json", "--yaml", tmp_path / "tool.yaml")
    written = written_parameters(tmp_path / "tool.yaml")
    assert written["tool_mass"] == TOOL.mass
    assert written["tool_center_of_gravity"] == pytest.approx(TOOL.center)
    assert written["tool_inertia"] == pytest.approx(TOOL.inertia)
    assert not {"bias", "sensor_offset"} & set(written)
    converted(tmp_path / "tool.yaml", "--bota", tmp_path / "again.json")
    assert properties(tmp_path / "again.json")["inertia"] == pytest.approx(inertia)


def test_what_its_estimator_wrote_is_read(tmp_path: Path) -> None:
    (path := tmp_path / "estimated.json").write_text(ESTIMATED)
    payload, why = read_bota(path)
    assert (payload.mass, payload.center, why) == (1.49963, (-0.0329777, 0.0483734, 0.0399691), "")
    # Of no body: of the nearest.
    assert about_the_origin(*payload[:3])[0] == pytest.approx(0.00665378, rel=0.05)
    assert min(payload.inertia_interval) > 0.2 * max(payload.inertia)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"mass": 1.49963', '"mass": -0.8', "a mass of -0.8 kg, which no tool has"),
        ('"mass": 1.49963', '"mass": NaN', "are finite numbers"),
        ('"z": 0.0399691', '"w": 0', "no configuration of Bota's payload compensator: no 'z'"),
        ('"z": 0.0399691', '"z": null', "com is 3 finite numbers"),
        ("payload_compensator_config", "payload_estimator_config", "no 'payload_compensator_config'"),
        ('"Izz": 0.00798172', '"Izz": "much"', "could not convert"),
    ],
)
def test_what_is_no_tool_is_refused(old: str, new: str, told: str, tmp_path: Path) -> None:
    assert old in ESTIMATED
    (path := tmp_path / "tool.json").write_text(ESTIMATED.replace(old, new))
    assert told in refused(path, "--yaml", tmp_path / "tool.yaml")
    assert not (tmp_path / "tool.yaml").exists()


def test_an_inertia_that_no_body_has_is_left_out_and_said(tmp_path: Path) -> None:
    (path := tmp_path / "tool.json").write_text(ESTIMATED.replace("0.00665378", "0.1"))
    assert "which no body has" in converted(path, "--yaml", tmp_path / "tool.yaml")
    assert written_parameters(tmp_path / "tool.yaml")["tool_inertia"] == [0.0] * 6


def test_an_output_is_asked_for_and_nothing_is_overwritten(tmp_path: Path) -> None:
    (path := tmp_path / "tool.json").write_text(ESTIMATED)
    assert "give --yaml OUT" in refused(path)
    assert "give --yaml OUT" in refused(path, "--bota", tmp_path / "other.json")
    (tmp_path / "there.yaml").write_text("a: 1")
    assert "there.yaml" in refused(path, "--yaml", tmp_path / "there.yaml")
    assert "does not have a tool's parameters" in refused(
        tmp_path / "there.yaml", "--bota", tmp_path / "b.json"
    )
    (tmp_path / "none.yaml").write_text(
        "/**: {ros__parameters: {tool_mass: 0, tool_center_of_gravity: [0, 0, 0]}}"
    )
    assert "tool_mass is 0" in refused(tmp_path / "none.yaml", "--bota", tmp_path / "b.json")
