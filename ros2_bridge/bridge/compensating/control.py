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

from bota_ethercat.health.history import line_slope
from bota_ethercat.replies import SensorStatus
from bridge.compensating.sources import IMU_IS_OFF, SourceChoice
from bridge.diagnostics import CompensationState
from bridge.parameters.declare import LiveParameters
from bridge.parameters.table import ParameterError, Parameters
from bridge.publishing.compensated_wrench import CompensatedOutput, Plan
from bridge.stream.link import Link
from bridge.stream.reader import Reader
from ft_compensation.bias import BiasRamp, Taken, force_bound_95
from ft_compensation.compensator import Compensator
from ft_compensation.motion_error import MotionError
from ft_compensation.outputs import cutoff_problem
from ft_compensation.payload_watch import PayloadWatch
from ft_compensation.quantities import NO_WRENCH, Accelerometer, Payload, Wrench, wrench_text

_FROM_PARAMETER: Final = "parameter"
_MEASURED: Final = ("tare", "identified")  # where a bias comes from that is one even if it is zero
_NOTHING_CURRENT: Final = "no current orientation"
_MOTION_S: Final = 1.0  # how often it is looked up what motion leaves
_LEAST_K: Final = 0.2  # change of temperature that shifts the bias; less is noise
_LEAST_TOLD_N: Final = 0.2  # about the noise of a force
_ANOTHER_SENSOR: Final = "the bias may be another sensor's"


