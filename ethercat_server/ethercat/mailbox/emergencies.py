"""The emergencies of all sensors: counted, the last one kept, logged and told to others at a bounded rate."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable
from typing import Any, Final

from ethercat_server.ethercat.clock import Clock
from ethercat_server.ethercat.mailbox.emergency import Emergency

_LOG_EVERY_NS: Final = 60_000_000_000
"""The same code of the same sensor is logged once in this time."""
_MOST_CODES: Final = 16
"""Codes of one sensor that are logged in that time; the last one and the count of all are in `status`."""
_TELL_AGAIN_NS: Final = 10_000_000_000
"""The same code is told once in this time, if no other one came in between."""
_TELL_EVERY_NS: Final = 1_000_000_000
_TELL_AT_ONCE: Final = 5
"""Of one sensor so many are told at once, and one more each `_TELL_EVERY_NS`."""

log = logging.getLogger(__name__)


class _OfSensor:
    """What one sensor has reported."""

    def __init__(self) -> None:
        self.count = 0
        self.last: Emergency | None = None
        self.at_ns = 0
        self.logged_ns: dict[int, int] = {}
        """When each code was logged, within `_LOG_EVERY_NS`."""
        self.told = (-1, 0)
        """The last code that was told, and when."""
        self.told_until_ns = 0
        """What was told takes up the time until then, at one each `_TELL_EVERY_NS`."""


class Emergencies:
    """`note` takes each one, from whichever mailbox it was read."""

    def __init__(self, clock: Clock) -> None:
        self._monotonic_ns = clock.monotonic_ns
        self._sensors: defaultdict[int, _OfSensor] = defaultdict(_OfSensor)
        self.tell: Callable[[int, Emergency, int], None] = lambda _number, _emergency, _count: None
        """Told of them, except of a flood: number of the sensor, emergency, how many the sensor has sent."""

    def note(self, number: int, emergency: Emergency) -> None:
        """The sensor `number` has sent it."""
        sensor, now_ns = self._sensors[number], self._monotonic_ns()
        sensor.count += 1
        sensor.last, sensor.at_ns = emergency, now_ns
        if self._is_to_be_logged(sensor, emergency.code, now_ns):
            level = logging.INFO if emergency.is_reset else logging.WARNING
            log.log(level, "sensor %d reports %s", number, emergency)
        if self._is_to_be_told(sensor, emergency.code, now_ns):
            self.tell(number, emergency, sensor.count)

    def _is_to_be_logged(self, sensor: _OfSensor, code: int, now_ns: int) -> bool:
        recent = {code: at for code, at in sensor.logged_ns.items() if now_ns - at < _LOG_EVERY_NS}
        sensor.logged_ns = recent
        if code in recent or len(recent) >= _MOST_CODES:
            return False
        recent[code] = now_ns
        return True

    def _is_to_be_told(self, sensor: _OfSensor, code: int, now_ns: int) -> bool:
        told_code, told_ns = sensor.told
        if code == told_code and now_ns - told_ns < _TELL_AGAIN_NS:
            return False
        if sensor.told_until_ns - now_ns > (_TELL_AT_ONCE - 1) * _TELL_EVERY_NS:
            return False
        sensor.told_until_ns = max(sensor.told_until_ns, now_ns) + _TELL_EVERY_NS
        sensor.told = (code, now_ns)
        return True

    def status(self, number: int) -> dict[str, Any]:
        """The sensor's part of the `status` reply."""
        sensor = self._sensors[number]
        last: dict[str, Any] | None = None
        if sensor.last is not None:
            ago_s = round((self._monotonic_ns() - sensor.at_ns) * 1e-9, 3)
            last = {**sensor.last.as_json(), "ago_s": ago_s}
        return {"emergencies": sensor.count, "emergency": last}
