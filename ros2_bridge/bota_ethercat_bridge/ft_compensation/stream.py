# SPDX-License-Identifier: Apache-2.0
"""What a stream says beside its samples, and what it means for their compensation.

The one place for the node, `ethercat-export --tool` and `ethercat-identify`; the ros2_control plugin does the
same in C++ (`OwnOffset` in compensation.hpp). The sensor adds an offset of its own (object 0x8000) to every
sample; a tare of the sensor, another client, or a power cycle changes it, and a bias with it.
"""

from __future__ import annotations

from collections.abc import Mapping

from bota_ethercat.settings import SettingValue
from bota_ethercat_bridge.ft_compensation.quantities import NO_WRENCH, Wrench

Settings = Mapping[str, SettingValue]


class OwnOffset:
    """How changes of the sensor's own offset affect a bias; offsets in N and Nm, None: unknown."""

    def __init__(self) -> None:
        self.of_bias: Wrench | None = None  # the offset that the bias goes with
        self._appeared = False  # whether the offset became known only after the bias was taken
        # Whether there is a bias. Zero may be one: what a tare finds where the sensor reads nothing.
        self.has_bias = False

    def begin(self, bias: Wrench, offset: Wrench | None, *, is_measured: bool = False) -> None:
        """`bias` goes with this offset. Zero is no bias, unless it was measured."""
        self.has_bias = is_measured or bias != NO_WRENCH
        self.of_bias, self._appeared = offset, False

    def follow(self, now: Wrench | None) -> Wrench | None:
        """The shift of the bias that the current offset requires, once; None: no shift."""
        before = self.of_bias
        if now is None or now == before:
            return None
        self.of_bias = now
        if not self.has_bias:
            return None
        self._appeared = self._appeared or before is None
        return None if before is None else now.plus(before, -1.0)

    def doubt(self, now: Wrench | None) -> str:
        """Why the bias may not fit the sensor with its current offset, a sentence; empty if it does."""
        if not self.has_bias:
            return ""
        if self._appeared:
            return "the sensor's own offset was unknown when the bias was taken: the bias may be wrong, tare"
        if self.of_bias is not None and now is None:
            return "the sensor's own offset is no longer known: the bias may be wrong, tare"
        return ""


def not_newtons(settings: Settings, *, has_tool: bool) -> str:
    """The setting with which force and torque are not what is compensated, a sentence; empty if none is."""
    if settings.get("calibration_matrix") is False:
        return (
            "settings.calibration_matrix is off, so force and torque are counts and not N and Nm: "
            "switch it on"
        )
    if settings.get("inertia_compensation") is True and has_tool:
        return (
            "settings.inertia_compensation is on, so the sensor takes gravity off itself: switch it off, "
            "or set tool_mass to 0"
        )
    return ""


IMU_IS_OFF = "the accelerometer reads zero: switch the IMU on (settings.imu_active)"


def hides_gravity(settings: Settings) -> str:
    """The setting with which the IMU does not tell the specific force, a sentence; empty if none is."""
    if settings.get("coordinate_system") is True:
        return (
            "settings.coordinate_system is on, so the wrench is in a frame configured in the sensor, and "
            "the rotation from the IMU to it is unknown: switch it off, or take the orientation of that "
            "frame from the robot (gravity_source)"
        )
    return IMU_IS_OFF if settings.get("imu_active") == 0 else ""
