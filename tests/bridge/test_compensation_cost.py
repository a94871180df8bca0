"""What the compensation costs the reader while nobody wants it: nothing."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

import rclpy

from bridge.compensating.gravity_sources import AccelerometerSource
from bridge.parameters.compensation import CompensationParameters
from bridge.publishing.compensated_wrench import CompensatedOutput, Plan, RestWindow
from bridge.publishing.messages import Outputs, make_stages
from ft_compensation.attitude.tilt import GyroscopeOffset
from ft_compensation.bias import BiasRamp
from ft_compensation.compensator import Compensator
from ft_compensation.stationary_limits import StationaryLimits
from tests.compensation.making import BIAS, TOOL

pytestmark = pytest.mark.ros
SAMPLES = 20_000
MOST_US = 20.0
_SOURCE = AccelerometerSource(CompensationParameters(payload=TOOL), GyroscopeOffset())


@pytest.fixture
def output(_ros: None) -> Iterator[CompensatedOutput]:
    node = rclpy.create_node("cost", namespace="/test_cost")
    made = CompensatedOutput(make_stages(node, "ft"))
    made.plan = Plan(_SOURCE, Compensator(TOOL, inertia=True), BiasRamp(BIAS), needs_gravity=True)
    yield made
    node.destroy_node()


def test_nothing_is_done_while_nobody_wants_it(output: CompensatedOutput) -> None:
    outputs = Outputs([output])
    outputs.refresh()
    assert list(outputs.wanted) == []  # the reader does not even call it
    output.window = RestWindow(1.0, StationaryLimits(), _SOURCE)
    outputs.refresh()
    assert list(outputs.wanted) == [output]
    output.window = None
    outputs.refresh()
    assert list(outputs.wanted) == []
