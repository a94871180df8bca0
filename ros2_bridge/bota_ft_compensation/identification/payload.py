# SPDX-License-Identifier: Apache-2.0
"""Payload identification: mass, center of gravity, bias and the accelerometer's offset from static poses.

Checks what is given, has `estimation` solve it, and judges how well the poses fit one payload. Two things are
looked for that no noise explains: a bias that drifts, linear in the time of the poses, and a single pose in
which something touched the tool, which is left out then. Each shifts the axes of force and torque, and so it
is found: by an F test, once that time or the pose's indicator is one more regressor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.settings import SettingValue
from bota_ft_compensation.bounds import at_reference
from bota_ft_compensation.identification.estimation import (
    FULL_CALIBRATION,
    Estimate,
    Value,
    calibration_prior,
    estimate,
)
from bota_ft_compensation.identification.poses import MOST_POSES, Coverage, Pose, coverage
from bota_ft_compensation.identification.weighted import CONFIDENCE, Array
from bota_ft_compensation.quantities import (
    IDENTITY,
    NORMAL_95,
    OFFSET_PRIOR,
    SCALE_PRIOR,
    ZERO,
    Accelerometer,
    Accuracy,
    CompensationError,
    Matrix,
    Payload,
    Six,
    Wrench,
    length,
    likely_inertia,
)
from bota_ft_compensation.stationary import triple
from bota_ft_compensation.turning import crossing

LARGEST_MASS: Final = 500.0  # kg: no sensor of the family carries more
LARGEST_CENTRE: Final = 2.0  # m
_LARGEST_MISFIT: Final = 0.1
# N: residuals and intervals are refused beyond this plus a tenth of the weight; of torques at its arm.
_FORGIVEN_MISFIT: Final = 1.0
# Of the interval before anything is measured: an offset no better known than so is not determined.
_UNKNOWN: Final = 0.5

ARM: Final = 0.05  # m: what makes a torque of a force where the center of gravity is nearer
_CHANCE: Final = 0.01  # of seeing drift, or a touch, where there is none
_SUSPECTS: Final = 12  # poses with the largest residuals
# What is fitted of the accelerometer: the fewest unknowns whose error of poses that are left out is so near
# to the least, of those with which noise explains what is left, if it does with any. More would fit errors of
# the wrench.
_MODELS: Final = {
    "offset": calibration_prior(),
    "offset and scale": calibration_prior(scale=True),
    "offset, scale and rotation": calibration_prior(scale=True, turn=True),
    "offset, scale and crossed axes": FULL_CALIBRATION,
}
_AS_GOOD: Final = 1.05
_LEFT_OUT: Final = 24  # poses, one by one
_SAME_POSE: Final = 0.97  # cosine
_FEWEST_IN_TIME: Final = 6  # poses: fewer leave nothing to tell drift from a payload
_SECONDS_A_MINUTE: Final = 60.0
_TINY: Final = 1e-12
_PARALLEL: Final = 1e-3  # (m/s²)²: gravity along what was read is from the accelerometer
NEGLIGIBLE: Final = 0.01  # of the weight: a residual below it is not worth a word
_RARE: Final = 3.09  # standard deviations that noise exceeds once in a thousand times


class IdentificationError(CompensationError):
    """The poses do not give an answer; the text is one sentence that says why and what to do."""


class TooVagueError(IdentificationError):
    """The intervals are too wide; motion may tell more."""

    def __init__(self, text: str, result: Identified) -> None:
        super().__init__(text)
        self.result = result


class Fit(NamedTuple):
    rms: float  # of the residuals, with the degrees of freedom taken into account, N or Nm
    degrees: float  # of freedom
    # Squares of the residuals in units of what the windows' noise explains, per degree of freedom: 1 is
    # ideal. None where that noise is not known.
    chi_square: float | None
    # `noise` explains the residuals, or they are `small` (1 % of the weight) all the same, or `large`.
    verdict: str


class OffsetFit(NamedTuple):
    """What the poses say of the accelerometer."""

    calibration: Accelerometer
    undetermined: str  # axes whose offset the poses do not determine: "", "x", ...
    model: str = ""  # what was fitted of it, and why, a phrase; empty: all, and nothing else was tried


class Joint(NamedTuple):
    """What poses say together, of mass, bias force, m times the center, bias torque and accelerometer."""

    unknowns: Array  # (22,)
    covariance: Array  # (22, 22)


class Identified(NamedTuple):
    """The answer. Every `..._interval` is half the width of an interval of `CONFIDENCE`, by Student's t.

    Each axis has the variance that its residuals show.
    """

    payload: Payload
    bias: Wrench
    gravity: float  # its magnitude in the poses, m/s²
    mass_interval: float  # kg
    bias_interval: Wrench  # N, Nm
    residuals: tuple[Wrench, ...]  # what the answer leaves of each pose, in order: measured minus modelled
    coverage: Coverage
    notes: tuple[str, ...]  # what a person should know, sentences: a pose that does not fit, a wide interval
    force_fit: Fit
    torque_fit: Fit
    accelerometer: OffsetFit | None  # None where the poses do not have what it read: it is not touched then
    # Of the bias, a minute; None if time explains nothing. `bias` is that of the last pose then.
    drift: Wrench | None = None
    touched: int | None = None  # index of the pose that does not fit the others, and is left out
    joint: Joint | None = None  # None where gravity is not from the accelerometer
    # Of one sample's force, N, and torque, Nm, with the filters that were set; zeros: not known.
    noise: tuple[float, ...] = (0.0,) * 6
    left: Six = (0.0,) * 6  # as `Accuracy.left`
    gyroscope: Matrix = IDENTITY  # angular rates are this times what is read
    imu: Vector3 = ZERO  # its place, m; zeros: not identified

    def accuracy(self, settings: Mapping[str, SettingValue]) -> Accuracy:
        """With these filters."""
        return Accuracy(at_reference(self.noise, settings), self.left)


def identify(poses: Sequence[Pose]) -> Identified:
    """Mass, center of gravity and bias from `poses`.

    At least four, with gravity in directions that do not lie on one line; six with each axis of the sensor
    once up and once down are best. If gravity is from the `acceleration` of every pose, the accelerometer is
    identified too; if every pose has its time, a drift of the bias.
    IdentificationError, a sentence, where the poses do not suffice: by the intervals that result.
    """
    if len(poses) > MOST_POSES:
        raise IdentificationError(f"{len(poses)} poses are more than the {MOST_POSES} that are taken")
    if not all(
        np.isfinite([*pose.wrench.values, *pose.gravity, *(pose.acceleration or ())]).all() for pose in poses
    ):
        raise IdentificationError("a pose has numbers that are not finite")
    seen = coverage(poses)
    if seen.missing is not None:
        raise IdentificationError(f"the poses do not suffice: {seen.missing}; {seen.next_pose}")
    equations = _Equations(poses)
    try:
        model = equations.choose()
        whole, drift, touched = _explained(equations)
        found, kept, shift = whole, np.ones(len(poses), bool), None
        if touched is not None:
            found, kept[touched.pose], shift = touched.rest, False, np.eye(len(poses))[touched.pose]
        elif drift is not None:
            shift = equations.minutes
        found, noise = equations.by_noise(found, kept, shift)
        every = equations.with_all(shift, noise)
    except np.linalg.LinAlgError:
        raise IdentificationError("the poses do not suffice: their equations leave an unknown open") from None
    mass, mass_interval = float(found.mass.value[0]), float(found.mass.half[0])
    check_mass(mass, mass_interval)
    payload = Payload(mass, triple(found.center.value), center_interval=triple(found.center.half))
    inertia, half = likely_inertia(payload)  # at rest it does not show
    payload = payload._replace(inertia=inertia, inertia_interval=half)
    gravity = float(np.linalg.norm(equations.gravity, axis=1).mean())
    weight, moment = _loads(payload, gravity)
    few = [pose for pose, is_kept in zip(poses, kept, strict=True) if is_kept]
    force = judge(few, found.residuals[kept, :3], found.degrees[:3], "force", weight)
    torque = judge(few, found.residuals[kept, 3:], found.degrees[3:], "torque", moment)
    most_force, most_torque = _limits(payload, gravity)
    _check_fit(_residual(whole.residuals[:, :3], whole.degrees[:3]), touched, most_force, "N")
    check_center(payload)
    _check_fit(_residual(whole.residuals[:, 3:], whole.degrees[3:]), touched, most_torque, "Nm")
    accelerometer = accelerometer_of(_with_unfitted(found.calibration, every), model)
    undetermined = accelerometer.undetermined if accelerometer else ""
    result = Identified(
        payload,
        Wrench.of(found.bias.value.tolist()),
        gravity,
        mass_interval,
        Wrench.of(found.bias.half.tolist()),
        tuple(map(Wrench.of, found.residuals.tolist())),
        seen,
        (
            *_misfit_notes(poses, drift, touched),
            *_mounting_notes(found.mounting),
            *_fit_notes(force, "force", "N"),
            *_fit_notes(torque, "torque", "Nm"),
            *_other_notes(mass, mass_interval, length(payload.center_interval), undetermined, seen),
        ),
        force,
        torque,
        accelerometer,
        drift,
        None if touched is None else touched.pose,
        Joint(every.unknowns, every.covariance) if every and every.calibration else None,
        equations.noise,
    )
    if why := too_vague(payload, mass_interval, gravity):
        raise TooVagueError(f"the poses {why}; {seen.next_pose if touched is None else touched}", result)
    return result


class _Equations:
    def __init__(self, poses: Sequence[Pose]) -> None:
        self.wrench = np.array([pose.wrench.values for pose in poses])
        self.gravity = np.array([pose.gravity for pose in poses])
        read = [pose.acceleration for pose in poses if pose.acceleration is not None]
        self._acceleration = np.array(read) if len(read) == len(poses) else None
        if self._acceleration is not None and not np.allclose(
            np.cross(self._acceleration, self.gravity), 0.0, atol=_PARALLEL
        ):
            self._acceleration = None  # gravity is known without it
        self._noise = float(
            np.mean([length(pose.acceleration_spread) ** 2 / 3.0 / pose.samples for pose in poses])
        )
        self.spread = np.array([[*pose.force_spread, *pose.torque_spread] for pose in poses])
        self._samples = _independent(poses)
        times = [pose.time_s for pose in poses if pose.time_s is not None]
        # Minutes before the last pose; None if they say nothing.
        self.minutes: Array | None = None
        if len(times) == len(poses) >= _FEWEST_IN_TIME and np.ptp(times) > 0.0:
            self.minutes = (np.array(times) - times[-1]) / _SECONDS_A_MINUTE

        self._is_turned, self._prior = False, FULL_CALIBRATION

    @property
    def noise(self) -> tuple[float, ...]:
        """Deviations of single samples; the part that is the mean's lacks in a window."""
        squares = self.spread**2 / np.maximum(1.0 - 1.0 / self._samples, 0.5)
        return tuple(np.sqrt(squares.mean(axis=0)).tolist())

    def choose(self) -> str:
        """Fit as much of the accelerometer as the poses tell: what that is, for people."""
        count = len(self.wrench)
        if self._acceleration is None or count < _FEWEST_IN_TIME:
            return ""
        left_out, errors, likely = np.eye(count)[:: math.ceil(count / _LEFT_OUT)], dict[str, float](), []
        for name, self._prior in _MODELS.items():
            found = self.solve(left_out)
            assert found.shift is not None
            longer = found.mass.value * (found.excess * left_out).sum(axis=-1, keepdims=True)
            off = np.concatenate([found.shift.value[:, :3], longer], axis=1)
            errors[name] = float(np.median(np.linalg.norm(off, axis=1)))  # whatever touched some of them
            if self.by_noise(self.solve(), np.ones(count, bool), None)[1] is not None:
                likely.append(name)
        most = _AS_GOOD * min(errors[name] for name in likely or errors)
        chosen = next(name for name in likely or errors if errors[name] <= most)
        self._prior = _MODELS[chosen]
        rest = ", ".join(f"{error:.3g} N with {name}" for name, error in errors.items() if name != chosen)
        return f"{chosen} fitted: a pose that is left out is off by {errors[chosen]:.3g} N ({rest})"

    def with_all(self, regressor: Array | None, noise: Array | None) -> Estimate | None:
        """The answer with all that an accelerometer may have."""
        self._prior = FULL_CALIBRATION
        return None if self._acceleration is None else self.solve(regressor, noise)

    def by_noise(
        self, found: Estimate, kept: NDArray[np.bool_], regressor: Array | None
    ) -> tuple[Estimate, Array | None]:
        """The answer if the windows' noise explains it, and `noise` as `estimate` has it; or `found`."""
        if self._acceleration is None or not self.spread.all():
            return found, None
        # Across gravity noise of what is read turns it: of force and torque together.
        up = found.gravity / np.linalg.norm(found.gravity, axis=1, keepdims=True)
        across = float(found.mass.value[0]) * (np.eye(3) - up[:, :, None] * up[:, None])
        turned = np.concatenate([across, crossing(found.center.value[None]) @ across], axis=1)
        own = np.diag((self.spread**2 / self._samples).mean(axis=0))
        noise = np.linalg.inv(np.linalg.cholesky(own + self._noise * turned @ turned.swapaxes(1, 2)))
        result = self.solve(regressor, noise)
        degrees = max(float(result.degrees.sum()), 1.0)
        whole = np.einsum("nij,nj->ni", noise, result.residuals)
        if float((whole[kept] ** 2).sum()) > degrees * _rarely(degrees):
            return found, None
        return result, noise

    def solve(self, regressor: Array | None = None, noise: Array | None = None) -> Estimate:
        given = self.wrench, self.gravity, self._acceleration, self._noise, regressor
        return estimate(*given, is_turned=self._is_turned, prior=self._prior, noise=noise)

    def look_for_mounting(self, found: Estimate) -> Estimate:
        """With the rotation between robot and sensor from here on, if that explains what is left."""
        if self._acceleration is not None:
            return found
        self._is_turned = True
        turned = self.solve()
        self._is_turned = float(_chance(found, turned)) < _CHANCE
        return turned if self._is_turned else found


