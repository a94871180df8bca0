"""The node's parameters: one table, from which they are declared, checked, described and documented.

All are read-only: they say what the node is. A wrong value ends the node at start with one sentence.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from protocol.pdo import ImuUnits

ParameterValue = bool | int | float | str


class ParameterError(Exception):
    """A parameter has a value that it cannot have; the text is one sentence."""


class Row(NamedTuple):
    """One parameter. The default's type is the parameter's."""

    name: str
    default: ParameterValue
    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()

    def check(self, value: object) -> ParameterValue:
        """Return `value`, a whole number as float where one is meant; ParameterError if it cannot be."""
        wanted = type(self.default)
        if wanted is float and type(value) is int:
            value = float(value)
        in_type = type(value) is wanted and (not isinstance(value, float) or math.isfinite(value))
        if not in_type or not isinstance(value, bool | int | float | str) or not self._allows(value):
            raise ParameterError(f"parameter {self.name} is {value!r}: it must be {self._choices_text()}")
        return value

    def _allows(self, value: ParameterValue) -> bool:
        if isinstance(value, str):
            return value in self.choices if self.choices else bool(value)
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    def _choices_text(self) -> str:
        if self.choices:
            return " or ".join(self.choices)
        if isinstance(self.default, str):
            return "text that is not empty"
        kind = "a whole number" if isinstance(self.default, int) else "a number"
        return f"{kind} from {self.low:g} to {self.high:g}"

    def descriptor(self) -> ParameterDescriptor:
        """What `ros2 param describe` shows."""
        descriptor = ParameterDescriptor(description=self.description, read_only=True)
        if self.choices:
            descriptor.additional_constraints = self._choices_text()
        if self.low is not None and self.high is not None:
            if isinstance(self.default, float):
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(self.low), to_value=float(self.high), step=0.0)
                ]
            else:
                descriptor.integer_range = [
                    IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)
                ]
        return descriptor


PARAMETERS: Final = (
    Row("server_host", "localhost", "Host that ethercat-server runs on"),
    Row("server_port", 12001, "TCP port of ethercat-server", 1, 65535),
    Row("SERVER_PORT", 0, "Another name for server_port; 0 = not used", 0, 65535),
    Row("sensor", 0, "The sensor's place on the bus, from 0", 0, 255),
    Row("publishing_frequency", 0.0, "Most messages a second, always the newest; 0 = every sample", 0, 1e6),
    Row("array_topic", "/sensone_sensor_data", "Topic of the Float64MultiArray"),
    Row(
        "imu_raw_units",
        ImuUnits.G_DPS.value,
        "What the sensor sends acceleration and angular rate in",
        choices=tuple(units.value for units in ImuUnits),
    ),
)


class Parameters(NamedTuple):
    """The parameters' values, checked."""

    server_host: str
    server_port: int
    sensor: int
    publishing_frequency: float
    array_topic: str
    imu_units: ImuUnits


def declare(node: Node) -> Parameters:
    """Declare every parameter on `node` and return their values; ParameterError if one is wrong."""
    values = {row.name: _declare(node, row) for row in PARAMETERS}
    port, alias = values["server_port"], values["SERVER_PORT"]
    if alias:
        if port not in (12001, alias):
            raise ParameterError(
                f"parameters server_port is {port} and SERVER_PORT is {alias}: they are one thing, give one"
            )
        port = alias
    return Parameters(
        server_host=str(values["server_host"]),
        server_port=int(port),
        sensor=int(values["sensor"]),
        publishing_frequency=float(values["publishing_frequency"]),
        array_topic=str(values["array_topic"]),
        imu_units=ImuUnits(values["imu_raw_units"]),
    )


def _declare(node: Node, row: Row) -> ParameterValue:
    # Declared twice: loosely, to see what was given whatever its type, then as what it is.
    given = node.declare_parameter(row.name, row.default, ParameterDescriptor(dynamic_typing=True)).value
    value = row.check(given)
    node.undeclare_parameter(row.name)
    node.declare_parameter(row.name, value, row.descriptor(), ignore_override=True)
    return value
