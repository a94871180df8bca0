"""CoE emergency messages: what a slave reports unasked, in words, kept for all sensors.

They are counted, the last one kept, and logged and told to others at a bounded rate.
Sources: ETG.1000.6, CiA 301.
"""

from __future__ import annotations

import logging
import struct
from collections import defaultdict
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Self

from ethercat_server.ethercat.clock import Clock

log = logging.getLogger(__name__)

_BODY: Final = struct.Struct("<HHB")  # CoE header, error code, error register; manufacturer data follow
_SERVICE: Final = 1
_DATA_SIZE: Final = 5
_CLASS_MASK: Final = 0xFF00
_LOG_EVERY_NS: Final = 60_000_000_000  # for the same code of the same sensor
_MOST_CODES: Final = 16  # of one sensor that are logged in that time
_TELL_AGAIN_NS: Final = 10_000_000_000  # for the same code, if no other one came in between
_TELL_EVERY_NS: Final = 1_000_000_000
_TELL_AT_ONCE: Final = 5  # of one sensor, and then one each `_TELL_EVERY_NS`

# By error code without its lower byte; what is not here belongs to the class of its first digit.
ERROR_CLASSES: Final[dict[int, str]] = {
    0x0000: "error reset, or no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2100: "current on the input side",
    0x2200: "current inside the device",
    0x2300: "current on the output side",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3200: "voltage inside the device",
    0x3300: "output voltage",
    0x4000: "temperature",
    0x4100: "ambient temperature",
    0x4200: "temperature of the device",
    0x5000: "hardware of the device",
    0x6000: "software of the device",
    0x6100: "internal software",
    0x6200: "user software",
    0x6300: "data set",
    0x7000: "additional modules",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8200: "protocol error",
    0x9000: "external error",
    0xA000: "change of the AL state failed",
    0xF000: "additional functions",
    0xFF00: "device-specific",
}


class Emergency(NamedTuple):
    """One emergency message."""

    code: int
    register: int  # the error register, object 0x1001
    data: bytes  # at most five bytes of the manufacturer's

    @classmethod
    def parse(cls, body: bytes) -> Self | None:
        """From a CoE message, without the mailbox header; None if it is no emergency."""
        if len(body) < _BODY.size:
            return None
        header, code, register = _BODY.unpack_from(body)
        if header >> 12 != _SERVICE:
            return None
        return cls(code, register, body[_BODY.size : _BODY.size + _DATA_SIZE])

    @property
    def is_reset(self) -> bool:
        """Whether it says that an error is over."""
        return not self.code & _CLASS_MASK

    @property
    def text(self) -> str:
        """The class of its error code in words."""
        known = ERROR_CLASSES.get(self.code & _CLASS_MASK) or ERROR_CLASSES.get(self.code & 0xF000)
        return known or "of no class that CiA 301 defines"

    def __str__(self) -> str:
        data = self.data.hex() or "none"
        return f"emergency 0x{self.code:04X} ({self.text}), error register 0x{self.register:02X}, data {data}"

    def as_json(self) -> dict[str, Any]:
        """The keys by which clients get it."""
        return {"code": self.code, "text": self.text, "register": self.register, "data": self.data.hex()}


class _OfSensor:
    """What one sensor has reported."""

    def __init__(self) -> None:
        self.count = 0
        self.last: Emergency | None = None
        self.at_ns = 0
        self.logged_ns: dict[int, int] = {}  # when each code was logged, within `_LOG_EVERY_NS`
        self.told = (-1, 0)  # the last code that was told, and when
        self.told_until_ns = 0  # what was told takes up the time until then, at one each `_TELL_EVERY_NS`


class Emergencies:
    """`note` takes each one, from whichever mailbox it was read."""

    def __init__(self, clock: Clock) -> None:
        self._monotonic_ns = clock.monotonic_ns
        self._sensors: defaultdict[int, _OfSensor] = defaultdict(_OfSensor)
        # Told of them, except of a flood: number of the sensor, emergency, how many the sensor has sent.
        self.tell: Callable[[int, Emergency, int], None] = lambda _number, _emergency, _count: None

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
