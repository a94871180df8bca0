"""An arm in motion as sensor and IMU feel it, with nothing touching the tool: rigid-body motion, seeded.

Independent of the virtual sensor and of the equations: position and attitude are functions of time, and what
is felt follows from them by differences on a grid that is fine enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.sensor.response import (
    FIR_TAPS,
    SINC_ORDER,
    acceleration_response,
    angular_rate_response,
    fir_taps,
)
from bota_ethercat.settings import SettingValue
from bota_ft_compensation.alignment import Alignment
from bota_ft_compensation.compensator import Compensator
from bota_ft_compensation.quantities import (
    EXACT,
    NO_WRENCH,
    OFFSET_PRIOR,
    SCALE_PRIOR,
    Accelerometer,
    Payload,
    Wrench,
)
from bota_ft_compensation.specific_force import ImuSpecificForce

Array = NDArray[np.float64]
# Times (n,), s, to position (n, 3), m, and three angles (n, 3), rad.
Path = Callable[[Array], tuple[Array, Array]]
GRAVITY: Final = np.array((0.0, 0.0, -STANDARD_GRAVITY))
IMU: Final[Vector3] = (0.0, 0.0, -0.0257)  # where a SensONE has it
_GRID_HZ: Final = 6400.0


class Imperfection(NamedTuple):
    """Of the IMU."""

    acceleration_noise: float = 0.02  # m/s²
    rate_noise: float = 0.0017  # rad/s
    rate_offset: float = 0.02  # rad/s, on each axis
    acceleration_offset: Vector3 = (0.0, 0.0, 0.0)  # m/s²
    scale: Vector3 = (1.0, 1.0, 1.0)
    cross_axis: tuple[float, ...] = (0.0,) * 6  # what is to be subtracted: xy xz yx yz zx zy
    gyroscope: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)  # reads so, row by row
    turned: Vector3 = (0.0, 0.0, 0.0)  # rad: the chip, against the wrench
    moved: Vector3 = (0.0, 0.0, 0.0)  # m: off its place

    @property
    def known(self) -> Accelerometer:
        """As a perfect identification finds it."""
        nothing = (1e-6,) * 3
        x, y, u, v, w, z = self.cross_axis
        return Accelerometer(
            self.acceleration_offset, self.scale, nothing, nothing, (x, y, u, v, w, z), nothing + nothing
        )


def imperfect(seed: int) -> Imperfection:
    """A healthy one: offsets as of any accelerometer, 0.5 % of scale and of each other axis."""
    draw = np.random.default_rng(seed)
    x, y, z = draw.normal(0.0, OFFSET_PRIOR, 3).tolist()
    a, b, c = (1.0 + SCALE_PRIOR * draw.normal(size=3)).tolist()
    crossed = tuple((SCALE_PRIOR * draw.normal(size=6)).tolist())
    return Imperfection(acceleration_offset=(x, y, z), scale=(a, b, c), cross_axis=crossed)


def tool_of(seed: int, mass: float = 1.5) -> Payload:
    """Eight lumps in a box of 8 to 24 cm, somewhere before the sensor."""
    draw = np.random.default_rng([seed, 3])
    at, lumps = draw.uniform(0.0, 2.0 * np.pi), draw.dirichlet(np.full(8, 3.0)) * mass
    places = draw.uniform(-1.0, 1.0, size=(8, 3)) * draw.uniform(0.04, 0.12, size=3)
    places -= lumps @ places / mass
    second = (places.T * lumps) @ places
    j = np.trace(second) * np.eye(3) - second
    center = 0.06 * math.cos(at), 0.06 * math.sin(at), draw.uniform(0.02, 0.05)
    return Payload(mass, center, (j[0, 0], j[1, 1], j[2, 2], j[0, 1], j[0, 2], j[1, 2]))


class Felt(NamedTuple):
    times: Array  # (n,) s
    force: Array  # (n, 3) N
    torque: Array  # (n, 3) Nm, about the wrench origin
    acceleration: Array  # (n, 3) m/s²
    rate: Array  # (n, 3) rad/s


HEALTHY: Final = Imperfection()
PERFECT: Final = Imperfection(0.0, 0.0, 0.0)


def feel(
    path: Path,
    tool: Payload,
    seconds: float,
    rate_hz: float = 800.0,
    *,
    seed: int = 0,
    imu: Imperfection = HEALTHY,
) -> Felt:
    """The samples of `path` with the wrench's origin on it."""
    finer = _finer(rate_hz)
    samples = len(np.arange(0.0, seconds, 1.0 / rate_hz))
    truth = _truth(path, tool, 0.0, (samples - 1) * finer + 1, 1.0 / finer / rate_hz, imu.moved)
    return _read(Felt(*(part[::finer] for part in truth)), imu, seed)


