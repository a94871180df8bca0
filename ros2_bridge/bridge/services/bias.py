"""The services that take, clear and undo the bias, and the window at rest that identification takes, too."""

from __future__ import annotations

import threading
from typing import Final

from rclpy.node import Node

from bota_ethercat.pdo import Vector3
from bridge.compensating.control import CompensationControl
from bridge.publishing.compensated_wrench import RestWindow
from bridge.services.sensor import create_triggers
from bridge.stream.link import DESCRIBE_TIMEOUT_S, Link, RequestFailedError, find_sensor
from ft_compensation.bias import Taken, check_at_rest, estimate_bias
from ft_compensation.quantities import NO_WRENCH, ZERO, CompensationError, length, wrench_text

_PATIENCE_S: Final = 2.0
"""A window may take this much longer than half as long again as it lasts."""
_LOOK_S: Final = 0.05
_SETTLED_WITHIN_S: Final = 10.0


class BiasServices:
    """A tare blocks the executor for `rest.duration`, and never the stream."""

    def __init__(self, node: Node, control: CompensationControl) -> None:
        self._control, self._log = control, node.get_logger()
        acts = {"tare": self._tare, "clear_tare": self._clear, "undo_tare": self._undo}
        create_triggers(node, acts, CompensationError)

    def _tare(self) -> str:
        control = self._control
        payload = control.parameters.payload
        window = take_window(control, needs_tool=payload.mass > 0)
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


def take_window(control: CompensationControl, *, needs_tool: bool) -> RestWindow:
    """The samples of the next `rest.duration`, whole, once the sensor's data has settled; blocks the caller
    and never the stream.

    CompensationError if they do not come or mean nothing.
    """
    if (conflict := control.conflict(needs_tool=needs_tool)) is not None:
        raise CompensationError(conflict)
    link = control.link
    if not link.is_connected:
        raise CompensationError(f"{link.absence}, so there are no samples")
    _wait_settled(link)
    seconds, limits = control.parameters.rest_duration, control.parameters.rest
    window = RestWindow(seconds, limits, control.source)
    patience_s = 1.5 * seconds + _PATIENCE_S
    clock = link.clock
    deadline_s = clock.monotonic() + patience_s
    info, offset, bad = link.info, link.offset, control.count_not_finite()
    control.output.window = window
    try:
        while not clock.wait(window.done, _LOOK_S):
            if link.ending:
                raise CompensationError("the node ends")
            if clock.monotonic() > deadline_s:
                raise CompensationError(
                    f"only {window.count} samples came in {patience_s:.1f} s: see /diagnostics, stream"
                )
    finally:
        control.output.window = None
    # By what the reader knows: the executor, which would count another sensor, is the one that waits here.
    if info is not None and link.info is not None and info.serial != link.info.serial:
        raise CompensationError("the sensor was replaced by another meanwhile: call again")
    if offset != link.offset:
        raise CompensationError("the sensor's own offset was changed meanwhile: call again")
    if bad := control.count_not_finite() - bad:
        raise CompensationError(
            f"the window is spoiled: {bad} of its samples were not finite; see /diagnostics, stream, and "
            "call again"
        )
    return window


def _wait_settled(link: Link) -> None:
    """After a sensor has entered OP its data settles, which the server knows."""
    deadline_s = link.clock.monotonic() + _SETTLED_WITHIN_S
    try:
        while find_sensor(link.ask("describe", DESCRIBE_TIMEOUT_S), link.sensor).settling:
            if link.clock.monotonic() > deadline_s:
                raise CompensationError(f"sensor {link.sensor} does not settle: see the server's log")
            link.clock.wait(threading.Event(), _LOOK_S)
    except RequestFailedError as error:
        raise CompensationError(str(error)) from None
