"""The signals `clock`, `ramp`, `sine`, `constant` and `rest`, each a function of the sample number.

The physical ones, `scene`, `poses` and `turn`, are in `scene.py`. Formulas are in docs/virtual-sensor.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple, Protocol

SIGNALS: Final = ("scene", "poses", "turn", "clock", "ramp", "sine", "constant", "rest")


Load = tuple[float, float, float, float, float, float]
"""Force (N) and torque (Nm)."""


class Reading(NamedTuple):
    """One sample before settings act on it, in the units of the process data."""

    force_torque: Load
    acceleration: tuple[float, float, float]
    """Specific force, g: a stationary sensor reads +1 along the axis that points up."""
    angular_rate: tuple[float, float, float]
    """°/s"""
    temperature: float
    """°C"""
    orientation: tuple[float, float, float, float]
    """x, y, z, w: turns vectors of the sensor's frame into the world's (z up)."""


class Signal(Protocol):
    """A source of readings."""

    exact: bool
    """Settings, offsets and noise do not affect the reading."""

    def reading(self, number: int, instant: int, seconds: float) -> Reading:
        """The reading of sample `number`, taken at `instant` ns, `seconds` after power-on."""


_LEVEL: Final = (0.0, 0.0, 1.0)
_STATIONARY: Final = (0.0, 0.0, 0.0)
_UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)
_TEMPERATURE: Final = 35.0

CONSTANT: Final[Load] = (1.5, -2.25, -9.75, 0.125, -0.0625, 0.03125)
"""Force (N) and torque (Nm) of the signal `constant`; exact in REAL32."""
REST_LENGTH: Final = 2**22
_REST_STEPS: Final = 2**18
_REST_TEMPERATURE: Final = 32
"""From here to 48 °C, steps of 2**-18 °C are exact in REAL32."""
RAMP_LENGTH: Final = 1024
SINE_LENGTH: Final = 1000
SINE_AMPLITUDES: Final = (10.0, 20.0, 30.0, 1.0, 2.0, 3.0)


class Formula:
    """A signal that is a function of sample number and instant; level and stationary."""

    def __init__(self, load: Callable[[int, int], Load], *, exact: bool = False) -> None:
        self._load, self.exact = load, exact

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `Signal`."""
        return Reading(self._load(number, instant), _LEVEL, _STATIONARY, _TEMPERATURE, _UPRIGHT)


class Rest(Formula):
    """The load of `constant`, with the sample number in the temperature: for tests of taring."""

    def reading(self, number: int, instant: int, seconds: float) -> Reading:
        """See `Signal`."""
        temperature = _REST_TEMPERATURE + number % REST_LENGTH / _REST_STEPS
        return super().reading(number, instant, seconds)._replace(temperature=temperature)


def _constant(_number: int, _instant: int) -> Load:
    return CONSTANT


def _ramp(number: int, _instant: int) -> Load:
    """Field i (0..5) is ((k + 100 i) mod 1024) / 64 - 8 for sample k."""
    a, b, c, d, e, f = (((number + 100 * i) % RAMP_LENGTH) / 64 - 8 for i in range(6))
    return a, b, c, d, e, f


def _sine(number: int, _instant: int) -> Load:
    """Field i (0..5) is A_i sin(2 pi (k / 1000 + i / 6)) for sample k."""
    turn = (number % SINE_LENGTH) / SINE_LENGTH
    a, b, c, d, e, f = (
        amplitude * math.sin(math.tau * (turn + i / 6)) for i, amplitude in enumerate(SINE_AMPLITUDES)
    )
    return a, b, c, d, e, f


def _clock(number: int, instant: int) -> Load:
    """Every sample carries its own number and its instant.

    force.x is the number modulo 2**24; force.y whole seconds modulo 2**20, force.z
    microseconds and torque.x the remaining nanoseconds. All are exact in REAL32.
    """
    whole, rest = divmod(instant, 10**9)
    micros, nanos = divmod(rest, 1000)
    return float(number % 2**24), float(whole % 2**20), float(micros), float(nanos), 0.0, 0.0


FORMULAS: Final[Mapping[str, Signal]] = {
    "clock": Formula(_clock, exact=True),
    "ramp": Formula(_ramp),
    "sine": Formula(_sine),
    "constant": Formula(_constant),
    "rest": Rest(_constant),
}
"""The signals of this file, by name."""


def decode_rest(temperature: float) -> int:
    """The number of a sample of the signal `rest`, modulo REST_LENGTH, from its temperature."""
    return int((temperature - _REST_TEMPERATURE) * _REST_STEPS)


class ClockReading(NamedTuple):
    """Content of a sample of the signal `clock`."""

    number: int
    """Sample number, modulo 2**24."""
    instant_ns: int
    """ns, modulo 2**20 s."""


def decode_clock(force_torque: Sequence[float]) -> ClockReading:
    """Sample number and instant from force x, y, z and torque x of the signal `clock`.

    Takes the values as they came off the bus. For tests and benchmarks.
    """
    number, seconds, micros, nanos = (int(value) for value in force_torque[:4])
    return ClockReading(number, seconds * 10**9 + micros * 1000 + nanos)