class _Touched(NamedTuple):
    """A pose that does not fit the others."""

    pose: int  # its index
    force: float  # N: by which it is off
    torque: float  # Nm
    rest: Estimate  # by the others; the residuals are those of all

    def __str__(self) -> str:
        return (
            f"pose {self.pose + 1} does not fit the others, by {self.force:.2g} N and {self.torque:.2g} Nm, "
            "and is left out: if something touched the tool, take it again"
        )


def _explained(equations: _Equations) -> tuple[Estimate, Wrench | None, _Touched | None]:
    """The answer, the drift of the bias a minute, and the pose that does not fit, if there are such."""
    found, count = equations.solve(), len(equations.wrench)
    if count < _FEWEST_IN_TIME:
        return found, None, None
    found = equations.look_for_mounting(found)
    suspects = np.argsort(np.abs(found.residuals / _rms(found.residuals)).max(axis=1))[-_SUSPECTS:]
    without = equations.solve(np.eye(count)[suspects])
    chances = _chance(found, without) * count
    which = int(chances.argmin())
    if equations.minutes is not None:
        drifting = equations.solve(equations.minutes)
        assert drifting.shift is not None
        chance = float(_chance(found, drifting))
        if chance < min(_CHANCE, float(chances[which])):
            return drifting, Wrench.of(drifting.shift.value.tolist()), None
    assert without.shift is not None
    pose, off = int(suspects[which]), without.shift.value[which]
    force, torque = float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))
    weight = float(found.mass.value[0]) * STANDARD_GRAVITY
    if chances[which] < _CHANCE and force + torque / ARM > NEGLIGIBLE * weight:
        rest = equations.solve(np.eye(count)[pose])
        rest.residuals[pose] += off
        return found, None, _Touched(pose, force, torque, rest)
    return found, None, None


