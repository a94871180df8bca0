"""What the sensor measures: formulas of the sample number, or a tool on a moving wrist with contacts.

Frames: the sensor's, with z out of the tool side; the world's, with z up. An attitude is yaw, pitch and roll
(rad) about z, y', x''; it turns sensor vectors into world vectors. Documented in docs/virtual-sensor.md.
"""

from __future__ import annotations

import math
import operator
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ethercat.sensor.filters import ACCELERATION_FILTERS, ANGULAR_RATE_FILTERS
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ, SettingValue
from ethercat_server.virtual_sensor.filters import LoadFilter, Past, filtered, imu_filter

Vector = tuple[float, float, float]


class Reading(NamedTuple):
    """One sample before settings act on it, in the units of the process data."""

    force_torque: tuple[float, ...]  # N, Nm
    acceleration: tuple[float, ...]  # specific force, g: +1 along the axis that points up, if stationary
    angular_rate: tuple[float, ...]  # °/s
    temperature: float  # °C
    orientation: tuple[float, ...]  # x, y, z, w: turns vectors of the sensor's frame into the world's


CONSTANT: Final = (1.5, -2.25, -9.75, 0.125, -0.0625, 0.03125)  # exact in REAL32


@dataclass(frozen=True)
class Formula:
    """A signal that is a function of sample number and instant; level and stationary.

    Settings, offsets and noise do not affect one that is `exact`.
    """

    load: Callable[[int, int], Iterable[float]]
    temperature: Callable[[int], float] = lambda _: 35.0
    exact: bool = False

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """The reading of sample `number`, taken at `instant` ns, `seconds` after power-on."""
        load, temperature = tuple(self.load(number, instant)), self.temperature(number)
        return Reading(load, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), temperature, (0.0, 0.0, 0.0, 1.0))


def _clock(number: int, instant: int) -> Iterable[float]:
    """Every sample carries its own number and its instant.

    force.x is the number modulo 2**24; force.y whole seconds modulo 2**20, force.z
    microseconds and torque.x the remaining nanoseconds. All are exact in REAL32.
    """
    whole, rest = divmod(instant, 10**9)
    micros, nanos = divmod(rest, 1000)
    return float(number % 2**24), float(whole % 2**20), float(micros), float(nanos), 0.0, 0.0


FORMULAS: Final = {
    "clock": Formula(_clock, exact=True),
    "ramp": Formula(lambda k, _: (((k + 100 * i) % 1024) / 64 - 8 for i in range(6))),
    "constant": Formula(lambda *_: CONSTANT),
    # The sample number in the temperature: steps of 2**-18 °C, from 32 to 48 °C, are exact in REAL32.
    "rest": Formula(lambda *_: CONSTANT, lambda k: 32 + k % 2**22 / 2**18),
}


class ClockReading(NamedTuple):
    """Content of a sample of the signal `clock`."""

    number: int  # modulo 2**24
    instant_ns: int  # modulo 2**20 s


def decode_clock(force_torque: Sequence[float]) -> ClockReading:
    """Sample number and instant from force x, y, z and torque x of the signal `clock`.

    Takes the values as they came off the bus. For tests and benchmarks.
    """
    number, seconds, micros, nanos = (int(value) for value in force_torque[:4])
    return ClockReading(number, seconds * 10**9 + micros * 1000 + nanos)


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _cosines_and_sines(angles: Vector) -> tuple[float, float, float, float, float, float]:
    yaw, pitch, roll = angles
    cos, sin = math.cos, math.sin
    return cos(yaw), sin(yaw), cos(pitch), sin(pitch), cos(roll), sin(roll)


def quaternion(attitude: Vector) -> tuple[float, ...]:
    """The attitude as x, y, z, w."""
    cy, sy, cp, sp, cr, sr = _cosines_and_sines((attitude[0] / 2, attitude[1] / 2, attitude[2] / 2))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def angular_rate(attitude: Vector, rates: Vector) -> Vector:
    """Angular velocity in the sensor's frame, rad/s, from the derivatives of yaw, pitch and roll."""
    _, _, cp, sp, cr, sr = _cosines_and_sines(attitude)
    yaw_rate, pitch_rate, roll_rate = rates
    return (
        roll_rate - yaw_rate * sp,
        pitch_rate * cr + yaw_rate * cp * sr,
        -pitch_rate * sr + yaw_rate * cp * cr,
    )


def to_sensor(attitude: Vector, vector: Vector) -> Vector:
    """A world vector in the sensor's frame."""
    cy, sy, cp, sp, cr, sr = _cosines_and_sines(attitude)
    x, y, z = vector
    return (
        cy * cp * x + sy * cp * y - sp * z,
        (cy * sp * sr - sy * cr) * x + (sy * sp * sr + cy * cr) * y + cp * sr * z,
        (cy * sp * cr + sy * sr) * x + (sy * sp * cr - cy * sr) * y + cp * cr * z,
    )


