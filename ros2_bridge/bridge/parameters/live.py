"""The parameters that can be set while the node runs: checked one by one and together, then applied."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from bridge.parameters.compensation import ROWS, CompensationParameters, gather
from bridge.parameters.row import ParameterError

_ROWS: Final = {row.name: row for row in ROWS}


class LiveParameters:
    """Lives in the executor's thread. `check` may refuse (ParameterError), `apply` gets what is new."""

    def __init__(
        self,
        node: Node,
        check: Callable[[CompensationParameters], None],
        apply: Callable[[CompensationParameters], None],
    ) -> None:
        """The parameters must have been declared."""
        self._node, self._check, self._apply = node, check, apply
        node.add_pre_set_parameters_callback(_convert)
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._after_set)

    def put(self, **values: Any) -> None:
        """Set parameters from within; ParameterError if that is refused."""
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        result = self._node.set_parameters_atomically(parameters)
        if not result.successful:
            raise ParameterError(result.reason)

    def _on_set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        changed = {parameter.name: parameter.value for parameter in parameters if parameter.name in _ROWS}
        if changed:
            try:
                self._check(self._gather(changed))
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _after_set(self, parameters: Sequence[Parameter]) -> None:
        if any(parameter.name in _ROWS for parameter in parameters):
            self._apply(self._gather({}))

    def _gather(self, changed: dict[str, Any]) -> CompensationParameters:
        values = {
            name: row.check(changed[name] if name in changed else self._node.get_parameter(name).value)
            for name, row in _ROWS.items()
        }
        return gather(values)


def _convert(parameters: Sequence[Parameter]) -> list[Parameter]:
    """Whole numbers as the floats that are meant: `ros2 param set /bridge tool_mass 1`."""
    return [
        Parameter(parameter.name, value=_ROWS[parameter.name].convert(parameter.value))
        if parameter.name in _ROWS and parameter.value is not None
        else parameter
        for parameter in parameters
    ]