def _rms(residuals: Array) -> Array:
    return np.asarray(np.sqrt((residuals**2).mean(axis=-2, keepdims=True)) + _TINY)


def _chance(before: Estimate, after: Estimate) -> Array:
    """How probably shifts of the six axes that mean nothing lessen the residuals so much.

    By an F test with 6 degrees of freedom; the axes of force have one variance, and those of torque.
    """
    gain = freedom = np.zeros(())
    for axes in (slice(0, 3), slice(3, 6)):
        degrees = np.maximum(after.degrees[..., axes].sum(axis=-1), 1.0)
        left = (after.residuals[..., axes] ** 2).sum(axis=(-1, -2)) + _TINY
        gain = gain + degrees * ((before.residuals[..., axes] ** 2).sum() / left - 1.0)
        freedom = freedom + degrees
    share, half = freedom / (freedom + np.maximum(gain, 0.0)), 0.5 * freedom
    rest = 1.0 - share
    return np.asarray(share**half * (1.0 + half * rest * (1.0 + 0.5 * (half + 1.0) * rest)))


def _with_unfitted(
    parts: tuple[Value, Value, Value] | None, every: Estimate | None
) -> tuple[Value, Value, Value] | None:
    """Where something was not fitted, its interval has what it would have been, or what is typical."""
    if parts is None or every is None or every.calibration is None:
        return parts
    likely = (NORMAL_95 * each for each in (OFFSET_PRIOR, SCALE_PRIOR, SCALE_PRIOR))
    offset, scale, cross = (
        Value(part.value, np.maximum(part.half, np.minimum(abs(whole.value - part.value) + whole.half, most)))
        for part, whole, most in zip(parts, every.calibration, likely, strict=True)
    )
    return offset, scale, cross