# Motions: attitude and its derivatives (rad/s) at a time since power-on, s.

Motion = Callable[[float], tuple[Vector, Vector]]
# Amplitude (rad) and angular frequency (rad/s) of yaw, pitch and roll.
_SWINGS = ((0.5, 0.31), (0.45, 0.23), (0.6, 0.37))
POSE_LENGTH: Final = 3.0  # duration of a pose, s
MOVE_LENGTH: Final = 2.0  # of the move between poses, s
_QUARTER: Final = math.pi / 2
# The axis of the sensor that points up, and yaw, pitch and roll. After the last comes the first again.
POSES: Final[tuple[tuple[str, Vector], ...]] = (
    ("+z", (0.0, 0.0, 0.0)),
    ("+y", (0.0, 0.0, _QUARTER)),
    ("-z", (0.0, 0.0, 2 * _QUARTER)),
    ("-y", (0.0, 0.0, 3 * _QUARTER)),
    ("+x", (0.0, -_QUARTER, 4 * _QUARTER)),
    ("-x", (0.0, _QUARTER, 4 * _QUARTER)),
)
TURN_LENGTH: Final = 60.0  # duration of a full turn, s
_TURN_PITCH: Final = 0.6


def sway(seconds: float) -> tuple[Vector, Vector]:
    """Never stationary: yaw, pitch and roll swing."""
    yaw, pitch, roll = (a * math.sin(w * seconds) for a, w in _SWINGS)
    yaw_rate, pitch_rate, roll_rate = (a * w * math.cos(w * seconds) for a, w in _SWINGS)
    return (yaw, pitch, roll), (yaw_rate, pitch_rate, roll_rate)


def pose(seconds: float) -> tuple[Vector, Vector]:
    """The six poses in which one axis of the sensor points up or down, one after another."""
    number, passed = divmod(seconds, POSE_LENGTH + MOVE_LENGTH)
    here = POSES[int(number) % len(POSES)][1]
    if passed < POSE_LENGTH:
        return here, (0.0, 0.0, 0.0)
    following = POSES[(int(number) + 1) % len(POSES)][1]
    s = (passed - POSE_LENGTH) / MOVE_LENGTH
    # Smooth from standstill to standstill.
    share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    rate = 30.0 * s * s * (1.0 - s) ** 2 / MOVE_LENGTH
    yaw, pitch, roll = (b - a for a, b in zip(here, following, strict=True))
    if following is POSES[0][1]:  # the first pose again is a whole roll further on
        roll += math.tau
    return (
        (here[0] + share * yaw, here[1] + share * pitch, here[2] + share * roll),
        (rate * yaw, rate * pitch, rate * roll),
    )


def turn(seconds: float) -> tuple[Vector, Vector]:
    """A slow whole turn, over and over: rolls round once while it pitches up and down."""
    speed = math.tau / TURN_LENGTH
    rolled = speed * seconds
    pitch, rate = _TURN_PITCH * math.sin(rolled), _TURN_PITCH * speed * math.cos(rolled)
    return (0.0, pitch, rolled), (0.0, rate, speed)


MOTIONS: Final[dict[str, Motion]] = {"scene": sway, "poses": pose, "turn": turn}
SIGNALS: Final = (*MOTIONS, *FORMULAS)

TOOL_MASS = 0.8  # kg
TOOL_CENTRE: Vector = (0.004, -0.006, 0.055)  # center of gravity in the sensor's frame, m
CONTACT_POINT: Vector = (0.0, 0.0, 0.12)  # on the tool, m
CONTACT_PERIOD = 7.0  # s from one contact to the next; the first begins 5 s after power-on
CONTACT_START, CONTACT_LENGTH = 5.0, 0.6
CONTACT_FORCE: Vector = (3.0, -2.0, -12.0)  # at its peak, N, in the sensor's frame
# Amplitude (m/s²) and angular frequency of the swaying wrist's acceleration along each world axis.
_SHAKE = ((0.15, 1.7), (0.10, 2.3), (0.20, 1.1))

# Standard deviation at SINC 51, and the power with which it falls with the length: half of what Bota's
# own test allows at 51, and a little under half of it at 1024.
_REFERENCE_SINC = 51
_NOISE = (*((0.3, 0.62),) * 3, (0.007, 0.78), (0.007, 0.78), (0.0025, 0.78))
_FILTERS: Final = ("fir", "acceleration_filter", "angular_rate_filter")
_ACCELERATION_NOISE = 0.002  # g
_ANGULAR_RATE_NOISE = 0.04  # °/s