def filtered(
    path: Path,
    tool: Payload,
    seconds: float,
    settings: Mapping[str, SettingValue],
    *,
    seed: int = 0,
    imu: Imperfection = HEALTHY,
) -> Felt:
    """The same as a sensor with these settings gives it.

    Force and torque go through the filters, on a grid that is finer than the samples; the IMU's only delay.
    """
    rate_hz = 51200 / settings["sinc_length"]
    finer = _finer(rate_hz)
    times: Array = np.arange(0.0, seconds, 1.0 / rate_hz)
    step_s, full = 1.0 / finer / rate_hz, SINC_ORDER + FIR_TAPS  # samples until the filters are full
    early_s = SINC_ORDER / 2 * step_s  # by which averages over steps are early
    begin_s, count = -full / rate_hz - early_s, (full + len(times)) * finer
    truth = _truth(path, tool, begin_s, count, step_s, imu.moved)
    sinc = np.ones(1)
    for _ in range(SINC_ORDER):
        sinc = np.convolve(sinc, np.full(finer, 1 / finer))
    second = np.array(fir_taps()) if settings["fir"] else np.ones(1)

    def passed(column: Array) -> Array:
        found: Array = np.convolve(np.convolve(column, sinc)[:count:finer], second)
        return found[full : full + len(times)]

    force, torque = (np.stack(list(map(passed, part.T)), axis=1) for part in (truth.force, truth.torque))
    late = [response(settings).delay_s or 0.0 for response in (acceleration_response, angular_rate_response)]
    acceleration, rate = (
        np.stack([np.interp(times - by_s, truth.times, column) for column in part.T], axis=1)
        for by_s, part in zip(late, (truth.acceleration, truth.rate), strict=True)
    )
    return _read(Felt(times, force, torque, acceleration, rate), imu, seed)


def _finer(rate_hz: float) -> int:
    return max(1, round(_GRID_HZ / rate_hz))


def _truth(path: Path, tool: Payload, begin_s: float, count: int, step_s: float, moved_by: Vector3) -> Felt:
    """As a perfect IMU so far from its place feels it, at instants `step_s` apart."""
    times = begin_s + step_s * np.arange(-2, count + 2, dtype=np.float64)
    positions, angles = path(times)
    turned = rotations(angles)  # sensor to world
    rates = _rate(turned[:-2], turned[2:], step_s)
    rate, spin = rates[1:-1], (rates[2:] - rates[:-2]) / (2 * step_s)
    moved = (positions[3:-1] - 2 * positions[2:-2] + positions[1:-3]) / step_s**2
    origin = np.einsum("nji,nj->ni", turned[2:-2], moved - GRAVITY)

    def at(place: Vector3) -> Array:
        d = np.array(place)
        found: Array = origin + np.cross(spin, d) + np.cross(rate, np.cross(rate, d))
        return found

    force = -tool.mass * at(tool.center)
    inertia = tensor(tool.inertia)
    torque = np.cross(tool.center, force) - spin @ inertia - np.cross(rate, rate @ inertia)
    x, y, z = np.add(IMU, moved_by).tolist()
    return Felt(times[2:-2], force, torque, at((x, y, z)), rate)


