# SPDX-License-Identifier: Apache-2.0
"""The state of the compensation: the bias with its history, the source, and the `Plan` that follows.

Changes of the bias, of services, parameters and another sensor, wait in a queue and are taken in the
executor's thread; a change of the sensor's own offset shifts the bias at once. The parameters `bias` and
`sensor_offset` show the bias in force, or being ramped in.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from bota_ethercat_bridge.compensating.compensation import Compensation
from bota_ethercat_bridge.compensating.sources import check_source, open_source
from bota_ethercat_bridge.diagnostics import CompensationState
from bota_ethercat_bridge.parameters.declare import NodeParameters
from bota_ethercat_bridge.parameters.table import ParameterError, Parameters
from bota_ethercat_bridge.stream.reader import Reader
from bota_ft_compensation.bias import BiasRamp, TareBasis
from bota_ft_compensation.imu import GravityCheck, Source
from bota_ft_compensation.outputs import cutoff_problem
from bota_ft_compensation.own_offset import OwnOffset
from bota_ft_compensation.quantities import (
    NO_WRENCH,
    STILL,
    Accelerometer,
    Accuracy,
    Payload,
    Wrench,
    wrench_text,
)
from bota_ft_compensation.stream import Plan, obstacle

_FROM_PARAMETER: Final = "parameter"
_MEASURED: Final = ("tare", "identified")  # where a bias comes from that is one even if it is zero
_SHOWN: Final = 5e-5  # N, Nm: less is that a file has fewer digits than the sensor
_NOTHING_CURRENT: Final = "no current orientation"
# What a source depends on.
_DEPENDS_ON: Final = (
    "gravity_source", "gravity", "payload", "accelerometer", "accuracy", "imu_position", "gyroscope_matrix",
    "orientation_topic",
    "orientation_base_frame", "orientation_mounting", "orientation_stale_after",
)  # fmt: skip


class BiasChange(NamedTuple):
    bias: Wrench
    origin: str
    taken: TareBasis = TareBasis()  # what a tare took it with
    offset: Wrench | None = None  # of the sensor, which the bias goes with; None: the current one


class CompensationControl:
    """Makes the plan of `output`, from `start` on; in the executor's thread, but for `link_changed`."""

    def __init__(
        self, node: Node, parameters: Parameters, output: Compensation, reader: Reader, live: NodeParameters
    ) -> None:
        self.parameters, self.output = parameters, output
        self.reader, self.link, self._live = reader, reader.link, live
        self.origin = _FROM_PARAMETER  # where the bias in force comes from
        self._node, self._log, self._setting = node, node.get_logger(), node.setting
        self.source, self._told = Source(), ""
        self._source_of: object = None  # what the open source depends on
        self._group = MutuallyExclusiveCallbackGroup()
        # Of the sensor that the bias in force is for; "": none was there yet.
        self._serial: int | str | None = ""
        self._changes: deque[BiasChange] = deque()
        self._is_showing = False  # whether parameters are being made what is in force
        check_source(node, parameters)
        output.stream.plan = Plan(ramp=BiasRamp(Wrench.of(parameters.bias)))
        self._replacing = threading.Lock()  # guards the plan
        live.check = self._check
        self._guard = node.create_guard_condition(self._follow_sensor)

    def start(self) -> None:
        """Open the orientation's source, before any sample comes; ParameterError if it cannot be had."""
        self._open_source()
        self._change()

    def stop(self) -> None:
        self._close_source()
        self.output.frames.close()

    def _close_source(self) -> None:
        self.source.close()
        self.source, self._source_of, self.output.gravity = Source(), None, GravityCheck()

    def link_changed(self) -> None:
        """What is in force, or the connection, has changed; for the reader's thread."""
        self.output.stream.configure(self.link.in_force)
        if self._is_same_sensor():
            self._follow_offset()
        else:
            # Not one sample of this sensor with what may be another's bias.
            self._forbid("the bias may be another sensor's")
            self._guard.trigger()

    @property
    def own_offset(self) -> OwnOffset:
        """How that of the sensor changes the bias."""
        return self.output.stream.own_offset

    @property
    def _ramp(self) -> BiasRamp:
        return self.output.stream.plan.ramp

    @property
    def bias(self) -> Wrench:
        """The one in force, or being ramped in."""
        return self._ramp.target

    @property
    def offset(self) -> Wrench | None:
        """The sensor's own, as it is now; None if it is not known."""
        return self.output.stream.offset

    @property
    def _sample_s(self) -> float:
        """The newest sample's time, by the server's monotonic clock, also while nobody has subscribed."""
        return self.reader.accounting.new_ns * 1e-9

    def state(self) -> CompensationState:
        output, source, parameters = self.output, self.source, self.parameters
        payload, bias, has_subscribers = parameters.payload, self.bias, output.has_subscribers
        parts = ["bias"] if bias != NO_WRENCH else []
        if payload.mass:
            parts.append("weight and inertia of the tool" if source.is_imu else "weight of the tool")
        before, self._told = self._told, output.gravity.problem if payload.mass else ""
        if self._told not in ("", before):
            self._log.warning(f"wrench_compensated is wrong: {self._told}")
        none = "nothing is subtracted: there is no bias and no tool_mass"
        good = f"subtracted: {', '.join(parts)}" if parts else none
        return CompensationState(
            good if has_subscribers else f"{good}; nobody has subscribed",
            self._values,
            stopped=self._why_stopped() or output.problem,
            doubtful=self._ramp.taken.doubt(payload) or (self._told if has_subscribers else ""),
            follows_imu=source.is_imu and payload.mass > 0.0,
            withheld=output.withheld,
            why_withheld=output.why_withheld or f"{_NOTHING_CURRENT} ({source.name})",
        )

    def _values(self) -> dict[str, object]:
        output, source, payload = self.output, self.source, self.parameters.payload
        has_subscribers, bounds = output.has_subscribers, ("", "")
        if source.is_imu:
            force, torque = output.stream.bounds(turning=None if has_subscribers else STILL)
            bounds = f"{force:.3f}", f"{torque:.4f}"
        age_s = source.age_s(output.time_s) if payload.mass and has_subscribers else math.inf
        return {
            "gravity_source": source.name,
            "orientation_age_s": round(age_s, 4) if math.isfinite(age_s) else "",
            "tf_frame_age_s": "" if (tf_age_s := output.frames.age_s) is None else round(tf_age_s, 4),
            "force_bound": bounds[0],
            "torque_bound": bounds[1],
            "contact": output.contact.why.value if output.contact else "",
            "tared": self.bias != NO_WRENCH,
            "bias_from": self.origin,
            "bias_ramping": not self._ramp.arrived(self._sample_s),
            "subscribed": has_subscribers,
            "compensated": output.published,
            "withheld": output.withheld,
        }

    def conflict(self, *, needs_tool: bool = False) -> str:
        """A setting of the sensor that conflicts with compensation or, if `needs_tool`, with knowing the
        specific force in the frame of the wrench, a sentence that says what to do."""
        by_imu, has_tool = self.parameters.gravity_source == "imu", self.parameters.tool_mass > 0
        return obstacle(self.link.settings, has_tool=has_tool or needs_tool, by_imu=by_imu)

    def _forbid(self, why: str) -> None:
        """Publish nothing, whatever is in force; empty: publish again."""
        self.output.stream.forbidden = why
        self.output.stream.check()

    def _why_stopped(self) -> str:
        """Why the newest sample was not compensated, or would not be if anybody had subscribed."""
        output, source, reader = self.output, self.source, self.reader
        if not output.has_subscribers:
            why = output.stream.hold
            if not why and self.parameters.tool_mass and reader.values is not None:
                why = source.why_none(output.decode(reader.values), reader.stamp_ns * 1e-9)
            return why and f"wrench_compensated could not be published if somebody subscribed: {why}"
        if not output.is_stopped or output.sample is None:
            return ""
        why = output.why_withheld or source.why_none(output.sample, output.stamp_s) or _NOTHING_CURRENT
        return f"wrench_compensated has stopped: {why}"

    # -- changes of the bias

    def set_bias(self, bias: Wrench, origin: str, taken: TareBasis = TareBasis()) -> None:  # noqa: B008
        """Put a bias in force, `taken` by a tare; ParameterError if it is none."""
        with self._setting:
            change, taken = taken.for_payload(self.parameters.payload)  # the tool may have been set since
            bias = bias.plus(change)
            self._live.check_values(bias=bias.values)
            self._changes.append(BiasChange(bias, origin, taken))
            self._change(self._apply_changes)
            self._show()

    def undo_bias(self) -> Wrench:
        """Go back to the bias before, and return it; CompensationError if there is none."""
        with self._setting:
            self._change(self._undone)
            self.origin = "undone"
            self._show()
            return self.bias

    def _undone(self, ramp: BiasRamp) -> BiasRamp:
        ramp = ramp.undone(self._sample_s, self.parameters.bias_ramp_time)
        self.own_offset.begin(ramp.target, self.offset)
        return ramp

    def forget_bias(self) -> None:
        """One that was measured is not for the next time: the sensor may be another."""
        if self.origin != _FROM_PARAMETER and self.bias != NO_WRENCH:
            self._log.warning(
                "the bias was measured before, and is zero now: tare when the node is active again"
            )
            self.set_bias(NO_WRENCH, "cleared")

    def set_payload(
        self, payload: Payload, bias: Wrench, accuracy: Accuracy, accelerometer: Accelerometer | None = None
    ) -> None:
        """Put an identified payload, its bias and the accelerometer's correction in force, all at once."""
        values: dict[str, Any] = {
            "tool_mass": payload.mass, "tool_center_of_gravity": [*payload.center],
            "tool_inertia": [*payload.inertia],
            "tool_center_of_gravity_interval": [*payload.center_interval],
            "tool_inertia_interval": [*payload.inertia_interval],
        }  # fmt: skip
        values |= {f"accuracy.{name}": [*part] for name, part in accuracy._asdict().items()}
        if accelerometer is not None:
            values |= {f"accelerometer.{name}": [*part] for name, part in accelerometer._asdict().items()}
        with self._setting:
            self._live.check_values(bias=bias.values)
            self._changes.append(BiasChange(bias, "identified"))
            try:
                self._live.put(**values)
            finally:
                self._changes.clear()
            self._show()

    def _change(self, change: Callable[[BiasRamp], BiasRamp] = lambda ramp: ramp) -> None:
        """Replace the plan; from any thread."""
        parameters = self.parameters
        with self._replacing:
            ramp = change(self._ramp)
            self.output.stream.plan = Plan(
                self.source, parameters.payload, ramp, parameters.accelerometer, parameters.accuracy
            )
            self.output.stream.check()

    def _apply_changes(self, ramp: BiasRamp) -> BiasRamp:
        """Of this ramp the one for the present tool that leads to the bias that waits."""
        parameters = self.parameters
        ramp = ramp.for_payload(parameters.payload)
        while self._changes:
            bias, self.origin, taken, offset = self._changes.popleft()
            may_undo, is_measured = self.origin != _FROM_PARAMETER, self.origin in _MEASURED
            ramp = ramp.go(bias, self._sample_s, parameters.bias_ramp_time, taken, may_undo=may_undo)
            self.own_offset.begin(bias, offset or self.offset, is_measured=is_measured or offset is not None)
        return ramp

    @property
    def _offset_values(self) -> tuple[float, ...]:
        """The sensor's offset that the bias goes with, as the parameter has it."""
        offset = self.own_offset.of_bias if self.own_offset.has_bias else None
        return (math.inf,) * 6 if offset is None else offset.values

    def _show(self) -> None:
        bias, offset = self.bias.values, self._offset_values
        if (self.parameters.bias, self.parameters.sensor_offset) == (bias, offset):
            return
        self._is_showing = True
        try:
            self._live.put(bias=[*bias], sensor_offset=[*offset])
        except ParameterError as error:
            self._log.error(str(error))
        finally:
            self._is_showing = False

    # -- parameters

    def _check(self, wanted: Parameters) -> None:
        check_source(self._node, wanted)
        cutoff_hz, was_hz = wanted.filter_cutoff, self.parameters.filter_cutoff
        if (cutoff_hz > 0) is not (was_hz > 0):
            raise ParameterError(
                f"parameter filter.cutoff is {cutoff_hz:g}: wrench_filtered is made at the start, or not at "
                "all; start the node with it"
            )
        rate_hz = self.link.info.rate_hz if self.link.is_connected else 0.0
        if cutoff_hz != was_hz and rate_hz and (problem := cutoff_problem(cutoff_hz, rate_hz)):
            raise ParameterError(problem)

    def apply(self, wanted: Parameters) -> None:
        was, self.parameters = self.parameters, wanted
        self._open_source(is_late=True)
        if self._is_showing:
            return
        # Nobody asks for the bias that is shown, even if the bias in force has been shifted since.
        is_other_offset = wanted.sensor_offset not in (was.sensor_offset, self._offset_values)
        if is_other_offset or wanted.bias not in (was.bias, self.bias.values):
            offset = _known(wanted.sensor_offset) if is_other_offset else None
            self._changes.append(BiasChange(Wrench.of(wanted.bias), _FROM_PARAMETER, offset=offset))
        is_given, before, warning = bool(self._changes), self.bias, ""
        self._change(self._apply_changes)
        # The bias of a tare is another one with another tool.
        if wanted.payload[:3] != was.payload[:3] and not is_given:
            warning = self._ramp.taken.warning(self.bias.plus(before, -1.0), wanted.payload)
        if warning:
            self._log.warning(warning)
        self._guard.trigger()  # the parameters follow

    def _open_source(self, *, is_late: bool = False) -> None:
        """Open the source that is wanted, unless it is open. ParameterError, if it is not too `late`."""
        depends_on = [getattr(self.parameters, name) for name in _DEPENDS_ON]
        if depends_on == self._source_of:
            return
        self._close_source()
        try:
            self.source = open_source(self._node, self.parameters, self._group)
            self._source_of = depends_on
        except ParameterError as error:
            self.source = Source(str(error))
            if not is_late:
                raise
            self._log.error(str(error))

    # -- the sensor

    def _is_same_sensor(self) -> bool:
        return not self.link.is_connected or self.link.info.serial == self._serial

    def _follow_sensor(self) -> None:
        """The bias, and what was before it, are not another sensor's; a fixed one stays."""
        with self._setting:
            while not self._is_same_sensor():
                serial, offset, ramp = self.link.info.serial, None, self._ramp
                if self._serial != "":
                    ramp = BiasRamp(self.bias)
                    if self.origin != _FROM_PARAMETER:
                        self._log.warning(
                            f"another sensor is there now, serial number {serial}: the bias was the other's "
                            "and is zero now; tare"
                        )
                        ramp, self.origin = BiasRamp(), _FROM_PARAMETER
                elif self.origin == _FROM_PARAMETER:
                    offset = _known(self.parameters.sensor_offset)
                self.own_offset.begin(ramp.target, offset or self.offset, is_measured=offset is not None)
                self._serial = serial
                self._change(partial(lambda ramp, _: ramp, ramp))
            self._follow_offset()
            self._show()
            self._forbid("")
            if not self._is_same_sensor():
                self.link_changed()

    def _follow_offset(self) -> None:
        """Shift the bias by the change of the sensor's own offset, from the next sample on; any thread."""
        with self._replacing:
            change = self.output.stream.follow_offset()
        if change is not None:
            if max(map(abs, change.values)) > _SHOWN:
                text = f"the sensor's own offset was changed by {wrench_text(change)}"
                self._log.info(f"{text}: the bias is shifted by that")
            self._guard.trigger()


def _known(offset: tuple[float, ...]) -> Wrench | None:
    """Of the parameter `sensor_offset`, which is infinite where there is none."""
    return Wrench.of(offset) if all(map(math.isfinite, offset)) else None
