"""What the compensation costs the reader: nothing while nobody wants it, little for each sample otherwise."""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

import rclpy

from bridge.compensated_output import CompensatedOutput, Plan, RestWindow
from bridge.compensation.bias import BiasRamp
from bridge.compensation.compensator import Compensator
from bridge.compensation.quantities import ZERO
from bridge.compensation.still import StillLimits
from bridge.compensation_parameters import CompensationParameters
from bridge.gravity_sources import AccelerometerSource
from bridge.messages import Outputs
from protocol.pdo import STANDARD_GRAVITY
from tests.compensation.making import BIAS, TOOL, sample

pytestmark = pytest.mark.ros
SAMPLES = 20_000
MOST_US = 20.0
_SOURCE = AccelerometerSource(CompensationParameters(payload=TOOL), ZERO)


@pytest.fixture
def output(_ros: None) -> Iterator[CompensatedOutput]:
    node = rclpy.create_node("cost", namespace="/test_cost")
    made = CompensatedOutput(node, "ft")
    made.plan = Plan(_SOURCE, Compensator(TOOL, inertia=True), BiasRamp(BIAS), needs_gravity=True)
    yield made
    node.destroy_node()


def test_nothing_is_done_while_nobody_wants_it(output: CompensatedOutput) -> None:
    outputs = Outputs([output])
    outputs.refresh()
    assert list(outputs.wanted) == []  # the reader does not even call it
    output.window = RestWindow(1.0, StillLimits(), _SOURCE)
    outputs.refresh()
    assert list(outputs.wanted) == [output]
    output.window = None
    outputs.refresh()
    assert list(outputs.wanted) == []


@pytest.mark.long
@pytest.mark.parametrize("window", [False, True])
def test_a_sample_costs_little(output: CompensatedOutput, window: bool) -> None:
    noise = random.Random(1)
    g = STANDARD_GRAVITY
    samples = [
        sample(force=(noise.gauss(0, 0.3), 0.0, -8.0), acceleration=(noise.gauss(0, 0.02), 0.0, g))
        for _ in range(SAMPLES)
    ]
    if window:
        output.window = RestWindow(1e9, StillLimits(), _SOURCE)
    took_ns = []
    for place, one in enumerate(samples):
        began_ns = time.perf_counter_ns()
        output.publish(one, 1_700_000_000_000_000_000 + place * 1_250_000)
        took_ns.append(time.perf_counter_ns() - began_ns)
    assert output.published == SAMPLES
    # The median: other processes take the processor away now and then.
    assert statistics.median(took_ns) / 1000 < MOST_US
