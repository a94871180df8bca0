"""Declares the table's parameters on the node and reads what was given."""

from __future__ import annotations

from typing import Any, Final

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from bridge.parameters.row import ParameterValue, Row
from bridge.parameters.table import PARAMETERS, Parameters, gather_all
from protocol.settings import SETTINGS
from protocol.text.did_you_mean import did_you_mean

SETTINGS_PREFIX: Final = "settings."
_OF_OTHERS: Final = ("qos_overrides.", "use_sim_time", "start_type_description_service")
"""Prefixes of parameters that rclpy itself may declare."""


def declare(node: Node) -> Parameters:
    """Declare every parameter on `node` and return their values; ParameterError if one is wrong."""
    # Of any type here: `Row.check` has made each what its default is.
    values: dict[str, Any] = {row.name: _given(node, row) for row in PARAMETERS}
    parameters = gather_all(dict(values))
    values["server_port"] = parameters.server_port
    for row in PARAMETERS:
        node.declare_parameter(row.name, values[row.name], descriptor(row), ignore_override=True)
    return parameters


def warn_of_others(node: Node) -> None:
    """Warn of given parameters that the node does not have; call it once all are declared."""
    # Not the node's own list, which leaves out settings without a value.
    names = [row.name for row in PARAMETERS] + [SETTINGS_PREFIX + name for name in SETTINGS]
    for given in node._parameter_overrides:  # rclpy has no public name
        if node.has_parameter(given) or given.startswith(_OF_OTHERS):
            continue
        guess = did_you_mean(given, names) or "; ros2 param list shows the valid names"
        node.get_logger().warning(f"unknown parameter {given} is ignored{guess}")
    if node.get_parameter("use_sim_time").value is True:
        node.get_logger().warning(
            "use_sim_time is true, but a real sensor has no simulation time: stamps are wall-clock time, and "
            "those of orientations must be too"
        )


def descriptor(row: Row) -> ParameterDescriptor:
    """What `ros2 param describe` shows."""
    described = ParameterDescriptor(description=row.description, read_only=not row.live)
    if row.choices or isinstance(row.default, tuple):
        described.additional_constraints = row.allowed()
    if row.low is not None and row.high is not None:
        if type(row.default) is int:
            described.integer_range = [IntegerRange(from_value=int(row.low), to_value=int(row.high), step=1)]
        elif isinstance(row.default, float):
            described.floating_point_range = [
                FloatingPointRange(from_value=float(row.low), to_value=float(row.high), step=0.0)
            ]
    return described


def _given(node: Node, row: Row) -> ParameterValue:
    """What was given, checked; declared loosely for that, whatever its type, and undeclared again."""
    given = node.declare_parameter(row.name, row.default, ParameterDescriptor(dynamic_typing=True)).value
    node.undeclare_parameter(row.name)
    return row.check(given)
