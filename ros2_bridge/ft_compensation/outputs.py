"""The compensated wrench filtered, and in another frame. Plain floats.

`wrench_filtered`: a notch if wanted, a second-order Butterworth low-pass, a dead band. Sections are biquads
in direct form I: their state is past inputs and outputs, which mean the same whatever the coefficients, so a
new cut-off makes no step. At the first sample, and after a pause longer than the filter's memory, the state
is what a constant load would have left: no transient.

Another frame: rotated, and its torque about the other frame's origin. Force and torque of one load, seen from
frame B instead of S (R takes vectors of S to B, t is the origin of S in B): f_B = R f_S, and m_B = R m_S +
cross(t, f_B), because a force that acts at a distance has a torque. Frames at rest to each other or not: this
holds at each instant.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Self

from bota_ethercat.pdo import Vector3
from ft_compensation.quantities import ZERO, CompensationError, Quaternion, Wrench, unit_quaternion

LEAST_CUTOFF_HZ: Final = 0.05
LEAST_NOTCH_HZ: Final = 1.0
Six = tuple[float, ...]  # Fx Fy Fz (N) Mx My Mz (Nm)
_SHORTEST_PAUSE: Final = 3.5  # sample periods: fewer are a few lost samples, which the state outlives


class FilterSettings(NamedTuple):
    """What is filtered out: the parameters `filter.*`."""

    cutoff: float = 0.0  # -3 dB, Hz; 0 = no filter
    notch: float = 0.0  # its center, Hz; 0 = none
    notch_width: float = 5.0  # between its -3 dB points, Hz
    dead_band_force: float = 0.0  # N
    dead_band_torque: float = 0.0  # Nm

    def problems(self, rate_hz: float) -> list[str]:
        """Why samples of this rate are too few for it, a sentence for each frequency."""
        half = rate_hz / 2.0
        frequencies = {"cutoff": self.cutoff} if self.cutoff else {}
        if self.cutoff and self.notch:
            frequencies |= {"notch": self.notch, "notch_width": self.notch_width}
        return [
            f"filter.{name} is {value:g} Hz, but must be below half of the sampling rate, {half:g} Hz: "
            "lower it"
            for name, value in frequencies.items()
            if not value < half
        ]


class Coefficients(NamedTuple):
    """y[n] = b0 x[n] + b1 x[n-1] + b2 x[n-2] - a1 y[n-1] - a2 y[n-2]"""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float

    @property
    def delay(self) -> float:
        """Group delay at DC, in samples."""
        b0, b1, b2, a1, a2 = self
        return (b1 + 2.0 * b2) / (b0 + b1 + b2) - (a1 + 2.0 * a2) / (1.0 + a1 + a2)


def low_pass(cutoff_hz: float, rate_hz: float) -> Coefficients:
    """Second-order Butterworth by the bilinear transform, exact at the cut-off."""
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    scale = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    b = k * k * scale
    return Coefficients(
        b, 2.0 * b, b, 2.0 * (k * k - 1.0) * scale, (1.0 - math.sqrt(2.0) * k + k * k) * scale
    )


def notch(center_hz: float, width_hz: float, rate_hz: float) -> Coefficients:
    """Second order, exact in center and width; nothing of the center passes, everything of DC does."""
    gain = 1.0 / (1.0 + math.tan(math.pi * width_hz / rate_hz))
    turn = -2.0 * gain * math.cos(2.0 * math.pi * center_hz / rate_hz)
    return Coefficients(gain, turn, gain, turn, 2.0 * gain - 1.0)


class _Section:
    """One biquad on six values."""

    def __init__(self, coefficients: Coefficients) -> None:
        self.coefficients = coefficients
        self.restart(())

    def restart(self, values: Six) -> None:
        """As if `values` had always been."""
        self._x1 = self._x2 = self._y1 = self._y2 = values

    def step(self, values: Six) -> Six:
        b0, b1, b2, a1, a2 = self.coefficients
        result = tuple([
            b0 * x + b1 * p + b2 * q - a1 * u - a2 * v
            for x, p, q, u, v in zip(values, self._x1, self._x2, self._y1, self._y2, strict=True)
        ])  # fmt: skip
        self._x2, self._x1, self._y2, self._y1 = self._x1, values, self._y1, result
        return result


class WrenchFilter:
    """Filters every sample of a stream. `step` is for one thread; another may `design` meanwhile."""

    def __init__(self) -> None:
        self.delay_s = 0.0  # group delay at DC, without the sensor's own filters
        self._sections: tuple[_Section, ...] = ()
        self._running: tuple[_Section, ...] = ()  # those that have a state
        self._dead_band_force = self._dead_band_torque = 0.0
        self._longest_pause_ns = 0.0
        self._last_ns = 0

    def design(self, settings: FilterSettings, rate_hz: float) -> None:
        """For samples of this rate, from the next one on. CompensationError if they are too few for it."""
        for problem in settings.problems(rate_hz):
            raise CompensationError(problem)
        designs = [low_pass(settings.cutoff, rate_hz)]
        if settings.notch:
            designs.insert(0, notch(settings.notch, settings.notch_width, rate_hz))
        if len(designs) != len(self._sections):
            self._sections = tuple(_Section(coefficients) for coefficients in designs)
        for section, coefficients in zip(self._sections, designs, strict=True):
            section.coefficients = coefficients
        self.delay_s = sum(coefficients.delay for coefficients in designs) / rate_hz
        memory_s = 1.0 / (2.0 * math.pi * settings.cutoff)
        self._longest_pause_ns = 1e9 * max(_SHORTEST_PAUSE / rate_hz, memory_s)
        self._dead_band_force, self._dead_band_torque = settings.dead_band_force, settings.dead_band_torque

    def step(self, force: Vector3, torque: Vector3, time_ns: int) -> Wrench:
        """The filtered wrench of this sample."""
        values: Six = force + torque
        passed_ns, self._last_ns = time_ns - self._last_ns, time_ns
        sections = self._sections
        if sections is not self._running or not 0 <= passed_ns <= self._longest_pause_ns:
            self._running = sections
            for section in sections:
                section.restart(values)
        for section in sections:
            values = section.step(values)
        fx, fy, fz, mx, my, mz = values
        force, torque = (fx, fy, fz), (mx, my, mz)
        if self._dead_band_force:
            force = beyond(force, self._dead_band_force)
        if self._dead_band_torque:
            torque = beyond(torque, self._dead_band_torque)
        return Wrench(force, torque)


def beyond(vector: Vector3, dead_band: float) -> Vector3:
    """What of a vector's length exceeds the dead band, in its direction: continuous, 0 inside."""
    x, y, z = vector
    size = math.sqrt(x * x + y * y + z * z)
    if size <= dead_band:
        return 0.0, 0.0, 0.0
    share = 1.0 - dead_band / size
    return x * share, y * share, z * share