def _read(felt: Felt, imu: Imperfection, seed: int) -> Felt:
    """As this IMU reads it."""
    draw, shape = np.random.default_rng(seed), felt.rate.shape
    crossed = np.eye(3)
    crossed[~np.eye(3, dtype=bool)] = -np.array(imu.cross_axis)
    chip = rotations(np.array(imu.turned[::-1]))  # z, y, x
    acceleration = felt.acceleration @ chip @ np.linalg.inv(crossed).T * imu.scale + imu.acceleration_offset
    acceleration += draw.normal(scale=imu.acceleration_noise, size=shape)
    rate = felt.rate @ chip @ np.reshape(imu.gyroscope, (3, 3)).T + imu.rate_offset
    rate += draw.normal(scale=imu.rate_noise, size=shape)
    return felt._replace(acceleration=acceleration, rate=rate)


def noise_like(settings: Mapping[str, SettingValue], shape: tuple[int, int], seed: Any) -> Array:
    """White noise through the filters of force and torque, of deviation 1 in every column."""
    # Behind a third-order sinc filter neighbors are correlated as 66, 26 and 1: so are sums with these taps.
    sinc, fir = np.convolve((1.0, 0.4305753), (1.0, 0.0430963)), fir_taps() if settings["fir"] else (1.0,)
    taps = np.convolve(sinc, fir)
    white = np.random.default_rng(seed).normal(size=(shape[0] + len(taps) - 1, shape[1]))
    passed = [np.convolve(column, taps / np.linalg.norm(taps), "valid") for column in white.T]
    return np.stack(passed, axis=1)


def later(path: Path, by_s: float) -> Path:
    return lambda t: path(t - by_s)


def settings(sinc_length: int = 64, fir: bool = False, **others: SettingValue) -> dict[str, SettingValue]:
    return {
        "sinc_length": sinc_length,
        "fir": fir,
        "acceleration_filter": 1,
        "angular_rate_filter": 3,
        "acceleration_range_g": 2,
        "angular_rate_range_dps": 250,
        **others,
    }


class Left(NamedTuple):
    times: Array  # (n,) s
    force: Array  # (n, 3) N
    torque: Array  # (n, 3) Nm
    turning: Array  # (2 or 4, 3, n)
    felt: Array  # (n, 3) m/s²: specific force at the center of gravity

    @property
    def size(self) -> Array:
        return np.asarray(np.linalg.norm(self.force, axis=1))

    @property
    def rms(self) -> float:
        return math.sqrt(float((self.size**2).mean()))

    def percentile(self, share: float) -> float:
        return float(np.quantile(self.size, share))


def left_over(
    felt: Felt,
    tool: Payload,
    alignment: Alignment | None = None,
    accelerometer: Accelerometer = EXACT,
    settling_s: float = -math.inf,
    bias: Wrench = NO_WRENCH,
) -> Left:
    """Of these samples, with no contact; samples that are withheld are missing."""
    x, y, z = (center - imu for center, imu in zip(tool.center, IMU, strict=True))
    imu, compensator = ImuSpecificForce((x, y, z), accelerometer, alignment), Compensator(tool, bias)
    specific, turning = cast(Any, imu.follow_all(np.hstack([felt.acceleration, felt.rate]), felt.times))
    final = compensator.compensate(cast(Any, felt.force.T), cast(Any, felt.torque.T), specific, turning).final
    kept = np.isfinite(specific[0]) & (felt.times >= settling_s)
    rows = np.vstack([felt.times, *final, specific])[:, kept]
    return Left(rows[0], rows[1:4].T, rows[4:7].T, turning[..., kept], rows[7:].T)


def tensor(inertia: tuple[float, ...] | Array) -> Array:
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def rotations(angles: Array) -> Array:
    (cz, cy, cx), (sz, sy, sx) = np.moveaxis(np.cos(angles), -1, 0), np.moveaxis(np.sin(angles), -1, 0)
    rows = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _rate(before: Array, after: Array, step_s: float) -> Array:
    """(n, 3), rad/s in the sensor's frame, in the middle of two attitudes two steps apart."""
    turn = np.einsum("nji,njk->nik", before, after)
    x, y, z = turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]
    return np.stack([x, y, z], axis=-1) / (4 * step_s)


