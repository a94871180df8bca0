"""The table's parameters on the node: declared with what was given, and set while the node runs.

Those that are set are checked one by one and together, then applied.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter

from bota_ethercat.settings import SETTINGS
from bota_ethercat.text.did_you_mean import did_you_mean
from bridge.parameters.row import ParameterError, ParameterValue, Row
from bridge.parameters.table import PARAMETERS, Parameters, gather_all

SETTINGS_PREFIX: Final = "settings."
_OF_OTHERS: Final = ("qos_overrides.", "use_sim_time", "start_type_description_service")
"""Prefixes of parameters that rclpy itself may declare."""
_LIVE: Final = {row.name: row for row in PARAMETERS if row.live}
_TYPES: Final = {type_.value for type_ in Parameter.Type}


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


class LiveParameters:
    """Lives in the executor's thread."""

    def __init__(self, node: Node) -> None:
        """The parameters must have been declared."""
        self._node = node
        self.checks: list[Callable[[Parameters], object]] = []
        """Each may refuse new values: ParameterError."""
        self.listeners: list[Callable[[Parameters], object]] = []
        """Each gets the new values."""
        node.add_pre_set_parameters_callback(_convert)
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._after_set)
        for service in node.services:
            if service.srv_type in (SetParameters, SetParametersAtomically):
                service.callback = _refuse_unknown_types(service.callback)

    def put(self, **values: Any) -> None:
        """Set parameters from within; ParameterError if that is refused."""
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        result = self._node.set_parameters_atomically(parameters)
        if not result.successful:
            raise ParameterError(result.reason)

    def _on_set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        changed = {parameter.name: parameter.value for parameter in parameters if parameter.name in _LIVE}
        if changed:
            try:
                wanted = self._gather(changed)
                for check in self.checks:
                    check(wanted)
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _after_set(self, parameters: Sequence[Parameter]) -> None:
        if any(parameter.name in _LIVE for parameter in parameters):
            found = self._gather({})
            for listener in self.listeners:
                listener(found)

    def _gather(self, changed: dict[str, Any]) -> Parameters:
        return gather_all(
            {
                row.name: row.check(
                    changed[row.name] if row.name in changed else self._node.get_parameter(row.name).value
                )
                for row in PARAMETERS
            }
        )


def _refuse_unknown_types(set_parameters: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """rclpy's callback of a service, which raises where anybody sends a type that there is not."""

    def callback(request: Any, response: Any) -> Any:
        unknown = {parameter.value.type for parameter in request.parameters} - _TYPES
        if not unknown:
            return set_parameters(request, response)
        reason = f"there is no parameter type {unknown.pop()}: see rcl_interfaces/msg/ParameterType"
        result = SetParametersResult(successful=False, reason=reason)
        if isinstance(response, SetParameters.Response):
            response.results = [result] * len(request.parameters)
        else:
            response.result = result
        return response

    return callback


def _convert(parameters: Sequence[Parameter]) -> list[Parameter]:
    """Whole numbers as the floats that are meant: `ros2 param set /bridge tool_mass 1`."""
    return [_converted(parameter) for parameter in parameters]


def _converted(parameter: Parameter) -> Parameter:
    try:
        value = _LIVE[parameter.name].check(parameter.value)
    except (KeyError, ParameterError):  # of others, or refused soon, with a sentence
        return parameter
    return Parameter(parameter.name, value=[*value] if isinstance(value, tuple) else value)