Rotation = tuple[Vector3, Vector3, Vector3]  # a rotation matrix, row by row
_IDENTITY: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class WrenchTransform(NamedTuple):
    """From a source frame to a target frame."""

    rotation: Rotation = _IDENTITY  # takes vectors of the source frame to the target frame
    translation: Vector3 = ZERO  # the origin of the source frame in the target frame, m

    @classmethod
    def of(cls, translation: Vector3, quaternion: Quaternion) -> Self:
        """From the pose of the source frame in the target frame, as TF gives it. ValueError if it is none."""
        x, y, z, w = unit_quaternion(quaternion)
        if not math.isfinite(sum(translation)):
            raise ValueError("a translation is three finite numbers")
        rotation = (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
            (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
            (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
        )
        return cls(rotation, translation)

    def inverse(self) -> Self:
        """From the target frame to the source frame."""
        (a, b, c), (d, e, f), (g, h, i) = self.rotation
        x, y, z = self.translation
        back = (a, d, g), (b, e, h), (c, f, i)
        return type(self)(
            back, (-a * x - d * y - g * z, -b * x - e * y - h * z, -c * x - f * y - i * z)
        )  # fmt: skip

    def apply(self, force: Vector3, torque: Vector3) -> Wrench:
        """The wrench in the target frame, its torque about that frame's origin."""
        (a, b, c), (d, e, f), (g, h, i) = self.rotation
        x, y, z = self.translation
        fx, fy, fz = force
        mx, my, mz = torque
        px, py, pz = a * fx + b * fy + c * fz, d * fx + e * fy + f * fz, g * fx + h * fy + i * fz
        return Wrench(
            (px, py, pz),
            (
                a * mx + b * my + c * mz + y * pz - z * py,
                d * mx + e * my + f * mz + z * px - x * pz,
                g * mx + h * my + i * mz + x * py - y * px,
            ),
        )
