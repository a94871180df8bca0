# SPDX-License-Identifier: Apache-2.0
"""What the compensation is to do: parameters made into a `Plan`, the bias with its history, the source.

Lives in the executor's thread, but for `link_changed`. The parameter `bias` is the bias: every
change goes through it, so that it always shows what is in force, or ramped in.
"""

from __future__ import annotations

import math
import threading
from typing import Any, Final

from rclpy.node import Node

from bridge.compensating.sources import SourceChoice
from bridge.diagnostics import CompensationState
from bridge.parameters.declare import LiveParameters
from bridge.parameters.table import ParameterError, Parameters
from bridge.publishing.compensated_wrench import CompensatedOutput, Plan
from bridge.stream.reader import Reader
from ft_compensation.bias import BiasRamp, Taken, force_bound_95
from ft_compensation.compensator import Compensator
from ft_compensation.outputs import cutoff_problem
from ft_compensation.quantities import NO_WRENCH, Accelerometer, Payload, Wrench, wrench_text
from ft_compensation.stream import OwnOffset, hides_gravity, not_newtons

_FROM_PARAMETER: Final = "parameter"
_MEASURED: Final = ("tare", "identified")  # where a bias comes from that is one even if it is zero
_NOTHING_CURRENT: Final = "no current orientation"
_ANOTHER_SENSOR: Final = "the bias may be another sensor's"


