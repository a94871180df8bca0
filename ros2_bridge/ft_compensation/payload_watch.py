# SPDX-License-Identifier: Apache-2.0
"""Whether the payload is still the one that is compensated: judged from what is measured in ordinary motion.

Short windows of slow motion are kept, the latest of each orientation. Another mass than the compensated one
leaves a force that turns with gravity; a contact does so in several orientations only by chance, a drift of
the bias never. What is found is said, once, and never applied.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from bota_ethercat.pdo import Vector3
from ft_compensation.quantities import Payload, length
from ft_compensation.stationary_limits import StationaryLimits

_LOOK_S: Final = 0.05  # between two samples that are looked at
_LOOKS: Final = 10  # in a window
_SLOW: Final = 0.1  # rad/s: of a gyroscope that may have an offset
_SAME: Final = 0.94  # cosine: directions of gravity nearer than 20° are one orientation
_FEWEST, _MOST = 3, 6  # orientations
_LEAST_SPREAD: Final = 0.25  # mean square of the directions about their mean
_LEAST_FORCE: Final = 0.5  # N: a smaller weight is not looked for, ...
_LEAST_SHARE: Final = 0.1  # ... and not less than this part of the compensated one.
_MISFIT: Final = 0.15  # of the missing weight: what may be left when a mass explains it; 0.3 N always may
_LEAST_MISFIT: Final = 0.3
_LONG_S: Final = 10.0
# Windows in a row, each in another orientation than the one before and over so many seconds, that agree.
_CONFIRMATIONS: Final = 3


class _Window(NamedTuple):
    force: Vector3  # N: left after compensation
    gravity: Vector3  # m/s²


class PayloadWatch:
    """Looks at compensated samples, from one thread; any may read `finding`."""

    def __init__(
        self,
        payload: Payload,
        say: Callable[[str], object] = lambda _: None,
        limits: StationaryLimits | None = None,
    ) -> None:
        """`say` gets the first finding. Of `limits` the standard deviation of the force counts."""
        self.finding = ""  # what does not agree, a sentence; empty as long as all does
        self.due_s = 0.0  # when the next sample is to be looked at, by the samples' time
        self._payload, self._say = payload, say
        self._variance = (limits or StationaryLimits()).force_deviation ** 2
        self._windows: list[_Window] = []
        self._since_s: float | None = None
        self._confirmed: list[_Window] = []
        self._said = False
        self._restart()

    def _restart(self) -> None:
        self._looks = 0
        self._sums = [0.0] * 9

    def is_due(self, time_s: float) -> bool:
        """Whether a sample of this time is to be looked at; also after a clock was set back."""
        return not self.due_s - 1.0 < time_s < self.due_s

    def look(self, force: Vector3, gravity: Vector3, angular_rate: Vector3, time_s: float) -> None:
        """Take a sample: force left after compensation, N; gravity (of slow motion), m/s²; rad/s."""
        if self._looks and not -1.0 < time_s - self.due_s < 1.0:
            self._restart()  # what was interrupted, or another time
        self.due_s = time_s + _LOOK_S
        if length(angular_rate) > _SLOW:
            self._restart()
            return
        for place, part in enumerate((*force, *gravity, *(part * part for part in force))):
            self._sums[place] += part
        self._looks += 1
        if self._looks < _LOOKS:
            return
        means = [part / _LOOKS for part in self._sums]
        self._restart()
        x, y, z, gx, gy, gz, xx, yy, zz = means
        if max(xx - x * x, yy - y * y, zz - z * z) <= self._variance:
            self._take(_Window((x, y, z), (gx, gy, gz)), time_s)

    def _take(self, window: _Window, time_s: float) -> None:
        others = [other for other in self._windows if not _is_same(other.gravity, window.gravity)]
        self._windows = [*others, window][-_MOST:]
        missing = self._missing_mass()
        if missing is None:
            self._since_s, self._confirmed = None, []
            return
        g = length(window.gravity)
        least = max(_LEAST_FORCE, _LEAST_SHARE * self._payload.mass * g)
        if abs(missing) * g < least or self._payload.mass + missing < -least / g:
            self._since_s, self._confirmed, self.finding = None, [], ""
            return
        if self._since_s is None or time_s < self._since_s:
            self._since_s = time_s
        if not self._confirmed or not _is_same(self._confirmed[-1].gravity, window.gravity):
            self._confirmed = [*self._confirmed, window][-_CONFIRMATIONS:]
        if len(self._confirmed) == _CONFIRMATIONS and time_s - self._since_s >= _LONG_S:
            self._find(max(self._payload.mass + missing, 0.0))

    def _missing_mass(self) -> float | None:
        """kg: that explains the latest windows of as many orientations as one mass can; None if none does."""
        for first in range(len(self._windows) - _FEWEST + 1):
            both = np.array(self._windows[first:])
            force, gravity = np.moveaxis(both - both.mean(axis=0), 1, 0)
            square = float((gravity**2).sum())
            if square < _LEAST_SPREAD * float((both[:, 1] ** 2).sum()):
                return None  # fewer have no more
            mass = float((gravity * force).sum()) / square
            left = float((force**2).sum()) - mass * mass * square
            degrees = 3 * len(both) - 4
            limit = max(_LEAST_MISFIT, _MISFIT * abs(mass) * length(self._windows[first].gravity))
            if left <= degrees * limit * limit:
                return mass
        return None

    def _find(self, mass: float) -> None:
        self.finding = (
            f"a tool of {mass:.2f} kg would explain the measurements in {len(self._windows)} orientations, "
            f"but tool_mass is {self._payload.mass:.2f} kg: if the tool was changed or lost, identify it"
        )
        if not self._said:
            self._said = True
            self._say(self.finding)


def _is_same(a: Vector3, b: Vector3) -> bool:
    return sum(x * y for x, y in zip(a, b, strict=True)) > _SAME * length(a) * length(b)