def contact_force(seconds: float) -> Vector:
    """Force of the contact in `scene` at `CONTACT_POINT`, N; zero most of the time."""
    phase = (seconds - CONTACT_START) % CONTACT_PERIOD
    if seconds < CONTACT_START or phase >= CONTACT_LENGTH:
        return (0.0, 0.0, 0.0)
    push = math.sin(math.pi * phase / CONTACT_LENGTH) ** 2
    x, y, z = CONTACT_FORCE
    return x * push, y * push, z * push


class Scene:
    """The tool on the wrist.

    All readings follow from the attitude R(t) and the wrist's acceleration a(t): specific force
    f = R^T (a - g), so +1 g upward when stationary; tool force F = m R^T (g - a) = -m f; torque r x F. The
    tool's own rotational inertia and the lever arm to the IMU are neglected: the wrist turns slowly. Only
    where it sways is it accelerated, too, and does the tool touch something.
    """

    exact = False

    def __init__(self, seed: int, noise: bool, motion: Motion = sway) -> None:
        """Measured without filters, until there are some."""
        self._motion = motion
        self._gauss = random.Random(seed).gauss
        self._noise = noise
        self._settings: tuple[SettingValue, ...] = ()  # of the filters
        self._load_filter: LoadFilter | None = None
        self._acceleration_filter: Past = [(0.0, 1.0)]
        self._rate_filter: Past = [(0.0, 1.0)]
        self.set_sinc_length(_REFERENCE_SINC)

    def set_sinc_length(self, sinc_length: int) -> None:
        """A longer filter makes force (N) and torque (Nm) quieter: their standard deviations with FIR off."""
        ratio = sinc_length / _REFERENCE_SINC
        self.deviations = tuple(deviation * ratio**-power for deviation, power in _NOISE)

    def set_filters(self, sinc_length: int, settings: Mapping[str, SettingValue]) -> None:
        """Measure through these filters; `sinc_length` is that in effect."""
        wanted = sinc_length, *(settings[name] for name in _FILTERS)
        if wanted == self._settings:
            return
        self._settings = wanted
        self.set_sinc_length(sinc_length)
        fir, acceleration, rate = wanted[1:]
        period_s = sinc_length / BASE_SAMPLING_RATE_HZ
        self._load_filter = LoadFilter(self.load, self._load_noise, period_s, fir=bool(fir))
        self._acceleration_filter = imu_filter(ACCELERATION_FILTERS[acceleration])
        self._rate_filter = imu_filter(ANGULAR_RATE_FILTERS[rate])

    def specific_force(self, seconds: float) -> Vector:
        """m/s²."""
        ax = ay = az = 0.0
        if self._motion is sway:
            ax, ay, az = (a * math.sin(w * seconds) for a, w in _SHAKE)
        return to_sensor(self._motion(seconds)[0], (ax, ay, az + STANDARD_GRAVITY))

    def load(self, seconds: float) -> tuple[float, ...]:
        """Force (N) and torque (Nm) of tool and contact."""
        fx, fy, fz = self.specific_force(seconds)
        weight = (-TOOL_MASS * fx, -TOOL_MASS * fy, -TOOL_MASS * fz)
        load = (*weight, *cross(TOOL_CENTRE, weight))
        if self._motion is not sway or not any(contact := contact_force(seconds)):
            return load
        return tuple(map(operator.add, load, (*contact, *cross(CONTACT_POINT, contact))))

    def rate(self, seconds: float) -> Vector:
        """Angular rate, rad/s."""
        return angular_rate(*self._motion(seconds))

    def _load_noise(self) -> list[float]:
        return [self._gauss(0.0, deviation) if self._noise else 0.0 for deviation in self.deviations]

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `Formula`."""
        if self._load_filter is None:
            load = tuple(map(operator.add, self.load(seconds), self._load_noise()))
        else:
            load = self._load_filter.at(number, seconds)
        force = filtered(self.specific_force, self._acceleration_filter, seconds)
        rate = filtered(self.rate, self._rate_filter, seconds)
        values = [*load, *(a / STANDARD_GRAVITY for a in force), *map(math.degrees, rate)]
        if self._noise:
            for axis in range(6, 9):
                values[axis] += self._gauss(0.0, _ACCELERATION_NOISE)
                values[axis + 3] += self._gauss(0.0, _ANGULAR_RATE_NOISE)
        # The temperature drifts by 2 °C about 35 °C in ten minutes.
        temperature = 35.0 + 2.0 * math.sin(math.tau * seconds / 600.0)
        return reading_of(values, temperature, quaternion(self._motion(seconds)[0]))


def reading_of(values: Sequence[float], temperature: float, orientation: tuple[float, ...]) -> Reading:
    """A reading from force, torque, acceleration and angular rate one after another."""
    return Reading(tuple(values[:6]), tuple(values[6:9]), tuple(values[9:12]), temperature, orientation)
