"""Temperature, gravity, and the drift of force and torque as far as it can be determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from clients.numbers import figure
from clients.report.checks.check import Check, judged
from clients.report.checks.timing import too_few
from clients.report.subjects.series import Floats, Series
from protocol.health.verdict import Finding, Level
from protocol.pdo import STANDARD_GRAVITY

_GRAVITY_TOLERANCE: Final = 1.0
"""m/s²: an accelerometer's offset is well below it."""
_FEWEST_POINTS: Final = 4
_MOST_POINTS: Final = 300
_TURNED_DEG: Final = 2.0
_LEAST_CHANGE: Final = 0.5
"""°C: below this a drift per degree is meaningless."""


@dataclass(frozen=True)
class Drift:
    """How the readings moved over the recording: medians of m equal spans."""

    time: Floats
    """(m,) s, the middle of each span"""
    load: Floats
    """(m, 6) force (N) and torque (Nm) less those of the first span"""
    temperature: Floats
    """(m,) °C"""
    turned_deg: float
    """By how much the direction of gravity moved at most, as the accelerometer saw it; NaN without one."""

    @property
    def known(self) -> bool:
        """Whether the recording is long enough."""
        return len(self.time) >= _FEWEST_POINTS

    @property
    def turned(self) -> bool:
        """Whether the sensor was turned, so that the load moved too."""
        return not self.turned_deg < _TURNED_DEG

    @property
    def change(self) -> Floats:
        """(6,) from the first tenth of the spans to the last."""
        tenth = max(1, len(self.time) // 10)
        late: Floats = np.median(self.load[-tenth:], axis=0) - np.median(self.load[:tenth], axis=0)
        return late

    @property
    def temperature_change(self) -> float:
        """°C, likewise."""
        tenth = max(1, len(self.time) // 10)
        return float(np.median(self.temperature[-tenth:]) - np.median(self.temperature[:tenth]))

    def sentence(self) -> str:
        """What it means."""
        if not self.known:
            return "The recording is too short to determine drift."
        if self.turned:
            how = (
                "The IMU cannot tell whether the sensor was turned"
                if np.isnan(self.turned_deg)
                else f"The sensor was turned by up to {figure(self.turned_deg, 2)}°"
            )
            return f"{how}: the readings changed with the load too, so they say nothing about drift."
        per_degree = ""
        if abs(self.temperature_change) >= _LEAST_CHANGE:
            slopes = self.change / self.temperature_change
            per_degree = (
                f" That is {figure(float(slopes[np.argmax(np.abs(slopes[:3]))]), 2)} N/°C on the axis that "
                "changed most."
            )
        return (
            "The sensor was not turned. If its load was constant, the change of the readings is its drift; "
            f"no limit is published for it.{per_degree}"
        )


def drift(series: Series) -> Drift:
    """Medians over time; samples that are not numbers are left out."""
    s = series.samples
    good = series.finite.all(axis=1) & np.isfinite(s.temperature) & ~series.saturated[:, :6].any(axis=1)
    time, load = series.time[good], series.values[good, :6]
    acceleration, temperature = s.acceleration[good], s.temperature[good]
    points = int(np.clip(series.duration, 0, _MOST_POINTS))
    nothing = Drift(np.zeros(0), np.zeros((0, 6)), np.zeros(0), float("nan"))
    if points < _FEWEST_POINTS or not len(time):
        return nothing
    index = np.clip((time / series.duration * points).astype(np.int64), 0, points - 1)
    rows = [rows for point in range(points) if len(rows := np.flatnonzero(index == point))]
    if len(rows) < _FEWEST_POINTS:
        return nothing
    loads = np.array([np.median(load[r], axis=0) for r in rows])
    directions = np.array([np.median(acceleration[r], axis=0) for r in rows])
    return Drift(
        np.array([np.median(time[r]) for r in rows]), loads - loads[0],
        np.array([np.median(temperature[r]) for r in rows]), _turned(directions),
    )  # fmt: skip


def _turned(directions: Floats) -> float:
    lengths = np.linalg.norm(directions, axis=1)
    if np.any(lengths < STANDARD_GRAVITY / 4):
        return float("nan")
    units = directions / lengths[:, None]
    return float(np.degrees(np.arccos(np.clip(units @ units[0], -1, 1)).max()))


def check_gravity(series: Series) -> Check:
    """Does the accelerometer measure 1 g?"""
    name = "Gravity"
    if series.imu_off:
        return Check(name, Level.NOT_APPLICABLE, "The IMU is off.")
    lengths = np.linalg.norm(series.samples.acceleration[series.finite[:, 6:9].all(axis=1)], axis=1)
    if not len(lengths):
        return too_few(name, 0)
    usual = float(np.median(lengths))
    found = (
        f"The accelerometer measures {figure(usual)} m/s² (median of the norm); {STANDARD_GRAVITY} is one g."
    )
    if abs(usual - STANDARD_GRAVITY) <= _GRAVITY_TOLERANCE:
        return Check(name, Level.GOOD, found)
    remedy = "If the sensor was stationary: check acceleration_range_g and the acceleration offset (0x8001)."
    if abs(usual / STANDARD_GRAVITY - STANDARD_GRAVITY) < _GRAVITY_TOLERANCE:
        remedy = "This firmware sends SI units: use --imu-raw-units si (ROS node: imu_raw_units)."
    elif abs(usual * STANDARD_GRAVITY - STANDARD_GRAVITY) < _GRAVITY_TOLERANCE:
        remedy = "This firmware sends g: omit --imu-raw-units si."
    return Check(name, Level.LOOK, found, "Gravity compensation subtracts the wrong weight.", remedy)


def check_temperature(series: Series, findings: Sequence[Finding]) -> Check:
    """Is the temperature plausible?"""
    name = "Temperature"
    finite = series.samples.temperature[np.isfinite(series.samples.temperature)]
    if not len(finite):
        return too_few(name, 0)
    low, high = float(finite.min()), float(finite.max())
    found = f"{figure(low)} to {figure(high)} °C."
    return judged(name, findings, found, details=found)
