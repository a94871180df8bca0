"""What is kept of one sensor for years: the largest wrench, saturations, how its zero goes by temperature.

Each run is the slope of one time at rest without a contact (`acquisition.drift`). The line is the mean of the
runs, its interval follows from how they differ: of one run the samples are correlated, so that its own
residuals would promise too much.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from operator import neg
from statistics import fmean
from typing import Any, Final

from bota_ethercat.control import known_six
from bota_ethercat.text.json_text import finite
from bota_ethercat.text.untrusted import number, whole

_MOST_RUNS: Final = 32  # the newest
_STEEPEST: Final = 1e3  # N/K; no sensor's
# Student's t, 95 % two-sided, for 2 degrees of freedom and more; the last one for all others.
_STUDENT: Final = (4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23)


class History:
    """Of one sensor; forces in N, torques in Nm, times in s of the Unix epoch.

    Attributes:
        line: slope and half of its 95 % interval by axis, N/K and Nm/K, and how many runs it is of; or None.
        changed: whether there is something to write.
    """

    def __init__(self, given: Mapping[str, Any] = {}) -> None:
        """As `kept` gave it, or whatever a file holds: what is not understood is left out."""
        given = finite(given)
        self.since = number(given.get("since")) or round(time.time())
        self.peak = list(known_six(given.get("peak")) or (0.0,) * 6)
        self.saturations = whole(given.get("saturations")) or 0
        self.saturated_at = number(given.get("saturated_at"))
        runs = map(known_six, given["runs"] if isinstance(given.get("runs"), list) else ())
        self._runs = [run for run in runs if run and max(map(abs, run)) < _STEEPEST]
        self._saturated = self._was_saturated = self.changed = False
        self.line = self._line()

    def see(self, wrench: Sequence[Sequence[float]], *, saturated: bool) -> None:
        """Some samples, by axis."""
        before, self.peak = self.peak, list(map(max, self.peak, map(max, wrench), map(neg, map(min, wrench))))
        self.changed |= self.peak != before
        self._saturated |= saturated

    def second(self) -> None:
        """A second has passed: seconds with saturated samples that follow each other are one saturation."""
        if self._saturated and not self._was_saturated:
            self.saturations, self.saturated_at, self.changed = self.saturations + 1, round(time.time()), True
        self._was_saturated, self._saturated = self._saturated, False

    def add_run(self, slope: Sequence[float]) -> None:
        """Add what was learned in one run, N/K and Nm/K."""
        self._runs.append(tuple(slope))
        self.line, self.changed = self._line(), True

    def _line(self) -> dict[str, Any] | None:
        del self._runs[:-_MOST_RUNS]
        if (count := len(self._runs)) < 3:
            return None
        axes = list(zip(*self._runs, strict=True))
        slope = [fmean(axis) for axis in axes]
        t = _STUDENT[min(count - 3, len(_STUDENT) - 1)] / math.sqrt(count * (count - 1))
        interval = [t * math.dist(axis, [mean] * count) for axis, mean in zip(axes, slope, strict=True)]
        return {"slope": slope, "interval": interval, "runs": count}

    def as_json(self) -> dict[str, Any]:
        """For `status`."""
        return {key: getattr(self, key) for key in ("since", "peak", "saturations", "saturated_at")}

    def kept(self) -> dict[str, Any]:
        """For a file."""
        return {**self.as_json(), "runs": self._runs}
