"""What is kept of one sensor for years: the largest wrench, and saturations."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from operator import neg
from typing import Any

from bota_ethercat.control import known_six
from bota_ethercat.text.json_text import finite
from bota_ethercat.text.untrusted import number, whole


class History:
    """Of one sensor; forces in N, torques in Nm, times in s of the Unix epoch.

    Attributes:
        changed: whether there is something to write.
    """

    def __init__(self, given: Mapping[str, Any] = {}) -> None:
        """As `as_json` gave it, or whatever a file holds: what is not understood is left out."""
        given = finite(given)
        self.since = number(given.get("since")) or round(time.time())
        self.peak = list(known_six(given.get("peak")) or (0.0,) * 6)
        self.saturations = whole(given.get("saturations")) or 0
        self.saturated_at = number(given.get("saturated_at"))
        self._saturated = self._was_saturated = self.changed = False

    def see(self, wrench: Sequence[Sequence[float]], *, saturated: bool) -> None:
        """Some samples, by axis."""
        before, self.peak = self.peak, list(map(max, self.peak, map(max, wrench), map(neg, map(min, wrench))))
        self.changed |= self.peak != before
        self._saturated |= saturated

    def each_second(self) -> None:
        """Seconds with saturated samples that follow each other are one saturation."""
        if self._saturated and not self._was_saturated:
            self.saturations, self.saturated_at, self.changed = self.saturations + 1, round(time.time()), True
        self._was_saturated, self._saturated = self._saturated, False

    def as_json(self) -> dict[str, Any]:
        """For `status`, and for a file."""
        return {key: getattr(self, key) for key in ("since", "peak", "saturations", "saturated_at")}
