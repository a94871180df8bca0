# SPDX-License-Identifier: Apache-2.0
"""The bias: estimated while the sensor is stationary, ramped in, and undone.

Pose-aware: with a payload, its weight at the pose of the window is not part of the bias, so it stays with
gravity compensation and the bias holds in every pose. With its `TareBasis` the bias for another payload is
known.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ft_compensation.compensator import Compensator
from bota_ft_compensation.quantities import (
    NO_PAYLOAD,
    NO_WRENCH,
    ZERO,
    Accelerometer,
    CompensationError,
    Payload,
    Six,
    Wrench,
    length,
    wrench_text,
)
from bota_ft_compensation.stationary import StationaryMeans


def check_at_rest(acceleration: Vector3, magnitude: float, tolerance: float = 0.5) -> None:
    """CompensationError unless the stationary accelerometer reads `magnitude`, m/s², within `tolerance`."""
    measured = length(acceleration)
    if abs(measured - magnitude) > tolerance:
        raise CompensationError(
            f"the stationary accelerometer reads {measured:.2f} m/s² where {magnitude:.2f} should be: check "
            "imu_raw_units, the IMU's settings and its offset"
        )


def estimate_bias(means: StationaryMeans, payload: Payload, specific_force: Vector3) -> Wrench:
    """The bias that makes the compensated wrench of this stationary window zero.

    The weight of `payload` is not counted as bias; without one everything is. `specific_force` is that during
    the window, in the sensor's frame, m/s².
    """
    return means.wrench.plus(_weight(payload, specific_force), -1.0)


def _weight(payload: Payload, specific_force: Vector3) -> Wrench:
    return Compensator(payload).compensate(ZERO, ZERO, specific_force).tool


class TareBasis(NamedTuple):
    """What a bias was taken with."""

    payload: Payload = NO_PAYLOAD  # whose weight is not part of it
    # During the tare, in the sensor's frame, m/s². None: unknown. Zero: of no tare, it holds for any.
    specific_force: Vector3 | None = ZERO
    accelerometer: Accelerometer | None = None  # as it was corrected, where that is by the sensor's own
    noise: Six = (0.0,) * 6  # meanwhile, as `Accuracy.noise`

    def for_payload(self, payload: Payload) -> tuple[Wrench, TareBasis]:
        """By how much the bias is another for this payload; nothing if the specific force is unknown."""
        if self.specific_force is None or payload[:3] == self.payload[:3]:
            return NO_WRENCH, self
        before, now = (_weight(each, self.specific_force) for each in (self.payload, payload))
        return before.plus(now, -1.0), self._replace(payload=payload)

    def warning(self, change: Wrench, payload: Payload) -> str:
        """What `for_payload`, and its `change`, mean for a user, a sentence; empty if nothing."""
        if change == NO_WRENCH:
            return self.doubt(payload)
        return (
            "the tool's parameters are not those of the tare: the bias is what it finds with the new ones, "
            f"another by {wrench_text(change)}; if the tool was put on or exchanged since, tare again"
        )

    def doubt(self, payload: Payload) -> str:
        """Why the bias may not fit this payload, a sentence; empty if it does."""
        if self.specific_force is not None or payload[:3] == self.payload[:3]:
            return ""
        (was, (ax, ay, az)), (mass, (bx, by, bz)) = self.payload[:2], payload[:2]
        moved = mass * bx - was * ax, mass * by - was * ay, mass * bz - was * az
        return (
            f"the bias was taken with {self.payload}, and in which pose is not known: with {payload} it may "
            f"be wrong by {abs(mass - was) * STANDARD_GRAVITY:.3g} N and "
            f"{length(moved) * STANDARD_GRAVITY:.3g} Nm in every pose: tare again"
        )


_NO_TARE: Final = TareBasis()
_EARLY_S: Final = 0.1  # a sample may be this much older than the sample that a ramp began at


class BiasRamp(NamedTuple):
    """A bias that replaces another one linearly in time, and what it goes back to if it is undone.

    Times are of the samples, s on any one clock. Every change is another ramp.
    """

    target: Wrench = NO_WRENCH
    taken: TareBasis = _NO_TARE  # what the target was taken with
    start: Wrench = NO_WRENCH
    begin_s: float = 0.0
    seconds: float = 0.0  # how long it takes; 0: at once
    before: tuple[Wrench, TareBasis] | None = None  # the previous target; None: nothing to undo

    def go(
        self, target: Wrench, now_s: float, seconds: float = 0.0, taken: TareBasis = _NO_TARE, *,
        may_undo: bool = True,
    ) -> BiasRamp:  # fmt: skip
        """From the bias of `now_s` (the newest sample's time) to `target`."""
        before = (self.target, self.taken) if may_undo else None
        return BiasRamp(target, taken, self.at(now_s), now_s, seconds, before)

    def undone(self, now_s: float, seconds: float = 0.0) -> BiasRamp:
        """Back to the target before the last change. CompensationError if there is none."""
        if self.before is None:
            raise CompensationError("there is no tare to undo")
        target, taken = self.before
        return self.go(target, now_s, seconds, taken, may_undo=False)

    def shifted(self, change: Wrench) -> BiasRamp:
        """The sensor itself adds this much more from here on, whatever the bias is and was."""
        before = self.before
        if before is not None and before[0] != NO_WRENCH:  # none stays none
            before = before[0].plus(change), before[1]
        return self._replace(start=self.start.plus(change), target=self.target.plus(change), before=before)

    def for_payload(self, payload: Payload) -> BiasRamp:
        """The ramp for another payload."""
        change, taken = self.taken.for_payload(payload)
        before = self.before
        if before is not None:
            of_before, taken_before = before[1].for_payload(payload)
            before = before[0].plus(of_before), taken_before
        return self._replace(
            start=self.start.plus(change), target=self.target.plus(change), taken=taken, before=before
        )

    def arrived(self, now_s: float) -> bool:
        """Whether the bias of `now_s` is the target; also of a time long before, as of a clock set back."""
        return not (self.seconds > 0.0 and -_EARLY_S <= now_s - self.begin_s < self.seconds)

    def at(self, now_s: float) -> Wrench:
        """The bias of the sample of time `now_s`."""
        if self.arrived(now_s):
            return self.target
        share = max(0.0, (now_s - self.begin_s) / self.seconds)
        (ax, ay, az), (au, av, aw) = self.start
        (bx, by, bz), (bu, bv, bw) = self.target
        return Wrench(
            (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az)),
            (au + share * (bu - au), av + share * (bv - av), aw + share * (bw - aw)),
        )
