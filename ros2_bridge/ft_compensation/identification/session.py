"""One identification in progress: poses are added one by one, each with advice, until they are solved.

Used by the node's services. Nothing in it measures or moves: it is given windows at rest.
"""

from __future__ import annotations

from ft_compensation.identification.payload import Identified, OffsetFit, identify
from ft_compensation.identification.poses import MOST_POSES, Coverage, Pose, coverage, pose_of
from ft_compensation.quantities import CompensationError
from ft_compensation.stationary import StationaryMeans
from protocol.pdo import STANDARD_GRAVITY, Vector3


class IdentificationSession:
    """The poses taken so far."""

    def __init__(self, magnitude: float = STANDARD_GRAVITY) -> None:
        """`magnitude` of gravity, m/s²."""
        self.magnitude = magnitude
        self.poses: list[Pose] = []

    @property
    def coverage(self) -> Coverage:
        """What the poses have seen."""
        return coverage(self.poses)

    def add(self, means: StationaryMeans, gravity: Vector3 | None = None) -> str:
        """Add a pose; returns a sentence: what it saw, what is missing, what to do next.

        `gravity` (m/s², the sensor's frame) is from the window's accelerometer unless it is given.
        CompensationError if the pose is no good; the others stay.
        """
        if len(self.poses) >= MOST_POSES:
            raise CompensationError(f"there are {MOST_POSES} poses already: solve, or cancel")
        pose = pose_of(means, gravity, self.magnitude)
        self.poses.append(pose)
        x, y, z = (round(part, 2) + 0.0 for part in pose.up)
        return (
            f"pose {len(self.poses)} taken (up is {x:.2f}, {y:.2f}, {z:.2f} in the sensor's frame); "
            f"{self.advice}"
        )

    def drop(self) -> str:
        """Take the latest pose back; returns what is missing now. CompensationError if there is none."""
        if not self.poses:
            raise CompensationError("there is no pose to take back")
        self.poses.pop()
        return f"the pose is dropped, {len(self.poses)} are left; {self.advice}"

    @property
    def advice(self) -> str:
        """What is missing and what to do next, a sentence."""
        seen = self.coverage
        if seen.missing is None:
            return f"the poses suffice; one more would help most: {seen.next_pose}"
        return f"not enough yet: {seen.missing}; {seen.next_pose}"

    def solve(self) -> Identified:
        """The answer. `payload.IdentificationError`, a sentence, where the poses do not suffice."""
        return identify(self.poses)


def summary(result: Identified) -> str:
    """The answer in one sentence with its confidence interval, and the notes as further ones."""
    x, y, z = (1000.0 * part for part in result.payload.center)
    ix, iy, iz = (1000.0 * part for part in result.centre_interval)
    text = (
        f"mass {result.payload.mass:.4f} ± {result.mass_interval:.4f} kg, center of gravity ({x:.2f} ± "
        f"{ix:.2f}, {y:.2f} ± {iy:.2f}, {z:.2f} ± {iz:.2f}) mm ({100 * result.confidence:g} % confidence) "
        f"from {result.coverage.poses} poses; residual {result.force_rms:.2g} N "
        f"({result.force_fit.verdict}), {result.torque_rms:.2g} Nm ({result.torque_fit.verdict})"
    )
    return ". ".join([text, *result.notes])


def accelerometer_text(fit: OffsetFit) -> str:
    """Offset and sensitivities of the accelerometer with their confidence intervals, a sentence."""
    found = fit.calibration
    axes = zip("xyz", found.offset, found.offset_interval, strict=True)
    offset = ", ".join(f"{axis} {value:.3f} ± {half:.3f}" for axis, value, half in axes)
    axes = zip("xyz", found.scale, found.scale_interval, strict=True)
    scale = ", ".join(f"{axis} {value:.4f} ± {half:.4f}" for axis, value, half in axes)
    return f"Accelerometer: offset {offset} m/s², scale {scale}"
