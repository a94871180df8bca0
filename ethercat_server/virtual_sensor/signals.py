"""What the sensor measures: `clock`, `ramp`, `sine`, `constant` and `rest`, each exact for a sample number.

The physical ones, `scene`, `poses` and `turn`, are in `scene.py`. Formulas are in docs/virtual-sensor.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple, Protocol

SIGNALS: Final = ("scene", "poses", "turn", "clock", "ramp", "sine", "constant", "rest")


class Reading(NamedTuple):
    """One sample before settings act on it, in the units of the process data."""

    force_torque: tuple[float, float, float, float, float, float]
    """N and Nm"""
    acceleration: tuple[float, float, float]
    """Specific force, g: a sensor at rest reads +1 along the axis that points up."""
    angular_rate: tuple[float, float, float]
    """°/s"""
    temperature: float
    """°C"""
    orientation: tuple[float, float, float, float]
    """x, y, z, w: turns vectors of the sensor's frame into the world's (z up)."""


class Signal(Protocol):
    """A source of readings."""

    exact: bool
    """Settings, offsets and noise leave the reading alone."""

    def reading(self, number: int, instant: int, seconds: float) -> Reading:
        """The reading of sample `number`, which came to be at `instant` ns, `seconds` after power-on."""


_LEVEL: Final = (0.0, 0.0, 1.0)
_STILL: Final = (0.0, 0.0, 0.0)
_UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)
_TEMPERATURE: Final = 35.0

CONSTANT: Final = (1.5, -2.25, -9.75, 0.125, -0.0625, 0.03125)
"""Force (N) and torque (Nm) of the signal `constant`; exact in REAL32."""
REST_LENGTH: Final = 2**22
_REST_STEPS: Final = 2**18
_REST_TEMPERATURE: Final = 32
"""From here to 48 °C, steps of 2**-18 °C are exact in REAL32."""
RAMP_LENGTH: Final = 1024
SINE_LENGTH: Final = 1000
SINE_AMPLITUDES: Final = (10.0, 20.0, 30.0, 1.0, 2.0, 3.0)


class ConstantSignal:
    """The same load for ever; level and still."""

    exact = False

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `Signal`."""
        return Reading(CONSTANT, _LEVEL, _STILL, _TEMPERATURE, _UPRIGHT)


class RestSignal:
    """The load of `constant`, the sample's number in the temperature: it can be tared and followed."""

    exact = False

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `Signal`."""
        temperature = _REST_TEMPERATURE + number % REST_LENGTH / _REST_STEPS
        return Reading(CONSTANT, _LEVEL, _STILL, temperature, _UPRIGHT)


class RampSignal:
    """Field i (0..5) is ((k + 100 i) mod 1024) / 64 - 8 for sample k; level and still."""

    exact = False

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `Signal`."""
        a, b, c, d, e, f = (((number + 100 * i) % RAMP_LENGTH) / 64 - 8 for i in range(6))
        return Reading((a, b, c, d, e, f), _LEVEL, _STILL, _TEMPERATURE, _UPRIGHT)


class SineSignal:
    """Field i (0..5) is A_i sin(2 pi (k / 1000 + i / 6)) for sample k; level and still."""

    exact = False

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `Signal`."""
        turn = (number % SINE_LENGTH) / SINE_LENGTH
        a, b, c, d, e, f = (
            amplitude * math.sin(math.tau * (turn + i / 6)) for i, amplitude in enumerate(SINE_AMPLITUDES)
        )
        return Reading((a, b, c, d, e, f), _LEVEL, _STILL, _TEMPERATURE, _UPRIGHT)


class ClockSignal:
    """Every sample carries its own number and the instant at which it came to be.

    force.x is the number modulo 2**24; force.y whole seconds of CLOCK_MONOTONIC modulo 2**20, force.z
    microseconds and torque.x the nanoseconds left over. All are exact in REAL32.
    """

    exact = True

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `Signal`."""
        whole, rest = divmod(instant, 10**9)
        micros, nanos = divmod(rest, 1000)
        load = (float(number % 2**24), float(whole % 2**20), float(micros), float(nanos), 0.0, 0.0)
        return Reading(load, _LEVEL, _STILL, _TEMPERATURE, _UPRIGHT)


FORMULAS: Final[Mapping[str, Callable[[], Signal]]] = {
    "clock": ClockSignal,
    "ramp": RampSignal,
    "sine": SineSignal,
    "constant": ConstantSignal,
    "rest": RestSignal,
}
"""The signals of this file, by name."""


def decode_rest(temperature: float) -> int:
    """The number of a sample of the signal `rest`, modulo REST_LENGTH, from its temperature."""
    return int((temperature - _REST_TEMPERATURE) * _REST_STEPS)


class ClockReading(NamedTuple):
    """What one sample of the signal `clock` says."""

    number: int
    """Sample number, modulo 2**24."""
    instant_ns: int
    """CLOCK_MONOTONIC, modulo 2**20 s."""


def decode_clock(force_torque: Sequence[float]) -> ClockReading:
    """Sample number and instant from force x, y, z and torque x of the signal `clock`.

    Takes the values as they came off the bus. For tests and benchmarks.
    """
    number, seconds, micros, nanos = (int(value) for value in force_torque[:4])
    return ClockReading(number, seconds * 10**9 + micros * 1000 + nanos)