class CompensationControl:
    """Wires parameters, bias and source to `output`, from `start` on."""

    def __init__(
        self,
        node: Node,
        parameters: Parameters,
        output: CompensatedOutput,
        reader: Reader,
        live: LiveParameters,
    ) -> None:
        """ParameterError if the parameters cannot be had here."""
        self.parameters, self.output = parameters, output
        self.reader, self.link, self._live = reader, reader.link, live
        self.origin = _FROM_PARAMETER  # where the bias in force comes from
        self._log = node.get_logger()
        self.choice = SourceChoice(node, self.link)
        # Of the sensor that the bias in force is for, for any thread; None until there was one.
        self._serial: int | str | None = ""  # of the sensor that was there last; "": none was
        self.own_offset = OwnOffset()
        # Origin of the bias that is being put in force, and what it was taken with if by a tare.
        self._next: tuple[str, Taken | None] = (_FROM_PARAMETER, None)
        self._is_following = False  # whether parameters are being made what is in force
        self.choice.check(parameters)
        self._ramp = BiasRamp(parameters.bias, parameters.bias_ramp_time)
        self._shifting = threading.Lock()  # guards shifts of the ramp, and its replacement
        live.check = self._check
        self._setting = node.setting
        self._guard = node.create_guard_condition(self._follow_sensor)

    def start(self) -> None:
        """Open the orientation's source, before any sample comes; ParameterError if it cannot be had."""
        self.choice.open(self.parameters)
        self._make_plan()

    def link_changed(self) -> None:
        """There is another connection, or none; for the reader's thread."""
        if not self._is_same_sensor():
            # Not one sample of this sensor with what may be another's bias.
            self.output.hold = _ANOTHER_SENSOR
            self._guard.trigger()
        else:
            self._follow_offset()
            if self.output.hold is not _ANOTHER_SENSOR:
                self._hold()

    @property
    def bias(self) -> Wrench:
        """The one in force, or being ramped in."""
        return self._ramp.target

    @property
    def offset(self) -> Wrench | None:
        """The sensor's own, as it is now; None if it is not known."""
        offset = self.link.info.offset
        return None if offset is None else Wrench.of(offset)

    @property
    def _sample_s(self) -> float:
        """The newest sample's time, by the server's monotonic clock, also while nobody has subscribed."""
        return self.reader.accounting.new_ns * 1e-9

    def state(self) -> CompensationState:
        """How things are, for the diagnostics' thread."""
        output, source, parameters = self.output, self.choice.source, self.parameters
        payload, bias, has_subscribers = parameters.payload, self.bias, output.has_subscribers
        bound = None
        if source.is_imu:
            bound = force_bound_95(payload, parameters.accelerometer, self._ramp.taken)
        age_s = source.age_s(output.time_s) if payload.mass and has_subscribers else math.inf
        parts = ["bias"] if bias != NO_WRENCH else []
        if payload.mass:
            parts.append("weight and inertia of the tool" if source.has_inertia else "weight of the tool")
        none = "nothing is subtracted: there is no bias and no tool_mass"
        good = f"subtracted: {', '.join(parts)}" if parts else none
        return CompensationState(
            good if has_subscribers else f"{good}; nobody has subscribed",
            {
                "gravity_source": source.describe,
                "orientation_age_s": round(age_s, 4) if math.isfinite(age_s) else "",
                "tf_frame_age_s": "" if (tf_age_s := output.frames.age_s) is None else round(tf_age_s, 4),
                "accelerometer_force": "" if bound is None else round(bound, 3),
                "tool_mass": round(payload.mass, 4),
                "tool_center_of_gravity": _numbers(payload.center),
                "tared": bias != NO_WRENCH,
                "bias": _numbers(bias.values),
                "bias_from": self.origin,
                "bias_ramping": not self._ramp.arrived(self._sample_s),
                "subscribed": has_subscribers,
                "compensated": output.published,
                "withheld": output.withheld,
            },
            stopped=self._why_stopped() or output.problem,
            doubtful=self.conflict()
            or (self.own_offset.doubt(self.offset) if self.link.is_connected else "")
            or self._ramp.taken.doubt(payload),
            follows_imu=source.is_imu and payload.mass > 0.0,
            withheld=output.withheld,
            why_withheld=output.why_withheld or f"{_NOTHING_CURRENT} ({source.describe})",
        )

    def conflict(self, *, needs_tool: bool = False) -> str:
        """A setting of the sensor that conflicts with compensation or, if `needs_tool`, with knowing the
        specific force in the frame of the wrench, a sentence that says what to do."""
        settings, has_tool = self.link.info.settings, self.parameters.payload.mass > 0
        return not_newtons(settings, has_tool=has_tool) or (self._why_unknown() if needs_tool else "")

    def _why_unknown(self) -> str:
        """Why these settings of the sensor hide the specific force, a sentence; empty if they do not."""
        return hides_gravity(self.link.info.settings) if self.parameters.gravity_source == "imu" else ""

    def _hold(self) -> None:
        """Publish nothing while the specific force is needed and cannot be known."""
        self.output.hold = self._why_unknown() if self.parameters.payload.mass else ""

    def _why_stopped(self) -> str:
        """Why the newest sample was not compensated, or would not be if anybody had subscribed."""
        output, source, watch = self.output, self.choice.source, self.reader.watch
        if not output.has_subscribers:
            why = output.hold
            if not why and self.parameters.payload.mass and watch.sample is not None:
                why = source.why_none(watch.sample, watch.stamp_ns * 1e-9)
            return why and f"wrench_compensated could not be published if somebody subscribed: {why}"
        if not output.is_stopped or output.sample is None:
            return ""
        why = output.why_withheld or source.why_none(output.sample, output.stamp_s) or _NOTHING_CURRENT
        return f"wrench_compensated has stopped: {why}"

    def set_bias(self, bias: Wrench, origin: str, taken: Taken | None = None) -> None:
        """Put a bias in force, `taken` by a tare."""
        with self._setting:
            if taken is not None:  # the tool may have been set since
                change, taken = taken.weighed(self.parameters.payload)
                bias = bias.plus(change)
            self.own_offset.begin(bias, self.offset, is_measured=origin in _MEASURED)
            self._put(origin, taken, bias=[*bias.values])

    def undo_bias(self) -> Wrench:
        """Go back to the bias before, and return it; CompensationError if there is none."""
        before = self._ramp.undo(self._sample_s)
        self.set_bias(before, "undone")
        self.origin = "undone"
        return before

    def forget_bias(self) -> None:
        """One that was measured is not for the next time: the sensor may be another."""
        if self.origin != _FROM_PARAMETER and self.bias != NO_WRENCH:
            self._log.warning(
                "the bias was measured before, and is zero now: tare when the node is active again"
            )
            self.set_bias(NO_WRENCH, "cleared")

    def set_payload(self, payload: Payload, bias: Wrench, accelerometer: Accelerometer | None = None) -> None:
        """Put an identified payload, its bias and the accelerometer's correction in force, all at once."""
        values: dict[str, Any] = {
            "tool_mass": payload.mass,
            "tool_center_of_gravity": [*payload.center],
            "bias": [*bias.values],
        }
        if accelerometer is not None:
            values |= {f"accelerometer.{name}": [*part] for name, part in accelerometer._asdict().items()}
        self._put("identified", **values)

    def _put(self, origin: str, taken: Taken | None = None, **values: Any) -> None:
        """Set parameters, the bias among them."""
        with self._setting:
            self._next = origin, taken
            try:
                self._live.put(sensor_offset=_offset_values(self.offset), **values)
            finally:
                self._next = _FROM_PARAMETER, None

    def _check(self, wanted: Parameters) -> None:
        """ParameterError if they cannot be had here."""
        self.choice.check(wanted)
        if self.link.is_connected and (rate_hz := self.link.info.rate_hz):
            cutoff_hz = wanted.filter_cutoff
            if cutoff_hz != self.parameters.filter_cutoff and (problem := cutoff_problem(cutoff_hz, rate_hz)):
                raise ParameterError(problem)

    def apply(self, wanted: Parameters) -> None:
        """Take other parameters."""
        was, self.parameters = self.parameters, wanted
        self._open_source()
        self._ramp.seconds = wanted.bias_ramp_time
        before, (origin, taken) = self.bias, self._next
        # A parameter that the shift of the bias has not reached yet is no wish.
        given = None if wanted.sensor_offset == was.sensor_offset else wanted.sensor_offset
        is_wish = not self._is_following and (
            taken is not None
            or wanted.bias not in (was.bias, before)
            or given not in (None, self.own_offset.of_bias)
        )
        with self._shifting:
            if wanted.payload != was.payload:
                self._ramp = self._ramp.weighed(wanted.payload)
            if is_wish:
                self._ramp.go(
                    wanted.bias, self._sample_s, taken or Taken(), may_undo=origin != _FROM_PARAMETER
                )
                is_measured = origin in _MEASURED or given is not None
                self.own_offset.begin(wanted.bias, given or self.offset, is_measured=is_measured)
                self.origin = origin
                self._guard.trigger()  # the parameter `sensor_offset` follows, or the bias does
            self._make_plan()
        if wanted.payload != was.payload and not is_wish:
            # The bias of a tare is another one with it.
            if warning := self._ramp.taken.warning(self.bias.plus(before, -1.0), wanted.payload):
                self._log.warning(warning)
            self._guard.trigger()  # the parameter follows
        if self.output.hold is not _ANOTHER_SENSOR:
            self._hold()

    def _open_source(self) -> None:
        try:
            self.choice.open(self.parameters)
        except ParameterError as error:  # too late to refuse the parameter
            self._log.error(str(error))

    def _make_plan(self) -> None:
        payload = self.parameters.payload
        self.output.plan = Plan(self.choice.source, Compensator(payload), self._ramp, payload.mass > 0.0)

    def _is_same_sensor(self) -> bool:
        return not self.link.is_connected or self.link.info.serial == self._serial

    def _follow_sensor(self) -> None:
        """The bias, and what was before it, are not another sensor's; a fixed one stays."""
        with self._setting:
            while not self._is_same_sensor():
                serial, given = self.link.info.serial, None
                if self._serial != "":
                    bias = self.bias
                    if self.origin != _FROM_PARAMETER:
                        self._log.warning(
                            f"another sensor is there now, serial number {serial}: the bias was the other's "
                            "and is zero now; tare"
                        )
                        bias, self.origin = NO_WRENCH, _FROM_PARAMETER
                    self._ramp = BiasRamp(bias, self.parameters.bias_ramp_time)
                elif self.origin == _FROM_PARAMETER:
                    given = self.parameters.sensor_offset
                self.own_offset.begin(self.bias, given or self.offset, is_measured=given is not None)
                self._serial = serial
                self._open_source()
                self._make_plan()
            self._follow_offset()
            offset = self.own_offset.of_bias if self.own_offset.has_bias else None
            if (self.bias, offset) != (self.parameters.bias, self.parameters.sensor_offset):
                self._is_following = True
                try:  # shifted, or zero again
                    self._live.put(bias=[*self.bias.values], sensor_offset=_offset_values(offset))
                except ParameterError as error:
                    self._log.error(str(error))
                finally:
                    self._is_following = False
            self._hold()
            if not self._is_same_sensor():
                self.link_changed()

    def _follow_offset(self) -> None:
        """Shift the bias by the change of the sensor's own offset, from the next sample on; any thread."""
        change = self.own_offset.follow(self.offset)
        if change is not None:
            with self._shifting:
                self._ramp.shift(change)
            self._log.info(
                f"the sensor's own offset was changed by {wrench_text(change)}: the bias is shifted by that"
            )
            self._guard.trigger()


def _offset_values(offset: Wrench | None) -> list[float]:
    """As the parameter has it."""
    return [math.inf] * 6 if offset is None else [*offset.values]


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.4f}" for value in values)