# -- what arms do


def waypoints(move_s: float, rest_s: float, seed: int, *, metres: float = 0.25, radians: float = 1.0) -> Path:
    """From one random pose to the next with the least jerk, and rests between."""
    draw = np.random.default_rng(seed)
    poses = draw.uniform(-1, 1, size=(64, 6)) * ([0.5 * metres] * 3 + [0.5 * radians] * 3)

    def path(t: Array) -> tuple[Array, Array]:
        number, within = np.divmod(np.maximum(t, 0.0), move_s + rest_s)
        share = np.clip((within - rest_s) / move_s, 0.0, 1.0)[:, None]
        smooth = share**3 * (10 - 15 * share + 6 * share**2)
        which = number.astype(int) % (len(poses) - 1)
        found = poses[which] + smooth * (poses[which + 1] - poses[which])
        return found[:, :3], found[:, 3:]

    return path


def guided(
    seed: int, *, metres: float = 0.06, radians: float = 0.4, hertz: tuple[float, float] = (0.2, 1.5)
) -> Path:
    draw = np.random.default_rng(seed)
    frequencies, phases = draw.uniform(*hertz, size=(4, 6)), draw.uniform(0, 2 * np.pi, size=(4, 6))
    sizes = np.array([metres] * 3 + [radians] * 3) / 4

    def path(t: Array) -> tuple[Array, Array]:
        found = (sizes * np.sin(2 * np.pi * frequencies * t[:, None, None] + phases)).sum(axis=1)
        return found[:, :3], found[:, 3:]

    return path


def turned(seed: int, *, rate: float = 3.0, spin: float = 20.0) -> Path:
    """A wrist that turns about all axes, at up to about `rate`, rad/s, and `spin`, rad/s²."""
    hertz = spin / rate / (2 * np.pi)
    return guided(seed, metres=0.05, radians=rate * rate / spin, hertz=(0.6 * hertz, 1.1 * hertz))


def together(*paths: Path) -> Path:
    def path(t: Array) -> tuple[Array, Array]:
        each = [one(t) for one in paths]
        return sum(place for place, _ in each), sum(angles for _, angles in each)  # type: ignore[return-value]

    return path


def shaken(hertz: float, acceleration: float = 2.0) -> Path:
    size = acceleration / (2 * np.pi * hertz) ** 2

    def path(t: Array) -> tuple[Array, Array]:
        found = np.zeros((len(t), 3))
        found[:, 0] = size * np.sin(2 * np.pi * hertz * t)
        return found, np.zeros_like(found)

    return path


def driven(acceleration: float = 0.5, seconds: float = 3.0) -> Path:
    corners = np.arange(0.0, 60.0, seconds)

    def path(t: Array) -> tuple[Array, Array]:
        x = np.zeros_like(t)
        place = v = 0.0
        for number, (begin, end) in enumerate(pairwise(corners)):
            a = acceleration if number % 4 in {0, 3} else -acceleration
            inside = (t >= begin) & (t < end)
            dt = t[inside] - begin
            x[inside] = place + v * dt + 0.5 * a * dt**2
            place, v = place + v * seconds + 0.5 * a * seconds**2, v + a * seconds
        return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1), np.zeros((len(t), 3))

    return path


def moves(seed: int) -> dict[str, Path]:
    circle = guided(seed + 4, metres=0.05, radians=0.2, hertz=(1.5, 2.5))
    return {
        "pick and place": waypoints(0.6, 1.0, seed),
        "fast": waypoints(0.4, 0.1, seed + 1),
        "hand-guiding": guided(seed + 2),
        "polishing": circle,
        "mobile base": together(driven(), waypoints(0.6, 0.3, seed + 3)),
        "vibration": together(shaken(31.0), guided(seed + 5)),
    }
