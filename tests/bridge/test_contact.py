"""`contact` and `contact/detected`: only if configured, and the true point is in the region."""

from __future__ import annotations

import numpy as np
import pytest

from bota_ethercat_bridge.parameters.table import PARAMETERS, ParameterError, gather, parse_surface
from bota_ft_compensation.contact import Capsule, Plane
from tests.bridge.simulated_node import UP, Node, Server, stamp_ns
from tests.compensation.making import SEED, TOOL

POINT = np.array((0.01, 0.02, 0.12))
NOISE = (0.1, 0.1, 0.1, 0.005, 0.005, 0.002)
FACE = "plane 0 0 0.12 0 0 2 0.05"
PARAMETERS_OF_TOOL = {"tool_mass": TOOL.mass, "tool_center_of_gravity": str([*TOOL.center])}


@pytest.mark.parametrize(
    ("text", "surface"),
    [
        (FACE, Plane((0.0, 0.0, 0.12), (0.0, 0.0, 1.0), 0.05)),
        ("sphere 0 0 0.1 0.02", Capsule((0.0, 0.0, 0.1), (0.0, 0.0, 0.1), 0.02)),
        ("capsule 0 0 0.1 0 0 0.2 0.02", Capsule((0.0, 0.0, 0.1), (0.0, 0.0, 0.2), 0.02)),
        (" ", None),
    ],
)
def test_a_surface_is_a_line_of_text(text: str, surface: object) -> None:
    assert parse_surface(text) == surface


@pytest.mark.parametrize(
    "text",
    ["plane", "cone 0 0 1 1", "plane 0 0 0 0 0 0 1", "sphere 0 0 0 0", "sphere 0 0 0 0 0 0 1",
     "sphere 0 0 nan 1", "capsule 0 0 0 1", "sphere a b c d", "plane 0 0 0 nan 0 1 1"],
)  # fmt: skip
def test_what_is_no_surface_is_refused(text: str) -> None:
    values = {row.name: row.default for row in PARAMETERS} | {"contact.surface": text}
    with pytest.raises(ParameterError, match="must be plane X Y Z NX NY NZ RADIUS, sphere"):
        gather(values)


def touch(server: Server, force: tuple[float, ...], draw: np.random.Generator) -> None:
    load = np.append(force, np.cross(POINT, force)) + draw.normal(size=6) * NOISE
    names = (f"{quantity}_{axis}" for quantity in ("force", "torque") for axis in "xyz")
    server.hold(UP, **dict(zip(names, load.tolist(), strict=True)))


def test_it_tells_the_point_and_only_while_there_is_contact() -> None:
    server, draw = Server(), np.random.default_rng([SEED, 96])
    with Node(
        server, **PARAMETERS_OF_TOOL, **{"contact.surface": FACE, "contact.noise": str([*NOISE])}
    ) as node:
        points, detected = node.hear("contact"), node.hear("contact/detected")

        def press(force: tuple[float, ...]) -> None:
            points.clear()
            detected.clear()
            for _ in range(200):
                touch(server, force, draw)
                node.run(0.01)

        press((0.0, 0.0, 0.0))
        assert not points
        assert {each.data for each in detected} == {False}
        press((0.5, -1.0, -10.0))
        assert {each.data for each in detected} == {True}
        assert len(points) == pytest.approx(2.0 * 25, abs=3), "25 a second"
        inside = 0
        for each in points:
            pose, covariance = each.pose.pose, np.reshape(each.pose.covariance, (6, 6))
            away = np.array((pose.position.x, pose.position.y, pose.position.z)) - POINT
            assert away[2] == pytest.approx(0.0, abs=1e-9)
            assert not covariance[2:].any()
            inside += away[:2] @ np.linalg.inv(covariance[:2, :2]) @ away[:2] < 5.991
            q = pose.orientation
            assert (q.x, q.y, q.z, q.w) == (0.0, 0.0, 0.0, 1.0)
        assert inside > 0.8 * len(points)
        assert len({stamp_ns(each) for each in points}) == len(points)
        press((0.0, 0.0, 0.0))
        assert not detected[-1].data