def accelerometer_of(parts: tuple[Value, Value, Value] | None, model: str = "") -> OffsetFit | None:
    if parts is None:
        return None
    limit = _UNKNOWN * NORMAL_95 * OFFSET_PRIOR
    open_axes = "".join(axis for axis, half in zip("xyz", parts[0].half, strict=True) if half > limit)
    values = (tuple(each.tolist()) for part in parts for each in part)
    offset, offset_half, scale, scale_half, cross, cross_half = values
    return OffsetFit(
        Accelerometer(offset, scale, offset_half, scale_half, cross, cross_half), open_axes, model
    )


def check_mass(mass: float, interval: float) -> None:
    if mass < -interval:
        raise IdentificationError(
            f"the mass would be negative ({mass:.3g} kg): force and gravity have opposite signs, so the "
            "frame or sign of one of them is wrong, or the tool was lifted"
        )
    if mass <= interval or mass <= 0.0:
        raise IdentificationError(
            f"the mass, {mass:.2g} kg, cannot be told from zero (± {interval:.2g} kg): without a tool take "
            "only the bias, with a light one take more and longer poses"
        )
    if mass > LARGEST_MASS:
        raise IdentificationError(
            f"a mass of {mass:.3g} kg cannot hang on a sensor: check the units of the force"
        )


