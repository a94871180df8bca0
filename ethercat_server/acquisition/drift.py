"""How far the zero of a sensor at rest has moved since its tare.

A change is believed only if nothing but drift explains it:

- In windows of 8 s the sensor is at rest (`tare.why_moving`), and its acceleration has the direction of the
  first one after the tare, within a degree: then a tool weighs on it as it did, to 2 % of its weight.
- From one window to the next it is as slow as drift is, 0.9 N or 0.03 Nm a minute; after motion, or another
  pose, it is what it was, within what a tare calls steady. Else it was a contact or another load, and all is
  void until the wrench is back where it was, or tared.

A contact that comes more slowly cannot be told from drift.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.stream.usable import FORCE_TORQUE
from ethercat_server.ethercat.clock import Clock
from ethercat_server.sensor.history import History
from ethercat_server.sensor.sensor import Sensor
from ethercat_server.sensor.tare import (
    CHANNELS,
    LOAD,
    PARTS,
    RATE,
    ChannelStatistics,
    Part,
    channel_statistics,
    why_moving,
)

_FIELDS: Final = LAYOUTS[min(LAYOUTS)]
_SATURATED, _WARNINGS = (_FIELDS.index(name) for name in ("force_torque_saturated", "warnings"))
_SATURATING: Final = FORCE_TORQUE.saturating
_ACCELERATION: Final = slice(_FIELDS.index("acceleration.x"), _FIELDS.index("acceleration.z") + 1)
_TEMPERATURE: Final = _FIELDS.index("temperature")
_GRAVITY: Final = slice(
    len(CHANNELS), len(CHANNELS) + 3
)  # acceleration among the sums; temperature is the last
_SUMS: Final = len(CHANNELS) + 4
_CONE: Final = math.cos(math.radians(1.0))
_LEAST_GRAVITY: Final = 0.5  # g, or m/s² of firmware that sends those: without an IMU it is 0
_SLOW_S: Final = 20.0  # in this time drift stays steady


class Drift:
    """Drift of the zero of one sensor since its tare, or what began a new count."""

    def __init__(self, sensor: Sensor, clock: Clock) -> None:
        self.history = History()
        self.sensor, self._clock = sensor, clock
        self.begin("start")

    def begin(self, cause: str) -> None:
        """All that was before is void: a `tare`, a `change` of settings, a `return`, the `start`."""
        self._cause, self._since_s = cause, self._now_s()
        self._part, self._parts = Part(_SUMS), list[Part]()
        self._full, self._found = list[Part](), list[ChannelStatistics]()  # a window, and what of it is known
        self._first: list[ChannelStatistics] | None = None
        self._was_plausible = False  # whether the window before was drift, by `_is_plausible`
        self._unusable = True  # until the next second, so that nothing is from before

    def _now_s(self) -> float:
        return self._clock.raw_ns() * 1e-9

    def add(self, columns: Sequence[Sequence[float]]) -> None:
        """Some samples, by field of the process data."""
        if self._unusable:
            return
        load = columns[LOAD]
        self._part.add([*load, *columns[RATE], *columns[_ACCELERATION], columns[_TEMPERATURE]])
        is_saturated = any(columns[_SATURATED]) or any(int(each) & _SATURATING for each in columns[_WARNINGS])
        self.history.see(load, saturated=is_saturated)
        if self._full:
            self._examine()

    def each_second(self) -> None:
        self.history.each_second()
        sensor = self.sensor
        self._unusable = sensor.settling or sensor.settings.get("calibration_matrix") is False
        part, self._part = self._part, Part(_SUMS)
        self._parts = [*self._parts, part] if part.taken else []
        if len(self._parts) == PARTS:
            self._full, self._parts, self._found = self._parts, [], []

    def _examine(self) -> None:
        """One channel of a full window: all at once would delay an exchange."""
        self._found.append(channel_statistics(self._full, len(self._found)))
        if len(self._found) == _SUMS:
            self._full = []
            self._was_plausible = self._is_plausible(self._found)
            if self._was_plausible:
                self._accept(self._found)

    def _is_plausible(self, window: Sequence[ChannelStatistics]) -> bool:
        gravity = [found.mean for found in window[_GRAVITY]]
        if why_moving(window[: len(CHANNELS)]) or math.hypot(*gravity) < _LEAST_GRAVITY:
            return False
        if self._first is None:
            return True
        was = [found.mean for found in self._first[_GRAVITY]]
        if sum(a * b for a, b in zip(gravity, was, strict=True)) < _CONE * math.hypot(*gravity) * math.hypot(
            *was
        ):
            return False
        share = (self._now_s() - self._last_s) / _SLOW_S if self._was_plausible else 1.0
        return all(
            abs(new.mean - old.mean) <= share * channel.steady + math.hypot(new.by_chance, old.by_chance) / 2
            for channel, new, old in zip(CHANNELS[:6], window, self._last, strict=False)
        )

    def _accept(self, window: list[ChannelStatistics]) -> None:
        self._first = self._first or window
        self._last, self._last_s = window, self._now_s()

    def _moved(self) -> tuple[float, list[float]]:
        """K, and N and Nm, since the first window."""
        assert self._first is not None
        *wrench, kelvin = (
            self._last[channel].mean - self._first[channel].mean for channel in (*range(6), _SUMS - 1)
        )
        return kelvin, wrench

    def as_json(self) -> dict[str, Any]:
        """The sensor's part of `status`."""
        drift = None
        if self._first is not None:
            kelvin, wrench = self._moved()
            ago_s = round(self._now_s() - self._since_s)
            drift = {"since": self._cause, "ago_s": ago_s, "kelvin": kelvin, "wrench": wrench}
        return {"drift": drift, "history": self.history.as_json()}
