"""Which topics the node publishes. To add one, add a class to this folder and a line here."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from bridge.parameters.table import Parameters
from bridge.publishing.compensated_wrench import CompensatedOutput
from bridge.publishing.filtered_wrench import FilteredTopic
from bridge.publishing.imu import ImuOutput, RawImuOutput
from bridge.publishing.messages import ArrayOutput, Outputs, TemperatureOutput, WrenchOutput, make_stages
from bridge.publishing.wrench_frames import make_frames


def make(node: Node, parameters: Parameters, compensated: CompensatedOutput) -> Outputs:
    """The node's outputs, `compensated` last."""
    return Outputs(
        [
            ArrayOutput(node, parameters.array_topic),
            WrenchOutput(node, "wrench", parameters.frame_id),
            RawImuOutput(node, parameters),
            ImuOutput(node, parameters),
            TemperatureOutput(node, "temperature", parameters),
            compensated,
        ]
    )


def make_compensated(node: Node, parameters: Parameters, rate_hz: Callable[[], float]) -> CompensatedOutput:
    """The output of all that is compensated; `rate_hz` tells the sensor's sampling rate, 0 if unknown.

    ParameterError if a frame needs TF and there is none.
    """
    return CompensatedOutput(
        [
            *make_stages(node, parameters.frame_id),
            *make_frames(node, parameters),
            FilteredTopic(node, parameters, rate_hz),
        ]
    )
