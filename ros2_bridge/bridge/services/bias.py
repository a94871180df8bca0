"""The services that take, clear and undo the bias: `~/tare`, `~/clear_tare`, `~/undo_tare`."""

from __future__ import annotations

from rclpy.node import Node

from bridge.compensating.control import CompensationControl
from bridge.publishing.compensated_wrench import RestWindow
from bridge.services.triggers import create_triggers
from bridge.services.window import take_window
from bridge.stream.requests import Requests
from ft_compensation.bias import Taken, check_at_rest, estimate_bias
from ft_compensation.quantities import NO_WRENCH, ZERO, CompensationError, length, wrench_text
from protocol.pdo import Vector3


class BiasServices:
    """A tare blocks the executor for `rest.duration`, and never the stream."""

    def __init__(self, node: Node, control: CompensationControl, requests: Requests) -> None:
        self._control, self._requests, self._log = control, requests, node.get_logger()
        acts = {"tare": self._tare, "clear_tare": self._clear, "undo_tare": self._undo}
        create_triggers(node, acts, CompensationError)

    def _tare(self) -> str:
        control = self._control
        payload = control.parameters.payload
        window = take_window(control, self._requests, needs_tool=payload.mass > 0)
        means = window.means()
        try:
            felt: Vector3 | None = self._specific_force(window)
        except CompensationError:
            if payload.mass:
                raise
            felt = None  # until there is a tool_mass nobody needs it
        control.set_bias(estimate_bias(means, payload, felt or ZERO), "tare", Taken(payload, felt))
        if payload.mass:
            weight = f"the weight of tool_mass {payload.mass:.3g} kg is not part of it"
        else:
            weight = (
                "tool_mass is 0, so the weight of whatever hangs on the sensor is part of it and it holds in "
                "this orientation only"
            )
        return self._said(f"bias of {means.samples} samples: {wrench_text(control.bias)}; {weight}")

    def _specific_force(self, window: RestWindow) -> Vector3:
        parameters = self._control.parameters
        if conflict := self._control.conflict(needs_tool=True):
            raise CompensationError(conflict)
        felt = window.specific_force()
        check_at_rest(felt, length(parameters.gravity))
        return felt

    def _clear(self) -> str:
        self._control.set_bias(NO_WRENCH, "cleared")
        return self._said("the bias is zero")

    def _undo(self) -> str:
        return self._said(f"back to the bias before: {wrench_text(self._control.undo_bias())}")

    def _said(self, text: str) -> str:
        control = self._control
        if control.parameters.bias_keep:
            text += f"; not kept: {control.keeping}" if control.keeping else "; kept for the next start"
        self._log.info(text)
        return text
