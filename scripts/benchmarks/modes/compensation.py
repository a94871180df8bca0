"""What compensation costs the node for each sample, besides publishing, beside decoding the same sample."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np

from ft_compensation.bias import BiasRamp
from ft_compensation.compensator import Compensator
from ft_compensation.outputs.filter import FilterSettings, WrenchFilter
from ft_compensation.outputs.frames import WrenchTransform
from ft_compensation.quantities import Payload, Wrench
from ft_compensation.stationary_limits import StationaryLimits
from protocol.framing import DataMessage
from protocol.pdo import Sample, SampleDecoder, encode
from scripts.benchmarks.chain import Figures, ScriptError, Setup
from scripts.benchmarks.modes.mode import Mode, points

SAMPLES: Final = 20_000
SIZE: Final = 61
DEFAULT: Final = "bias, weight and inertia"  # what is on by default, once there is a tool_mass
MOST_US: Final = 20.0  # more than this is an error
MOST_BY_DEFAULT_US: Final = 12.0
_TOOL: Final = Payload(0.8, (0.004, -0.006, 0.055))
_BIAS: Final = Wrench((3.0, -1.5, 7.25), (0.2, -0.05, 0.125))
_START_NS: Final = 1_700_000_000_000_000_000

Costs = dict[str, dict[str, float]]


def frames() -> Iterator[bytes]:
    """Process data of a sensor that lies stationary, upright, with its noise."""
    noise = random.Random(1)
    for _ in range(SAMPLES):
        yield encode(
            SIZE,
            {
                "force.x": noise.gauss(0.0, 0.3), "force.z": -8.0,
                "acceleration.x": noise.gauss(0.0, 0.002), "acceleration.z": 1.0,
            },
        )  # fmt: skip


def took(each: Callable[[int], object]) -> dict[str, float]:
    """Median, mean and p99, in µs, of calling `each` with the numbers from 0 on."""
    times = []
    for number in range(SAMPLES):
        began = time.perf_counter_ns()
        each(number)
        times.append(time.perf_counter_ns() - began)
    found = {str(percent): float(np.percentile(times, percent)) / 1000 for percent in (50, 99)}
    return {**found, "mean": sum(times) / len(times) / 1000}


def costs(setup: Setup) -> Costs:
    """Each case's."""
    import rclpy  # noqa: PLC0415 - the other modes do without
    from rclpy.context import Context  # noqa: PLC0415

    from bridge.compensating.tool_sources import ImuSource  # noqa: PLC0415
    from bridge.parameters.compensation import DEFAULTS  # noqa: PLC0415
    from bridge.publishing.compensated_wrench import CompensatedOutput, Plan, RestWindow  # noqa: PLC0415
    from bridge.publishing.messages import make_stages  # noqa: PLC0415

    data, decoder = list(frames()), SampleDecoder(SIZE)
    samples: list[Sample] = [decoder.decode(one) for one in data]
    step_ns = 1_000_000_000 // setup.rate_hz

    def frame(number: int) -> DataMessage:
        moment = _START_NS + number * step_ns
        return DataMessage(number, moment, moment, 0, 0, 3, data[number % SAMPLES])

    messages = [frame(number) for number in range(SAMPLES)]
    found = {"decoding": took(lambda number: decoder.decode(data[number]))}
    context = Context()
    rclpy.init(args=[], context=context)
    try:
        node = rclpy.create_node("compensation_cost", context=context)
        output = CompensatedOutput(make_stages(node, "ft"))

        def measure(name: str, *, window: bool) -> None:
            source = ImuSource(DEFAULTS._replace(payload=_TOOL), (0.0, 0.0, -0.0257))
            output.plan = Plan(source, Compensator(_TOOL), BiasRamp(_BIAS), has_tool=True)
            output.window = RestWindow(1e9, StationaryLimits(), source) if window else None
            before = output.published
            found[name] = took(lambda number: output.publish(samples[number], messages[number]))
            if output.published - before != SAMPLES:
                raise ScriptError(f"{name}: not all samples were compensated")

        measure(DEFAULT, window=False)
        measure("while a tare is taken", window=True)
    finally:
        rclpy.try_shutdown(context=context)
    found |= outputs(samples, setup.rate_hz)
    return found


def outputs(samples: list[Sample], rate_hz: float) -> Costs:
    """What outputs that are configured cost besides, each while somebody has subscribed to it."""
    wrench_filter, step_ns = WrenchFilter(), 1_000_000_000 / rate_hz
    frame = WrenchTransform.of((0.1, 0.2, 0.3), (0.5, 0.5, 0.5, 0.5))

    def step(number: int) -> object:
        return wrench_filter.step(samples[number].force, samples[number].torque, round(number * step_ns))

    wrench_filter.design(FilterSettings(cutoff=10.0), rate_hz)
    found = {"wrench_filtered": took(step)}
    wrench_filter.design(FilterSettings(10.0, 50.0, 5.0, 1.0, 0.01), rate_hz)
    found["wrench_filtered, notch and dead band"] = took(step)
    found["another frame"] = took(lambda number: frame.apply(samples[number].force, samples[number].torque))
    return found


def measure(setup: Setup, _: Any) -> list[Figures]:
    """A row for each case. ScriptError if it costs too much."""
    found = costs(setup)
    worst = max(found, key=lambda name: found[name]["50"])
    for name, most_us in ((worst, MOST_US), (DEFAULT, MOST_BY_DEFAULT_US)):
        if found[name]["50"] > most_us:
            raise ScriptError(f"{name} takes {found[name]['50']:.1f} µs a sample, more than {most_us:g} µs")
    return [
        {"case": name, "us": cost, "of_decoding": round(cost["50"] / found["decoding"]["50"], 1)}
        for name, cost in found.items()
    ]


MODE: Final = Mode(
    "only what compensation costs the node for each sample",
    measure,
    {
        "compensation of a sample": lambda row: row["case"],
        "median / mean / p99, µs": lambda row: points(row["us"], "50", "mean", "99", digits=1),
        "of decoding": lambda row: f"{row['of_decoding']}",
    },
)
