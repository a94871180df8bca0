"""What prevents a correct compensation, with or without subscribers. No ROS."""

from __future__ import annotations

from typing import Final

from bridge.compensating.tool_sources import IMU_IS_OFF, ImuSource, Listening, NoSource, Source
from bridge.parameters.compensation import CompensationParameters
from bridge.publishing.compensated_wrench import CompensatedOutput
from bridge.stream.link import Link
from bridge.stream.watch import Watch

_SATURATED: Final = "force or torque is saturated, and on_saturation is stop"


class Obstacles:
    """Each as a sentence that says what to do; None if there is none."""

    def __init__(self, link: Link, watch: Watch) -> None:
        self._link, self._watch = link, watch

    def conflict(self, parameters: CompensationParameters, *, needs_tool: bool = False) -> str | None:
        """A setting of the sensor that conflicts with compensation or, if `needs_tool`, with knowing the
        specific force in the frame of the wrench."""
        settings = self._link.settings
        if settings.get("calibration_matrix") is False:
            return (
                "settings.calibration_matrix is off, so force and torque are counts and not N and Nm: "
                "switch it on"
            )
        if settings.get("inertia_compensation") is True and parameters.payload.mass:
            return (
                "settings.inertia_compensation is on, so the sensor takes gravity off itself: switch it off, "
                "or set tool_mass to 0"
            )
        return self._blind(parameters) if needs_tool else None

    def hold(self, parameters: CompensationParameters, output: CompensatedOutput) -> None:
        """Stop `output` while the specific force is needed and cannot be known."""
        output.hold = self._blind(parameters) if parameters.payload.mass else None

    def _blind(self, parameters: CompensationParameters) -> str | None:
        if parameters.orientation.source != "imu" or self._link.settings.get("coordinate_system") is not True:
            return None
        return (
            "settings.coordinate_system is on, so the wrench is in a frame configured in the sensor, and the "
            "rotation from the IMU to it is unknown: switch it off, or take the orientation of that frame "
            "from the robot (gravity_source)"
        )

    def stopping(
        self,
        parameters: CompensationParameters,
        output: CompensatedOutput,
        source: Source,
        listener: Listening | None,
    ) -> str | None:
        """Why the newest sample was not compensated, or would not be if anybody had subscribed."""
        if not output.has_subscribers:
            return output.hold or self._foreseen(parameters, output, source, listener)
        if not output.is_stopped:
            return None
        if output.is_saturated:
            return output.hold or _SATURATED
        return output.hold or source.why_none(output.time_s, output.stamp_s)

    def _foreseen(
        self,
        parameters: CompensationParameters,
        output: CompensatedOutput,
        source: Source,
        listener: Listening | None,
    ) -> str | None:
        """The same without subscribers, as far as it can be known while no sample is compensated."""
        sample, stamp_s = self._watch.sample, self._watch.stamp_ns * 1e-9
        if not parameters.payload.mass:
            return None
        if isinstance(source, NoSource):
            return source.why_none(output.time_s, stamp_s)
        if listener is not None:
            latest, limit_s = listener.latest, parameters.orientation.stale_after
            fits = latest is not None and abs(stamp_s - latest.stamp_ns * 1e-9) <= limit_s
            return None if fits or sample is None else source.why_none(output.time_s, stamp_s)
        is_off = self._link.settings.get("imu_active") == 0 or (
            sample is not None and not any(sample.acceleration)
        )
        if isinstance(source, ImuSource) and is_off:
            return IMU_IS_OFF
        return None