def check_center(payload: Payload) -> None:
    if length(payload.center) > LARGEST_CENTRE:
        raise IdentificationError(
            f"the center of gravity would be {length(payload.center):.2g} m from the sensor with a mass of "
            f"{payload.mass:.3g} kg, which cannot be: something held or touched the tool, or there is no tool"
        )


def _loads(payload: Payload, gravity: float) -> tuple[float, float]:
    """The tool's weight, N, and the moment, Nm, that it has at its center of gravity, or at ARM."""
    weight = payload.mass * gravity
    return weight, weight * max(ARM, length(payload.center))


def _limits(payload: Payload, gravity: float) -> tuple[float, float]:
    """N, Nm: residuals and intervals beyond these are no answer."""
    weight, moment = _loads(payload, gravity)
    return (
        _FORGIVEN_MISFIT + _LARGEST_MISFIT * weight,
        _FORGIVEN_MISFIT * ARM + _LARGEST_MISFIT * moment,
    )


def too_vague(payload: Payload, mass_interval: float, gravity: float) -> str:
    """That what was measured does not suffice, with how wide the intervals are; empty if it does."""
    (weight, _), (force, torque) = _loads(payload, gravity), _limits(payload, gravity)
    if mass_interval * gravity <= force and length(payload.center_interval) * weight <= torque:
        return ""
    return (
        f"do not suffice: mass {payload.mass:.2g} ± {mass_interval:.2g} kg, center of gravity "
        f"{_millimeters(payload)}"
    )


def _residual(residuals: Array, degrees: Array) -> float:
    """Root mean square, with the degrees of freedom taken into account."""
    return math.sqrt(float((residuals**2).sum()) / max(float(degrees.sum()), 1.0))


def _check_fit(rms: float, touched: _Touched | None, limit: float, unit: str) -> None:
    if rms > limit:
        again = "take all again" if touched is None else f"pose {touched.pose + 1} fits worst: take it again"
        raise IdentificationError(
            f"the poses do not fit one payload: the residual is {rms:.2g} {unit}, the limit {limit:.2g} "
            f"{unit}; something touched the tool, or it moved; {again}"
        )


def _rarely(degrees: float) -> float:
    """Chi squared by `degrees` that noise exceeds once in a thousand times (Wilson and Hilferty)."""
    ninth = 2.0 / (9.0 * degrees)
    return (1.0 - ninth + _RARE * math.sqrt(ninth)) ** 3


def _independent(poses: Sequence[Pose]) -> Array:
    """(n, 1): as many independent samples would tell as much; how alike they are is a matter of filters."""
    alike = np.mean([pose.alike for pose in poses])
    return np.array([[pose.samples / alike] for pose in poses])


def judge(poses: Sequence[Pose], residuals: Array, degrees: Array, name: str, weight: float) -> Fit:
    """How `residuals` (n, 3) of "force" or "torque" fit; `weight` in N, or Nm at its arm."""
    freedom, rms = max(float(degrees.sum()), 1.0), _residual(residuals, degrees)
    spread = np.array([getattr(pose, f"{name}_spread") for pose in poses])
    chi_square = None
    if spread.all():
        expected = spread**2 / _independent(poses)
        chi_square = float((residuals**2 / expected).sum()) / freedom
        if chi_square <= _rarely(freedom):
            return Fit(rms, freedom, chi_square, "noise")
    return Fit(rms, freedom, chi_square, "small" if rms <= NEGLIGIBLE * weight else "large")