class OwnOffset:
    """The offset (object 0x8000) that the sensor itself adds to every sample, and how it affects the bias.

    Follows what the server reports; used by the executor's thread and the reader's.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        # The offset that the bias was taken with; None if it was never known.
        self._of_bias: Wrench | None = None
        self._appeared = False  # whether the offset became known only after the bias was taken
        # Whether there is a bias. Zero may be one: what a tare finds where the sensor reads nothing.
        self.has_bias = False

    @property
    def now(self) -> Wrench | None:
        """The sensor's current offset; None if unknown."""
        offset = self._link.info.offset
        return None if offset is None else Wrench.of(offset)

    def begin(self, bias: Wrench, *, is_measured: bool = False) -> None:
        """`bias` goes with the current offset. Zero is no bias, unless it was measured."""
        self.has_bias = is_measured or bias != NO_WRENCH
        self._of_bias, self._appeared = self.now, False

    def follow(self) -> Wrench | None:
        """The shift of the bias that the current offset requires, once; None: no shift."""
        now, before = self.now, self._of_bias
        if now is None or now == before:
            return None
        self._of_bias = now
        if not self.has_bias:
            return None
        self._appeared = self._appeared or before is None
        return None if before is None else now.plus(before, -1.0)

    def doubt(self) -> str:
        """Why the bias may no longer fit the sensor, a sentence; empty if it does."""
        if not self.has_bias or not self._link.is_connected:
            return ""
        if self._appeared:
            return "the sensor's own offset was unknown when the bias was taken: the bias may be wrong, tare"
        if self._of_bias is not None and self._link.info.offset is None:
            return "the sensor's own offset is no longer known: the bias may be wrong, tare"
        return ""


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
        self.own_offset = OwnOffset(self.link)
        # Origin of the bias that is being put in force, and what it was taken with if by a tare.
        self._next: tuple[str, Taken | None] = (_FROM_PARAMETER, None)
        self._celsius: float | None = None  # up to which temperature the bias follows the line
        self.choice.check(parameters)
        self._ramp = BiasRamp(parameters.bias, parameters.bias_ramp_time)
        self._shifting = threading.Lock()  # guards shifts of the ramp, and its replacement
        self._payload_watch: PayloadWatch | None = None
        # What the latest second of motion leaves, and when that was computed, s.
        self._motion: tuple[float, MotionError | None] = -math.inf, None
        self._watched: object = None
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
    def _sample_s(self) -> float:
        """The newest sample's time, by the server's monotonic clock, also while nobody has subscribed."""
        return self.reader.accounting.new_ns * 1e-9

    def state(self) -> CompensationState:
        """How things are, for the diagnostics' thread."""
        output, source, parameters = self.output, self.choice.source, self.parameters
        payload, bias, has_subscribers = parameters.payload, self.bias, output.has_subscribers
        bound = force_bound_95(payload, parameters.accelerometer) if source.is_imu else None
        now_s, (then_s, motion) = self.link.clock.monotonic(), self._motion
        if now_s - then_s >= _MOTION_S:
            motion = source.error(payload.mass) if payload.mass and has_subscribers else None
            self._motion = now_s, motion
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
                "motion_force": "" if motion is None else round(motion.filters, 3),
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
            or self.own_offset.doubt()
            or self._ramp.taken.doubt(payload)
            or (self._payload_watch.finding if self._payload_watch is not None else "")
            or _vibration(motion, bound),
            follows_imu=source.is_imu and payload.mass > 0.0,
            out_of_range=0.0 if motion is None else motion.out_of_range,
            withheld=output.withheld,
            why_withheld=output.why_withheld or f"{_NOTHING_CURRENT} ({source.describe})",
        )

    def conflict(self, *, needs_tool: bool = False) -> str:
        """A setting of the sensor that conflicts with compensation or, if `needs_tool`, with knowing the
        specific force in the frame of the wrench, a sentence that says what to do."""
        settings = self.link.info.settings
        if settings.get("calibration_matrix") is False:
            return (
                "settings.calibration_matrix is off, so force and torque are counts and not N and Nm: "
                "switch it on"
            )
        if settings.get("inertia_compensation") is True and self.parameters.payload.mass:
            return (
                "settings.inertia_compensation is on, so the sensor takes gravity off itself: switch it off, "
                "or set tool_mass to 0"
            )
        return self._why_unknown() if needs_tool else ""

    def _why_unknown(self) -> str:
        """Why these settings of the sensor hide the specific force, a sentence; empty if they do not."""
        if self.parameters.gravity_source != "imu":
            return ""
        if self.link.info.settings.get("coordinate_system") is True:
            return (
                "settings.coordinate_system is on, so the wrench is in a frame configured in the sensor, and "
                "the rotation from the IMU to it is unknown: switch it off, or take the orientation of that "
                "frame from the robot (gravity_source)"
            )
        return IMU_IS_OFF if self.link.info.settings.get("imu_active") == 0 else ""

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
            self.own_offset.begin(bias, is_measured=origin in _MEASURED)
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
                self._live.put(**values)
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
        is_wish = taken is not None or wanted.bias not in (was.bias, before)
        with self._shifting:
            if wanted.payload != was.payload:
                self._ramp = self._ramp.weighed(wanted.payload)
            if is_wish:
                self._ramp.go(
                    wanted.bias, self._sample_s, taken or Taken(), may_undo=origin != _FROM_PARAMETER
                )
                self.own_offset.begin(wanted.bias, is_measured=origin in _MEASURED)
                self.origin = origin
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
        payload, rest = self.parameters.payload, self.parameters.rest
        watched = payload, self.bias, self._serial
        if watched != self._watched:
            self._watched = watched
            self._payload_watch = PayloadWatch(payload, self._log.warning, rest) if payload.mass else None
        source, has_tool = self.choice.source, payload.mass > 0.0
        self.output.plan = Plan(source, Compensator(payload), self._ramp, has_tool, self._payload_watch)

    def _is_same_sensor(self) -> bool:
        return not self.link.is_connected or self.link.info.serial == self._serial

    def _follow_sensor(self) -> None:
        """The bias, and what was before it, are not another sensor's; a fixed one stays."""
        with self._setting:
            while not self._is_same_sensor():
                serial = self.link.info.serial
                if self._serial != "":
                    bias = self.bias
                    if self.origin != _FROM_PARAMETER:
                        self._log.warning(
                            f"another sensor is there now, serial number {serial}: the bias was the other's "
                            "and is zero now; tare"
                        )
                        bias, self.origin = NO_WRENCH, _FROM_PARAMETER
                    self._ramp = BiasRamp(bias, self.parameters.bias_ramp_time)
                self.own_offset.begin(self.bias)
                self._serial = serial
                self._open_source()
                self._make_plan()
            self._follow_offset()
            if self.bias != self.parameters.bias:
                try:
                    self._live.put(bias=[*self.bias.values])  # shifted, or zero again
                except ParameterError as error:
                    self._log.error(str(error))
            self._hold()
            if not self._is_same_sensor():
                self.link_changed()

    def _follow_offset(self) -> None:
        """Shift the bias by the change of the sensor's own offset, from the next sample on; any thread."""
        change = self.own_offset.follow()
        if change is not None:
            with self._shifting:
                self._ramp.shift(change)
            self._log.info(
                f"the sensor's own offset was changed by {wrench_text(change)}: the bias is shifted by that"
            )
            self._guard.trigger()

    def follow_temperature(self, row: SensorStatus, celsius: float) -> None:
        """Shift a bias along the line in this row of `status`, if that is wanted; any thread."""
        slope = line_slope(row) if self.parameters.temperature_line and self.own_offset.has_bias else None
        if slope is None or self._celsius is None:
            self._celsius = None if slope is None else celsius
        elif abs(celsius - self._celsius) >= _LEAST_K:
            change = Wrench.of([value * (celsius - self._celsius) for value in slope])
            self._celsius = celsius
            with self._shifting:
                self._ramp.shift(change)
            self._guard.trigger()


def _vibration(motion: MotionError | None, bound: float | None) -> str:
    """That motion leaves more than the accelerometer's own errors, a sentence; empty if it does not."""
    if motion is None or bound is None or motion.filters <= max(bound, _LEAST_TOLD_N):
        return ""
    return (
        f"vibration leaves {motion.filters:.2g} N (root mean square) in wrench_compensated, because the "
        "filters of force and acceleration pass it differently: set settings.acceleration_filter to 1, or a "
        "longer settings.sinc_length, or damp it"
    )


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.4f}" for value in values)