def _misfit_notes(poses: Sequence[Pose], drift: Wrench | None, touched: _Touched | None) -> Iterator[str]:
    if drift is not None:
        first, last = poses[0].up, poses[-1].up
        is_checked = sum(a * b for a, b in zip(first, last, strict=True)) > _SAME_POSE
        check = "" if is_checked else ", and take the first pose again at the end"
        yield (
            f"the bias drifted by {length(drift.force):.2g} N and {length(drift.torque):.2g} Nm a minute, "
            f"which was fitted, and the bias is that of the last pose: let the sensor warm up{check}"
        )
    if touched is not None:
        yield str(touched)


def _mounting_notes(mounting: Value | None) -> Iterator[str]:
    if mounting is not None and (np.abs(mounting.value) > mounting.half).any():
        axes = zip("xyz", np.degrees(mounting.value), np.degrees(mounting.half), strict=True)
        turned = ", ".join(f"{axis} {value:.2f} ± {half:.2f}" for axis, value, half in axes)
        yield (
            f"gravity is turned by {turned} degrees in the sensor's frame beyond the robot's orientation, "
            "which the answer takes into account and compensation does not: correct how the sensor is mounted"
        )


def _fit_notes(fit: Fit, name: str, unit: str) -> Iterator[str]:
    if fit.verdict == "large" and fit.chi_square is not None:
        yield (
            f"the residual {name}, {fit.rms:.2g} {unit}, is {math.sqrt(fit.chi_square):.0f} times what the "
            "noise explains: the bias drifts, a cable pulls, the tool moves, or the orientation is not exact"
        )


def _other_notes(
    mass: float, mass_half: float, center_half: float, undetermined: str, seen: Coverage
) -> Iterator[str]:
    """Of wide intervals, kg and m, and of axes, as in "xz", whose offset of the accelerometer is open."""
    more = "take more poses, or longer ones"
    if mass_half > 0.05 * mass:
        yield f"the mass is known to ± {100 * mass_half / mass:.0f} % only: {more}"
    if center_half > 0.01:
        yield f"the center of gravity is known to ± {1000 * center_half:.0f} mm only: {more}"
    if undetermined:
        yield (
            f"the poses do not determine the accelerometer's offset along {' and '.join(undetermined)}, so "
            "nearly none is assumed there: take poses with that axis once up and once down"
        )
    elif seen.unchecked:
        yield (
            f"gravity hardly changed along {seen.unchecked}, so nothing checks the answer in that direction: "
            f"{seen.next_pose}"
        )


def _millimeters(payload: Payload) -> str:
    axes = zip(payload.center, payload.center_interval, strict=True)
    return f"({', '.join(f'{1e3 * value:.2f} ± {1e3 * part:.2f}' for value, part in axes)}) mm"


def summary(result: Identified) -> str:
    """The answer in one sentence with its confidence interval, and the notes as further ones."""
    text = (
        f"mass {result.payload.mass:.4f} ± {result.mass_interval:.4f} kg, center of gravity "
        f"{_millimeters(result.payload)} ({100 * CONFIDENCE:g} % "
        f"confidence) from {result.coverage.source}; residual {result.force_fit.rms:.2g} N "
        f"({result.force_fit.verdict}), {result.torque_fit.rms:.2g} Nm ({result.torque_fit.verdict})"
    )
    return ". ".join([text, *result.notes])


def accelerometer_text(fit: OffsetFit) -> str:
    """Offset and sensitivities of the accelerometer with their confidence intervals, a sentence."""
    found = fit.calibration
    offset = _with_intervals(found.offset, found.offset_interval, 3)
    scale = _with_intervals(found.scale, found.scale_interval, 4)
    return (
        f"Accelerometer: offset {offset} m/s², scale {scale}, cross-axis terms up to "
        f"{max(map(abs, found.cross_axis)):.4f} ± {max(found.cross_axis_interval):.4f}"
        f"{fit.model and '; ' + fit.model}"
    )


def _with_intervals(values: Vector3, halves: Vector3, digits: int) -> str:
    axes = zip("xyz", values, halves, strict=True)
    return ", ".join(f"{axis} {value:.{digits}f} ± {half:.{digits}f}" for axis, value, half in axes)
